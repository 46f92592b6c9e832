"""Context of a frame that stages act on: sensor, time, poses, surroundings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime

import numpy as np
from numpy.typing import NDArray

from geoscene.geometry.frames import Frame
from geoscene.typing import Float
from lidar.geometry.poses import Poses
from lidar.sensors.camera.light import Light
from lidar.sensors.laser.cloud import Cloud
from lidar.sensors.rig.specs import CameraSpec
from lidar.signal.effects import Effects
from lidar.world.world import World


@dataclass(frozen=True, slots=True)
class Situation:
    """Context of a sensor's frame: name, time, poses, surroundings, as far as they are known.

    sensor   : its name
    frame    : number of the frame, 0 for a receiver or inertial unit, whose measurements are those of a whole
        drive; of clouds that are not numbered, the file's name without its ending
    start_ns : of the frame, nanoseconds since the drive's start
    utc      : of the drive's start; None for clouds without a dataset
    poses    : of the sensor in the scene frame at times (n,) in nanoseconds since the drive's start; None for
        clouds without a dataset
    clearness : share of the light from elsewhere that reaches the sensor along a pulse (row) from a distance
        in metres, through the stages' weather; None in clear air
    geo      : from degrees to the scene frame; None for clouds without a dataset
    ground   : height of the ground at x and y of the scene frame, same frame; of recorded data whose scene is
        not there that under the vehicle. None for clouds without a dataset
    world    : what rays hit; None for recorded data
    surroundings : the scene around points (k, 3), without road users, of recorded data whose scene is there;
        else None
    seed     : of the drive, for what lasts longer than a frame
    camera   : the camera that takes an image; None of other sensors
    light    : sun and sky of an image; None of other sensors
    earlier  : the cloud of the same scanner a number of frames (1 or more) before, as without stages; None
        before the first frame. On drives it reaches back for the seconds of `Stage.lookback`. None for
        sensors that are not scanners
    effects  : counts what the stages do; None where nobody asks
    """

    sensor: str
    frame: int | str
    start_ns: int = 0
    utc: datetime | None = None
    poses: Callable[[NDArray[np.int64]], Poses] | None = None
    world: World | None = None
    seed: int = 0
    camera: CameraSpec | None = None
    light: Light | None = None
    earlier: Callable[[int], Cloud | None] | None = None
    effects: Effects | None = None
    geo: Frame | None = None
    clearness: Callable[[int, float], float] | None = None
    ground: Callable[[float, float], float] | None = None
    surroundings: Callable[[Float], World] | None = None
