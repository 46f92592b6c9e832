"""Builds watertight solids from the table of buildings."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.buildings.footprints import Polygons, clean, groups
from geoscene.buildings.roofs import RoofSpec, roof_shells
from geoscene.buildings.shells import ShellTriangles, parapets, prisms
from geoscene.buildings.table import Buildings
from geoscene.buildings.unions import unite
from geoscene.classes import Class
from geoscene.errors import InputError
from geoscene.geometry.mesh import FLOOR, ROOF, Mesh
from geoscene.geometry.watertight import check_solids, weld
from geoscene.support.columns import Columns
from geoscene.support.problems import Problem, described, make_without_failures
from geoscene.typing import Bools, Float, Ints

_ALIGNED = 0.02
"""Metres, grid on which the pieces of a building are put together if they do not unite as they are."""


_OVERLAP = 0.01
"""Metres by which pieces with roofs grow if they do not unite as they are.

The corners of a roof on a wall are rounded, and so lie off the plane of the wall beside it."""

_STRAIGHT = 2e-3
"""Metres off a straight wall within which corners are left out; far below what a map resolves (1 cm)."""


@dataclass(frozen=True, slots=True)
class _Pieces(Columns):
    """Single polygons to extrude: one or several per row of the table."""

    polygon: NDArray[Any]
    row: Ints
    building: Ints
    base: Float
    low: Float
    high: Float
    flat: Bools
    parapet: Float


def build_solids(
    buildings: Buildings,
    *,
    base: Float,
    foot: Float | None = None,
    lod: int = 2,
    parapet: Float | None = None,
) -> tuple[Mesh, list[Problem]]:
    """One valid body (`check_solids`) per building, and the simplified or dropped ones.

    Vertices lie on the 0.1 mm grid. Faces have the building's row as feature, class BUILDING, and surface,
    material and colour. LoD 0 extrudes the outline from its lowest underside to the mean height of its parts;
    LoD 1 has parts with their undersides and flat tops at full height; LoD 2 has roofs. A building whose body
    is not a solid is built again with its parts on a common grid, then with parts that have roofs overlapping
    others, then with flat roofs, then with cleaned footprints, and is dropped if that fails too.

    base : (count,) or (n,) z in metres of each building's base, in the order of the table; a part stands on
           its building's base
    foot : z in metres of the lower end of each building's walls, in the same order; parts that stand on the
           ground reach down to it. The base by default.
    parapet : (n,) metres of the parapet above the flat roof of each row of the table, where no part of its
           building as high is beside it; none by default, and on a building that is no solid with them

    Raises InputError for another level of detail or a base of the wrong length.
    """
    if lod not in (0, 1, 2):
        raise InputError(f"level of detail {lod}: there are 0 (blocks), 1 (parts, flat roofs) and 2 (roofs)")
    base = np.asarray(base, float)
    for what, z in (("bases", base), ("feet", base if foot is None else foot)):
        if len(z) not in (buildings.count, len(buildings)):
            raise InputError(f"{len(z)} {what} for {buildings.count} buildings")
    foot = base if foot is None else np.asarray(foot, float)
    pieces = _pieces(buildings, base, foot=foot, lod=lod)
    if parapet is not None and lod == 2:
        pieces = replace(pieces, parapet=_parapets(pieces, parapet))
    problems: list[Problem] = []

    done = [ShellTriangles(np.empty((0, 3, 3)), np.empty(0, np.int64), np.empty(0, np.uint8))]
    for attempt in ("", "no-parapet", "aligned-parts", "overlapping-roofs", "flat-roof", "cleaned-footprint"):
        if not len(pieces.row):
            break
        if attempt in ("overlapping-roofs", "flat-roof") and pieces.flat.all():
            continue
        if attempt == "no-parapet":
            if not pieces.parapet.any():
                continue
            pieces = replace(pieces, parapet=np.zeros(len(pieces.row)))
        if attempt == "aligned-parts":
            pieces = _align(pieces)
        elif attempt in ("flat-roof", "cleaned-footprint"):
            pieces = replace(pieces, flat=np.ones(len(pieces.row), np.bool_))
        if attempt == "cleaned-footprint":
            pieces = _simplify(pieces)
        tried = _overlapping(pieces) if attempt == "overlapping-roofs" else pieces
        shells, failed, notes = _bodies(buildings, tried)
        problems += notes
        good = shells.take(~np.isin(tried.building[shells.piece], failed))
        done.append(replace(good, piece=tried.row[good.piece]))
        if attempt:
            made = np.setdiff1d(pieces.building, failed)
            problems += [_problem(buildings, b, action="repaired", reason=attempt) for b in made]
        pieces = pieces.take(np.isin(pieces.building, failed))
    problems += [
        _problem(buildings, b, action="dropped", reason="no-solid") for b in np.unique(pieces.building)
    ]
    return _mesh(buildings, ShellTriangles.concatenate(done)), problems


def _problem(buildings: Buildings, row: int, *, action: Any, reason: str, detail: str = "") -> Problem:
    return Problem(str(buildings.osm_id[row]), "building", action, reason, detail)


def _pieces(buildings: Buildings, base: Float, *, foot: Float, lod: int) -> _Pieces:
    """The polygons to extrude, sorted by building."""
    chosen = np.flatnonzero(~buildings.is_part if lod == 0 else buildings.drawn)
    polygon, index = shapely.get_parts(buildings.footprint[chosen], return_index=True)
    row = chosen[index]
    building = buildings.outline[row].astype(np.int64)
    order = np.argsort(building, kind="stable")
    polygon, row, building = polygon[order], row[order], building[order]
    low, high = buildings.min_height[row], buildings.height[row]
    if lod == 0:
        low, high = _lowest(buildings)[row], _mean_heights(buildings)[row]
    flat = (
        np.full(len(row), lod < 2) | (buildings.roof_shape[row] == "flat") | (buildings.roof_height[row] <= 0)
    )
    underside = base[building] + low
    grounded = low <= 0
    underside[grounded] = np.minimum(underside, foot[building])[grounded]
    polygon = _straighten(polygon, building)
    return _Pieces(
        polygon, row, building, base[building], underside, base[building] + high, flat, np.zeros(len(row))
    )


def _parapets(pieces: _Pieces, parapet: Float) -> Float:
    """Heights (n,) of parapets: 0 next to a piece of the building of similar or greater height."""
    rise = np.where(pieces.flat, parapet[pieces.row], 0.0)
    i, j = shapely.STRtree(pieces.polygon).query(pieces.polygon, predicate="dwithin", distance=0.1)
    beside = (i != j) & (pieces.building[i] == pieces.building[j]) & (pieces.high[j] > pieces.high[i] - 1.0)
    rise[i[beside & (pieces.low[j] < pieces.high[i] + 1.0)]] = 0.0
    return rise


def _straighten(polygons: Polygons, building: Ints) -> Polygons:
    """Polygons (n,) without corners in straight walls, unless another piece of the building has them."""
    simple = shapely.simplify(polygons, _STRAIGHT)
    longer = np.isin(
        building, building[shapely.get_num_coordinates(simple) < shapely.get_num_coordinates(polygons)]
    )
    rings, of = shapely.get_rings(polygons[longer], return_index=True)
    corners, ring = shapely.get_coordinates(rings, return_index=True)
    wanted, polygon = shapely.get_coordinates(simple[longer], return_index=True)
    owner = building[longer][np.append(of[ring], polygon)]
    place, _ = weld(np.pad(np.concatenate([corners, wanted]), ((0, 0), (0, 1))), owner)
    kept = np.isin(place[: len(corners)], place[len(corners) :])
    kept[:-1] &= np.diff(ring) == 0  # a ring's last point is its first
    kept[-1:] = False
    out = polygons.copy()
    out[longer] = shapely.polygons(shapely.linearrings(corners[kept], indices=ring[kept]), indices=of)
    return out


def _lowest(buildings: Buildings) -> Float:
    """Lowest undersides (n,) of the drawn rows of each row's outline, in metres above its base."""
    lowest, drawn = np.full(len(buildings), np.inf), buildings.drawn
    np.minimum.at(lowest, buildings.outline[drawn], buildings.min_height[drawn])
    return np.where(np.isinf(lowest), buildings.min_height, lowest)


