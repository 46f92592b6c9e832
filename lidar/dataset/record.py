"""One frame of one sensor: measured in the simulated world and written as files."""

from __future__ import annotations

from lidar.dataset.record_clouds import record_cloud
from lidar.dataset.record_images import record_images
from lidar.dataset.recording import Recording
from lidar.rig.devices import Camera, Scanner
from lidar.world.thread_worlds import Worlds


def record_frame(recording: Recording, sensor: Scanner | Camera, *, frame: int, worlds: Worlds) -> int:
    """Simulate one frame and write its files; return the number of points, 0 for images.

    Several threads may do so at once.
    """
    if isinstance(sensor, Camera):
        record_images(recording, sensor, frame=frame, worlds=worlds)
        return 0
    return record_cloud(recording, sensor, frame=frame, worlds=worlds)
