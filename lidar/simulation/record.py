"""One frame of one sensor: measured in the simulated world, and written as files."""

from __future__ import annotations

from lidar.sensors.rig.devices import Camera, Scanner
from lidar.simulation.measured import MeasuredCloud, MeasuredImages
from lidar.simulation.record_clouds import measure_cloud, record_cloud
from lidar.simulation.recording import Recording
from lidar.world.world import Worlds


def record_frame(
    recording: Recording, sensor: Scanner | Camera, *, frame: int, worlds: Worlds
) -> MeasuredCloud | MeasuredImages:
    """Simulate one frame and write its files. Several threads may do so at once."""
    if isinstance(sensor, Camera):
        from lidar.simulation.record_images import record_images  # noqa: PLC0415  (0.1 s)

        return record_images(recording, sensor, frame=frame, worlds=worlds)
    return record_cloud(recording, sensor, frame=frame, worlds=worlds)


def measure_frame(
    recording: Recording, sensor: Scanner | Camera, *, frame: int, worlds: Worlds
) -> MeasuredCloud | MeasuredImages:
    """Simulate one frame as `record_frame` does, without files. Several threads may do so at once."""
    if isinstance(sensor, Camera):
        from lidar.simulation.record_images import measure_images  # noqa: PLC0415  (0.1 s)

        return measure_images(recording, sensor, frame=frame, worlds=worlds)
    return measure_cloud(recording, sensor, frame=frame, worlds=worlds)
