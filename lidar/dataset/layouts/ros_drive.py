"""Frames, names and time stamps shared by all topics of a drive in a ROS 2 recording.

Frames: ``map`` (REP 105: true metres from the scene's origin, x east, y north, z up), ``base_link`` (the
vehicle) and one of each sensor's name; a camera has ``<name>`` with the axes of a body (x forward, y left,
z up) and ``<name>_optical`` (REP 103: x right, y down, z forward), in which its images are.
"""

from __future__ import annotations

import functools
import logging
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from geoscene.errors import GeosceneError
from geoscene.typing import Float
from lidar.dataset.layout import Dataset, reading_file
from lidar.errors import DatasetError, LidarError
from lidar.geometry.poses import Trajectory
from lidar.geometry.time_scales import posix_ns
from lidar.sensors.rig.specs import Rig, rig_of

log = logging.getLogger(__name__)

MAP, BASE = "map", "base_link"
"""Frames of the scene and of the vehicle (REP 105)."""

_TAKEN = {MAP, BASE, "tf", "tf_static", "ground_truth"}
"""Names that are not free for sensors."""

Message = tuple[int, Callable[[], Any]]
"""When a message is complete, nanoseconds since the drive's start, and what makes it."""


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic.

    kind     : message type
    messages : in order of time; each is made when it is its turn
    count    : number of messages
    latched  : whether late subscribers get the last message, too
    counted  : what the messages are, for the summary; empty for those that are not counted
    """

    name: str
    kind: str
    messages: Iterator[Message]
    count: int
    latched: bool = False
    counted: str = ""


@dataclass(frozen=True)
class RosDrive:
    """A drive and what all of its topics share."""

    dataset: Dataset

    @functools.cached_property
    def base_ns(self) -> int:
        """The drive's start, nanoseconds since 1970."""
        return posix_ns(self.dataset.start)

    @functools.cached_property
    def trajectory(self) -> Trajectory:
        """The ego vehicle's poses."""
        return self.dataset.trajectory()

    @property
    def scale(self) -> Float:
        """Scene metres per true metre (3,)."""
        return np.array([self.trajectory.scale[0], self.trajectory.scale[0], 1.0])

    @functools.cached_property
    def sensors(self) -> dict[str, dict[str, Any]]:
        """Entries of ``calibration.json`` by the sensors' names."""
        return self.dataset.sensors()

    @functools.cached_property
    def names(self) -> dict[str, str]:
        """Names of the sensors' frames and topics, by the sensors' own names.

        Raises DatasetError for sensors without distinct names.
        """
        names = {name: ros_name(name) for name in self.sensors}
        frames = [f"{names[k]}_optical" for k, s in self.sensors.items() if s["kind"] == "camera"]
        used = [*names.values(), *frames, *_TAKEN]
        if twice := sorted({name for name in used if used.count(name) > 1}):
            raise DatasetError(
                f"{self.dataset.paths.calibration}: {', '.join(twice)}: frames of ROS need distinct names;"
                " rename sensors in the rig and drive again"
            )
        return names

    @functools.cached_property
    def rig(self) -> Rig | None:
        """The rig, if its files are as they were for the drive."""
        try:
            with reading_file(self.dataset.paths.manifest):
                return rig_of(str(self.dataset.manifest["recipe"]["rig"]))
        except (GeosceneError, LidarError) as error:
            log.warning("no laser scans of 2D scanners and no covariances of inertial units: %s", error)
            return None

    def stamp(self, time_ns: int) -> int:
        """Nanoseconds since 1970 of a time since the drive's start."""
        return self.base_ns + int(time_ns)


def ros_name(name: str) -> str:
    """A sensor's name as a token of a ROS 2 topic: letters, digits and single underscores, no digit first."""
    token = re.sub(r"[-_]+", "_", name)
    return f"sensor_{token}" if token[:1].isdigit() else token
