"""Vehicles with ray-cast sensors driven through a geoscene scene."""

from __future__ import annotations

from typing import TYPE_CHECKING

from geoscene import __version__ as __version__
from geoscene.support.lazy import lazily

if TYPE_CHECKING:
    from lidar.conversion import convert as convert
    from lidar.dataset.formats import read_cloud as read_cloud
    from lidar.dataset.layout import Dataset as Dataset
    from lidar.dataset.layout import open_dataset as open_dataset
    from lidar.maps.aggregate import aggregate as aggregate
    from lidar.options import DriveOptions as DriveOptions
    from lidar.options import MapOptions as MapOptions
    from lidar.pipeline import drive as drive
    from lidar.rig.scanner import load_sensor as load_sensor
    from lidar.rig.specs import load_rig as load_rig
    from lidar.signal.registry import read_attacks as read_attacks
    from lidar.signal.registry import read_stages as read_stages
    from lidar.simulation import DriveFrame as DriveFrame
    from lidar.simulation import Simulation as Simulation
    from lidar.simulation import simulate as simulate
    from lidar.traffic.populate import TrafficOptions as TrafficOptions
    from lidar.training import TrainingData as TrainingData
    from lidar.training import training_data as training_data
    from lidar.weather.setting import read_weather as read_weather

_HOMES = {
    "Dataset": "dataset.layout",
    "DriveFrame": "simulation",
    "DriveOptions": "options",
    "MapOptions": "options",
    "Simulation": "simulation",
    "TrafficOptions": "traffic.populate",
    "TrainingData": "training",
    "aggregate": "maps.aggregate",
    "convert": "conversion",
    "drive": "pipeline",
    "load_rig": "rig.specs",
    "load_sensor": "rig.scanner",
    "open_dataset": "dataset.layout",
    "read_attacks": "signal.registry",
    "read_cloud": "dataset.formats",
    "read_stages": "signal.registry",
    "read_weather": "weather.setting",
    "simulate": "simulation",
    "training_data": "training",
}
__all__ = list(_HOMES)


__getattr__ = lazily(__name__, _HOMES)
