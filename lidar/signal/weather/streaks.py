"""Drops and flakes that fly past a camera while it exposes: streaks on the image."""

# mypy: disallow-untyped-decorators=False
from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoscene.support.compiled import njit
from geoscene.typing import Float
from lidar.sensors.rig.camera_model import project, unproject
from lidar.sensors.rig.specs import CameraSpec

APERTURE = 2.5e-3
"""Diameter of a lens's entrance pupil, metres: 4 to 6 mm of focal length at f/1.8 to f/2.4, typical."""

_NEAR = 0.1  # metres; nearer drops are out of focus over much of the image, and few
_FAINT = 0.008  # share of a pixel, 2 of 255 levels, below which a drop belongs to the air between
_LEFT_OUT = 0.1  # share of the variance of a pixel, of the faintest particles over that
_FARTHEST = 60.0  # metres
_STEPS = 200  # of distance and of its distribution
_INTERVALS = 12  # of distance, over each of which the particles that are drawn are evenly spread


@dataclass(frozen=True, slots=True)
class FallingParticles:
    """Falling drops or flakes, one row for each class of diameter.

    diameter : (k,) metres
    density  : (k,) particles in a cubic metre
    fall     : (k,) m/s
    swing    : standard deviation of the horizontal speed of single particles, m/s
    """

    diameter: Float
    density: Float
    fall: Float
    swing: float = 0.0


def drawn_distances(camera: CameraSpec, particles: FallingParticles, *, exposure: float) -> Float:
    """Depth (k,) in metres up to which particles of each class are drawn one by one.

    Left out are particles that cover less than 2 of 255 levels of a pixel, and of the others the faintest, as
    long as they have less than a tenth of the variance of a pixel of the sky. Nearer surfaces lose less.

    exposure : seconds
    """
    pixels = math.sqrt(camera.fx * camera.fy)
    z = np.geomspace(_NEAR, _FARTHEST, _STEPS)
    across = particles.fall[:, None] * exposure * pixels / z
    width, blur = particles.diameter[:, None] * pixels / z, APERTURE * pixels / z
    area = _footprint(*_soft_disc(width, blur), length=across)
    share = 0.25 * math.pi * width**2 / area
    variance = particles.density[:, None] * z**2 * np.gradient(z) * area * share**2
    variance[share <= _FAINT] = 0.0
    order = np.argsort(-share, axis=None)
    seen = np.cumsum(variance.flat[order])
    least = share.flat[order[np.searchsorted(seen, (1 - _LEFT_OUT) * seen[-1])]]
    distance: Float = np.where(share > max(float(least), _FAINT), z, 0.0).max(axis=1)
    return distance


def drawn_depth(
    particles: FallingParticles, *, far: Float, column: Callable[[float], NDArray[np.float32]]
) -> NDArray[np.float32]:
    """Mean optical depth (h, w) of the particles that are drawn in front of each pixel's surface.

    far    : (k,) metres of depth up to which each class is drawn
    column : metres (h, w) of the medium along each pixel's ray up to a depth, or up to the surface
    """
    section = particles.density * 0.25 * math.pi * particles.diameter**2
    edge = np.geomspace(_NEAR, max(float(far.max(initial=0.0)), 2 * _NEAR), _INTERVALS + 1)
    within = np.maximum(np.minimum(far, edge[:, None]) - _NEAR, 0.0) @ section
    density = np.diff(within) / np.diff(edge)
    nearer = column(float(edge[0]))
    depth = np.zeros_like(nearer)
    for d, end in zip(density, edge[1:], strict=True):
        further = column(float(end))
        depth += np.float32(d) * (further - nearer)
        nearer = further
    return depth


def streak_cover(
    camera: CameraSpec,
    particles: FallingParticles,
    *,
    far: Float,
    exposure: float,
    down: Float,
    air: Float,
    distance: NDArray[np.float32],
    rng: np.random.Generator,
    share: Callable[[Float], Float] | None = None,
) -> NDArray[np.float32]:
    """Share (h, w) of each pixel's light that comes from particles in front of the visible surface.

    Each particle is a disc that moves on a line during the exposure, out of focus as of a lens of `APERTURE`
    focused at infinity.

    far      : (k,) metres of depth up to which particles of each class are drawn
    exposure : seconds
    down     : (3,) unit vector of the fall, camera frame
    air      : (3,) m/s of the air relative to the camera, camera frame
    distance : (h, w) metres along each pixel's ray, inf for sky
    share    : share (n,) of the particles that there are at places (n, 3), camera frame; all by default
    """
    cover = np.zeros((camera.height, camera.width), np.float32)
    rows = zip(particles.diameter, particles.density, particles.fall, far, strict=True)
    for diameter, density, fall, farthest in rows:
        drift = air + fall * down
        beside = float(np.linalg.norm(drift)) * exposure + diameter + APERTURE
        position = _positions(camera, density=float(density), far=float(farthest), margin=beside, rng=rng)
        swing = particles.swing * rng.standard_normal(position.shape)
        if share is not None:
            there = _drawn(share(position), rng=rng)
            position, swing = position[there], swing[there]
        if not len(position):
            continue
        half = (drift + swing) * exposure / 2
        begin, end = position - half, position + half
        if camera.model == "pinhole":
            seen = np.minimum(begin[:, 2], end[:, 2]) > _NEAR / 2
            position, begin, end = position[seen], begin[seen], end[seen]
        first, last = project(camera, begin)[0], project(camera, end)[0]
        away = np.linalg.norm(position, axis=1)
        pixels = _pixels_per_radian(camera, position, away=away)
        width = diameter * pixels / away
        reach, edge = _soft_disc(width, APERTURE * pixels / away)
        length = np.linalg.norm(last - first, axis=1)
        peak = np.minimum(0.25 * math.pi * width**2 / _footprint(reach, edge, length=length), 1.0)
        draw(cover, distance, np.hstack([first, last]), np.stack([away, peak, reach, edge], axis=1))
    return cover


