"""Drops of water on the window in front of a camera, which act as lenses out of focus."""

# mypy: disallow-untyped-decorators=False
from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoscene.support.compiled import njit
from geoscene.typing import Float
from lidar.geometry.random_streams import generator
from lidar.sensors.rig.specs import CameraSpec
from lidar.signal.weather.streaks import APERTURE

WINDOW = 0.05
"""Metres from a lens to its window, typical of a camera behind a cover."""

_RADIUS, _SPREAD = (
    1.0e-3,
    0.45,
)  # median radius of drops on glass in metres, deviation of its logarithm, typical
_CONTACT = math.radians(40.0)  # contact angle of water on glass, 20 to 60 degrees, typical
_FOCUS = 1 / (0.333 * math.sin(_CONTACT))  # focal length of a plano-convex drop over its radius, n = 1.333
_STAYS = 8.0, 30.0  # seconds until a drop runs off or another takes its place, typical
_COARSE = 4  # pixels along each side of a cell of the layer of drops, which is out of focus


@dataclass(frozen=True, slots=True)
class Drops:
    """Drops on a window: ``centre`` (n, 2) and ``radius`` (n,) in pixels of the image."""

    centre: Float
    radius: Float


def drops_on(camera: CameraSpec, cover: float, *, seconds: float, seed: int) -> Drops:
    """The drops on a camera's window at a time; they stay for some seconds, then others form elsewhere.

    cover   : share of the window under drops, 0 to 1
    seconds : since the drive's start
    """
    scale = math.sqrt(camera.fx * camera.fy) / WINDOW
    size = np.array([camera.width, camera.height])
    mean = math.pi * (_RADIUS * scale) ** 2 * math.exp(2 * _SPREAD**2)
    # Drops overlap: a share c of independent discs covers 1 - exp(-c).
    count = round(-math.log1p(-min(cover, 0.95)) * float(np.prod(size)) / mean)
    centre, radius = np.empty((count, 2)), np.empty(count)
    for k in range(count):
        first = generator(seed, camera.name, "window", k)
        stays = first.uniform(*_STAYS)
        drawn = generator(seed, camera.name, "window", k, int(seconds / stays + first.random()))
        centre[k] = drawn.random(2) * size
        radius[k] = _RADIUS * scale * math.exp(_SPREAD * drawn.standard_normal())
    return Drops(centre, radius)


def through_drops(light: NDArray[np.float32], drops: Drops, *, camera: CameraSpec) -> NDArray[np.float32]:
    """Linear light (h, w, 3) of an image that is taken through drops.

    A drop is a lens of short focus: it shows the scene upside down and small. Both the drop and its edge are
    blurred by the lens, whose focus is far behind the window.
    """
    from scipy.ndimage import gaussian_filter  # noqa: PLC0415  (0.1 s)

    if not len(drops.radius):
        return light
    h, w = light.shape[0] // _COARSE, light.shape[1] // _COARSE
    small = np.ascontiguousarray(
        light[: h * _COARSE, : w * _COARSE].reshape(h, _COARSE, w, _COARSE, 3).mean(axis=(1, 3))
    )
    seen, cover = np.zeros_like(small), np.zeros((h, w), np.float32)
    scale = math.sqrt(camera.fx * camera.fy) / WINDOW
    turn = 1 - scale * WINDOW / (_FOCUS * drops.radius)
    _refract(small, drops.centre / _COARSE, drops.radius / _COARSE, turn, seen, cover)
    # A uniform disc of diameter A f / M has the variance of a Gaussian of a quarter of it.
    blur = APERTURE * scale / 4 / _COARSE
    seen = gaussian_filter(seen, (blur, blur, 0), mode="nearest")
    cover = gaussian_filter(cover, blur, mode="nearest")
    seen, cover = _enlarge(seen, light.shape[:2]), _enlarge(cover[..., None], light.shape[:2])
    out: NDArray[np.float32] = light * (1 - cover) + seen
    return out


def _enlarge(coarse: NDArray[np.float32], shape: tuple[int, ...]) -> NDArray[np.float32]:
    """A coarse image on a grid of `_COARSE` times as many pixels, bilinear."""
    h, w = shape
    for axis, n in ((0, h), (1, w)):
        low, share = _weights(coarse.shape[axis], n)
        rest = [slice(None) if axis == a else None for a in range(3)]
        part = share[tuple(rest)]
        coarse = np.take(coarse, low, axis=axis) * (1 - part) + np.take(coarse, low + 1, axis=axis) * part
    return coarse


@functools.lru_cache(maxsize=8)
def _weights(coarse: int, fine: int) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
    """The coarse sample before each of the fine ones, and the share of the next one."""
    at = np.clip((np.arange(fine) + 0.5) / _COARSE - 0.5, 0, coarse - 1)
    low = np.minimum(at.astype(np.intp), coarse - 2)
    return low, (at - low).astype(np.float32)


@njit(cache=True, nogil=True)
def _refract(
    light: NDArray[np.float32],
    centre: Float,
    radius: Float,
    turn: Float,
    seen: NDArray[np.float32],
    cover: NDArray[np.float32],
) -> None:
    """Fill ``seen`` with the light through drops, and ``cover`` with their area.

    turn : (n,) pixels of the scene for a pixel of each drop; negative upside down
    """
    h, w = cover.shape
    for i in range(len(radius)):
        cx, cy, r = centre[i, 0], centre[i, 1], radius[i]
        for y in range(max(int(cy - r), 0), min(int(cy + r) + 2, h)):
            for x in range(max(int(cx - r), 0), min(int(cx + r) + 2, w)):
                off = math.sqrt((x - cx) ** 2 + (y - cy) ** 2)
                if off > r:
                    continue
                # Towards its edge the drop is steep: total reflection leaves a dark rim (to 80 %).
                rim = min(max((r - off) / (0.15 * r), 0.2), 1.0)
                u = min(max(int(cx + turn[i] * (x - cx)), 0), w - 1)
                v = min(max(int(cy + turn[i] * (y - cy)), 0), h - 1)
                for c in range(3):
                    seen[y, x, c] = rim * light[v, u, c]
                cover[y, x] = 1.0
