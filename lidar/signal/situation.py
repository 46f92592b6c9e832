"""Context of a frame that stages act on (sensor, time, poses, surroundings), and counts of what they do."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime

import numpy as np
from numpy.typing import NDArray

from geoscene.geometry.frames import Frame
from geoscene.typing import Float
from lidar.errors import InputError
from lidar.geometry.poses import Poses
from lidar.sensors.camera.light import Light
from lidar.sensors.laser.cloud import Cloud, TracedCloud
from lidar.sensors.physics.echoes import TracedEchoes
from lidar.sensors.rig.specs import CameraSpec
from lidar.world.world import World

Counts = dict[str, dict[str, int]]
"""Numbers by stage, and by what was added, removed or changed, such as ``returns added``."""


class Effects:
    """Counts of what stages did; several threads may add to them."""

    def __init__(self) -> None:
        self.counts: Counts = {}
        self._lock = threading.Lock()

    def add(self, stage: str, counts: Mapping[str, int]) -> None:
        """Add what a stage did to a frame, or to the measurements of a device."""
        with self._lock:
            own = self.counts.setdefault(stage, {})
            for what, number in counts.items():
                own[what] = own.get(what, 0) + int(number)


def row_changes(
    before: TracedEchoes | TracedCloud,
    after: TracedEchoes | TracedCloud,
    *,
    unit: str,
    columns: Sequence[str],
) -> dict[str, int]:
    """Numbers of rows of a table of ``unit`` that were added, removed, and changed in some columns."""
    known, still = before.source >= 0, after.source >= 0
    most = max(before.source.max(initial=-1), after.source.max(initial=-1)) + 1
    row = np.full(most, -1)
    row[before.source[known]] = np.flatnonzero(known)
    old, new = row[after.source[still]], np.flatnonzero(still)
    differs = np.zeros(len(new), bool)
    for name in columns:
        unequal = getattr(after, name)[new] != getattr(before, name)[old]
        differs |= unequal.any(axis=tuple(range(1, unequal.ndim)))
    gained = int((~still).sum()) - int((~known).sum())  # of what stages have added
    return {
        f"{unit} added": max(gained, 0),
        f"{unit} removed": int(known.sum()) - len(new) + max(-gained, 0),
        f"{unit} changed": int(differs.sum()),
    }


def effect_lines(effects: Counts) -> list[str]:
    """A line for each stage."""
    lines = []
    for stage, counts in effects.items():
        done = ", ".join(f"{number:,} {what}" for what, number in counts.items() if number)
        lines.append(f"stage {stage}: {done or 'changed nothing; check when and where it acts'}")
    return lines


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


def degrees_of(place: str, *, form: str = "LAT,LON,HEIGHT") -> tuple[float, ...]:
    """Latitude, longitude and, by the form, height of a text; raises InputError for others."""
    try:
        found = tuple(float(word) for word in place.replace(",", " ").split())
    except ValueError:
        found = ()
    if len(found) != len(form.split(",")):
        raise InputError(f"place = {place!r} is not {form}")
    if not (abs(found[0]) <= 90 and abs(found[1]) <= 180 and all(abs(height) < 1e4 for height in found[2:])):
        raise InputError(f"place = {place!r} is not {form} in degrees{' and metres' if found[2:] else ''}")
    return found


def point_of(place: str, *, geo: Frame, at: Situation) -> Float:
    """The point (3,) in the scene frame of a place as `degrees_of` reads it, its height above the ground."""
    lat, lon, height = degrees_of(place)
    x, y = (float(axis) for axis in geo.from_geographic(lon, lat))
    return np.array([x, y, height + (0.0 if at.ground is None else at.ground(x, y))])
