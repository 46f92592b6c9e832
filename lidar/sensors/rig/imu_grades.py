"""Noise of inertial measurement units."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Noise:
    """Allan parameters of an inertial measurement unit; units as in `ImuSpec`."""

    gyro_noise: float
    gyro_walk: float
    accel_noise: float
    accel_walk: float
    source: str
    gyro_instability: float = 0.0
    accel_instability: float = 0.0


PRESETS = {
    "adis16448": Noise(1.6968e-4, 1.9393e-5, 2.0e-3, 3.0e-3, "EuRoC data set, sensor.yaml of its ADIS16448"),
    "vn100": Noise(
        6.10866e-5,
        0.0,
        1.372e-3,
        5.0e-5,
        "VectorNav VN-100 data sheet (0.0035 deg/s, 0.14 mg) and its support",
    ),
    "mti-g-700": Noise(1.745e-4, 0.0, 5.88e-4, 0.0, "Xsens MTi-G-700 data sheet (0.01 deg/s, 60 ug)"),
    "tactical": Noise(
        1.75e-5,
        1.71e-7,
        1.0e-3,
        1.56e-5,
        "a NovAtel-class unit: data sheet and Allan variance",
        gyro_instability=2.18e-6,
        accel_instability=7.35e-4,
    ),
}
"""Noise of units by name; 0 for figures that the source does not give."""
