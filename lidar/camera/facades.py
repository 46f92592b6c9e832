"""Flat walls of buildings and the windows that are generated on them."""

# mypy: disallow-untyped-decorators=False

from __future__ import annotations

import math
import weakref
from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from geoscene.classes import Class
from geoscene.columns import Columns
from geoscene.mesh import WALL
from geoscene.typing import Float
from lidar.camera.texture import covered, hashed, pulses, span
from lidar.raycast import Caster, Geometry, Hits
from lidar.world.world import World


@dataclass(frozen=True, slots=True)
class Facades(Columns):
    """Flat walls of buildings, and the wall of each face.

    wall    : (m,) int32 per face, row of its wall below, -1 for other faces
    tangent : (k, 2) horizontal unit vector along the wall, to the right as seen from outside
    along   : (k, 2) start and end of the wall along the tangent, metres
    height  : (k, 2) z of the building's foot and of the wall's top, metres
    style   : (k, 10) appearance of its windows, see `_styles`
    """

    wall: NDArray[np.int32]
    tangent: Float
    along: Float
    height: Float
    style: Float


def facades(corners: Float, normal: Float, *, feature: NDArray[np.int32], wall: NDArray[np.bool_]) -> Facades:
    """The flat walls among m faces: upright ones of one feature in one plane are one wall.

    corners : (m, 3, 3) metres
    normal  : (m, 3) unit normals
    wall    : (m,) bool, the face is a wall of a building
    """
    m = len(corners)
    length = np.hypot(normal[:, 0], normal[:, 1])
    face = np.flatnonzero(wall & (np.abs(normal[:, 2]) < 0.02) & (length > 0))
    if not len(face):
        none = np.empty((0, 2))
        return Facades(np.full(m, -1, np.int32), none, none, none, np.empty((0, 10)))

    flat = normal[face, :2] / length[face, None]
    corners, feature = corners[face], feature[face]
    turn = np.arctan2(flat[:, 1], flat[:, 0])
    # Sorting and splitting at gaps groups values that differ by rounding errors; rounded keys would not.
    order = np.lexsort((turn, feature))
    bearing = _runs(feature[order], turn[order], gap=0.005)
    tangent = np.empty((len(face), 2))
    first = np.flatnonzero(np.r_[True, np.diff(bearing) > 0])
    tangent[order] = np.stack([-flat[order[first], 1], flat[order[first], 0]], axis=1)[bearing]
    away = np.einsum("ij,ij->i", corners[:, 0, :2], np.stack([tangent[:, 1], -tangent[:, 0]], axis=1))
    group = np.empty(len(face), np.int64)
    group[order] = bearing
    order = np.lexsort((away, group))
    run = _runs(group[order], away[order], gap=0.05)
    plane = np.empty(len(face), np.int64)
    plane[order] = run

    k = int(run[-1]) + 1
    place = np.einsum("ijk,ik->ij", corners[:, :, :2], tangent)
    lower, upper = corners[:, :, 2].min(axis=1), corners[:, :, 2].max(axis=1)
    along, height = np.empty((k, 2)), np.empty((k, 2))
    along[:] = np.inf, -np.inf
    np.minimum.at(along[:, 0], plane, place.min(axis=1))
    np.maximum.at(along[:, 1], plane, place.max(axis=1))
    _, building = np.unique(feature, return_inverse=True)
    foot = np.full(int(building.max()) + 1, np.inf)
    np.minimum.at(foot, building, lower)
    height[plane, 0] = foot[building]
    height[:, 1] = -np.inf
    np.maximum.at(height[:, 1], plane, upper)
    tangents = np.empty((k, 2))
    tangents[plane] = tangent
    of_face = np.full(m, -1, np.int32)
    of_face[face] = plane
    owner = np.empty(k, np.int32)
    owner[plane] = feature
    return Facades(of_face, tangents, along, height, _styles(owner, along, height=height))


def _runs(key: NDArray[np.integer], value: Float, *, gap: float) -> NDArray[np.int64]:
    """Numbers (n,) of the runs in sorted rows: a new one where the key changes or the value jumps."""
    numbers = np.zeros(len(key), np.int64)
    np.cumsum((np.diff(key) != 0) | (np.diff(value) > gap), out=numbers[1:])
    return numbers


BAY, STOREY, FLOORS, WIDE, TALL, RISE, SHOP_WIDE, SHOP_TALL, BAND, PAINT = range(10)
"""Columns of `Facades.style`."""


@njit(cache=True, nogil=True, error_model="numpy")
def _chances(feature: NDArray[np.int32], count: int) -> Float:
    """Hashes (k, count) from 0 to 1 of feature numbers (k,)."""
    out = np.empty((len(feature), count))
    for i in range(len(feature)):
        for j in range(count):
            out[i, j] = hashed(feature[i], j, 20)
    return out