def _mean_heights(buildings: Buildings) -> Float:
    """Heights (n,) of the table's rows; of buildings with parts, the mean of the parts weighted by area."""
    area = np.where(buildings.drawn, shapely.area(buildings.footprint), 0.0)
    total = np.bincount(buildings.outline, weights=area, minlength=len(buildings))
    sums = np.bincount(buildings.outline, weights=area * buildings.height, minlength=len(buildings))
    return np.divide(sums, total, out=buildings.height.copy(), where=total > 0)


def _align(pieces: _Pieces) -> _Pieces:
    """The pieces of each building on a common grid of 2 cm in plan and 1 cm in height.

    Corners and edges of different pieces then coincide or are at least 1 cm apart (snap rounding).
    """
    out = [pieces.take(np.empty(0, np.int64))]
    for mine in groups(pieces.building):
        family = pieces.take(mine)
        lines = shapely.union_all(shapely.boundary(family.polygon), grid_size=_ALIGNED)
        cells = shapely.get_parts(shapely.polygonize(shapely.get_parts(lines)))
        inside = shapely.point_on_surface(cells)
        held = [cells[shapely.contains(polygon, inside)] for polygon in family.polygon]
        out.append(_cut(family, np.fromiter([shapely.union_all(h) for h in held], object)))
    aligned = _Pieces.concatenate(out)
    low, high = np.round(aligned.low, 2), np.round(aligned.high, 2)
    return replace(aligned, low=low, high=high).take(high > low)


