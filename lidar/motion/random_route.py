"""Random routes: where they start, which streets they take and where they end."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.geometry import polylines
from geoscene.roadgraph.graph import RoadGraph
from geoscene.roadgraph.routing import TurnStates, permitted_turns, turns_back
from geoscene.support.splitmix import GOLDEN
from geoscene.typing import Bools, Float, Ints
from lidar.geometry.random_streams import generator

_LAST_START = 0.9
"""Share of a street within which a route starts."""
_FIRST_END = 0.1
"""Share of a street from which on a route ends."""
_SHORTEST = 0.75
"""Share of the longest route that must be left at the start if no route has the requested length."""
_MINOR = ("service", "track")
_WALKING = "living_street"
_SELDOM = 0.02
"""Weight of minor roads in the choice at a junction; of streets 1."""
_FURTHER = 20
"""Maximum number of streets by which a route is longer than requested, to end on a public street."""
_BODY_M = 5.0
"""Metres of street that must not lie below a roof at the start."""
_PLACES = 50
"""Maximum number of places that are drawn for a start in the open."""
_MOST_STREETS = 1_000_000
"""Streets of zero length must not make a route endless."""


@dataclass(frozen=True, slots=True)
class _Streets:
    """States of the search for a route, in units of the requested route.

    edge        : (s,) edge of each state
    cost        : (m,) length of each edge
    left        : (s,) longest drive from the start of each state; over 2 where it is unlimited
    first, after : states that follow state k are ``after[first[k] : first[k + 1]]``
    """

    edge: NDArray[np.int32]
    cost: Float
    left: Float
    first: Ints
    after: NDArray[np.int32]

    def starts(self, need: float) -> Float:
        """Share (m,) of each edge, from its beginning, on which a route can start that still has ``need``."""
        left = self.left[: len(self.cost)]  # the first states are the edges themselves
        spare = np.divide(left - need, self.cost, out=np.zeros(len(left)), where=self.cost > 0)
        return np.clip(spare, 0.0, _LAST_START)


def public_streets(graph: RoadGraph, *, body_width: float) -> Bools:
    """Whether (m,) edges are public streets in the open, as wide as a body of so many metres.

    Service roads, among them the aisles of car parks, tracks and streets at walking pace are not; nor is what
    lies in a tunnel.
    """
    other = np.isin(graph.highway, (*_MINOR, _WALKING))
    return ~graph.tunnel & ~other & (graph.width >= body_width)


def random_edges(
    graph: RoadGraph,
    *,
    seed: int,
    seconds: float = np.inf,
    metres: float = np.inf,
    avoid: Collection[tuple[int, int]] = (),
    body_width: float = 0.0,
    roofs: shapely.STRtree | None = None,
) -> tuple[NDArray[np.int32], tuple[float, float]]:
    """Edges of a random route that lasts ``seconds`` at the speed limits or ``metres``, whichever is shorter.

    Also the true metres from the first edge's tail to the start, and from the last one's tail to the end.

    The start is drawn by length from all places from which so long a route is possible: into a connected part
    of the graph that has as much street, or the largest, or out of the map. Without such a place it is one
    from which three quarters of the longest route are left. Other places than those on `public_streets` and
    not below ``roofs`` (polygons in scene metres) are drawn only where there is none of these. Consecutive
    seeds give places far apart. The route prefers streets that it has not driven, then ends on the next
    public street, anywhere. It turns round at dead ends only if five times as many starts are possible with
    such turns.
    """
    rng = generator(seed, "route")
    states = permitted_turns(graph, avoid)
    cost = np.maximum(graph.length / metres, graph.length / graph.speed / seconds)
    on = ~turns_back(graph, states.edge[states.before], after=states.edge[states.after])
    choices = [_streets(states, cost, turns=use) for use in (on, np.ones_like(on))]
    public = public_streets(graph, body_width=body_width)
    ranks = [public, graph.width >= body_width, np.ones_like(public)]
    streets, reach = _starts(choices, [graph.length * rank for rank in ranks])
    state, start = _draw_start(graph, reach, seed=seed, rng=rng, roofs=roofs)
    liking = np.where(np.isin(graph.highway, _MINOR), _SELDOM, 1.0)
    visits = np.zeros(len(graph))
    done = -start / float(graph.length[state]) * float(cost[state])
    walk, end, further = [state], 1.0, _FURTHER
    while (done < 1.0 or (further and not public[walk[-1]])) and len(walk) < _MOST_STREETS:
        edge = walk[-1]
        further -= done >= 1.0
        done += float(cost[edge])
        visits[edge] += 1
        if graph.twin[edge] >= 0:
            visits[graph.twin[edge]] += 1
        following = streets.after[streets.first[state] : streets.first[state + 1]]
        if not len(following):
            break
        left = streets.left[following]
        following = following[left >= min(1.0 - done, float(left.max()))]
        ways = streets.edge[following]
        odds = np.cumsum(liking[ways] / (1.0 + visits[ways]) ** 4)
        state = int(following[np.searchsorted(odds, rng.random() * odds[-1], side="right")])
        walk.append(int(streets.edge[state]))
        end = rng.uniform(_FIRST_END, 1.0) if done >= 1.0 else 1.0
    return np.array(walk, np.int32), (start, end * float(graph.length[walk[-1]]))


def _starts(choices: Sequence[_Streets], ranks: Sequence[Float]) -> tuple[_Streets, Float]:
    """The states to search, without or with turns round, and metres (m,) of each edge on which to start.

    ranks : metres (m,) of each edge that count, from the narrowest choice to the widest
    """
    for length in ranks:
        straight, turning = (streets.starts(1.0) @ length for streets in choices)
        if turning > 0:
            streets = choices[int(straight < 0.2 * turning)]
            return streets, streets.starts(1.0) * length
    streets = choices[0]
    share = streets.starts(_SHORTEST * float(streets.left.max()))
    possible = [share * length for length in ranks]
    return streets, next((reach for reach in possible if reach.any()), possible[-1])


def _draw_start(
    graph: RoadGraph, reach: Float, *, seed: int, rng: np.random.Generator, roofs: shapely.STRtree | None
) -> tuple[int, float]:
    """An edge, and true metres from its tail, on the first ``reach`` (m,) metres of edges.

    Multiples of the golden ratio along a curve that fills the plane: any seeds that follow each other are
    spread evenly over the streets.
    """
    order = _along_curve(graph)
    until = np.cumsum(reach[order])
    share = (seed * int(GOLDEN) + 2**63) % 2**64 / 2**64
    for _ in range(_PLACES):
        at = share * float(until[-1])
        row = min(int(np.searchsorted(until, at, side="right")), len(order) - 1)
        edge = int(order[row])
        start = float(np.clip(at - (until[row] - reach[edge]), 0.0, reach[edge]))
        if roofs is None or not _below(roofs, graph, edge=edge, start=start):
            break
        share = rng.random()
    return edge, start


def _below(roofs: shapely.STRtree, graph: RoadGraph, *, edge: int, start: float) -> bool:
    """Whether a street lies below one of the roofs from a place on."""
    line = graph.geometry[edge][:, :2]
    scale = polylines.length(line) / max(float(graph.length[edge]), 1e-9)
    here = polylines.cut(line, start * scale, end=(start + _BODY_M) * scale)
    return len(roofs.query(shapely.linestrings(here), predicate="intersects")) > 0


def _along_curve(graph: RoadGraph, *, bits: int = 16) -> Ints:
    """Edges (m,) in the order of their middles along Hilbert's curve: near in the order, near in plan."""
    middle = np.array([(line[0, :2] + line[-1, :2]) / 2 for line in graph.geometry])
    size = 2**bits
    low = middle.min(axis=0)
    span = max(float(np.ptp(middle, axis=0).max()), 1e-9)
    x, y = ((middle - low) / span * (size - 1)).astype(np.int64).T
    place = np.zeros(len(middle), np.int64)
    for bit in range(bits - 1, -1, -1):
        side = 1 << bit
        right, up = (x & side) > 0, (y & side) > 0
        place += side * side * np.where(up, np.where(right, 2, 1), np.where(right, 3, 0))
        mirrored = right & ~up
        x, y = np.where(mirrored, size - 1 - x, x), np.where(mirrored, size - 1 - y, y)
        x, y = np.where(up, x, y), np.where(up, y, x)
    return np.argsort(place, kind="stable")