def _styles(feature: NDArray[np.int32], along: Float, *, height: Float) -> Float:
    """Appearance of the windows of each wall (k, 10), a hash of the building's number: maps do not hold it.

    Metres, but for FLOORS (a count; 0 for a wall without windows) and PAINT (albedo of the frames).
    SHOP_WIDE is 0 where the ground floor is like the others, BAND where no line marks the storeys.
    """
    style = np.zeros((len(feature), 10))
    chance = _chances(feature, 7)
    width = along[:, 1] - along[:, 0]
    storey = 2.9 + 0.7 * chance[:, 0]
    bays = np.floor(width / (2.1 + 1.7 * chance[:, 1]))
    floors = np.floor((height[:, 1] - height[:, 0] - 0.3) / storey)
    bay = width / np.maximum(bays, 1.0)
    shop = chance[:, 2] < 0.5
    style[:, BAY], style[:, STOREY] = np.maximum(bay, 1e-3), storey
    style[:, FLOORS] = np.where((bays > 0) & (floors > 0), floors, 0.0)
    style[:, WIDE], style[:, TALL] = bay * (0.36 + 0.28 * chance[:, 3]), storey * (0.42 + 0.2 * chance[:, 4])
    style[:, RISE] = 0.08 * storey
    style[:, SHOP_WIDE], style[:, SHOP_TALL] = np.where(shop, 0.84 * bay, 0.0), 0.76 * storey
    style[:, BAND] = np.where(chance[:, 5] < 0.5, 0.12, 0.0)
    style[:, PAINT] = np.where(chance[:, 6] < 0.6, 0.75, 0.06)
    return style


@njit(cache=True, nogil=True, error_model="numpy")
def windows(
    u: float, v: float, style: Float, w: int, across: float, up: float, feature: int, out: Float
) -> None:
    """Fill ``out`` with the shares of glass, frame and band in a pixel, and the albedo behind the glass.

    style, w   : `Facades.style` and the wall's row of it
    u, v       : metres from the wall's left end and the building's foot
    across, up : the pixel's footprint along them, metres
    """
    out[:] = 0.0
    bay, storey = style[w, BAY], style[w, STOREY]
    k = math.floor(v / storey)
    if style[w, BAND] > 0.0:
        out[2] = pulses(v + 0.5 * storey, storey, style[w, BAND], up)
    if k < 0 or k >= style[w, FLOORS]:
        return
    wide, tall, rise = style[w, WIDE], style[w, TALL], style[w, RISE]
    if k == 0 and style[w, SHOP_WIDE] > 0.0:
        wide, tall, rise = style[w, SHOP_WIDE], style[w, SHOP_TALL], -0.06 * storey
    column = math.floor(u / bay)
    aside = abs(u - (column + 0.5) * bay) - 0.5 * wide - 0.08
    above = abs(v - rise - (k + 0.5) * storey) - 0.5 * tall - 0.08
    if across < bay and up < storey and (aside > 0.5 * across or above > 0.5 * up):
        return
    # Each storey's row of windows is one pulse; a footprint beyond a storey sees the mean of them.
    x, y = span(u, bay, across), span(v - rise, storey, up)
    inside_y = covered(y, storey, tall)
    inner, bar = covered(x, bay, wide) * inside_y, covered(x, bay, 0.06) * inside_y
    outer = covered(x, bay, wide + 0.16) * covered(y, storey, tall + 0.16)
    out[0] = inner - bar
    out[1] = max(outer - inner, 0.0) + bar
    fade = max(0.0, 1.0 - max(across / bay, up / storey))
    shown = hashed(feature * 131 + column, k, 21)
    out[3] = 0.06 + fade * (0.45 * shown * shown * shown - 0.04)


def facades_of(world: World) -> Facades:
    """The walls of a world's own mesh, ``wall`` by the face numbers of its hits; kept with its tiles."""
    caster = world.caster
    known, last, whole = _CACHE.get(caster, ({}, (), None))
    parts = caster.scene.parts
    state = tuple((number, part.first, id(part.vertices)) for number, part in parts.items())
    if whole is not None and state == last:
        return whole
    found = {}
    for number, part in parts.items():
        old = known.get(number)
        same = old is not None and old[0] is part.vertices
        found[number] = old if old is not None and same else (part.vertices, _of_part(world, part))
    whole = _concatenated([found[number][1] for number in parts], [_numbers(part) for part in parts.values()])
    _CACHE[caster] = found, state, whole
    return whole


_Part = tuple[Float, Facades]
_CACHE: weakref.WeakKeyDictionary[
    Caster, tuple[dict[int, _Part], tuple[tuple[int, int, int], ...], Facades | None]
] = weakref.WeakKeyDictionary()


def _numbers(part: Geometry) -> NDArray[np.int32]:
    """Face numbers in hits of a part's faces."""
    own = part.numbers[: len(part)] if len(part.numbers) else np.arange(len(part), dtype=np.int32)
    return own + np.int32(part.first)


def _of_part(world: World, part: Geometry) -> Facades:
    m = len(part)
    own, ones = np.full(m, -1, np.int32), np.ones(m)
    surfaces = world.lookup(Hits(ones, _numbers(part), own, ones.astype(np.float32), np.empty((0, 3))))
    corners = part.vertices[part.faces] + world.caster.origin
    wall = (surfaces.klass == Class.BUILDING) & (surfaces.surface == WALL)
    return facades(corners, part.planes[:m, :3], feature=surfaces.feature, wall=wall)


def _concatenated(parts: list[Facades], numbers: list[NDArray[np.int32]]) -> Facades:
    """Walls of several parts whose faces have the given numbers."""
    wall = np.full(max((int(n.max(initial=-1)) for n in numbers), default=-1) + 1, -1, np.int32)
    first = 0
    for part, number in zip(parts, numbers, strict=True):
        wall[number] = np.where(part.wall >= 0, part.wall + np.int32(first), -1)
        first += len(part.style)
    none = Facades(wall, np.empty((0, 2)), np.empty((0, 2)), np.empty((0, 2)), np.empty((0, 10)))
    return replace(Facades.concatenate([none, *parts]), wall=wall)
