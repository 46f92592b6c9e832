"""What stages know of the frames of a dataset."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lidar.dataset.recording import Recording
from lidar.geometry.poses import Poses
from lidar.rig.devices import Camera, Scanner
from lidar.signal.situation import Situation
from lidar.world.world import World


def situation_of(
    recording: Recording, device: Scanner | Camera, *, frame: int, world: World | None = None
) -> Situation:
    """Where and when a sensor takes a frame; ``world`` during it, None for recorded data."""
    mount = device.spec.mount

    def poses(time_ns: NDArray[np.int64]) -> Poses:
        return recording.trajectory.at(time_ns).mounted(mount.translation, mount.rotation)

    start_ns = device.frame_start_ns(frame)
    return Situation(device.name, frame, start_ns, utc=recording.start, poses=poses, world=world)
