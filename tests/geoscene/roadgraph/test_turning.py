"""Turning circles, turning loops and mini-roundabouts are surfaces of their size."""

import numpy as np
import pytest
import shapely

from geoscene.classes import Class
from geoscene.geometry.frames import Frame
from geoscene.roadgraph import build_road_graph
from geoscene.roadgraph.graphml import read_graphml, write_graphml
from geoscene.roadgraph.surfaces import road_surfaces
from geoscene.sources.data import OsmData, TaggedNode, Way

FRAME = Frame.at(10.0, 50.0)
PLACES = {1: (-100.0, 0.0), 2: (0.0, 0.0), 3: (100.0, 0.0), 4: (0.0, 100.0), 5: (0.0, -100.0)}
END, ON_THE_WAY, CROSS = ((1, 2),), ((1, 2, 3),), ((1, 2, 3), (4, 2, 5))


def streets_with(tags, ways=END, *, street=None):
    """A map of streets with a node of these tags."""
    lonlat = {n: np.array(FRAME.to_geographic(*xy)) for n, xy in PLACES.items()}
    street = {"highway": "residential"} | (street or {})
    return OsmData(
        bounds=(9.9, 49.9, 10.1, 50.1),
        ways=[
            Way(f"way/{k}", street, np.array(nodes), np.array([lonlat[n] for n in nodes]))
            for k, nodes in enumerate(ways)
        ],
        areas=[],
        points=[TaggedNode("node/2", tags, *lonlat[2])],
        relations=[],
    )


def classes_beside(tags, ways=END, *, metres, street=None):
    """Class of the ground north-east of node 2, at distances from it, and problems."""
    osm = streets_with(tags, ways, street=street)
    graph, problems = build_road_graph(osm, FRAME)
    rows = road_surfaces(osm, graph, frame=FRAME)
    order = np.argsort(-rows.priority, kind="stable")
    found = []
    for r in metres:
        point = shapely.Point(r * np.cos(1.0), r * np.sin(1.0))
        on = [k for k in order if rows.polygon[k].covers(point)]
        found.append(Class(rows.klass[on[0]]) if on else None)
    return found, problems


@pytest.mark.parametrize("ways", [END, ON_THE_WAY])
@pytest.mark.parametrize(
    ("tags", "radius"),
    [
        ({"highway": "turning_circle", "diameter": "16"}, 8.0),
        ({"highway": "turning_circle", "diameter": "60 ft"}, 9.144),
        ({"highway": "turning_circle"}, 6.0),
    ],
)
def test_a_turning_circle_is_road_of_its_diameter(ways, tags, radius):
    bare = {"sidewalk": "no"}
    found, problems = classes_beside(tags, ways, metres=[0.5, radius - 0.1, radius + 0.1], street=bare)
    assert found == [Class.ROAD, Class.ROAD, None]
    assert not problems
    found, _ = classes_beside(
        tags, ways, metres=[radius - 0.1, radius + 0.08, radius + 1.0], street={"sidewalk": "both"}
    )
    assert found == [Class.ROAD, Class.KERB, Class.SIDEWALK]


def test_a_turning_loop_has_an_island():
    tags = {"highway": "turning_loop", "diameter": "20"}
    found, _ = classes_beside(tags, metres=[1.0, 4.8, 4.92, 5.1, 9.9], street={"sidewalk": "no"})
    assert found == [Class.GRASS, Class.GRASS, Class.KERB, Class.ROAD, Class.ROAD]
    small, _ = classes_beside(tags | {"diameter": "10"}, metres=[1.0, 4.9], street={"sidewalk": "no"})
    assert small == [Class.ROAD, Class.ROAD]
    found, _ = classes_beside({"highway": "turning_loop"}, metres=[1.0, 7.9, 8.1], street={"sidewalk": "no"})
    assert found == [Class.GRASS, Class.ROAD, None]


def test_the_road_graph_keeps_the_size_of_the_island(tmp_path):
    graph, _ = build_road_graph(streets_with({"highway": "turning_loop", "diameter": "20"}), FRAME)
    assert graph.node_island[graph.node_id == 2] == 5.0
    write_graphml(graph, FRAME, path=tmp_path / "roads.graphml")
    read = read_graphml(tmp_path / "roads.graphml", FRAME)
    assert read.node_island.tolist() == graph.node_island.tolist()
    circle, _ = build_road_graph(streets_with({"highway": "turning_circle"}), FRAME)
    assert not circle.node_island.any()


@pytest.mark.parametrize(
    ("diameter", "street", "radius"),
    [("10.4", {}, 0.0), ("11", {}, 0.5), ("10", {"width": "13"}, 1.5)],
)
def test_the_road_graph_counts_the_islands_that_are_drawn(diameter, street, radius):
    tags, street = {"highway": "turning_loop", "diameter": diameter}, {"sidewalk": "no"} | street
    graph, _ = build_road_graph(streets_with(tags, street=street), FRAME)
    assert graph.node_island[graph.node_id == 2] == radius
    found, _ = classes_beside(tags, metres=[0.05], street=street)
    assert found == [Class.GRASS if radius else Class.ROAD]


def test_a_mini_roundabout_is_road_with_a_painted_middle():
    tags = {"highway": "mini_roundabout", "diameter": "24"}
    found, _ = classes_beside(tags, CROSS, metres=[1.0, 2.0, 11.9, 12.1], street={"sidewalk": "no"})
    assert found == [Class.LANE_MARKING, Class.ROAD, Class.ROAD, None]


@pytest.mark.parametrize("text", ["wide", "1", "500"])
def test_an_unreadable_diameter_is_reported(text):
    tags = {"highway": "turning_circle", "diameter": text}
    found, problems = classes_beside(tags, metres=[5.9], street={"sidewalk": "no"})
    assert found == [Class.ROAD]
    assert [(p.osm_id, p.reason, p.detail) for p in problems] == [
        ("node/2", "unreadable-tag", f"diameter={text}")
    ]


def test_a_circle_is_not_narrower_than_its_road_and_one_off_the_roads_is_nothing():
    tags = {"highway": "turning_circle", "diameter": "4"}
    found, _ = classes_beside(tags, metres=[2.9], street={"sidewalk": "no"})
    assert found == [Class.ROAD]
    away, _ = classes_beside(tags | {"diameter": "16"}, ((1, 4),), metres=[2.0])
    assert away == [None]
