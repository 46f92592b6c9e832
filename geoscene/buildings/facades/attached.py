"""Parts that project from facades: balconies, cornices, awnings over shops and downpipes.

Each is a closed solid that ends 5 mm before the wall, so that it is a body of its own that touches nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.buildings.facades.description import SHOP, WINDOW
from geoscene.buildings.facades.doors import OUT, Sheet, obstacles
from geoscene.buildings.facades.walls import Elevations
from geoscene.classes import Class, materials
from geoscene.geometry.mesh import Mesh, concatenate
from geoscene.geometry.watertight import validate_mesh
from geoscene.support.splitmix import uniform_at
from geoscene.typing import Bools, Float, Ints

_GAP = 0.005
"""Metres between a part and its wall."""

_SLAB, _PARAPET, _THICK = 0.18, 1.0, 0.08
"""Metres: depth of the slab of a balcony, and height and width of its parapet; assumed."""

_HEADROOM = 2.1
"""Metres, at least, between the ground and a balcony or an awning; assumed."""

_BEFORE = 1.0
"""Metres of free space before a balcony."""

_CORNICE = ((_GAP, 0.0), (0.12, 0.0), (0.35, 0.3), (0.35, 0.45), (_GAP, 0.45))
_AWNING = ((_GAP, 0.0), (1.2, -0.35), (1.2, -0.29), (_GAP, 0.06))
_PIPE = ((_GAP, 0.0), (0.085, 0.0), (0.085, 1.0), (_GAP, 1.0))
"""Profiles across the wall: metres out of it and up, counter-clockwise; assumed."""

_AWNINGS, _PIPES = 0.5, 0.5
"""Shares of buildings with awnings over their shop fronts, and with downpipes; assumed."""

_CLOTHS = np.array([[122, 44, 40], [38, 74, 60], [44, 62, 96], [196, 186, 160]], np.uint8)


@dataclass(frozen=True, slots=True)
class Attached:
    """Solids that project from facades.

    mesh    : in scene metres
    guessed : (m,) bool, faces of parts that the map does not have
    counts  : number of parts by kind
    """

    mesh: Mesh
    guessed: Bools
    counts: dict[str, int]


def attach(sheet: Sheet, at: Elevations, *, facing: Bools, guess: bool) -> Attached:
    """Solids that project from the facades; windows behind balconies extend to the floor.

    facing : (k,) whether walls face a street
    guess  : also parts that the map does not have
    """
    made = {"balconies": _balconies(sheet, at, guess=guess)}
    if guess:
        made["cornices"] = _cornices(at, facing=facing)
        made["awnings"] = _awnings(sheet, at)
        made["downpipes"] = _pipes(sheet, at, facing=facing)
    mesh = concatenate([mesh for mesh, _ in made.values()])
    guessed = np.ones(len(mesh), np.bool_)
    balconies = made["balconies"][0].feature
    guessed[: len(balconies)] = ~np.isin(balconies, at.walls.feature[at.styles.balcony_tagged])
    return Attached(mesh, guessed, {name: count for name, (_, count) in made.items()})


def without_touching(parts: Attached, solids: Mesh) -> tuple[Attached, int]:
    """The parts without those of buildings in which they touch each other or the walls.

    Also returns the number of these buildings; the counts of the parts stay.
    """
    own = solids.take(np.isin(solids.feature, parts.mesh.feature))
    verdict = validate_mesh(concatenate([own, parts.mesh]))
    bad = verdict.feature[~verdict.ok]
    kept = ~np.isin(parts.mesh.feature, bad)
    return replace(parts, mesh=parts.mesh.take(kept), guessed=parts.guessed[kept]), len(bad)


def _free(at: Elevations, wall: Ints, *, along: Float, out: Float, span: Float) -> Bools:
    """Whether no building is in the boxes (n,) before walls, ``out`` (n,) deep, ``span`` (n, 2) in height."""
    if not len(wall):
        return np.empty(0, np.bool_)
    low = np.full(len(wall), OUT)
    ends = ((0, low), (1, low), (1, out), (0, out))
    corners = [at.walls.points(wall, along[:, k], out=d) for k, d in ends]
    which, other = obstacles(at, wall, shape=shapely.polygons(np.stack(corners, axis=1)))
    free = np.ones(len(wall), np.bool_)
    free[which[(other[:, 0] < span[which, 1]) & (other[:, 1] > span[which, 0])]] = False
    return free


def _balconies(sheet: Sheet, at: Elevations, *, guess: bool) -> tuple[Mesh, int]:
    """Balconies before windows over the ground floor, in whole columns of the grid."""
    styles, cells = at.styles, at.cells
    having = (styles.balcony if guess else styles.balcony & styles.balcony_tagged)[cells.wall]
    cell = np.flatnonzero(having & (sheet.kind == WINDOW) & (cells.storey > 0))
    wall = cells.wall[cell]
    draw = uniform_at(styles.seed[wall], cells.column[cell], count=1, seed=3)[0]
    wide = np.minimum(np.floor((at.grids.cell[wall, 0] - 0.3) * 10) / 10, 3.4)
    middle, floor = cells.middle[cell], cells.floor[cell]
    along = np.column_stack([middle - wide / 2, middle + wide / 2])
    whole = uniform_at(styles.seed, np.zeros(len(styles), np.int64), count=1, seed=4)[0]
    deep = 1.1 + np.floor(whole[wall] * 4) / 10
    ok = (draw < 0.6) & (wide >= 1.4) & (along[:, 0] >= 0.2) & (along[:, 1] <= at.walls.size[wall, 0] - 0.2)
    ok &= floor - _SLAB >= cells.ground[cells.upright[cell]] + _HEADROOM
    span = np.column_stack([floor - _SLAB, floor + _PARAPET])
    ok &= _free(at, wall, along=along, out=deep + _BEFORE, span=span)
    cell, wall, along, floor, deep = cell[ok], wall[ok], along[ok], floor[ok], deep[ok]
    low = sheet.place[cell] * np.array([1, 0, 1, 1]) + np.array([0, 0.15, 0, 0])
    fits = sheet.fits(cell, WINDOW, box=low, above=0.0)
    sheet.put(cell[fits], WINDOW, box=low[fits])

    inner, near = deep - _THICK, np.full(len(deep), _GAP)
    beside = inner - _GAP
    front = _profiles([near, deep, deep, inner, inner, near], [-_SLAB, -_SLAB, _PARAPET, _PARAPET, 0.0, 0.0])
    side = _profiles([near, beside, beside, near], [_GAP, _GAP, _PARAPET, _PARAPET])
    look = {"material": materials()["concrete"].code, "color": styles.colors[wall, 3]}
    left = np.column_stack([along[:, 0], along[:, 0] + _THICK])
    right = np.column_stack([along[:, 1] - _THICK, along[:, 1]])
    bodies = [
        _prisms(at, wall, along=ends, base=floor, profile=shape, **look)
        for ends, shape in ((along, front), (left, side), (right, side))
    ]
    return concatenate(bodies), len(cell)


def _cornices(at: Elevations, *, facing: Bools) -> tuple[Mesh, int]:
    """Cornices at the top of walls to a street, under flat roofs."""
    table = at.setting.buildings
    top = at.grids.bottom + at.walls.size[:, 1]
    flat = (table.roof_height[at.grids.row] <= 0) & (top >= table.height[at.grids.row] - 0.05)
    plain = at.walls.polygon == None  # noqa: E711 - element by element
    wall = np.flatnonzero(at.styles.cornice & facing & flat & plain & (at.walls.size[:, 0] > 3.0))
    along = np.column_stack([np.full(len(wall), 0.01), at.walls.size[wall, 0] - 0.01])
    base = top[wall] - 0.5
    span = np.column_stack([base, base + 0.45])
    free = _free(at, wall, along=along, out=np.full(len(wall), 0.5), span=span)
    wall, along, base = wall[free], along[free], base[free]
    mesh = _prisms(
        at,
        wall,
        along=along,
        base=base,
        profile=_same(_CORNICE, len(wall)),
        material=materials()["stone"].code,
        color=at.styles.colors[wall, 3],
    )
    return mesh, len(wall)


def _awnings(sheet: Sheet, at: Elevations) -> tuple[Mesh, int]:
    """Awnings over shop fronts."""
    cells = at.cells
    draw = uniform_at(at.styles.seed, np.zeros(len(at.styles), np.int64), count=2, seed=5)
    cell = np.flatnonzero((sheet.kind == SHOP) & (draw[0] < _AWNINGS)[cells.wall])
    wall = cells.wall[cell]
    left = cells.middle[cell] - at.grids.middle[wall]
    along = left[:, None] + sheet.place[cell][:, [0, 2]] + np.array([-0.02, 0.02])
    base = cells.floor[cell] + sheet.place[cell, 3] + 0.25
    span = np.column_stack([base - 0.35, base + 0.06])
    free = span[:, 0] >= cells.ground[cells.upright[cell]] + _HEADROOM
    free &= _free(at, wall, along=along, out=np.full(len(wall), 1.5), span=span)
    wall, along, base = wall[free], along[free], base[free]
    mesh = _prisms(
        at,
        wall,
        along=along,
        base=base,
        profile=_same(_AWNING, len(wall)),
        material=materials()["clothing"].code,
        color=_CLOTHS[(draw[1][wall] * len(_CLOTHS)).astype(np.int64)],
    )
    return mesh, len(wall)


def _pipes(sheet: Sheet, at: Elevations, *, facing: Bools) -> tuple[Mesh, int]:
    """Downpipes beside the left edge of walls to a street without shops."""
    cells, size = at.cells, at.walls.size
    draw = uniform_at(at.styles.seed, np.zeros(len(at.styles), np.int64), count=1, seed=6)[0]
    wanted = facing & (draw < _PIPES) & (at.grids.storey == 0) & (size[:, 0] > 4.0)
    wanted &= at.walls.polygon == None  # noqa: E711 - element by element
    wanted[cells.wall[sheet.kind == SHOP]] = False
    wall = np.flatnonzero(wanted)
    ground = cells.ground[cells.upright[np.searchsorted(cells.wall, wall)]]
    base = np.maximum(ground, at.grids.bottom[wall]) + 0.15
    high = at.grids.bottom[wall] + size[wall, 1] - 0.6 - base
    along = np.tile([0.08, 0.16], (len(wall), 1))
    span = np.column_stack([base, base + high])
    free = (high > 2.0) & _free(at, wall, along=along, out=np.full(len(wall), 0.2), span=span)
    wall, base, high = wall[free], base[free], high[free]
    metal = materials()["metal"]
    mesh = _prisms(
        at,
        wall,
        along=along[free],
        base=base,
        profile=_same(_PIPE, len(wall)) * np.stack([np.ones(len(wall)), high], axis=1)[:, None],
        material=metal.code,
        color=np.tile(np.array(metal.color, np.uint8), (len(wall), 1)),
    )
    return mesh, len(wall)


def _profiles(out: Sequence[Float], up: Sequence[float]) -> Float:
    """Profiles (n, c, 2) with corners at metres out (n,) and up."""
    x = np.stack(out, axis=1)
    return np.stack([x, np.broadcast_to(np.array(up), x.shape)], axis=2)


def _same(profile: tuple[tuple[float, float], ...], count: int) -> Float:
    return np.tile(np.array(profile), (count, 1, 1))


def _prisms(
    at: Elevations,
    wall: Ints,
    *,
    along: Float,
    base: Float,
    profile: Float,
    material: int,
    color: NDArray[np.uint8],
) -> Mesh:
    """Closed prisms along walls (n,), in scene metres.

    along   : (n, 2) start and end along the wall
    base    : (n,) height above the building's base
    profile : (n, c, 2) corners across the wall, metres out and up, counter-clockwise
    """
    n, c = profile.shape[:2]
    z = at.grids.zero[wall][:, None] + base[:, None] + profile[:, :, 1]
    of, out = np.repeat(wall, c), profile[:, :, 0].ravel()
    ends = [
        np.column_stack([at.walls.points(of, np.repeat(along[:, k], c), out=out), z.ravel()]) for k in (0, 1)
    ]
    points = np.round(np.stack([e.reshape(n, c, 3) for e in ends], axis=1).reshape(-1, 3), 4)
    i, j = np.arange(c), (np.arange(c) + 1) % c
    # a balcony's profile is an L, all others are convex
    fan = [(0, k, k + 1) for k in range(1, c - 1)]
    cap = np.array([(0, 1, 4), (0, 4, 5), (1, 2, 3), (1, 3, 4)] if c == 6 else fan)
    faces = np.concatenate(
        [cap, cap[:, ::-1] + c, np.column_stack([j, i, i + c]), np.column_stack([j, i + c, j + c])]
    )
    every = (faces + 2 * c * np.arange(n)[:, None, None]).reshape(-1, 3)
    return Mesh.of(
        points,
        every,
        feature=np.repeat(at.walls.feature[wall], len(faces)),
        klass=int(Class.BUILDING),
        material=material,
        color=np.repeat(color, len(faces), axis=0),
        closed=True,
    )