def _pixels_per_radian(camera: CameraSpec, position: Float, *, away: Float) -> Float:
    """Pixels per radian (n,) at places (n, 3) and distances (n,), geometric mean of both directions.

    Distortion is left out.
    """
    cosine = position[:, 2] / away
    if camera.model == "fisheye":
        stretch = np.sinc(np.arccos(np.clip(cosine, -1, 1)) / math.pi) ** -0.5
    else:
        stretch = cosine**-1.5
    pixels: Float = math.sqrt(camera.fx * camera.fy) * stretch
    return pixels


def _soft_disc(width: Float, blur: Float) -> tuple[Float, Float]:
    """Radius of the image of a disc and width of its soft rim, pixels.

    width, blur : pixels of the disc in focus and of a point out of focus
    """
    edge = np.maximum(np.minimum(width, blur), 1.0)
    return (np.sqrt(1.0 + width**2 + blur**2) + edge) / 2, edge


def _footprint(radius: Float, edge: Float, *, length: Float) -> Float:
    """Sum over pixels of the image of a disc with a soft rim that moves by ``length`` pixels."""
    core = radius - edge
    caps = math.pi / 3 * (radius**2 + radius * core + core**2)
    area: Float = (radius + core) * length + caps
    return area


def _drawn(share: Float, *, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Mask of the particles that are drawn, with probabilities ``share`` (n,)."""
    there = share >= 1
    partly = (share > 0) & ~there
    there[partly] = rng.random(int(partly.sum())) < share[partly]
    return there


def _positions(
    camera: CameraSpec, *, density: float, far: float, margin: float, rng: np.random.Generator
) -> Float:
    """Positions (n, 3) of particles in front of a camera, camera frame, with a margin around the view.

    far    : metres of depth; of distance for a fisheye
    margin : metres beside it
    """
    if far <= _NEAR:
        return np.empty((0, 3))
    z = np.linspace(_NEAR, far, _STEPS)
    area = (camera.width / camera.fx * z + margin) * (camera.height / camera.fy * z + margin)
    volume = np.concatenate([[0.0], np.cumsum((area[1:] + area[:-1]) / 2 * np.diff(z))])
    n = int(rng.poisson(density * volume[-1]))
    away = np.interp(rng.random(n) * volume[-1], volume, z)
    across = rng.random((n, 2)) - 0.5
    size = np.array([camera.width, camera.height])
    focal = np.array([camera.fx, camera.fy])
    pixel = (size - 1) / 2 + across * (size + margin * focal / away[:, None])
    if camera.model == "pinhole":
        middle = np.array([camera.cx, camera.cy])
        return np.column_stack([(pixel - middle) / focal * away[:, None], away])
    ray = unproject(camera, pixel)
    angle = np.arccos(np.clip(ray[:, 2], -1, 1))
    # The solid angle of an equidistant pixel falls with the sine of its angle over the angle.
    kept = np.isfinite(angle) & (rng.random(n) < np.sinc(angle / np.pi))
    placed: Float = ray[kept] * away[kept, None]
    return placed


@njit(cache=True, nogil=True)
def draw(cover: NDArray[np.float32], distance: NDArray[np.float32], ends: Float, sizes: Float) -> None:
    """Add streaks to ``cover``, the share of each pixel's light that they take.

    ends  : (n, 4) pixels, columns and rows of both ends
    sizes : (n, 4) metres to the particle; share of light in the middle; pixels: radius and soft rim
    """
    h, w = cover.shape
    for i in range(len(ends)):
        ax, ay, bx, by = ends[i, 0], ends[i, 1], ends[i, 2], ends[i, 3]
        away, share, reach, edge = sizes[i, 0], sizes[i, 1], sizes[i, 2], sizes[i, 3]
        if not (abs(ax) < 1e5 and abs(ay) < 1e5 and abs(bx) < 1e5 and abs(by) < 1e5):
            continue
        dx, dy = bx - ax, by - ay
        squared = dx * dx + dy * dy
        left, right = max(int(min(ax, bx) - reach), 0), min(int(max(ax, bx) + reach) + 2, w)
        top, bottom = max(int(min(ay, by) - reach), 0), min(int(max(ay, by) + reach) + 2, h)
        for y in range(top, bottom):
            first, last = left, right
            if abs(dy) > 1.0:  # of the row, the pixels near the line through both ends
                middle, beside = ax + (y - ay) * dx / dy, reach * math.sqrt(squared) / abs(dy)
                first, last = max(left, int(middle - beside)), min(right, int(middle + beside) + 2)
            for x in range(first, last):
                along = ((x - ax) * dx + (y - ay) * dy) / squared if squared > 0.0 else 0.0
                along = min(max(along, 0.0), 1.0)
                off = math.sqrt((x - ax - along * dx) ** 2 + (y - ay - along * dy) ** 2)
                inside = min(max((reach - off) / edge, 0.0), 1.0)
                if inside > 0.0 and away < distance[y, x]:
                    cover[y, x] = 1.0 - (1.0 - cover[y, x]) * (1.0 - share * inside)
