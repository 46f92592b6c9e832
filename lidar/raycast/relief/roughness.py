"""Roughness of the ground as a height function: h(x, y) at or below the plane of a face.

Roads have the spectrum of ISO 8608: the one-sided power spectral density of heights along any straight line
is Gd(n) = Gd(n0) (n / n0)^-2 with n0 = 0.1 cycles per metre. Heights of an isotropic random field with the
spectral density A k^-3 over the plane have the density 4 A / n^2 along lines (integrate (n^2 + m^2)^(-3/2)
over m), so A = Gd(n0) n0^2 / 4. Fields are periodic tiles of heights, bilinear between the nodes.
"""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import Class, materials
from geoscene.geometry.mesh import Mesh
from geoscene.support.files import write_atomically
from geoscene.support.storage import cache_folder
from geoscene.support.untrusted import DAMAGED_ARCHIVE, read_arrays
from geoscene.typing import Float

N0 = 0.1
"""Reference spatial frequency of ISO 8608, cycles per metre."""

CLASS_A, CLASS_B, CLASS_C = (16e-6 * 4.0**k for k in range(3))
"""Gd(n0) in m^3: geometric means of ISO 8608's classes."""

BAND = (0.1, 10.0)
"""Cycles per metre of the waves of roads: 10 m to 10 cm."""

_GRAINS = (2.5, 10.0)
"""Cycles per metre of grains: 40 to 10 cm."""

NODES, STEP = 512, 0.025
"""Nodes along a side of a field, a power of two, and metres between them."""

LEVELS = 7
"""Levels of detail of a field; each has half as many nodes along a side as the one before."""

BLOCK = 2
"""Cells along a side of the blocks whose steepness is known."""

REACH = 8
"""Cells along a side of the blocks whose highest places ahead are known, as many cells away."""

_RINGS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64)
"""Blocks ahead up to which steepness is bounded together; each at most twice the one before."""

_PEAK = 2.5
"""Standard deviations at which peaks and dips are cut off: 1.2 % of the area."""

_SEED = 8608


class RoughnessKind(NamedTuple):
    """Roughness parameters of a kind of ground.

    road   : Gd(n0) in m^3 of the waves of `BAND`
    grain  : metres, standard deviation of the heights of grains
    stones : length and width of stones in a regular bond, width and depth of the joints between, metres;
             zeros for none
    """

    road: float
    grain: float
    stones: tuple[float, float, float, float]


_NO_STONES = (0.0, 0.0, 0.0, 0.0)

KINDS: dict[str, RoughnessKind] = {
    # Roads by ISO 8608; grains, stones and joints are assumed.
    "asphalt": RoughnessKind(CLASS_A, 0.0, _NO_STONES),
    "concrete": RoughnessKind(CLASS_A, 0.0, _NO_STONES),
    "paving": RoughnessKind(CLASS_B, 0.0, (0.4, 0.4, 0.008, 0.004)),
    "sett": RoughnessKind(CLASS_B, 0.0, (0.16, 0.11, 0.02, 0.012)),
    "gravel": RoughnessKind(CLASS_C, 0.004, _NO_STONES),
    "ballast": RoughnessKind(CLASS_C, 0.008, _NO_STONES),
    "sand": RoughnessKind(CLASS_C, 0.004, _NO_STONES),
    "soil": RoughnessKind(CLASS_C, 0.003, _NO_STONES),
    "grass": RoughnessKind(CLASS_C, 0.006, _NO_STONES),
    "forest_floor": RoughnessKind(CLASS_C, 0.008, _NO_STONES),
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
    "dirt": "soil",
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
    Class.PAVED,
)

_STEEPEST = 0.5
"""Least z of the unit normal of a face with roughness: kerbs and walls stay planes."""


