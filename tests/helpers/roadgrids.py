"""Small road graphs for tests."""

import numpy as np

from geoscene.roadgraph.graph import RoadGraph


def road_graph(nodes, pairs, *, twoway=True, width=7.0, speed=13.9, lanes=1.0, bends=None, **columns):
    """A graph of straight streets between nodes (n, 2) or (n, 3); ``bends`` gives other lines by pair."""
    nodes = np.asarray(nodes, float)
    if nodes.shape[1] == 2:
        nodes = np.column_stack([nodes, np.zeros(len(nodes))])
    tail, head, twin, geometry = [], [], [], []
    for number, (a, b) in enumerate(pairs):
        line = np.asarray((bends or {}).get((a, b), nodes[[a, b]]), float)
        both = twoway if isinstance(twoway, bool) else twoway[number]
        k = len(tail)
        tail, head, geometry = [*tail, a], [*head, b], [*geometry, line]
        twin = [*twin, k + 1 if both else -1]
        if both:
            tail, head, geometry, twin = [*tail, b], [*head, a], [*geometry, line[::-1]], [*twin, k]
    m, n = len(tail), len(nodes)
    lines = np.empty(m, object)
    lines[:] = geometry
    length = np.array([np.hypot(*np.diff(line[:, :2], axis=0).T).sum() for line in geometry])
    values = {
        "speed": np.full(m, speed),
        "lanes": np.full(m, lanes),
        "width": np.full(m, width),
        "highway": np.full(m, "residential"),
        "contraflow": np.zeros(m),
        **{name: np.full(m, "") for name in ("lane_kinds", "lane_widths", "lane_turns")},
        "bridge": np.zeros(m, bool),
        "tunnel": np.zeros(m, bool),
        "roundabout": np.zeros(m, bool),
    } | {name: np.asarray(value) for name, value in columns.items()}
    text = np.full(m, "default")
    return RoadGraph(
        node_id=np.arange(n),
        node_xyz=nodes,
        tail=np.array(tail, np.int32),
        head=np.array(head, np.int32),
        geometry=lines,
        length=length,
        speed_source=text,
        lanes_source=text,
        width_source=text,
        oneway=np.array(twin) < 0,
        layer=np.zeros(m, np.int8),
        layer_source=text,
        name=np.full(m, ""),
        ref=np.full(m, ""),
        osm_id=np.array([f"way/{k}" for k in range(m)]),
        twin=np.array(twin, np.int32),
        signals=np.zeros(n, bool),
        stop=np.zeros(n, bool),
        give_way=np.zeros(n, bool),
        node_island=np.zeros(n),
        **values,
    )


def grid(columns=4, rows=4, gap=100.0, **options):
    """A grid of streets, ``gap`` metres apart."""
    nodes = [(gap * i, gap * j) for j in range(rows) for i in range(columns)]
    pairs = [(j * columns + i, j * columns + i + 1) for j in range(rows) for i in range(columns - 1)]
    pairs += [(j * columns + i, (j + 1) * columns + i) for j in range(rows - 1) for i in range(columns)]
    return road_graph(nodes, pairs, **options)
