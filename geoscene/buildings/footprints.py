"""Footprints of buildings: repair, building parts within their outlines, overlaps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.errors import GEOSException

from geoscene.buildings.table import GRID, Texts
from geoscene.geometry.frames import Frame
from geoscene.sources.data import Relation
from geoscene.support.graphs import components
from geoscene.support.problems import Problem, describe_unexpected
from geoscene.typing import Bools, Float, Ints

Polygons = NDArray[Any]

NOTCHES = (1e-2, 3e-2, 1e-1)
"""Half the diagonal of the notch that separates two rings touching in a point, metres. The next size is tried
where the rings diverge so little that the grid closes the notch again (thin wedges)."""

Rows = Ints

_LEAST_SHOWN = 0.01
"""Square metres that problems name at least."""


def to_grid(xy: Float) -> Float:
    """Coordinates rounded to the 0.1 mm grid."""
    # like GEOS: division by 1e4 gives the float nearest to the decimal, multiplication by 1e-4 does not
    return np.rint(xy * 1e4) / 1e4


def groups(number: NDArray[np.integer]) -> list[Ints]:
    """Ascending positions of each distinct number, in order of the numbers."""
    order = np.argsort(number, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(number[order])) + 1) if len(order) else []


def project(geometry: Polygons, frame: Frame) -> Polygons:
    """Polygons (n,) in degrees as polygons in scene metres, not yet on the grid."""
    out: Polygons = shapely.transform(
        geometry, lambda lonlat: np.column_stack(frame.from_geographic(lonlat[:, 0], lonlat[:, 1]))
    )
    return out


def clean(polygons: Polygons) -> tuple[Polygons, Bools]:
    """Valid polygons on the grid (n,), and which of them had to be repaired.

    A repaired polygon may be a MultiPolygon, or empty. Rings of the result do not touch: a notch of 10 mm (up
    to 100 mm in thin wedges) separates rings that touched in a point, where a wall edge would have four
    faces.
    """
    out = np.array(polygons, dtype=object)
    finite = np.isfinite(shapely.bounds(out)).all(axis=1) & ~shapely.is_empty(out)
    out[~finite] = shapely.Polygon()
    snapped = _without_repeated_points(shapely.transform(out, to_grid))
    bad = ~shapely.is_valid(snapped)
    if bad.any():
        valid = shapely.make_valid(out[bad], method="structure", keep_collapsed=False)
        snapped[bad] = _polygonal(shapely.set_precision(valid, GRID))
    pinched = ~shapely.is_simple(shapely.boundary(snapped))  # rings touch
    for row in np.flatnonzero(pinched):
        snapped[row] = _separate_rings(snapped[row])
    return shapely.orient_polygons(snapped), bad | pinched


def _without_repeated_points(polygons: Polygons) -> Polygons:
    """Polygons (n,) without repeated points; one with a ring that has shrunk to a point stays, invalid."""
    try:
        return np.asarray(shapely.remove_repeated_points(polygons, 0.0), object)
    except GEOSException:
        if len(polygons) == 1:
            return polygons
        return np.concatenate([_without_repeated_points(polygons[k : k + 1]) for k in range(len(polygons))])


def _polygonal(geometry: Polygons) -> Polygons:
    """The polygonal parts of geometries (n,); lines and points are dropped."""
    parts, row = shapely.get_parts(geometry, return_index=True)
    parts, index = shapely.get_parts(parts, return_index=True)
    keep = (shapely.get_type_id(parts) == shapely.GeometryType.POLYGON) & ~shapely.is_empty(parts)
    parts, row = parts[keep], row[index[keep]]
    out = np.full(len(geometry), shapely.Polygon(), dtype=object)
    for members in groups(row):
        k, mine = row[members[0]], parts[members]
        out[k] = mine[0] if len(mine) == 1 else shapely.multipolygons(mine)
    return out


def _separate_rings(polygon: Any) -> Any:
    """The polygon with a notch cut wherever a corner of a ring lies on another ring."""
    points, cut = _touching(polygon), polygon
    for reach in NOTCHES:
        notches = shapely.union_all(shapely.buffer(points, reach, quad_segs=1))
        cut = _polygonal(np.array([shapely.difference(polygon, notches, grid_size=GRID)], dtype=object))[0]
        if not len(_touching(cut)):
            break
    return cut


def _touching(polygon: Any) -> Polygons:
    """The corners of a polygon's rings that lie on other rings, as points."""
    rings = shapely.get_rings(shapely.get_parts(polygon))
    corners, ring = shapely.get_coordinates(rings, return_index=True)
    points = shapely.points(corners)
    distance = shapely.distance(points[:, None], rings)
    distance[np.arange(len(ring)), ring] = np.inf
    found: Polygons = points[distance.min(axis=1, initial=np.inf) < GRID / 2]
    return found