def _overlapping(pieces: _Pieces) -> _Pieces:
    """The pieces; those with roofs are enlarged by different amounts (1 cm, 2 cm ...) to overlap."""
    near = 10 * _OVERLAP
    i, j = shapely.STRtree(pieces.polygon).query(pieces.polygon, predicate="dwithin", distance=near)
    same = pieces.building[i] == pieces.building[j]
    i, j = i[same], j[same]
    rank = np.zeros(len(pieces.row), np.int64)
    for k in np.flatnonzero(~pieces.flat).tolist():
        taken = rank[j[i == k]]
        rank[k] = np.setdiff1d(np.arange(1, len(taken) + 2), taken)[0]
    return _cut(pieces, shapely.buffer(pieces.polygon, _OVERLAP * rank, join_style="mitre"))


def _simplify(pieces: _Pieces) -> _Pieces:
    """The pieces with footprints opened by 5 mm and rounded to 1 cm, which removes thin necks and spikes.

    Pieces of a divided building also lose 1 cm all around, so that those side by side do not touch.
    """
    alone = np.bincount(pieces.building)[pieces.building] == 1
    opened = shapely.buffer(pieces.polygon, np.where(alone, -0.005, -0.015), join_style="mitre")
    rounded = shapely.set_precision(shapely.buffer(opened, 0.005, join_style="mitre"), 0.01)
    return _cut(pieces, rounded)


def _cut(pieces: _Pieces, polygons: Polygons) -> _Pieces:
    """The pieces with other polygons (n,), one piece for each part of these."""
    polygon, index = shapely.get_parts(clean(polygons)[0], return_index=True)
    return replace(pieces.take(index), polygon=polygon).take(shapely.area(polygon) > 0)


def _bodies(buildings: Buildings, pieces: _Pieces) -> tuple[ShellTriangles, Ints, list[Problem]]:
    """Triangles of all bodies, the buildings that failed, and the replaced roofs and separated bodies."""
    shells, notes = _shells(buildings, pieces)
    found = check_solids(shells.corners, shells.piece, n=len(pieces.row))
    bad = np.unique(pieces.building[~found.closed_solid])
    alone = np.bincount(pieces.building, minlength=len(buildings) + 1)[pieces.building] == 1
    cut = np.array([len(cuts) > 0 for cuts in buildings.passages[pieces.building]], np.bool_)
    ready = found.ok & alone & ~cut
    out = [shells.take(ready[shells.piece])]
    rest = shells.take((~ready & ~np.isin(pieces.building, bad))[shells.piece])
    owner = pieces.building[rest.piece]
    families = [rest.take(rows) for rows in groups(owner)]
    cuts = [_cuts(buildings, pieces, chosen=np.unique(family.piece)) for family in families]
    for building, united in zip(np.unique(owner).tolist(), unite(families, cuts), strict=True):
        if united is None:
            bad = np.append(bad, building)
            continue
        body, note = united
        out.append(body)
        if note:
            notes.append(
                _problem(buildings, building, action="repaired", reason="touching-bodies", detail=note)
            )
    failed = {buildings.osm_id[b] for b in bad}
    return ShellTriangles.concatenate(out), bad, [p for p in notes if p.osm_id not in failed]


