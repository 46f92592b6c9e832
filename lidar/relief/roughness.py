"""Roughness of the ground as a height function: h(x, y) at or below the plane of a face.

Roads have the spectrum of ISO 8608: the one-sided power spectral density of heights along any straight line
is Gd(n) = Gd(n0) (n / n0)^-2 with n0 = 0.1 cycles per metre. Heights of an isotropic random field with the
spectral density A k^-3 over the plane have the density 4 A / n^2 along lines (integrate (n^2 + m^2)^(-3/2)
over m), so A = Gd(n0) n0^2 / 4. Fields are periodic tiles of heights, bilinear between the nodes.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import Class, materials
from geoscene.mesh import Mesh
from geoscene.typing import Float

N0 = 0.1
"""Reference spatial frequency of ISO 8608, cycles per metre."""

CLASS_A, CLASS_B, CLASS_C = (16e-6 * 4.0**k for k in range(3))
"""Gd(n0) in m^3: geometric means of ISO 8608's classes."""

BAND = (0.1, 10.0)
"""Cycles per metre of the waves of roads: 10 m to 10 cm."""

_GRAINS = (4.0, 16.0)
"""Cycles per metre of grains: 25 to 6 cm."""

_NODES = 1024
_ROAD_STEP, _GRAIN_STEP = 0.02, 0.01
"""Nodes along a side of a field, and metres between them."""

_BLOCK_NODES = 8
BLOCK = _BLOCK_NODES * _GRAIN_STEP
"""Metres: side of the blocks of grains whose greatest height is known."""

_PEAK = 2.5
"""Standard deviations at which peaks and dips are cut off: 1.2 % of the area."""

_SEED = 8608


class Kind(NamedTuple):
    """A kind of ground.

    road   : Gd(n0) in m^3 of the waves of `BAND`
    grain  : metres, standard deviation of the heights of grains
    stones : length and width of stones in a regular bond, width and depth of the joints between, metres;
             zeros for none
    """

    road: float
    grain: float
    stones: tuple[float, float, float, float]


_NO_STONES = (0.0, 0.0, 0.0, 0.0)

KINDS: dict[str, Kind] = {
    # Roads by ISO 8608; grains, stones and joints are assumed.
    "asphalt": Kind(CLASS_A, 0.0, _NO_STONES),
    "concrete": Kind(CLASS_A, 0.0, _NO_STONES),
    "paving": Kind(CLASS_B, 0.0, (0.4, 0.4, 0.008, 0.004)),
    "sett": Kind(CLASS_B, 0.0, (0.16, 0.11, 0.02, 0.012)),
    "gravel": Kind(CLASS_C, 0.004, _NO_STONES),
    "ballast": Kind(CLASS_C, 0.008, _NO_STONES),
    "sand": Kind(CLASS_C, 0.004, _NO_STONES),
    "soil": Kind(CLASS_C, 0.003, _NO_STONES),
    "grass": Kind(CLASS_C, 0.006, _NO_STONES),
    "forest_floor": Kind(CLASS_C, 0.008, _NO_STONES),
}
"""Kinds of ground by name; the number of a kind is its place."""

_BY_MATERIAL = {
    "asphalt": "asphalt",
    "asphalt_fresh": "asphalt",
    "lane_paint": "asphalt",
    "concrete": "concrete",
    "paving": "paving",
    "brick": "paving",
    "stone": "sett",
    "gravel": "gravel",
    "ballast": "ballast",
    "sand": "sand",
    "soil": "soil",
    "grass": "grass",
    "dry_grass": "grass",
}

_GROUND = (
    Class.ROAD,
    Class.LANE_MARKING,
    Class.CROSSING,
    Class.SIDEWALK,
    Class.PARKING,
    Class.RAIL,
    Class.TERRAIN,
    Class.GRASS,
    Class.FOREST_FLOOR,
    Class.SAND,
)

_STEEPEST = 0.5
"""Least z of the unit normal of a face with roughness: kerbs and walls stay planes."""


