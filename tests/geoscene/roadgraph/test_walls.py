"""Streets of unknown width yield to the walls of buildings; what remains is reported."""

import numpy as np
import pytest
import shapely

from geoscene.geometry.frames import Frame
from geoscene.roadgraph import build_road_graph
from geoscene.roadgraph.carriageways import read_carriageways
from geoscene.roadgraph.surfaces import road_surfaces
from geoscene.roadgraph.walls import IN_CARRIAGEWAY, NARROWEST_CAR_LANE, Walls
from geoscene.sources.data import OsmData, Way

FRAME = Frame.at(10.0, 50.0)
X = (-100.0, -50.0, 50.0, 100.0)


def town(tags, *houses, min_height=0.0):
    """Graph, problems and carriageway of a street along x, and of houses (xmin, ymin, xmax, ymax)."""
    lonlat = np.array([FRAME.to_geographic(x, 0.0) for x in X])
    street = Way("way/1", {"highway": "residential", "sidewalk": "no"} | tags, np.arange(4) + 1, lonlat)
    osm = OsmData((9.99, 49.99, 10.01, 50.01), [street], [], [], [])
    boxes = np.array([shapely.box(*house) for house in houses], object)
    names = np.array([f"way/{100 + k}" for k in range(len(houses))])
    walls = Walls.of(boxes, names, min_height=np.full(len(houses), min_height))
    graph, problems = build_road_graph(osm, FRAME, walls=walls)
    table = read_carriageways(osm, FRAME, sidewalks="mapped", left_hand=False, walls=walls)
    rows = road_surfaces(osm, graph, frame=FRAME, roads=table)
    road = shapely.union_all(rows.polygon[(rows.priority >= 130) & (rows.priority < 150)])
    assert (rows.edge[rows.priority < 150] >= 0).all()
    return graph, problems, road


def widths(graph):
    """Widths of the street's stretches from west to east."""
    order = np.argsort([line[:, 0].mean() for line in graph.geometry], kind="stable")
    ahead = [k for k in order if graph.geometry[k][-1, 0] > graph.geometry[k][0, 0]]
    return [float(graph.width[k]) for k in ahead]


def test_a_street_is_narrower_between_the_nodes_where_a_house_is_near():
    graph, problems, road = town({}, (-10.0, 2.1, 10.0, 12.0))
    assert widths(graph) == [6.0, 4.0, 6.0]
    assert set(graph.width_source) == {"default", "buildings"}
    assert set(graph.osm_id) == {"way/1"}
    assert not problems
    assert road.intersection(shapely.box(-10.0, 2.1, 10.0, 12.0)).area == 0.0


def test_a_street_between_walls_is_one_lane_that_a_car_passes():
    graph, problems, _ = town({}, (-10.0, 1.3, 10.0, 12.0), (-10.0, -12.0, 10.0, -1.5))
    assert widths(graph)[1] == NARROWEST_CAR_LANE
    assert not problems
    narrow = graph.width_source == "buildings"
    assert graph.lanes[narrow].tolist() == [0.5, 0.5]
    assert graph.lanes[~narrow].tolist() == [1.0] * 4


def test_mapped_lanes_keep_room_for_a_car_each():
    graph, problems, _ = town({"lanes": "2"}, (-10.0, 1.0, 10.0, 12.0))
    assert widths(graph)[1] == 2 * NARROWEST_CAR_LANE
    assert graph.lanes.tolist() == [1.0] * 6
    assert [(p.osm_id, p.reason) for p in problems] == [("way/1", IN_CARRIAGEWAY)]


@pytest.mark.parametrize("tags", [{"width": "6"}, {"est_width": "6"}, {"width:lanes:forward": "3"}])
def test_a_mapped_width_does_not_yield_and_is_reported(tags):
    graph, problems, _ = town(tags | {"width:lanes:backward": "3"}, (-10.0, 2.1, 10.0, 12.0))
    assert widths(graph) == [6.0]
    assert [(p.osm_id, p.action, p.reason, p.detail) for p in problems] == [
        ("way/1", "repaired", IN_CARRIAGEWAY, "way/100 stands up to 0.9 m within the carriageway")
    ]


def test_a_house_on_the_middle_of_a_street_is_reported():
    graph, problems, _ = town({}, (-10.0, -2.0, 10.0, 12.0), (20.0, 0.5, 30.0, 9.0))
    assert widths(graph)[1] == NARROWEST_CAR_LANE
    assert [p.detail.split()[0] for p in problems] == ["way/100", "way/101"]


@pytest.mark.parametrize(
    ("tags", "min_height"),
    [
        ({}, 4.0),
        ({"tunnel": "building_passage"}, 0.0),
        ({"covered": "yes"}, 0.0),
        ({"bridge": "yes"}, 0.0),
        ({"tunnel": "yes"}, 0.0),
    ],
)
def test_streets_below_and_above_buildings_do_not_yield(tags, min_height):
    graph, problems, _ = town(tags, (-10.0, -2.0, 10.0, 12.0), min_height=min_height)
    assert widths(graph) == [6.0]
    assert not problems


def test_houses_beside_a_street_change_nothing():
    graph, problems, _ = town({}, (-10.0, 3.1, 10.0, 12.0))
    assert widths(graph) == [6.0]
    assert not problems