def _cuts(buildings: Buildings, pieces: _Pieces, *, chosen: Ints) -> list[ShellTriangles]:
    """Closed shells of the passages through a building, given its pieces (numbers).

    Their faces, which become those of the passages, have the number of the piece of which they cut most.
    """
    low, base = pieces.low[chosen].min() - 1.0, pieces.base[chosen[0]]
    out = []
    for polygons, top in buildings.passages[pieces.building[chosen[0]]]:
        for polygon in shapely.get_parts(polygons):
            common = shapely.area(shapely.intersection(pieces.polygon[chosen], polygon))
            shell = prisms(
                np.array([polygon]),
                chosen[[np.argmax(common)]],
                low=np.array([low]),
                high=np.array([base + top]),
            )
            # tops of passages are undersides of what is above them
            out.append(replace(shell, surface=np.where(shell.surface == ROOF, FLOOR, shell.surface)))
    return out


def _shells(buildings: Buildings, pieces: _Pieces) -> tuple[ShellTriangles, list[Problem]]:
    """The closed shell of each piece, and the replaced roofs."""
    notes = []
    flat = np.flatnonzero(pieces.flat)
    bare, walled = flat[pieces.parapet[flat] <= 0], flat[pieces.parapet[flat] > 0]
    made = [prisms(pieces.polygon[bare], bare.astype(np.int64), low=pieces.low[bare], high=pieces.high[bare])]
    if len(walled):
        low, high, rise = pieces.low[walled], pieces.high[walled], pieces.parapet[walled]
        made.append(parapets(pieces.polygon[walled], walled.astype(np.int64), low=low, high=high, rise=rise))

    def failed(k: int, error: Exception) -> None:
        one = slice(k, k + 1)
        shell = prisms(pieces.polygon[one], np.array([k]), low=pieces.low[one], high=pieces.high[one])
        shape = buildings.roof_shape[pieces.row[k]]
        given.append((shell, {k: f"{shape} roof made flat, {described(error)}"}))

    given: list[tuple[ShellTriangles, dict[int, str]]] = []
    given += make_without_failures(
        lambda rows: _roof(buildings, pieces, rows=rows), np.flatnonzero(~pieces.flat), failed=failed
    )
    made += [shells for shells, _ in given]
    for _, replaced in given:
        notes += [
            _problem(buildings, pieces.row[k], action="repaired", reason="roof-fallback", detail=note)
            for k, note in replaced.items()
        ]
    return ShellTriangles.concatenate(made), notes


def _roof(buildings: Buildings, pieces: _Pieces, *, rows: Ints) -> tuple[ShellTriangles, dict[int, str]]:
    """Closed shells of pieces (rows) with their roofs, and replaced roofs, by piece."""
    of = pieces.row[rows]
    columns = (
        buildings.roof_shape[of],
        pieces.low[rows],
        pieces.high[rows],
        buildings.roof_height[of],
        buildings.roof_direction[of],
        buildings.roof_across[of],
    )
    specs = [RoofSpec(*values) for values in zip(*(column.tolist() for column in columns), strict=True)]
    shells, notes = roof_shells(pieces.polygon[rows], specs)
    shells = replace(shells, piece=rows[shells.piece])
    return shells, {k: note for k, note in zip(rows.tolist(), notes, strict=True) if note}


def _mesh(buildings: Buildings, triangles: ShellTriangles) -> Mesh:
    """The mesh of all triangles (pieces: rows of the table), sorted by building and welded within each."""
    triangles = triangles.take(np.argsort(buildings.outline[triangles.piece], kind="stable"))
    row = triangles.piece
    feature = buildings.outline[row].astype(np.int64)
    corners = triangles.corners.reshape(-1, 3)
    ids, first = weld(corners, np.repeat(feature, 3))
    roof = (triangles.surface == ROOF)[:, None]
    return Mesh.of(
        corners[first],
        ids.reshape(-1, 3),
        feature=feature,
        klass=int(Class.BUILDING),
        material=np.where(roof[:, 0], buildings.roof_material[row], buildings.wall_material[row]),
        surface=triangles.surface,
        color=np.where(roof, buildings.roof_color[row], buildings.wall_color[row]),
        closed=True,
    )