class Roughness(NamedTuple):
    """The kinds of ground for compiled code.

    road, grain : (n, n) float32, heights of periodic fields, for Gd(n0) = 1 m^3 and for a standard
                  deviation of 1 m; at most 0, and 0 somewhere
    highest     : (n / 8, n / 8) float32, greatest height of ``grain`` in blocks of side `BLOCK`
    step        : (2,) metres between their nodes
    kinds       : (k, 9) factors of the fields, stones as in `Kind`, greatest depth, greatest slope, and
                  that of the waves alone
    """

    road: NDArray[np.float32]
    grain: NDArray[np.float32]
    highest: NDArray[np.float32]
    step: Float
    kinds: Float


@functools.cache
def roughness() -> Roughness:
    """The fields and kinds; the same for all scenes."""
    rng = np.random.default_rng(_SEED)
    waves = _field(rng, step=_ROAD_STEP, band=BAND, power=3.0)
    grains = _field(rng, step=_GRAIN_STEP, band=_GRAINS, power=1.0)
    road, grain = _below(waves), _below(grains / grains.std())
    depth = np.array([-road.min(), -grain.min()], float)
    slope = np.array([_steepest(road) / _ROAD_STEP, _steepest(grain) / _GRAIN_STEP])
    rows = []
    for kind in KINDS.values():
        factors = np.array([np.sqrt(kind.road), kind.grain])
        *_, joint, deep = kind.stones
        rows.append(
            [
                *factors,
                *kind.stones,
                float(factors @ depth) + deep,
                float(factors @ slope) + (2.0 * deep / joint if joint else 0.0),
                float(factors[0] * slope[0]),
            ]
        )
    return Roughness(road, grain, _highest(grain), np.array([_ROAD_STEP, _GRAIN_STEP]), np.array(rows))


def kinds_of(mesh: Mesh) -> NDArray[np.int8]:
    """The number of the kind (m,) of each face of a mesh, -1 for faces without roughness."""
    names = {material.code: name for name, material in materials().items()}
    numbers = {name: k for k, name in enumerate(KINDS)}
    kind = np.full(256, -1, np.int8)
    for code, name in names.items():
        if name in _BY_MATERIAL:
            kind[code] = numbers[_BY_MATERIAL[name]]
    ground = np.isin(mesh.klass, _GROUND)
    number = np.where(ground, kind[mesh.material], np.int8(-1))
    number[ground & (mesh.klass == Class.FOREST_FLOOR)] = numbers["forest_floor"]
    number[ground & (mesh.normals()[:, 2] < _STEEPEST)] = -1
    return number.astype(np.int8)


def _below(field: Float) -> NDArray[np.float32]:
    """A field moved down to 0 and less, without its rare peaks, which would set the plane far above it."""
    most = _PEAK * float(field.std())
    return np.asarray(np.clip(field, -most, most) - most, np.float32)


def _highest(field: NDArray[np.float32]) -> NDArray[np.float32]:
    """The greatest of the nodes in and on the border of each block of a periodic field."""
    n = len(field) // _BLOCK_NODES
    padded = np.pad(field, (0, 1), mode="wrap")
    first = np.arange(n) * _BLOCK_NODES
    within = first[:, None] + np.arange(_BLOCK_NODES + 1)
    found: NDArray[np.float32] = padded[within[:, None, :, None], within[None, :, None, :]].max(axis=(2, 3))
    return found


def _steepest(field: NDArray[np.float32]) -> float:
    """Bound of the change of a periodic field per step in any direction."""
    changes = (np.abs(field - np.roll(field, 1, axis=axis)).max() for axis in (0, 1))
    return float(np.hypot(*changes))


def _field(rng: np.random.Generator, *, step: float, band: tuple[float, float], power: float) -> Float:
    """A periodic Gaussian field (n, n) with the density k^-power / 4 over the plane within a band, else 0."""
    k = np.fft.fftfreq(_NODES, step)
    radius = np.hypot(k[:, None], k)
    inside = (radius >= band[0]) & (radius <= band[1])
    density = np.zeros_like(radius)
    density[inside] = radius[inside] ** -power / 4.0 * N0**2
    white = np.fft.fft2(rng.standard_normal((_NODES, _NODES)))
    return np.fft.ifft2(white * np.sqrt(density) / step).real
