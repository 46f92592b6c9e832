"""Vehicles with ray-cast sensors driven through a geoscene scene."""

from __future__ import annotations

from typing import TYPE_CHECKING

from geoscene import __version__ as __version__
from geoscene.support.registry import lazily, register_previews

if TYPE_CHECKING:
    from lidar.dataset.formats import read_cloud as read_cloud
    from lidar.dataset.layout import Dataset as Dataset
    from lidar.dataset.layout import open_dataset as open_dataset
    from lidar.options.drive import DriveOptions as DriveOptions
    from lidar.options.maps import MapOptions as MapOptions
    from lidar.sensors.rig.scanner import load_sensor as load_sensor
    from lidar.sensors.rig.specs import load_rig as load_rig
    from lidar.signal.registry import read_attacks as read_attacks
    from lidar.signal.registry import read_stages as read_stages
    from lidar.signal.weather.setting import read_weather as read_weather
    from lidar.simulation.drive import drive as drive
    from lidar.simulation.frames import DriveFrame as DriveFrame
    from lidar.simulation.frames import Simulation as Simulation
    from lidar.simulation.frames import simulate as simulate
    from lidar.tools.convert import convert as convert
    from lidar.tools.maps.aggregate import aggregate as aggregate
    from lidar.tools.training_data import TrainingData as TrainingData
    from lidar.tools.training_data import training_data as training_data
    from lidar.traffic.options import TrafficOptions as TrafficOptions

_HOMES = {
    "Dataset": "dataset.layout",
    "DriveFrame": "simulation.frames",
    "DriveOptions": "options.drive",
    "MapOptions": "options.maps",
    "Simulation": "simulation.frames",
    "TrafficOptions": "traffic.options",
    "TrainingData": "tools.training_data",
    "aggregate": "tools.maps.aggregate",
    "convert": "tools.convert",
    "drive": "simulation.drive",
    "load_rig": "sensors.rig.specs",
    "load_sensor": "sensors.rig.scanner",
    "open_dataset": "dataset.layout",
    "read_attacks": "signal.registry",
    "read_cloud": "dataset.formats",
    "read_stages": "signal.registry",
    "read_weather": "signal.weather.setting",
    "simulate": "simulation.frames",
    "training_data": "tools.training_data",
}
__all__ = list(_HOMES)


__getattr__ = lazily(__name__, _HOMES)

register_previews(
    {
        "lidar.dataset.layout.Dataset": "lidar.dataset.preview",
        "lidar.sensors.laser.cloud.Cloud": "lidar.sensors.laser.preview",
    }
)