class Roughness(NamedTuple):
    """The kinds of ground for compiled code.

    field  : (f t,) float32, heights of periodic fields, at most 0, level by level; the first field in units
             in which Gd(n0) = 1 m^3, the others, with grains, in metres
    steep  : (4, f t / 4) uint8, bounds of the rise from any place in a block of `BLOCK` cells to any
             place ahead of it, per cell: along +x +y, +x -y, -x +y and -x -y; cells are counted along
             the axis along which they are more
    top    : (4, f t / 64) float32, heights of the highest places ahead of the places in a block of `REACH`
             cells, up to as many cells away, in the same four directions
    first  : (f, `LEVELS`) start of each field's levels in ``field``
    unit   : (f, `LEVELS`) unit of ``steep``
    number : (k,) field of each kind
    kinds  : (k, 10) factor of the field, stones as in `RoughnessKind`, depth, greatest slope, one over the
             factor, mean height of joints, and greatest slope of the field
    """

    field: NDArray[np.float32]
    steep: NDArray[np.uint8]
    top: NDArray[np.float32]
    first: NDArray[np.int64]
    unit: Float
    number: NDArray[np.int64]
    kinds: Float


@functools.cache
def roughness() -> Roughness:
    """The fields and kinds; the same for all scenes.

    To make them takes a third of a second, so they are kept in the user's cache folder.
    """
    path, made_by = cache_folder() / "roughness.npz", np.frombuffer(_made_by(), np.uint8)
    with suppress(*DAMAGED_ARCHIVE):  # also a missing file
        arrays = read_arrays(path)
        if np.array_equal(arrays.pop("made_by"), made_by):
            return Roughness(**arrays)
    tables, data = _made(), BytesIO()
    np.savez(data, made_by=made_by, **tables._asdict())
    with suppress(OSError):  # of a folder that cannot be written
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, data.getvalue())
    return tables


def _made_by() -> bytes:
    """Digest of this module and of the version of numpy, whose random numbers and transforms it uses."""
    return hashlib.sha256(Path(__file__).read_bytes() + np.__version__.encode()).digest()


def _made() -> Roughness:
    rng = np.random.default_rng(_SEED)
    waves = _below(_field(rng, band=BAND, power=3.0))
    grains = _field(rng, band=_GRAINS, power=2.0)
    grains = _below(grains / grains.std())
    fields, number, rows = {(1.0, 0.0): 0}, [], []
    for kind in KINDS.values():
        factor, *_, joint, deep = np.sqrt(kind.road), *kind.stones
        key = (float(factor), kind.grain) if kind.grain else (1.0, 0.0)
        number.append(fields.setdefault(key, len(fields)))
        rows.append([1.0 if kind.grain else factor, *kind.stones, deep, 2.0 * deep / joint if joint else 0.0])
    finest = np.stack([road * waves + grain * grains for road, grain in fields]).astype(np.float32)
    kinds = np.array(rows)
    kinds[:, 5] -= kinds[:, 0] * finest.min(axis=(1, 2))[number]
    slope = kinds[:, 0] * np.array([_steepest(f) for f in finest])[number]
    kinds[:, 6] += slope
    mean = [_mean_of_joints(kind.stones) for kind in KINDS.values()]
    kinds = np.column_stack([kinds, 1.0 / kinds[:, 0], mean, slope])
    levels = [_levels(field) for field in finest]
    steep = [[_towards(_steepness_ahead, level) for level in field] for field in levels]
    top = [_towards(_highest_ahead, level).reshape(4, -1) for field in levels for level in field]
    unit = np.array([[level.max() / 254.0 for level in field] for field in steep])
    scaled = [
        np.ceil(level / one).astype(np.uint8).reshape(4, -1)
        for field, units in zip(steep, unit, strict=True)
        for level, one in zip(field, units, strict=True)
    ]
    flat = [level.ravel() for field in levels for level in field]
    first = np.cumsum([0] + [len(level) for level in flat])[:-1].reshape(unit.shape)
    return Roughness(
        np.concatenate(flat),
        np.hstack(scaled),
        np.hstack(top).astype(np.float32),
        first,
        unit,
        np.array(number),
        kinds,
    )


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


def _below(field: Float) -> Float:
    """A field moved down to 0 and less, without its rare peaks, which would set the plane far above it."""
    most = _PEAK * float(field.std())
    found: Float = np.clip(field, -most, most) - most
    return found


def _levels(field: NDArray[np.float32]) -> list[NDArray[np.float32]]:
    """A periodic field and its means, each level at every second node of the one before.

    Means are weighted 1 : 2 : 1 along each axis, so that nodes keep their places.
    """
    found = [field]
    while len(found) < LEVELS:
        wide = found[-1].astype(np.float64)
        for axis in (0, 1):
            wide = (np.roll(wide, 1, axis) + 2.0 * wide + np.roll(wide, -1, axis)) / 4.0
        found.append(np.ascontiguousarray(wide[::2, ::2]).astype(np.float32))
    return found


