"""Scanners and cameras of a rig: maximum range, start times and number of frames."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from lidar.sensors.rig.patterns.beams import frame_ns
from lidar.sensors.rig.scanner import Sensor, firings, load_sensor, sensor_names
from lidar.sensors.rig.specs import CameraSpec, LidarSpec, Rig, load_rig, rig_names


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


def sensor_rows() -> list[dict[str, Any]]:
    """One row per preset: name, maker, model, kind, channels, rates, range, wavelength and sources."""
    return [_sensor_row(name, load_sensor(name)) for name in sensor_names()]


def _sensor_row(name: str, sensor: Sensor) -> dict[str, Any]:
    pulses = firings(sensor, 0)
    elevation = np.degrees(np.arcsin(np.clip(pulses.direction[:, 2], -1, 1)))
    return {
        "name": name,
        "maker": sensor.maker,
        "model": sensor.model,
        "kind": sensor.kind,
        "channels": int(pulses.channel.max()) + 1 if sensor.kind == "spinning" else 1,
        "pulses_per_s": round(len(pulses) * sensor.rate_hz),
        "rate_hz": sensor.rate_hz,
        "elevation_deg": [round(float(elevation.min()), 2), round(float(elevation.max()), 2)],
        "min_range_m": sensor.min_range,
        "max_range_m": sensor.max_range,
        "wavelength_nm": sensor.wavelength_nm,
        "echoes": sensor.max_echoes,
        "return_mode": sensor.return_mode,
        "fmcw": sensor.fmcw,
        "note": sensor.note,
        "source": sensor.source,
    }


def rig_rows() -> list[dict[str, Any]]:
    """One row per rig: name, vehicle, sensors and the source of its figures."""
    rows = []
    for name in rig_names():
        rig = load_rig(name)
        rows.append(
            {
                "name": name,
                "vehicle": rig.vehicle,
                "lidars": {s.name: s.preset for s in rig.lidars},
                "cameras": {s.name: f"{s.width}x{s.height}" for s in rig.cameras},
                "gnss": [s.name for s in rig.gnss],
                "imus": [s.name for s in rig.imus],
                "source": rig.source,
            }
        )
    return rows
