"""Assigns parts to buildings, finds what parts leave of an outline, and resolves overlaps of buildings."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import shapely
from shapely.errors import GEOSException

from geoscene.buildings.footprints import Polygons, clean, groups, subtract
from geoscene.buildings.table import GRID, Texts
from geoscene.sources.data import Relation
from geoscene.support.graphs import components
from geoscene.support.problems import Problem, describe_unexpected
from geoscene.typing import Bools, Float, Ints

Rows = Ints

_LEAST_SHOWN = 0.01
"""Square metres that problems name at least."""


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

    Relations of type building take precedence. Otherwise it is the outline that covers most of the part, at
    least half of it; of several that cover over 90 %, the smallest.
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
    osm_id: Sequence[str] | Texts,
    footprint: Polygons,
    *,
    owner: Rows,
    rank: Ints,
    low: Float,
    high: Float,
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