def subtract(polygon: Any, others: Any, *, sliver: float = 0.02) -> Any:
    """The polygon minus others, on the grid, without slivers narrower than twice ``sliver`` metres."""
    # pieces thinner than the grid come back as lines, which no further operation takes together with polygons
    rest = _polygonal(np.array([shapely.difference(polygon, others, grid_size=GRID)], dtype=object))[0]
    opened = shapely.buffer(
        shapely.buffer(rest, -sliver, join_style="mitre"), sliver * 1.5, join_style="mitre"
    )
    rest = shapely.intersection(rest, opened, grid_size=GRID)
    return clean(_polygonal(np.array([rest], dtype=object)))[0][0]


def overlapping(a: Polygons, b: Polygons, *, least: float = 1e-4) -> tuple[Rows, Rows, Float]:
    """Pairs of rows of a and b that share more than ``least`` square metres, and the shared areas."""
    of_b, of_a = shapely.STRtree(a).query(b, predicate="intersects")
    return _share(a, b, rows=(of_a.astype(np.int64), of_b.astype(np.int64)), least=least)


def overlapping_pairs(polygons: Polygons, *, least: float = 1e-4) -> tuple[Rows, Rows, Float]:
    """Pairs of rows, the lesser first, that share more than ``least`` square metres, and the shared areas."""
    second, first = shapely.STRtree(polygons).query(polygons, predicate="intersects").astype(np.int64)
    once = first < second
    return _share(polygons, polygons, rows=(first[once], second[once]), least=least)


def _share(a: Polygons, b: Polygons, *, rows: tuple[Rows, Rows], least: float) -> tuple[Rows, Rows, Float]:
    """The pairs of rows of a and b that share more than ``least`` square metres, and the shared areas."""
    i, j = rows
    # most pairs only touch; this test is cheaper than their intersection
    overlap = ~shapely.touches(a[i], b[j])
    i, j = i[overlap], j[overlap]
    area = shapely.area(shapely.intersection(a[i], b[j]))
    keep = area > least
    return i[keep], j[keep], area[keep]


def duplicates(
    osm_id: Sequence[str] | Texts, footprint: Polygons, *, score: Float
) -> tuple[Bools, list[Problem]]:
    """Which buildings (n,) repeat another one, and the problems.

    Two buildings are the same if they share over 90 % of both areas. The one with the higher score is kept,
    of equal ones the first.

    score : (n,) how much is known of each building, in any unit
    """
    area = shapely.area(footprint)
    # Equal outlines first: each overlaps all others.
    shapes = shapely.to_wkb(shapely.normalize(footprint))
    order = np.argsort(-score, kind="stable")
    _, best, group = np.unique(shapes[order], return_index=True, return_inverse=True)
    first = np.empty(len(footprint), np.int64)
    first[order] = order[best][group.ravel()]
    kept = np.flatnonzero(first == np.arange(len(footprint)))
    a, b, shared = overlapping_pairs(footprint[kept])
    a, b = kept[a], kept[b]
    same = shared > 0.9 * np.maximum(area[a], area[b])
    repeated = first != np.arange(len(footprint))
    problems = [
        Problem(osm_id[i], "building", "dropped", "duplicate", f"the same outline as {osm_id[first[i]]}")
        for i in np.flatnonzero(repeated).tolist()
    ]
    for i, j, s in zip(a[same], b[same], shared[same], strict=True):
        if repeated[i] or repeated[j]:
            continue
        loser, winner = (j, i) if score[i] >= score[j] else (i, j)
        repeated[loser] = True
        detail = f"shares {s:.1f} of {area[loser]:.1f} m2 with {osm_id[winner]}"
        problems.append(Problem(osm_id[loser], "building", "dropped", "duplicate", detail))
    return repeated, problems


