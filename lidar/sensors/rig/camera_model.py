"""Camera models: the ray of each pixel, and the pixel of each point."""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geoscene.typing import Float
from lidar.sensors.rig.specs import CameraSpec

_STEPS = 30
_TOLERANCE = 1e-12


def intrinsic_matrix(camera: CameraSpec) -> Float:
    """K (3, 3), which maps normalised image coordinates (x, y, 1) to pixels (u, v, 1)."""
    return np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])


def exposure_times(camera: CameraSpec, start_ns: int, *, samples: int = 1) -> NDArray[np.int64]:
    """Times at which poses are needed of one frame: ``samples`` over the exposure.

    Each sample is one time, or, for a rolling shutter, one for each row from the top.
    """
    within = (2 * np.arange(samples) + 1) * camera.exposure_ns // (2 * samples)
    rows = np.arange(camera.height) * camera.row_ns if camera.row_ns else np.zeros(1, np.int64)
    return (start_ns + within[:, None] + rows[None]).ravel().astype(np.int64)


@functools.lru_cache(maxsize=16)  # the cameras of a rig
def pixel_rays(camera: CameraSpec) -> Float:
    """Unit directions (height * width, 3) of the pixels' centres, row by row, in the camera frame.

    NaN for pixels without a ray: outside a fisheye's image circle, or where the distortion is not one to one.
    The array is read-only and shared between calls.
    """
    row, column = np.indices((camera.height, camera.width))
    directions = unproject(camera, np.stack([column.ravel(), row.ravel()], axis=1))
    directions.flags.writeable = False
    return directions


def unproject(camera: CameraSpec, pixels: ArrayLike) -> Float:
    """Unit directions (n, 3) of pixels (n, 2) in the camera frame; NaN for pixels without a ray."""
    uv = np.asarray(pixels, float)
    distorted = (uv - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    if camera.model == "fisheye":
        return _fisheye_rays(distorted, camera.distortion)
    return _rays(distorted, camera.distortion)


def project(camera: CameraSpec, points: ArrayLike) -> tuple[Float, Float]:
    """Pixels (n, 2) at which points (n, 3) of the camera frame appear, and their depth z (n,), metres.

    NaN for points that are not imaged: behind a pinhole camera, or beyond the field in which the distortion
    is one to one. Pixels may lie outside the image; the centre of its top-left pixel is (0, 0).
    """
    p = np.asarray(points, float)
    distorted = (
        _fisheye_distort(p, camera.distortion)
        if camera.model == "fisheye"
        else _distort(p, camera.distortion)
    )
    return distorted * [camera.fx, camera.fy] + [camera.cx, camera.cy], p[:, 2]


# Pinhole with the distortion of Brown (Photogrammetric Engineering 32, 1966) in the form of OpenCV.


def _distortion(x: Float, y: Float, *, k: tuple[float, ...]) -> tuple[Float, Float, Float, Float, Float]:
    """Distorted x and y of normalised coordinates, and the elements xx, xy and yy of the Jacobian."""
    k1, k2, p1, p2, k3 = k
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3))
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    xx = radial + x * x * slope + 2 * p1 * y + 6 * p2 * x
    xy = x * y * slope + 2 * p1 * x + 2 * p2 * y
    yy = radial + y * y * slope + 6 * p1 * y + 2 * p2 * x
    return xd, yd, xx, xy, yy


def _squared_limit(k: tuple[float, ...]) -> float:
    """Squared radius up to which the radial distortion increases; inf without a limit."""
    k1, k2, _, _, k3 = k
    return _first_root(7 * k3, 5 * k2, 3 * k1, 1.0)


def _first_root(*coefficients: float) -> float:
    """Least positive root of a polynomial, highest power first; inf if there is none."""
    # Coefficients too small to matter within any field of view would overflow the companion matrix.
    roots = np.roots([c if abs(c) > 1e-15 else 0.0 for c in coefficients])
    real = roots[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)].real
    return float(real.min()) if len(real) else float("inf")


def _radial(t: Float, k: tuple[float, ...]) -> tuple[Float, Float]:
    """Distorted radius t (1 + k1 t^2 + k2 t^4 + ...) and its derivative, at radii or angles t."""
    powers = range(len(k), 0, -1)
    value = np.polyval([*(k[i - 1] for i in powers), 1.0], t * t)
    slope = np.polyval([*((2 * i + 1) * k[i - 1] for i in powers), 1.0], t * t)
    return np.asarray(t * value, float), np.asarray(slope, float)


