"""Lines along which the ground of roads bends: across them where their gradient changes, and amid them."""

from __future__ import annotations

from typing import Any

import numpy as np
import shapely

from geoscene.geometry import polylines
from geoscene.roadgraph.grading import structure_starts
from geoscene.roadgraph.graph import RoadGraph
from geoscene.roadgraph.routing import edge_lines
from geoscene.roadgraph.surface_rows import in_reach
from geoscene.typing import Bools, Float, Height, Ints

_STRAIGHT = 0.005
"""Metres by which a profile may be off between the lines across it."""

_LEVEL = 1e-3
"""Metres: the heights of a road whose ground needs no lines, unless a higher or lower one is beside it."""

_GRADED = 40.0
"""Metres between the centre lines of roads within which the ground of one slopes to that of the other."""

_NEAR = 50.0
"""Metres from an area within which roads count: more than between vertices."""

_BESIDE = 2.0
"""Metres beyond both edges of a carriageway to which lines across it reach."""

_WITHIN = 0.05
"""Metres inside both edges of a carriageway at which the ground is looked up."""

_OFF = 0.01
"""Metres from the profile to the ground at the edges of a carriageway from which its middle has a line."""

_SHARES = (0.0, 0.25, 0.5, 0.75, 1.0)
"""Where between two vertices that is looked up."""


def crease_lines(graph: RoadGraph, height: Height, *, area: Any | None = None) -> Float:
    """Segments (m, 2, 2) in scene metres that the ground of roads needs to have the heights of the graph.

    Lines across carriageways on the ground, where the gradient of their profile changes; their centre lines
    where the ground at their edges is higher or lower, as near junctions and beside other roads.

    graph  : with heights
    height : of the ground, graded to it
    area   : shapely geometry, scene metres: roads far from it have none; all have by default
    """
    single = graph.once
    on_ground = ~graph.bridge & ~graph.tunnel
    uneven = np.array([bool(np.abs(line[:, 2]).max() > _LEVEL) for line in graph.geometry], np.bool_)
    once = np.flatnonzero(single & on_ground)
    drawn = edge_lines(graph)
    tree = shapely.STRtree(drawn[uneven])
    once = once[np.unique(tree.query(drawn[once], predicate="dwithin", distance=_GRADED)[0])]
    once = once[in_reach(drawn[once], area, metres=_NEAR)]
    if not len(once):
        return np.empty((0, 2, 2))
    begun = structure_starts(graph)
    begun = begun.take(in_reach(drawn[begun.edge], area, metres=_NEAR))
    lines = [*graph.geometry[once], *begun.line]
    edge = np.append(once, begun.edge)
    xyz = np.concatenate(lines)
    of = np.repeat(np.arange(len(lines)), [len(line) for line in lines])
    half = graph.width[edge][of] / 2
    start = np.flatnonzero(of[1:] == of[:-1])
    across = _across(xyz, of)
    count = len(graph.node_id)
    ends = np.concatenate(
        [
            np.stack([graph.tail[once], graph.head[once]], axis=1).astype(np.int64),
            np.stack([begun.node, count + np.arange(len(begun))], axis=1),
        ]
    )
    along = _bent_across(xyz, start, across=across, half=half, height=height)
    along = _around_nodes(along, of[start], ends=ends, count=count + len(begun))
    ribbed = _bent_along(xyz, of)
    ribbed[start[along]] = ribbed[start[along] + 1] = True
    first, last = np.append(True, of[1:] != of[:-1]), np.append(of[1:] != of[:-1], True)
    at_node = np.concatenate([graph.tail[single], graph.head[single]])
    arms = np.bincount(at_node, minlength=count + len(begun))
    node = np.where(first, ends[of, 0], ends[of, 1])
    ribbed &= ~(first | last) | (arms[node] < 3)
    aside = (half + _BESIDE)[ribbed, None] * across[ribbed]
    middle = np.stack([xyz[start[along], :2], xyz[start[along] + 1, :2]], axis=1)
    ribs = np.stack([xyz[ribbed, :2] - aside, xyz[ribbed, :2] + aside], axis=1)
    return np.concatenate([middle, ribs])


def _across(xyz: Float, of: Ints) -> Float:
    """Unit vectors (n, 2) across lines at their vertices; of two directions the mean."""
    step = polylines.unit(np.diff(xyz[:, :2], axis=0))
    step[of[1:] != of[:-1]] = 0.0
    none = np.zeros((1, 2))
    x, y = polylines.unit(np.concatenate([none, step]) + np.concatenate([step, none])).T
    return np.column_stack([-y, x])


def _bent_along(xyz: Float, of: Ints) -> Bools:
    """Whether profiles need each vertex (n,): ends, and changes of gradient."""
    step = np.hypot(*np.diff(xyz[:, :2], axis=0, prepend=xyz[:1, :2]).T)
    first = np.flatnonzero(np.diff(of, prepend=-1))
    step[first] = 0.0
    along = polylines.add_up(step, first[of])
    profiles = shapely.linestrings(np.column_stack([along, xyz[:, 2]]), indices=of)
    kept, line = shapely.get_coordinates(shapely.simplify(profiles, _STRAIGHT), return_index=True)
    far = float(along.max()) + 1.0
    needed: Bools = np.isin(of * far + along, line * far + kept[:, 0])
    return needed


def _bent_across(xyz: Float, start: Ints, *, across: Float, half: Float, height: Height) -> Bools:
    """Whether the ground at an edge of a carriageway is off the profile after vertices (s,)."""
    bent = np.zeros(len(start), np.bool_)
    for share in _SHARES:
        place = xyz[start] * (1 - share) + xyz[start + 1] * share
        turn = polylines.unit(across[start] * (1 - share) + across[start + 1] * share)
        for side in (-1.0, 1.0):
            x, y = (place[:, :2] + side * (half[start] - _WITHIN)[:, None] * turn).T
            bent |= np.abs(np.asarray(height(x, y), float) - place[:, 2]) > _OFF
    return bent


def _around_nodes(along: Bools, of: Ints, *, ends: Ints, count: int) -> Bools:
    """Segments (s,) with those of all lines at a node where one of them is chosen.

    of   : (s,) the line of each segment
    ends : (k, 2) nodes at the start and the end of each line
    """
    first, last = np.append(True, of[1:] != of[:-1]), np.append(of[1:] != of[:-1], True)
    bent = np.zeros(count, np.bool_)
    bent[ends[of[first & along], 0]] = bent[ends[of[last & along], 1]] = True
    around: Bools = along | (first & bent[ends[of, 0]]) | (last & bent[ends[of, 1]])
    return around