def assign(
    part_id: Sequence[str],
    part: Polygons,
    *,
    outline_id: Sequence[str],
    outline: Polygons,
    relations: Sequence[Relation],
) -> Rows:
    """The row of the outline of every part (n,), -1 for parts outside any outline.

    Relations of type building take precedence, by their outline or as an outline themselves. Otherwise it is
    the outline that covers most of the part, at least half of it; of several that cover over 90 %, the
    smallest.
    """
    found = np.full(len(part), -1, np.int64)
    p, o, shared = overlapping(part, outline)
    share = shared / shapely.area(part)[p]
    order = np.lexsort((shapely.area(outline)[o], -np.minimum(share, 0.9), p))
    order = order[share[order] > 0.5]
    _, first = np.unique(p[order], return_index=True)
    found[p[order][first]] = o[order][first]

    outline_row, part_row = ({name: row for row, name in enumerate(ids)} for ids in (outline_id, part_id))
    for relation in relations:
        if relation.tags.get("type") != "building":
            continue
        members = [(f"{kind}/{ref}", role) for kind, ref, role in relation.members]
        target = next((outline_row[m] for m, role in members if role == "outline" and m in outline_row), None)
        target = outline_row.get(relation.osm_id) if target is None else target
        if target is None:
            continue
        for member, role in members:
            if role != "outline" and member in part_row:
                found[part_row[member]] = target
    return found


def clusters(polygons: Polygons) -> Rows:
    """Cluster number (n,) of polygons; those that touch or overlap, directly or through others, share one."""
    i, j = shapely.STRtree(polygons).query(polygons, predicate="intersects")
    return components(i, j, count=len(polygons))


def remainder(outline: Any, parts: Polygons, *, strip: float) -> tuple[Any, float, float]:
    """Outline minus its parts: the pieces that are wider than ``strip`` metres somewhere.

    Also returns the share of the outline that the parts cover, and the area in square metres that neither
    they nor the pieces do.
    """
    union = shapely.union_all(parts, grid_size=GRID)
    covered = shapely.area(shapely.intersection(outline, union))
    pieces = shapely.get_parts(subtract(outline, union))
    wide = ~shapely.is_empty(shapely.buffer(pieces, -strip / 2, join_style="mitre"))
    kept = pieces[wide]
    rest = kept[0] if len(kept) == 1 else shapely.multipolygons(kept)
    left_out = shapely.area(outline) - covered - shapely.area(rest)
    return rest, float(covered / shapely.area(outline)), float(left_out)


def cut_overlaps(
    osm_id: Sequence[str] | Texts, footprint: Polygons, *, owner: Rows, rank: Ints, low: Float, high: Float
) -> tuple[Polygons, list[Problem]]:
    """Footprints (n,) without the overlaps between buildings, and the problems.

    Of two pieces of different buildings that overlap in plan and in height, the one of higher rank keeps its
    shape; the smaller one does if the ranks are equal or if it rises above the other. A piece that keeps less
    than a tenth of its area is dropped (its footprint becomes empty).

    rank      : (n,) how well each piece is described
    low, high : metres above the base; pieces above one another do not overlap
    """
    area = shapely.area(footprint)
    a, b, shared = overlapping_pairs(footprint)
    overlap = (owner[a] != owner[b]) & (np.minimum(high[a], high[b]) > np.maximum(low[a], low[b]))
    a, b, shared = a[overlap], b[overlap], shared[overlap]
    b_smaller = area[b] < area[a]  # of equal ones a comes first
    small, large = np.where(b_smaller, (b, a), (a, b))
    small_wins = (rank[small] >= rank[large]) | (high[small] > high[large])
    loser, winner = np.where(small_wins, (large, small), (small, large))
    place = np.empty(len(area), np.int64)
    place[np.lexsort((area, -rank))] = np.arange(len(area))
    out = footprint.copy()
    problems = []
    # in order of rank and size, so that most pieces have their final shapes before they cut others
    for mine in sorted(groups(loser), key=lambda g: place[loser[g[0]]]):
        row = loser[mine[0]]
        cutters = out[winner[mine]]
        try:
            out[row] = subtract(out[row], shapely.union_all(cutters, grid_size=GRID))
        except GEOSException as error:
            out[row] = shapely.Polygon()
            problems.append(describe_unexpected(osm_id[row], error, kind="building"))
            continue
        winners = ", ".join(sorted({osm_id[w] for w in winner[mine]}))
        lost = area[row] - shapely.area(out[row])  # under 0 where rounding to the grid adds more
        amount = f"{lost:.2f}" if lost >= _LEAST_SHOWN else f"under {_LEAST_SHOWN}"
        detail = f"lost {amount} m2 of {area[row]:.1f} m2 to {winners}"
        if shapely.area(out[row]) < 0.1 * area[row]:
            out[row] = shapely.Polygon()
            problems.append(Problem(osm_id[row], "building", "dropped", "inside-another", detail))
        else:
            problems.append(Problem(osm_id[row], "building", "repaired", "overlap", detail))
    out[loser] = clean(out[loser])[0]
    return out, problems