def _undistorted_radius(radius: Float, k: tuple[float, ...], *, limit: float) -> Float:
    """Undistorted radii below a limit of distorted ones; the limit for those beyond its range."""
    low, high = np.zeros_like(radius), np.full_like(radius, limit)
    if np.isinf(limit):
        high = np.maximum(radius, 1.0)
        while (short := _radial(high, k)[0] < radius).any():
            high = np.where(short, 2 * high, high)
    edge, _ = _radial(high, k)
    # The distorted radius increases from 0 to the edge, so the root is bracketed: take Newton's step, or
    # bisect where the step leaves the bracket.
    t = np.minimum(radius, 0.5 * high)
    for _ in range(60):
        value, slope = _radial(t, k)
        low, high = np.where(value < radius, t, low), np.where(value < radius, high, t)
        step = (value - radius) / np.where(slope > 1e-6, slope, 1e-6)
        newton = t - step
        t = np.where((newton >= low) & (newton <= high), newton, 0.5 * (low + high))
        if np.abs(step[radius < edge]).max(initial=0.0) < _TOLERANCE:
            break
    return t


def _distort(points: Float, k: tuple[float, ...]) -> Float:
    z = np.where(points[:, 2] > 0, points[:, 2], np.nan)
    x, y = points[:, 0] / z, points[:, 1] / z
    if not any(k):
        return np.stack([x, y], axis=1)
    with np.errstate(invalid="ignore", over="ignore"):
        xd, yd, xx, xy, yy = _distortion(x, y, k=k)
        seen = (x * x + y * y < _squared_limit(k)) & (xx * yy - xy * xy > 0) & (xx > 0)
    return np.where(seen[:, None], np.stack([xd, yd], axis=1), np.nan)


def _rays(distorted: Float, k: tuple[float, ...]) -> Float:
    """Unit directions of distorted coordinates (n, 2), by Newton's method."""
    x, y = distorted.T.copy()
    if any(k):
        x, y = _undistort(distorted, k)
    rays = np.stack([x, y, np.ones_like(x)], axis=1)
    unit: Float = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    return unit


def _undistort(distorted: Float, k: tuple[float, ...]) -> tuple[Float, Float]:
    xd, yd = distorted.T
    x, y = xd.copy(), yd.copy()
    limit = _squared_limit(k)
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        # Without a start near the root, here that of the radial part, Newton's method may diverge.
        radius = np.hypot(xd, yd)
        start = _undistorted_radius(radius, (k[0], k[1], k[4]), limit=np.sqrt(limit))
        shrink = np.minimum(start, 0.999 * np.sqrt(limit)) / np.where(radius > 0, radius, 1.0)
        x *= shrink
        y *= shrink
        for _ in range(_STEPS):
            fx, fy, xx, xy, yy = _distortion(x, y, k=k)
            ex, ey = fx - xd, fy - yd
            det = xx * yy - xy * xy
            dx, dy = (yy * ex - xy * ey) / det, (xx * ey - xy * ex) / det
            x -= dx
            y -= dy
            if np.nanmax(np.abs(dx) + np.abs(dy), initial=0.0) < _TOLERANCE:
                break
        fx, fy, xx, xy, yy = _distortion(x, y, k=k)
        found = (np.hypot(fx - xd, fy - yd) < 1e-9) & (x * x + y * y < limit)
        found &= (xx * yy - xy * xy > 0) & (xx > 0)
    return np.where(found, x, np.nan), np.where(found, y, np.nan)


# Fisheye: Kannala and Brandt (IEEE PAMI 28, 2006) in the form of OpenCV; equidistant if all are zero.


def _fisheye_limit(k: tuple[float, ...]) -> float:
    """Angle from the optical axis up to which the distorted angle increases, at most pi."""
    k1, k2, k3, k4 = k
    return float(min(np.pi, np.sqrt(_first_root(9 * k4, 7 * k3, 5 * k2, 3 * k1, 1.0))))


def _fisheye_distort(points: Float, k: tuple[float, ...]) -> Float:
    flat = np.hypot(points[:, 0], points[:, 1])
    theta = np.arctan2(flat, points[:, 2])
    radius, _ = _radial(theta, k)
    seen = (theta < _fisheye_limit(k)) & ((flat > 0) | (points[:, 2] > 0))
    factor = np.where(seen, radius / np.where(flat > 0, flat, 1.0), np.nan)
    return points[:, :2] * factor[:, None]


def _fisheye_rays(distorted: Float, k: tuple[float, ...]) -> Float:
    radius = np.hypot(distorted[:, 0], distorted[:, 1])
    limit = _fisheye_limit(k)
    edge, _ = _radial(np.array(limit), k)
    theta = _undistorted_radius(radius, k, limit=limit)
    scale = np.where(radius < edge, np.sin(theta) / np.where(radius > 0, radius, 1.0), np.nan)
    z = np.where(radius < edge, np.cos(theta), np.nan)
    return np.concatenate([distorted * scale[:, None], z[:, None]], axis=1)
