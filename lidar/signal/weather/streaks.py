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
_FARTHEST = 60.0  # metres
_STEPS = 200  # of distance and of its distribution


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


def streak_cover(
    camera: CameraSpec,
    particles: FallingParticles,
    *,
    exposure: float,
    down: Float,
    air: Float,
    distance: NDArray[np.float32],
    rng: np.random.Generator,
    share: Callable[[Float], Float] | None = None,
) -> NDArray[np.float32]:
    """Share (h, w) of each pixel's light that comes from particles in front of the visible surface.

    Each particle is a disc that moves on a line during the exposure, out of focus as of a lens of `APERTURE`
    focused at infinity. Particles that cover less than 2 of 255 levels are left out.

    exposure : seconds
    down     : (3,) unit vector of the fall, camera frame
    air      : (3,) m/s of the air relative to the camera, camera frame
    distance : (h, w) metres along each pixel's ray, inf for sky
    share    : share (n,) of the particles that there are at places (n, 3), camera frame; all by default
    """
    cover = np.zeros((camera.height, camera.width), np.float32)
    pixels = math.sqrt(camera.fx * camera.fy)
    for diameter, density, fall in zip(particles.diameter, particles.density, particles.fall, strict=True):
        drift = air + fall * down
        speed = float(np.linalg.norm(drift))
        path = speed * exposure
        far = _visible_distance(float(diameter), across=fall * exposure, pixels=pixels)
        position = _positions(camera, density=float(density), far=far, margin=path, rng=rng)
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
        width = diameter * pixels / away
        blur = APERTURE * pixels / away
        size = np.sqrt(1.0 + width**2 + blur**2)
        edge = np.maximum(np.minimum(width, blur), 1.0)
        draw(cover, distance, np.hstack([first, last]), np.stack([away, width, size, edge], axis=1))
    return cover


def _drawn(share: Float, *, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Mask of the particles that are drawn, with probabilities ``share`` (n,)."""
    there = share >= 1
    partly = (share > 0) & ~there
    there[partly] = rng.random(int(partly.sum())) < share[partly]
    return there


def _visible_distance(diameter: float, *, across: float, pixels: float) -> float:
    """Metres up to which a particle covers more than `_FAINT` of a pixel.

    across : metres that it moves across the line of sight during the exposure
    """
    z = np.geomspace(_NEAR, _FARTHEST, _STEPS)
    width = diameter * pixels / z
    size = np.sqrt(1.0 + width**2 + (APERTURE * pixels / z) ** 2)
    share = width**2 / (size * (size + across * pixels / z))
    seen = z[share > _FAINT]
    return float(seen.max(initial=0.0))


def _positions(
    camera: CameraSpec, *, density: float, far: float, margin: float, rng: np.random.Generator
) -> Float:
    """Positions (n, 3) of particles in front of a camera, camera frame, with a margin around the view.

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
    sizes : (n, 4) metres to the particle; pixels: width of the particle, of its image, of its soft edge
    """
    h, w = cover.shape
    for i in range(len(ends)):
        ax, ay, bx, by = ends[i, 0], ends[i, 1], ends[i, 2], ends[i, 3]
        away, width, size, edge = sizes[i, 0], sizes[i, 1], sizes[i, 2], sizes[i, 3]
        if not (abs(ax) < 1e5 and abs(ay) < 1e5 and abs(bx) < 1e5 and abs(by) < 1e5):
            continue
        dx, dy = bx - ax, by - ay
        squared = dx * dx + dy * dy
        share = 0.25 * math.pi * width * width / (size * math.sqrt(squared) + 0.25 * math.pi * size * size)
        reach = 0.5 * (size + edge)
        left, right = max(int(min(ax, bx) - reach), 0), min(int(max(ax, bx) + reach) + 2, w)
        top, bottom = max(int(min(ay, by) - reach), 0), min(int(max(ay, by) + reach) + 2, h)
        for y in range(top, bottom):
            for x in range(left, right):
                along = ((x - ax) * dx + (y - ay) * dy) / squared if squared > 0.0 else 0.0
                along = min(max(along, 0.0), 1.0)
                off = math.sqrt((x - ax - along * dx) ** 2 + (y - ay - along * dy) ** 2)
                inside = min(max((reach - off) / edge, 0.0), 1.0)
                if inside > 0.0 and away < distance[y, x]:
                    cover[y, x] = 1.0 - (1.0 - cover[y, x]) * (1.0 - min(share, 1.0) * inside)
