"""Scanners and cameras of a rig, ready to work: when their frames start, how many there are."""

from __future__ import annotations

from dataclasses import dataclass

from lidar.rig.patterns.beams import frame_ns
from lidar.rig.scanner import Sensor, load_sensor
from lidar.rig.specs import CameraSpec, LidarSpec, Rig


@dataclass(frozen=True, slots=True)
class Scanner:
    """A laser scanner of the rig, ready to fire."""

    spec: LidarSpec
    sensor: Sensor

    @property
    def name(self) -> str:
        """Name on the rig."""
        return self.spec.name

    @property
    def reach(self) -> float:
        """Metres beyond which nothing is seen."""
        return self.sensor.max_range

    @property
    def period_ns(self) -> int:
        """Nanoseconds a frame lasts, rounded down."""
        return int(frame_ns(self.sensor.rate_hz))

    def frame_start_ns(self, frame: int) -> int:
        """Time at which a frame starts, since the drive's start."""
        return self.sensor.frame_start_ns(frame)

    def frame_count(self, duration_ns: int) -> int:
        """Number of frames that end within a drive of that length."""
        return self.sensor.frame_count(duration_ns)


@dataclass(frozen=True, slots=True)
class Camera:
    """A camera of the rig."""

    spec: CameraSpec

    @property
    def name(self) -> str:
        """Name on the rig."""
        return self.spec.name

    @property
    def reach(self) -> float:
        """Metres beyond which nothing is seen."""
        return self.spec.far

    @property
    def period_ns(self) -> int:
        """Nanoseconds from frame to frame, rounded down."""
        return int(frame_ns(self.spec.rate_hz))

    def frame_start_ns(self, frame: int) -> int:
        """Time at which the shutter opens, since the drive's start."""
        return self.spec.time_offset_ns + int(frame * frame_ns(self.spec.rate_hz))

    def frame_count(self, duration_ns: int) -> int:
        """Number of frames whose period ends within a drive of that length, as for scanners."""
        return max(0, int((duration_ns - self.spec.time_offset_ns) // frame_ns(self.spec.rate_hz)))


def scanners(rig: Rig) -> list[Scanner]:
    """The rig's laser scanners with their presets.

    Raises RigError for a preset that is unknown or bad.
    """
    return [
        Scanner(
            s,
            load_sensor(
                s.preset,
                name=s.name,
                rate_hz=s.rate_hz,
                return_mode=s.return_mode,
                start_ns=s.time_offset_ns,
            ),
        )
        for s in rig.lidars
    ]


def cameras(rig: Rig) -> list[Camera]:
    """The rig's cameras."""
    return [Camera(s) for s in rig.cameras]
