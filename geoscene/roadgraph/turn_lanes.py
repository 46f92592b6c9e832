"""Lanes that lead into each of the roads that follow, by the arrows on them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from geoscene.geometry import polylines
from geoscene.roadgraph.graph import RoadGraph
from geoscene.roadgraph.lane_tags import Lane
from geoscene.roadgraph.lanes import edge_lanes
from geoscene.roadgraph.routing import HEADING_REACH
from geoscene.typing import Float

STRAIGHT = np.radians(30.0)
"""Turns up to this angle go straight on."""

# Degrees to the left that the values of turn:lanes mean.
_MEANT = {
    "sharp_left": 135.0,
    "left": 90.0,
    "slight_left": 45.0,
    "through": 0.0,
    "slight_right": -45.0,
    "right": -90.0,
    "sharp_right": -135.0,
}
_ASIDE, _OTHER_SIDE = np.radians([10.0, 25.0])
"""An arrow to a side leads less into a road that turns by less than the first to it, as if it were off by the
second in addition."""
_MOST_OFF = np.radians(75.0)
"""An arrow does not lead into a road that turns by more than this from what it means."""


def merges(lane: Lane) -> bool:
    """Whether a lane ends and its traffic moves to the next lane."""
    return any(value.startswith("merge") for value in lane.turns)


def lanes_by_turn(lanes: Sequence[Lane], turns: Float, *, left_hand: bool) -> list[tuple[int, ...]]:
    """Numbers of the lanes that lead into each of the following roads.

    An arrow leads into the road whose direction is nearest to it. Lanes without an arrow, and lanes that
    merge, lead straight on; the former also into turns that no arrow leads into. If there are no arrows, all
    lanes lead everywhere; which lanes a turn takes is then up to the number of lanes that follow.

    lanes     : from left to right as driven
    turns     : (t,) radians to the left that each road turns
    left_hand : traffic keeps left, and turns back on the right
    """
    everything = tuple(range(len(lanes)))
    arrows = [tuple(v for v in lane.turns if not v.startswith("merge")) for lane in lanes]
    if not any(lane.turns for lane in lanes) or not len(turns):
        return [everything] * len(turns)
    found: list[set[int]] = [set() for _ in turns]
    for number, values in enumerate(arrows):
        for value in values:
            meant = np.radians(_MEANT.get(value, -180.0 if left_hand else 180.0))
            off = np.abs((turns - meant + np.pi) % (2 * np.pi) - np.pi)
            off = off + np.where(np.sign(meant) * turns < _ASIDE * abs(np.sign(meant)), _OTHER_SIDE, 0.0)
            if off.min() < _MOST_OFF:
                found[int(off.argmin())].add(number)
    free = [number for number, values in enumerate(arrows) if not values]
    staying = [number for number in free if not merges(lanes[number])]
    ahead = int(np.abs(turns).argmin())
    if abs(turns[ahead]) < 2 * STRAIGHT:
        found[ahead].update(free)
    for k, turn in enumerate(turns.tolist()):
        if not found[k]:
            left = staying or free or everything
            found[k] = {left[0]} if turn > STRAIGHT else {left[-1]} if turn < -STRAIGHT else set(left)
    return [tuple(sorted(numbers)) for numbers in found]


def lanes_into(graph: RoadGraph, edge: int, *, left_hand: bool) -> dict[int, list[int]]:
    """Numbers from the kerb of the lanes of an edge that lead into each edge that may follow."""
    out = np.flatnonzero(graph.tail == graph.head[edge])
    out = out[out != graph.twin[edge]]
    _, leaves = polylines.end_headings(graph.geometry[edge], reach=HEADING_REACH)
    enters = [polylines.end_headings(graph.geometry[e], reach=HEADING_REACH)[0] for e in out.tolist()]
    turns = (np.array(enters) - leaves + np.pi) % (2 * np.pi) - np.pi
    lanes = edge_lanes(graph, edge)
    leading = lanes_by_turn(lanes, turns, left_hand=left_hand)
    return {
        following: sorted(lane if left_hand else len(lanes) - 1 - lane for lane in numbers)
        for following, numbers in zip(out.tolist(), leading, strict=True)
    }
