"""Which lanes lead into which through a junction."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from geoscene.roadgraph.lane_tags import Lane, LaneKind
from geoscene.roadgraph.turn_lanes import STRAIGHT, lanes_by_turn, merges
from geoscene.typing import Float

Pose = tuple[Float, float, float]
"""Point (3,), heading and gradient, in driving direction, where traffic enters or leaves a road."""


@dataclass(frozen=True, slots=True)
class DrivenLane:
    """A lane at the end of a road, as seen in its direction.

    number : in OpenDRIVE
    lane   : its kind, width and arrows
    inner  : metres that its inner edge is left of the centre line
    middle : metres that its middle is left of the centre line
    """

    number: int
    lane: Lane
    inner: float
    middle: float


LanePair = tuple[DrivenLane, DrivenLane]


@dataclass(frozen=True, slots=True)
class Turn:
    """A turn through a junction.

    before, after : edges
    begin, end    : where it leaves the one and enters the other
    there         : lanes of the edge after it, from the middle outwards
    pairs         : lanes that are joined
    room          : metres from the one and from the other to the node
    steepest      : greatest gradient of the two edges between their ends and the node, metres a metre
    """

    before: int
    after: int
    begin: Pose
    end: Pose
    there: Sequence[DrivenLane]
    pairs: list[LanePair]
    room: tuple[float, float]
    steepest: float

    @property
    def angle(self) -> float:
        """Radians to the left."""
        return float((self.end[1] - self.begin[1] + np.pi) % (2 * np.pi) - np.pi)


def link_lanes(here: Sequence[DrivenLane], turns: Sequence[Turn], *, left_hand: bool) -> None:
    """Join the lanes of an edge, from the middle outwards, with those of the edges that follow.

    Lanes lead where their arrows point (`lanes_by_turn`). One that leads nowhere goes straight on, into the
    lane in line with it; where there is none it ends, and its traffic merges into the lane beside it.
    """
    angles = np.array([turn.angle for turn in turns])
    kinds: tuple[LaneKind, ...] = ("driving", "bus")
    for kind in kinds:
        own = [lane for lane in here if lane.lane.kind == kind]
        in_order = own[::-1] if left_hand else own  # from left to right
        allowed = lanes_by_turn([lane.lane for lane in in_order], angles, left_hand=left_hand)
        for turn, numbers in zip(turns, allowed, strict=True):
            chosen = [in_order[number] for number in numbers]
            chosen = chosen[::-1] if left_hand else chosen
            open_there = [lane for lane in turn.there if lane.lane.kind == kind]
            if len(chosen) > len(open_there):
                chosen = [lane for lane in chosen if not merges(lane.lane)] or chosen
            if not open_there and kind == "bus":  # the bus lane ends
                open_there = [lane for lane in turn.there if lane.lane.kind == "driving"][-1:]
            turn.pairs.extend(
                _aligned(chosen, open_there, begin=turn.begin, end=turn.end, left_hand=left_hand)
            )
        if not own or not turns:
            continue
        straight = turns[int(np.abs(angles).argmin())]
        ahead = straight.pairs.copy()
        linked = {lane.number for turn in turns for lane, _ in turn.pairs}
        for lane in own:
            if lane.number not in linked and ahead:
                near = min(ahead, key=lambda pair: abs(pair[0].number - lane.number))
                straight.pairs.append(
                    (lane, near[1] if merges(lane.lane) else _beside(near, lane, turn=straight))
                )


def _beside(near: LanePair, lane: DrivenLane, *, turn: Turn) -> DrivenLane:
    """The lane into which a lane leads if it stays beside a pair of joined lanes; else that of the pair."""
    steps = abs(lane.number) - abs(near[0].number)
    wanted = abs(near[1].number) + steps
    found = (one for one in turn.there if abs(one.number) == wanted and one.lane.kind == lane.lane.kind)
    return next(found, near[1])


def link_new_lanes(turns: Sequence[Turn]) -> None:
    """Join lanes that begin at a junction with those that lead most directly into the lane beside them.

    A lane for cars into which only a lane for buses leads begins there, too.
    """
    into: dict[int, list[Turn]] = defaultdict(list)
    for turn in turns:
        into[turn.after].append(turn)
    for entering in into.values():
        linked = {lane.number for turn in entering for a, lane in turn.pairs if a.lane.kind == "driving"}
        usable = [turn for turn in entering if any(a.lane.kind == "driving" for a, _ in turn.pairs)]
        if not usable:
            continue
        straight = min(usable, key=lambda turn: (abs(turn.angle), turn.before))
        pairs = [pair for pair in straight.pairs if pair[0].lane.kind == "driving"]
        for lane in straight.there:
            if lane.number not in linked and lane.lane.kind == "driving":
                near = min(pairs, key=lambda pair: abs(pair[1].number - lane.number))
                straight.pairs.append((near[0], lane))


def _aligned(
    here: Sequence[DrivenLane],
    there: Sequence[DrivenLane],
    *,
    begin: Pose,
    end: Pose,
    left_hand: bool,
) -> list[LanePair]:
    """Pairs of lanes, both from the middle outwards.

    A turn towards the kerb takes the outermost lanes, one away from it the innermost ones; straight on, those
    that lie in line.
    """
    turn = (end[1] - begin[1] + np.pi) % (2 * np.pi) - np.pi
    outward = turn if left_hand else -turn
    count = min(len(here), len(there))
    spare, more = len(here) - count, len(there) - count
    if outward > STRAIGHT:
        places = [(spare, more)]
    elif outward < -STRAIGHT:
        places = [(0, 0)]
    else:
        places = [(k, 0) for k in range(spare + 1)] if spare else [(0, k) for k in range(more + 1)]
    heading = begin[1] + turn / 2
    left = np.array([-np.sin(heading), np.cos(heading)])
    gap = float((end[0][:2] - begin[0][:2]) @ left)

    def off(place: tuple[int, int]) -> float:
        pairs = zip(here[place[0] :], there[place[1] :], strict=False)
        return round(sum(abs(gap + b.middle - a.middle) for a, b in pairs), 6)

    a, b = min(places, key=off)
    return list(zip(here[a : a + count], there[b : b + count], strict=True))


def side_by_side(pairs: Sequence[LanePair]) -> list[list[LanePair]]:
    """Pairs from the middle outwards, in runs of lanes that lie side by side, in one order, on both roads."""
    runs: list[list[LanePair]] = []
    for pair in sorted(pairs, key=lambda pair: (abs(pair[0].number), abs(pair[1].number))):
        last = runs[-1][-1] if runs else None
        if last and all(abs(pair[k].number) - abs(last[k].number) == 1 for k in (0, 1)):
            runs[-1].append(pair)
        else:
            runs.append([pair])
    return runs
