"""Published figures that the software must reproduce: published value, computed value, deviation.

    python benchmarks/anchors.py

The tests contain many more figures than these.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from geoscene.geometry.frames import Frame
from lidar.sensors.physics.reflect import WATER, fresnel
from lidar.sensors.rig.imu_grades import PRESETS
from lidar.sensors.rig.scanner import firings, load_sensor
from lidar.sensors.rig.specs import load_rig

Row = tuple[str, float, float, str, str]
"""Quantity, published value, computed value, unit, source."""

_VLP16 = "Velodyne VLP-16 manual 63-9243"


def _azimuth_deg(direction: np.ndarray) -> np.ndarray:
    """Azimuth clockwise from forward, as in Velodyne's data."""
    turn: np.ndarray = np.degrees(np.arctan2(-direction[:, 1], direction[:, 0])) % 360
    return turn


def scanners() -> Iterator[Row]:
    """Directions, times and footprints."""
    fired = firings(load_sensor("vlp16"), 0)
    lowest = fired.direction[fired.channel == 0]
    yield (
        "VLP-16 azimuth step at 10 Hz",
        0.199066,
        float(np.diff(_azimuth_deg(lowest)[:100]).mean()),
        "deg",
        _VLP16,
    )
    highest = fired.direction[fired.channel == 15]
    yield "VLP-16 height at el -15, R 10", -2.58819, 10 * float(lowest[0, 2]), "m", _VLP16
    yield "VLP-16 plan range at el -15, R 10", 9.65926, 10 * float(np.hypot(*lowest[0, :2])), "m", _VLP16
    yield "VLP-16 height at el 15, R 20", 5.17638, 20 * float(highest[0, 2]), "m", _VLP16
    yield "VLP-16 plan range at el 15, R 20", 19.31852, 20 * float(np.hypot(*highest[0, :2])), "m", _VLP16
    for name, degrees in (("mid40", 19.16), ("mid70", 35.19)):
        sensor = load_sensor(name)
        forward = min(float(firings(sensor, k).direction[:, 0].min()) for k in range(10))
        got = float(np.degrees(np.arccos(forward)))
        yield f"{name} angle off the axis, greatest", degrees, got, "deg", "Livox simulation's prism angles"
    for name, millimetres in (("lms511", 151.0), ("lms511_sr", 343.0)):
        got = 1000 * float(load_sensor(name).footprint(30.0)[0])
        yield f"{name} footprint at 30 m", millimetres, got, "mm", "SICK LMS5xx manual"


def physics() -> Iterator[Row]:
    """Reflection of water; noise of inertial units."""
    s, p = (float(v) for v in fresnel(np.cos(np.radians(60.0)), WATER))
    yield "water at 60 deg, R_s", 0.1137, s, "", "Fresnel's equations, n = 1.33"
    yield "water at 60 deg, R_p", 0.0044, p, "", "Fresnel's equations, n = 1.33"
    unit = PRESETS["adis16448"]
    crossing = float(np.sqrt(3) * unit.gyro_noise / unit.gyro_walk)
    yield "EuRoC gyro, white noise equals random walk", 15.2, crossing, "s", "IEEE Std 952; EuRoC sensor.yaml"


def frames() -> Iterator[Row]:
    """Map projection and camera projections."""
    frame = Frame.at(-76.3059, 36.8853, crs="utm")
    east, north = frame.to_projected(*frame.from_geographic(-76.3059, 36.8853))
    yield "UTM 18N of Norfolk, E", 383629.0124, float(east), "m", "transverse Mercator, WGS 84"
    yield "UTM 18N of Norfolk, N", 4082944.5213, float(north), "m", "transverse Mercator, WGS 84"
    cases = (
        ("kitti", "image_2", (10.0, 0.0, 0.0), (613.964, 175.007), "KITTI calibration 2011_09_26"),
        ("nuscenes", "cam_front", (1.0, 15.0, -0.5), (910.705, 532.505), "nuScenes calibrated_sensor"),
    )
    for rig_name, camera_name, point, pixel, source in cases:
        rig = load_rig(rig_name)
        camera = next(c for c in rig.cameras if c.name == camera_name)
        mount = rig.lidars[0].mount
        on_vehicle = np.array(mount.translation) + mount.rotation @ point
        x, y, z = camera.mount.rotation.T @ (on_vehicle - camera.mount.translation)
        got = (camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy)
        for axis, expected, value in zip("uv", pixel, got, strict=True):
            yield f"{rig_name} {camera_name}, point {point}, {axis}", expected, float(value), "px", source


def main() -> None:
    """Print the table."""
    print("| quantity | published | computed | deviation | unit | source |\n|---|---|---|---|---|---|")
    for rows in (scanners(), physics(), frames()):
        for quantity, expected, got, unit, source in rows:
            print(
                f"| {quantity} | {expected:.10g} | {got:.10g} | {got - expected:+.1g} | {unit} | {source} |"
            )


if __name__ == "__main__":
    main()