def _mean_of_joints(stones: tuple[float, float, float, float]) -> float:
    """Mean height of the joints of a bond: their sides are planes, so that tops are frusta of pyramids."""
    length, width, joint, deep = stones
    if not joint:
        return 0.0
    top = (length - joint) * (width - joint)
    middle = (length - 0.5 * joint) * (width - 0.5 * joint)
    return deep * ((length * width + 4.0 * middle + top) / (6.0 * length * width) - 1.0)


def _steepest(field: NDArray[np.float32]) -> float:
    """Bound of the slope of a periodic field in any direction."""
    changes = (np.abs(field - np.roll(field, 1, axis=axis)).max() for axis in (0, 1))
    return float(np.hypot(*changes)) / STEP


def _towards(ahead: Callable[[Float], Float], field: NDArray[np.float32]) -> Float:
    """Result (4, ...) of a function of a field for +x +y, in the four diagonal directions."""
    found = []
    for sx, sy in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        # Mirrored such that cells, not nodes, keep their blocks.
        mirrored = np.roll(field[::sx, ::sy], (sx < 0, sy < 0), (0, 1))
        found.append(ahead(mirrored.astype(np.float64))[::sx, ::sy])
    return np.stack(found)


def _highest_ahead(h: Float) -> Float:
    """Height (n / 8, n / 8) of the highest place in a block and in those next to it at +x and +y."""
    return _grown(_blocks(_of_corners(h, np.maximum), np.maximum, REACH), 1)


def _steepness_ahead(h: Float) -> Float:
    """Bound (n / 2, n / 2) of the rise per cell from any place in a block to any place at +x and +y of it.

    The rise is at most the greatest rise of a cell on the way; and to places ``ring`` blocks ahead, at most
    the height of the highest there above the lowest in the block, over the cells between.
    """
    right, up, both = (np.roll(h, shift, (0, 1)) for shift in ((-1, 0), (0, -1), (-1, -1)))
    along_x = np.maximum(np.maximum(right - h, both - up), 0.0)
    along_y = np.maximum(np.maximum(up - h, both - right), 0.0)
    rise = _blocks(along_x + along_y, np.maximum, BLOCK)
    top = _blocks(_of_corners(h, np.maximum), np.maximum, BLOCK)
    low = _blocks(_of_corners(h, np.minimum), np.minimum, BLOCK)
    bound, before = rise.copy(), 0
    for ring in _RINGS:
        rise, top = (_grown(values, ring - before) for values in (rise, top))
        apart = BLOCK * before
        over = (top - low) / apart if apart else np.inf
        bound, before = np.maximum(bound, np.minimum(rise, over)), ring
    found: Float = np.maximum(bound, (top.max() - low) / (BLOCK * before))
    return found


def _of_corners(h: Float, choose: Callable[[Float, Float], Float]) -> Float:
    """The greatest or least of the corners of each cell."""
    along_x = choose(h, np.roll(h, -1, 0))
    return choose(along_x, np.roll(along_x, -1, 1))


def _blocks(values: Float, choose: Callable[[Float, Float], Float], side: int) -> Float:
    """The greatest or least of blocks of cells, ``side`` along each axis, a power of two."""
    while side > 1:
        values = choose(values[::2], values[1::2])
        values, side = choose(values[:, ::2], values[:, 1::2]), side // 2
    return values


def _grown(values: Float, by: int) -> Float:
    """The greatest within so many blocks ahead, of values that hold as many already."""
    wide: Float = np.maximum(values, np.roll(values, -by, 0))
    found: Float = np.maximum(wide, np.roll(wide, -by, 1))
    return found


def _field(rng: np.random.Generator, *, band: tuple[float, float], power: float) -> Float:
    """A periodic Gaussian field (n, n) with the density k^-power / 4 over the plane within a band, else 0."""
    k = np.fft.fftfreq(NODES, STEP)
    radius = np.hypot(k[:, None], k)
    inside = (radius >= band[0]) & (radius <= band[1])
    density = np.zeros_like(radius)
    density[inside] = radius[inside] ** -power / 4.0 * N0**2
    white = np.fft.fft2(rng.standard_normal((NODES, NODES)))
    return np.fft.ifft2(white * np.sqrt(density) / STEP).real
