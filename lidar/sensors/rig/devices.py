"""Scanners and cameras of a rig: maximum range, start times and number of frames."""

from __future__ import annotations

from dataclasses import dataclass

from lidar.sensors.rig.patterns.beams import frame_ns
from lidar.sensors.rig.scanner import Sensor, load_sensor
from lidar.sensors.rig.specs import CameraSpec, LidarSpec, Rig


@dataclass(frozen=True, slots=True)
class Scanner:
    """A laser scanner of the rig with its preset."""

    spec: LidarSpec
    sensor: Sensor

    @property
    def name(self) -> str:
        """Name on the rig."""
        return self.spec.name

    @property
    def max_range(self) -> float:
        """Maximum range, metres."""
        return self.sensor.max_range

    @property
    def period_ns(self) -> int:
        """Duration of a frame in nanoseconds, rounded down."""
        return int(frame_ns(self.sensor.rate_hz))

    def frame_start_ns(self, frame: int) -> int:
        """Start of a frame, nanoseconds since the drive's start."""
        return self.sensor.frame_start_ns(frame)

    def frame_count(self, duration_ns: int) -> int:
        """Number of frames that end within a drive of this duration."""
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
    def max_range(self) -> float:
        """Maximum range, metres."""
        return self.spec.far

    @property
    def period_ns(self) -> int:
        """Nanoseconds from frame to frame, rounded down."""
        return int(frame_ns(self.spec.rate_hz))

    def frame_start_ns(self, frame: int) -> int:
        """Time at which the shutter opens, nanoseconds since the drive's start."""
        return self.spec.time_offset_ns + int(frame * frame_ns(self.spec.rate_hz))

    def frame_count(self, duration_ns: int) -> int:
        """Number of frames whose period ends within a drive of this duration."""
        return max(0, int((duration_ns - self.spec.time_offset_ns) // frame_ns(self.spec.rate_hz)))


def scanners(rig: Rig) -> list[Scanner]:
    """The rig's laser scanners with their presets.

    Raises RigError for an unknown or invalid preset.
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
                firing_jitter_ns=s.firing_jitter_ns,
                code_bits=s.code_bits,
            ),
        )
        for s in rig.lidars
    ]


def cameras(rig: Rig) -> list[Camera]:
    """Cameras of the rig, with their intrinsics and mounts."""
    return [Camera(s) for s in rig.cameras]


def sensor_kinds(rig: Rig) -> dict[str, str]:
    """Kind of each sensor of a rig by name: lidar, camera, gnss or imu."""
    return {
        **{spec.name: "lidar" for spec in rig.lidars},
        **{spec.name: "camera" for spec in rig.cameras},
        **{spec.name: "gnss" for spec in rig.gnss},
        **{spec.name: "imu" for spec in rig.imus},
    }