def _streets(states: TurnStates, cost: Float, *, turns: Bools) -> _Streets:
    """Longest drives from each state by some of the turns (t,)."""
    before, after = states.before[turns], states.after[turns]
    label, size = _components(states, cost, before=before, after=after)
    enough = (size > 0) & (size >= min(1.0, size.max(initial=0.0)))
    own = np.zeros(len(size))
    np.maximum.at(own, label, np.where(size[label] > 0, size[label], cost[states.edge]))
    most = 2.0 + float(cost.max(initial=0.0))
    left = np.where(enough, most, own)
    across = label[before] != label[after]
    source, target = label[before[across]], label[after[across]]
    while True:  # at most as often as streets follow each other within the wanted route
        more = left.copy()
        np.maximum.at(more, source, np.minimum(own[source] + left[target], most))
        if (more == left).all():
            break
        left = more
    order = np.argsort(before, kind="stable")
    first = np.searchsorted(before[order], np.arange(len(states) + 1))
    return _Streets(states.edge, cost, left[label], first, after[order])


def _components(
    states: TurnStates, cost: Float, *, before: NDArray[np.int32], after: NDArray[np.int32]
) -> tuple[Ints, Float]:
    """Strongly connected component (s,) of each state, and the cost (c,) of each component's streets.

    A component of one state that no turn leads back to costs 0.
    """
    from scipy.sparse import csr_array  # noqa: PLC0415
    from scipy.sparse.csgraph import connected_components  # noqa: PLC0415

    links = csr_array((np.ones(len(before)), (before, after)), shape=(len(states), len(states)))
    count, label = connected_components(links, directed=True, connection="strong")
    part, edge = np.unique(np.column_stack([label, states.edge]), axis=0).T
    size = np.bincount(part, weights=cost[edge], minlength=count)
    loops = np.zeros(count, bool)
    loops[label[before[before == after]]] = True
    size[(np.bincount(label, minlength=count) == 1) & ~loops] = 0.0
    return np.asarray(label, np.int64), np.asarray(size, np.float64)
