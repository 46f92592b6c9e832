"""Lateral position of lanes: how a carriageway is divided between its two directions.

Routes, traffic, paint and OpenDRIVE all take the number, width and place of lanes from here. Lanes of an edge
are counted from the kerb: lane 0 is the outermost one. Offsets are measured from the carriageway's centre
line, positive towards the side that traffic keeps to.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from geoscene.roadgraph.graph import RoadGraph
from geoscene.support.columns import Columns
from geoscene.typing import Bools, Float, Ints

WIDEST_LANE = 4.5
"""Metres: the lanes of a carriageway with several are not wider; the rest is for parking and bicycles."""


@dataclass(frozen=True, slots=True)
class LaneLayout(Columns):
    """Lanes of directed edges, one row each.

    own    : (m,) int64, lanes that only traffic along the edge uses
    other  : (m,) int64, lanes that only traffic against the edge uses
    shared : (m,) bool, there is one more lane between them, which both directions use
    carriageway : (m,) metres from kerb to kerb
    """

    own: Ints
    other: Ints
    shared: Bools
    carriageway: Float

    @property
    def count(self) -> Ints:
        """Lanes (m,) of both directions."""
        return self.own + self.other + self.shared

    @property
    def span(self) -> Float:
        """Metres (m,) that all lanes take up together, in the middle of the carriageway."""
        widest = np.where(self.count > 1, WIDEST_LANE * self.count, np.inf)
        return np.minimum(self.carriageway, widest)

    @property
    def width(self) -> Float:
        """Metres (m,) of a lane."""
        return self.span / self.count

    @property
    def divider(self) -> Float:
        """Offset (m,) of the line between the directions, in the middle of a shared lane.

        On a one-way street it is the edge of the lanes on the other side.
        """
        return self.span / 2 - (self.own + 0.5 * self.shared) * self.span / self.count

    def offsets(self, lane: ArrayLike = 0, *, body_width: float, clearance: float) -> Float:
        """Offset (m,) of the middle of a lane, or of a body that keeps clear of the kerbs where it can.

        On a single shared lane, each direction keeps to its half.

        lane       : number of the lane, from the kerb
        body_width : metres
        clearance  : metres between body and kerb; where there is no room for it the body takes the middle
        """
        middle = self.span / 2 - (np.asarray(lane) + 0.5) * self.span / self.count
        middle = np.where(self.shared & (self.count == 1), self.carriageway / 4, middle)
        room = np.maximum(self.carriageway / 2 - body_width / 2 - clearance, 0.0)
        return np.clip(middle, -room, room)


def lane_layout(along: Float, against: Float, *, two_way: Bools, width: Float) -> LaneLayout:
    """Layout of the lanes of carriageways.

    along, against : (m,) lanes of each direction as mapped; where both are fractions, as in 1.5 and 1.5,
                     there is a lane that both share; other fractions are dropped
    two_way : (m,) bool
    width   : (m,) metres from kerb to kerb
    """
    shared = two_way & (along % 1 > 0) & (against % 1 > 0)
    least = np.where(shared, 0, 1)
    own = np.maximum(np.floor(along), least).astype(np.int64)
    other = np.where(two_way, np.maximum(np.floor(against), least), 0).astype(np.int64)
    return LaneLayout(own, other, shared, width)


def graph_lanes(graph: RoadGraph) -> LaneLayout:
    """The lanes of the edges of a road graph."""
    two_way = graph.twin >= 0
    against = np.where(two_way, graph.lanes[graph.twin], 0.0)
    return lane_layout(graph.lanes, against, two_way=two_way, width=graph.width)
