"""Random routes: a seed draws where they start and end and which way they take."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoscene.roadgraph.graph import RoadGraph
from geoscene.roadgraph.routing import TurnStates, permitted_turns, turns_back
from geoscene.typing import Bools, Float, Ints
from lidar.geometry.random_streams import generator

_LAST_START = 0.9
"""Share of a street within which a route starts."""
_FIRST_END = 0.1
"""Share of a street from which on a route ends."""
_SHORTEST = 0.75
"""Share of the longest route that must be left at the start if no route has the requested length."""
_MINOR = 0.1
"""Weight of service roads and tracks in random choices; of other streets 1."""
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


def random_edges(
    graph: RoadGraph,
    *,
    seed: int,
    seconds: float = np.inf,
    metres: float = np.inf,
    avoid: Collection[tuple[int, int]] = (),
) -> tuple[NDArray[np.int32], tuple[float, float]]:
    """Edges of a random route that lasts ``seconds`` at the speed limits or ``metres``, whichever is shorter.

    Also the true metres from the first edge's tail to the start, and from the last one's tail to the end.

    The start is drawn by length, service roads and tracks counting a tenth, from all places from which so
    long a route is possible: into a connected part of the graph that has as much street, or the largest, or
    out of the map. Without such a place it is one from which three quarters of the longest route are left.
    The route prefers streets that it has not driven, then ends on the next street, anywhere. It turns round
    at dead ends only if five times as many starts are possible with such turns.
    """
    rng = generator(seed, "route")
    states = permitted_turns(graph, avoid)
    cost = np.maximum(graph.length / metres, graph.length / graph.speed / seconds)
    on = ~turns_back(graph, states.edge[states.before], after=states.edge[states.after])
    streets, turning = (_streets(states, cost, turns=use) for use in (on, np.ones_like(on)))
    if streets.starts(1.0) @ graph.length < 0.2 * (turning.starts(1.0) @ graph.length):
        streets = turning
    need = 1.0 if streets.starts(1.0).any() else _SHORTEST * float(streets.left.max())
    liking = np.where(np.isin(graph.highway, ("service", "track")), _MINOR, 1.0)
    reach = streets.starts(need) * graph.length
    weight = np.cumsum(reach * liking)
    state = int(np.searchsorted(weight, rng.random() * weight[-1], side="right"))
    start = float(reach[state] * rng.random())
    visits = np.zeros(len(graph))
    done = -start / float(graph.length[state]) * float(cost[state])
    walk, end = [state], 1.0
    while done < 1.0 and len(walk) < _MOST_STREETS:
        edge = walk[-1]
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
