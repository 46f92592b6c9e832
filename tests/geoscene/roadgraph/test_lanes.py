"""The driving side, and the lane positions that routes, traffic, lane markings and OpenDRIVE use."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
import zoneinfo

import numpy as np
import pytest
from helpers.export_worlds import write_world
from helpers.roadgrids import road_graph
from helpers.scenes import restated

from geoscene.errors import InputError
from geoscene.export import export_scene
from geoscene.geometry.frames import Frame
from geoscene.options import BuildOptions
from geoscene.pipeline.build import build
from geoscene.roadgraph import build_road_graph, write_graphml
from geoscene.roadgraph.carriageways import read_carriageways
from geoscene.roadgraph.lanes import (
    LEFT_HAND,
    WIDEST_LANE,
    Side,
    driving_side,
    graph_lanes,
    lane_layout,
    side_at,
)
from geoscene.roadgraph.markings import _offsets, painted_stretches
from geoscene.sources.data import OsmData, Way
from lidar.motion.route import lane_route
from lidar.options.drive import DriveOptions
from lidar.traffic.lanes import lane_shift, lanes_of

PLACES = {
    "left": [
        (-0.1, 51.5), (-5.93, 54.6), (-6.26, 53.35), (14.5, 35.9), (33.3, 35.1), (139.7, 35.6),
        (103.86, 1.28), (114.1, 22.3), (113.54, 22.2), (77.2, 28.6), (100.5, 13.7), (106.8, -6.2),
        (151.2, -33.9), (174.8, -36.9), (18.4, -33.9), (36.8, -1.3), (32.6, -25.9), (-59.5, 3.0),
        (-76.8, 18.0), (-64.8, 18.35), (178.4, -18.1),
    ],
    "right": [
        (24.94, 60.17), (-76.3, 36.9), (7.42, 43.73), (-5.35, 36.14), (114.06, 22.55), (121.5, 31.2),
        (102.6, 17.97), (30.06, -1.95), (13.2, -8.8), (-66.1, 18.4), (-170.7, -14.3), (37.6, 55.8),
        (166.4, -22.3), (-30.0, 40.0),
    ],
}  # fmt: skip


def street(osm_id, **tags):
    line = np.array([[103.8600, 1.2800], [103.8610, 1.2800], [103.8620, 1.2805]])
    return Way(f"way/{osm_id}", {"highway": "residential"} | tags, np.arange(3) + 10 * osm_id, line)


def extract(*ways):
    return OsmData((103.859, 1.279, 103.863, 1.282), list(ways), [], [], [])


@pytest.mark.parametrize(
    ("side", "place"), [(side, place) for side, found in PLACES.items() for place in found]
)
def test_cities_keep_to_the_side_of_their_country(side, place):
    assert side_at(*place) == side


def test_left_hand_time_zones_exist():
    assert zoneinfo.available_timezones() >= LEFT_HAND


def test_driving_side_tags_override_the_country():
    assert driving_side(extract(street(1))) == ("left", "place")
    assert driving_side(extract(street(1), street(2, driving_side="right"))) == ("right", "tag")
    assert driving_side(extract(street(1, driving_side="both"))) == ("left", "place")


def test_a_street_that_is_driven_on_the_other_side_does_not_turn_its_town():
    town = extract(street(1, driving_side="right"), street(2), street(3))
    assert driving_side(town) == ("left", "place")


@pytest.mark.parametrize("given", ["", "left", "right"])
def test_scene_and_drive_use_the_same_driving_side(given, tmp_path):
    scene = build(extract(street(1)), tmp_path / "scene", options=BuildOptions(driving_side=given))
    roads = json.loads((tmp_path / "scene" / "scene.json").read_text())["roads"]
    side = given or "left"
    assert roads == {"driving_side": side, "driving_side_source": "option" if given else "place"}
    assert scene.left_hand == (side == "left")
    assert DriveOptions().side_in(scene) == side
    assert DriveOptions(side="right").side_in(scene) == "right"


def test_unknown_driving_side_is_refused():
    with pytest.raises(InputError, match="`driving_side` 'middle' is unknown"):
        BuildOptions(driving_side="middle")


def layout(along, against=0.0, *, width=7.0):
    two_way = np.array([against > 0])
    return lane_layout(np.array([along]), np.array([against]), two_way=two_way, width=np.array([width]))


@pytest.mark.parametrize(
    ("along", "against", "found"),
    [
        (1.0, 1.0, (1, 1, False)),
        (2.0, 1.0, (2, 1, False)),
        (1.5, 1.5, (1, 1, True)),  # lanes=3: the middle one is for both
        (0.5, 0.5, (0, 0, True)),  # lanes=1
        (0.75, 0.75, (0, 0, True)),  # lanes=1.5: still one lane
        (2.0, 0.5, (2, 1, False)),  # a half that the other direction does not share is a lane
        (1.5, 0.0, (1, 0, False)),  # one-way: a wide lane
        (3.5, 0.0, (3, 0, False)),
    ],
)
def test_mapped_lanes_are_divided_into_own_other_and_shared_lanes(along, against, found):
    lanes = layout(along, against)
    assert (lanes.own[0], lanes.other[0], lanes.shared[0]) == found
    assert lanes.width[0] * lanes.count[0] == pytest.approx(7.0)


def test_wide_carriageways_leave_room_beside_their_lanes():
    lanes = layout(2.0, 2.0, width=24.0)
    assert lanes.width == WIDEST_LANE
    places = [lanes.offsets(k, body_width=1.8, clearance=0.2)[0] for k in (0, 1)]
    assert places == pytest.approx([6.75, 2.25])
    assert layout(1.0, width=8.0).width == 8.0  # a single lane takes all of it


def test_vehicles_stay_inside_the_carriageway():
    assert layout(1.0, 1.0, width=4.0).offsets(body_width=2.0, clearance=0.25) == pytest.approx(0.75)
    assert layout(1.0, 1.0, width=2.0).offsets(body_width=2.0, clearance=0.25) == 0.0


def test_divider_separates_the_directions():
    assert layout(1.0, 1.0).divider == 0.0
    assert layout(1.5, 1.5).divider == pytest.approx(0.0)
    assert layout(2.0, 1.0, width=9.0).divider == pytest.approx(-1.5)
    assert layout(2.0, width=7.0).divider == pytest.approx(-3.5)


@pytest.mark.full
@pytest.mark.parametrize("lanes", [[1, 1], [2, 1], [1.5, 1.5], [2, 2], [2, 0.5], [1.25, 1.25]])
@pytest.mark.parametrize("width", [9.0, 24.0])
def test_routes_traffic_and_opendrive_agree(tmp_path, lanes, width):
    graph = road_graph([(0, 0), (200, 0)], [(0, 1)], lanes=lanes, width=width)
    scene = write_world(tmp_path / "scene")
    write_graphml(graph, scene.frame, path=scene.files.road_graph)
    scene = restated(scene.path)
    root = ET.parse(export_scene(scene, tmp_path / "a.xodr").path).getroot()  # noqa: S314  (our own file)
    road = root.find("road")
    zero = float(road.find("lanes/laneOffset").get("a"))
    traffic = lanes_of(graph)
    for edge, side in ((0, -1), (1, 1)):
        found = road.findall(f"lanes/laneSection/{'left' if side > 0 else 'right'}/lane")
        found = sorted(found, key=lambda lane: abs(int(lane.get("id"))))
        widths = [float(lane.find("width").get("a")) for lane in found]
        middles = side * zero + np.cumsum(widths) - np.array(widths) / 2
        outer = max(k for k, lane in enumerate(found) if lane.get("type") == "driving")
        for lane in range(int(traffic.layout.own[edge])):
            assert lane_shift(traffic, edge, lane=lane, width=1.6) == pytest.approx(middles[outer - lane])
        line = lane_route(graph, [edge], ends=(0.0, 200.0), body_width=1.6).line
        np.testing.assert_allclose(abs(line[:, 1]), middles[outer], atol=0.01)
        assert middles[-1] + widths[-1] / 2 == pytest.approx(width / 2)


@pytest.mark.parametrize("side", ["right", "left"])
@pytest.mark.parametrize("tags", [{"lanes": "3"}, {"lanes": "3", "lanes:forward": "2"}, {"lanes": "4"}])
def test_lane_markings_lie_between_driven_lanes(side: Side, tags):
    way = {"highway": "primary", "width": "24", "sidewalk": "both", **tags}
    street = Way("way/1", way, np.array([1, 2]), np.array([[0.0, 0.0], [0.002, 0.0]]))
    osm = OsmData((0.0, -0.001, 0.002, 0.001), [street], [], [], [])
    frame = Frame.at(0.001, 0.0)
    left_hand = side == "left"
    roads = read_carriageways(osm, frame, sidewalks="mapped", left_hand=left_hand)
    _, painted, _, _ = _offsets(roads, painted_stretches(roads, left_hand=left_hand), left_hand=left_hand)
    graph, _ = build_road_graph(osm, frame)
    lanes = graph_lanes(graph, left_hand=left_hand)
    ahead = graph.geometry[0][-1, 0] > graph.geometry[0][0, 0]
    driven = []
    for edge in range(2):
        sign = (1 if (edge == 0) == ahead else -1) * (1 if left_hand else -1)
        places = range(int(lanes.own[edge]))
        row = lanes.take([edge])
        driven += [sign * float(row.offsets(k, body_width=1.8, clearance=0.2)[0]) for k in places]
    gaps = np.abs(np.subtract.outer(sorted(driven), sorted(painted))).min()
    assert gaps == pytest.approx(lanes.width[0] / 2)
