"""OpenDRIVE: lanes are continuous through junctions, and only permitted turns have connecting roads."""

import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest
from helpers.export_worlds import roads, write_world
from helpers.roadgrids import grid, road_graph
from helpers.scenes import restated
from hypothesis import given, settings
from hypothesis import strategies as st

from geoscene.errors import InputError
from geoscene.export import export_scene
from geoscene.export.roadnet import connecting_curve, driven_lanes, plan_view, road_net
from geoscene.options import BuildOptions, ExportOptions
from geoscene.pipeline.build import build
from geoscene.roadgraph import write_graphml
from geoscene.roadgraph.routing import turn_table
from geoscene.scene import SceneFiles
from geoscene.sources import read_osm


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_world(tmp_path_factory.mktemp("scene") / "world")


def _number(element, name):
    return float(element.get(name))


def _place(geometry, ds):
    """Position and heading on one segment of a reference line, by the formulae of the standard."""
    x, y, h, length = (_number(geometry, name) for name in ("x", "y", "hdg", "length"))
    shape = geometry[0]
    if shape.tag == "line":
        return x + ds * np.cos(h), y + ds * np.sin(h), h
    if shape.tag == "arc":
        k = _number(shape, "curvature")
        return x + (np.sin(h + k * ds) - np.sin(h)) / k, y - (np.cos(h + k * ds) - np.cos(h)) / k, h + k * ds
    p = ds / length
    (u, v), (du, dv) = (
        [
            np.polynomial.Polynomial([_number(shape, f"{c}{axis}") for c in "abcd"]).deriv(n)(p)
            for axis in "UV"
        ]
        for n in (0, 1)
    )
    return x + u * np.cos(h) - v * np.sin(h), y + u * np.sin(h) + v * np.cos(h), h + np.arctan2(dv, du)


class _Road:
    """A road of a file, with the edges of its lanes at both ends."""

    def __init__(self, element):
        self.element, self.id = element, element.get("id")
        self.length = _number(element, "length")
        pieces = list(element.find("planView"))
        self.pieces = pieces
        self.ends = _place(pieces[0], 0.0), _place(pieces[-1], _number(pieces[-1], "length"))

    def height(self, end):
        s = self.length * end
        piece = [e for e in self.element.find("elevationProfile") if _number(e, "s") <= s + 1e-9][-1]
        ds = s - _number(piece, "s")
        return sum(_number(piece, c) * ds**k for k, c in enumerate("abcd"))

    def lanes(self, end):
        """Both edges (2, 3) of each lane at one end."""
        x, y, h = self.ends[end]
        offset = self.element.find("lanes/laneOffset")
        out = {}
        for side, sign in (("left", 1), ("right", -1)):
            t = _number(offset, "a") if offset is not None else 0.0
            section = self.element.findall("lanes/laneSection")[-end]
            for lane in sorted(section.findall(f"{side}/lane"), key=lambda e: abs(int(e.get("id")))):
                width = lane.find("width")
                wide = _number(width, "a") + _number(width, "b") * self.length * end
                edges = [
                    (x - s * np.sin(h), y + s * np.cos(h), self.height(end)) for s in (t, t + sign * wide)
                ]
                out[int(lane.get("id"))] = np.array(edges)
                t += sign * wide
        return out


def _roads(path):
    document = ET.parse(path).getroot()  # noqa: S314  (our own file)
    return document, {e.get("id"): _Road(e) for e in document.iter("road")}


def _keeping(scene, left_hand):
    """The scene with left-hand or right-hand traffic."""
    roads = {"driving_side": "left" if left_hand else "right"}
    return replace(scene, manifest={**scene.manifest, "roads": roads})


def _write(graph, scene, folder, **options):
    """Path of the OpenDRIVE file of a scene with this graph."""
    path = folder / "scene"
    if not path.exists():
        write_world(path)
    write_graphml(graph, scene.frame, path=SceneFiles(path).road_graph)
    manifest = scene.manifest | {"files": restated(path).manifest["files"]}
    scene = replace(scene, path=path, manifest=manifest)
    return export_scene(scene, folder / "a.xodr", overwrite=True, options=ExportOptions(**options)).path


def _check_links(path):
    """Assert that connecting roads begin and end at the edges of the lanes they join; the number of lanes."""
    _, found = _roads(path)
    joined = 0
    for road in found.values():
        for a, b in zip(road.pieces, road.pieces[1:], strict=False):
            np.testing.assert_allclose(_place(a, _number(a, "length"))[:2], _place(b, 0.0)[:2], atol=1e-6)
        for word, end in (("predecessor", 0), ("successor", 1)):
            link = road.element.find(f"link/{word}")
            if link is None or link.get("elementType") == "junction":
                continue
            other = found[link.get("elementId")]
            there = 0 if link.get("contactPoint") == "start" else 1
            mine, theirs = road.lanes(end), other.lanes(there)
            for lane in road.element.iter("lane"):
                target = lane.find(f"link/{word}")
                if target is None:
                    continue
                edges, wanted = mine[int(lane.get("id"))], theirs[int(target.get("id"))]
                # the edges of a lane that is driven against its road's direction come in the other order
                gap = min(np.abs(edges - wanted).max(), np.abs(edges - wanted[::-1]).max())
                assert gap < 1e-6
                joined += 1
    return joined


@pytest.mark.parametrize("left_hand", [False, True])
def test_lanes_are_continuous_through_junctions(scene, tmp_path, left_hand):
    path = export_scene(_keeping(scene, left_hand), tmp_path / "a.xodr").path
    assert _check_links(path) >= 12


@pytest.mark.full
@pytest.mark.parametrize("lanes", [0.5, 1.0, 2.0, [2, 1] * 24])
@pytest.mark.parametrize("left_hand", [False, True])
def test_lanes_are_continuous_in_a_grid_of_any_lane_count(scene, tmp_path, lanes, left_hand):
    graph = grid(width=9.0)
    graph = replace(graph, lanes=np.broadcast_to(np.asarray(lanes, float), len(graph)).copy())
    assert _check_links(_write(graph, _keeping(scene, left_hand), tmp_path)) > 100


def _sections(road):
    """Of each lane section: its start and the lanes with the lanes before and after them."""
    found = []
    for section in road.element.iter("laneSection"):
        lanes = {}
        for lane in section.iter("lane"):
            links = [lane.find(f"link/{word}") for word in ("predecessor", "successor")]
            if lane.get("id") != "0":
                lanes[lane.get("id")] = [None if e is None else e.get("id") for e in links]
        found.append((_number(section, "s"), lanes))
    return found


def test_roads_that_their_junctions_do_not_identify_have_several_sections(scene, tmp_path):
    # a loop at a dead end, two streets side by side around a narrow block, and a dual carriageway
    nodes = [(0, 0), (100, 0), (200, 0), (300, 0), (400, 0), (500, 0)]
    pairs = [(0, 1), (1, 2), (1, 2), (2, 3), (3, 4), (4, 3), (4, 5), (5, 5)]
    graph = road_graph(nodes, pairs, twoway=[True] * 4 + [False] * 2 + [True] * 2)
    lines = graph.geometry.copy()
    for edge, bend in {4: (150, 30), 8: (350, 15), 9: (350, -15)}.items():
        lines[edge] = np.array([lines[edge][0], (*bend, 0), lines[edge][-1]], float)
    lines[5] = lines[4][::-1]
    lines[12] = np.array([(500, 0, 0), (540, 20, 0), (540, -20, 0), (500, 0, 0)], float)
    lines[13] = lines[12][::-1]
    path = _write(replace(graph, geometry=lines), scene, tmp_path)
    _, found = _roads(path)
    roads = {k: road for k, road in found.items() if road.element.get("junction") == "-1"}
    parts = {road.element.find("userData").get("value"): _sections(road) for road in roads.values()}
    # the longer one of those side by side, and the loop, whose halves would be side by side, too
    assert {way: len(sections) for way, sections in parts.items() if len(sections) > 1} == {
        "way/4": 2,
        "way/12": 3,
    }
    for road in roads.values():
        sections = _sections(road)
        for k, (start, lanes) in enumerate(sections):
            assert start / road.length == pytest.approx(k / len(sections), abs=0.5 / len(sections))
            away = [abs(start - _number(e, "s")) for e in road.pieces[1:]]
            assert k == 0 or min(away, default=1.0) > 1.0  # not in a bend
            same = list(lanes)
            assert k == 0 or [links[0] for links in lanes.values()] == same
            assert k == len(sections) - 1 or [links[1] for links in lanes.values()] == same
    assert _check_links(path) > 20


def test_restrictions_without_opendrive_equivalent_are_counted(tmp_path):
    scene = write_world(tmp_path / "world")
    assert export_scene(scene, tmp_path / "plain.xodr").notes == ()
    chain = np.fromiter([np.array([0, 2, 3], np.int32)], object)
    graph = replace(roads(), chain_edges=chain, chain_kind=np.array(["no_u_turn"]))
    write_graphml(graph, scene.frame, path=scene.files.road_graph)
    scene = restated(scene.path)
    (note,) = export_scene(scene, tmp_path / "bound.xodr").notes
    assert note.startswith("1 turn restrictions via ways are left out")
    assert (tmp_path / "bound.xodr").read_bytes() == (tmp_path / "plain.xodr").read_bytes()


def test_connecting_roads_are_the_permitted_turns(scene, tmp_path):
    document, found = _roads(export_scene(scene, tmp_path / "a.xodr").path)
    graph = roads()
    before, after = turn_table(graph)
    name = {}
    ways = {
        e.find("userData").get("value"): k
        for k, e in ((r.id, r.element) for r in found.values())
        if e.find("userData") is not None
    }
    for edge in range(len(graph)):
        first = edge if not 0 <= graph.twin[edge] < edge else graph.twin[edge]
        name[edge] = ways[f"way/{first}"]
    wanted = sorted(
        (name[a], name[b]) for a, b in zip(before.tolist(), after.tolist(), strict=True) if name[a] != name[b]
    )
    taken = []
    for connection in document.iter("connection"):
        road = found[connection.get("connectingRoad")].element
        taken.append((connection.get("incomingRoad"), road.find("link/successor").get("elementId")))
        assert road.find("link/predecessor").get("elementId") == connection.get("incomingRoad")
        links = [(e.get("from"), e.get("to")) for e in connection.iter("laneLink")]
        assert links == [
            (e.find("link/predecessor").get("id"), e.get("id"))
            for e in road.iter("lane")
            if e.get("id") != "0"
        ]
    assert sorted(taken) == wanted
    assert (name[0], name[6]) not in taken  # the left turn that the map forbids


def test_signs_are_on_the_side_of_the_traffic_they_address(scene, tmp_path):
    document, _ = _roads(export_scene(scene, tmp_path / "a.xodr").path)
    told = {
        s.get("name"): (s.get("orientation"), _number(s, "t"), _number(s, "s"), r.get("length"))
        for r in document.iter("road")
        for s in r.iter("signal")
    }
    orientation, t, s, length = told["traffic_signals"]
    assert (orientation, t) == ("+", -4.0)
    assert s <= float(length)
    assert told["stop"][:2] == ("-", 4.0)


def test_opendrive_header_has_the_georeference(scene, tmp_path):
    document, found = _roads(export_scene(scene, tmp_path / "a.xodr").path)
    header = document.find("header")
    assert "+proj=utm +zone=33" in header.find("geoReference").text
    offset = header.find("offset")
    assert (_number(offset, "x"), _number(offset, "y")) == scene.frame.origin
    assert header.get("date") == "2024-05-06T07:08:09"
    heights = [road.height(end) for road in found.values() for end in (0, 1)]
    assert min(heights) == pytest.approx(-2)
    assert max(heights) == pytest.approx(2)
    speeds = {_number(e, "max") for e in document.iter("speed")}
    assert speeds == {13.9}


def test_bridges_and_bidirectional_lanes_are_marked(scene, tmp_path):
    graph = road_graph([(0, 0), (100, 0), (200, 50)], [(0, 1), (1, 2)], lanes=0.5, width=4.0)
    graph = replace(graph, bridge=np.array([True, True, False, False]))
    document, _ = _roads(_write(graph, scene, tmp_path))
    assert len(list(document.iter("bridge"))) == 1
    kinds = [
        lane.get("type")
        for r in document.iter("road")
        if r.get("junction") == "-1"
        for lane in r.iter("lane")
    ]
    assert sorted(kinds) == ["bidirectional", "bidirectional", "none", "none"]


def test_scene_without_roads_is_refused(scene, tmp_path):
    folder = tmp_path / "none"
    folder.mkdir()
    with pytest.raises(InputError, match="no drivable roads"):
        export_scene(replace(scene, path=folder, manifest={"files": {}}), tmp_path / "a.xodr")


steps = st.lists(st.tuples(st.floats(0.5, 60), st.floats(-3.0, 3.0)), min_size=1, max_size=8)


@pytest.mark.full
@settings(max_examples=80, deadline=None)
@given(steps)
def test_a_reference_line_is_smooth_and_near_its_polyline(steps):
    lengths, turns = np.array(steps).T
    heading = np.cumsum(turns)
    points = np.concatenate(
        [[[0, 0]], np.cumsum(np.column_stack([np.cos(heading), np.sin(heading)]) * lengths[:, None], axis=0)]
    )
    plan = plan_view(points)
    assert (np.diff(plan.at) > 0).all()
    assert plan.at[-1] == pytest.approx(plan.total, abs=1e-4)
    assert plan.total <= lengths.sum() + 1e-9
    k, ds = plan.curvature, plan.length
    bent = np.abs(k) > 0
    r = np.divide(1, k, out=np.zeros_like(k), where=bent)
    end = plan.heading + k * ds
    dx = np.where(bent, r * (np.sin(end) - np.sin(plan.heading)), ds * np.cos(plan.heading))
    dy = np.where(bent, -r * (np.cos(end) - np.cos(plan.heading)), ds * np.sin(plan.heading))
    np.testing.assert_allclose((plan.x + dx)[:-1], plan.x[1:], atol=1e-5)
    np.testing.assert_allclose((plan.y + dy)[:-1], plan.y[1:], atol=1e-5)
    np.testing.assert_allclose([plan.x[-1] + dx[-1], plan.y[-1] + dy[-1]], points[-1], atol=1e-5)
    kinks = (end[:-1] - plan.heading[1:] + np.pi) % (2 * np.pi) - np.pi
    sharp = (np.abs((turns[1:] + np.pi) % (2 * np.pi) - np.pi) > 1.2).sum()
    assert (np.abs(kinks) > 1e-6).sum() <= sharp


def test_vertices_that_only_have_heights_do_not_bend_a_reference_line():
    along = np.array([0, 10, 20, 50, 60.0])
    points = np.column_stack([along, [0, 5e-5, -5e-5, 0, 0]])
    plan = plan_view(np.vstack([points, [80, 20]]))
    assert (plan.curvature != 0).tolist() == [False, True, False]
    np.testing.assert_allclose(plan.at[:4], along[:4], atol=1e-4)


@settings(max_examples=60, deadline=None)
@given(st.floats(-3, 3), st.floats(-2.8, 2.8), st.floats(2, 60))
def test_connecting_curve_is_near_an_arc_of_the_stated_length(heading, turn, chord):
    direction = heading + turn / 2
    end = chord * np.array([np.cos(direction), np.sin(direction)])
    curve = connecting_curve(np.zeros(2), heading, end=end, end_heading=heading + turn)
    p = np.linspace(0, 1, 20001)
    u, v = (np.polynomial.polynomial.polyval(p, c) for c in (curve.u, curve.v))
    assert curve.length == pytest.approx(np.hypot(np.diff(u), np.diff(v)).sum(), rel=1e-5)
    arc = chord * (turn / 2) / np.sin(turn / 2) if abs(turn) > 1e-6 else chord
    assert curve.length == pytest.approx(arc, rel=0.06)
    c, s = np.cos(heading), np.sin(heading)
    np.testing.assert_allclose([c * u[-1] - s * v[-1], s * u[-1] + c * v[-1]], end, atol=1e-9)


def _steepest(road):
    """Greatest gradient of a road of the file, metres a metre."""
    ends = [_number(e, "s") for e in road.element.find("elevationProfile")] + [road.length]
    steepest = 0.0
    for piece, start, stop in zip(road.element.find("elevationProfile"), ends, ends[1:], strict=False):
        height = np.polynomial.Polynomial([_number(piece, c) for c in "abcd"])
        steepest = max(steepest, np.abs(height.deriv()(np.linspace(0, stop - start, 50))).max())
    return steepest


@pytest.mark.parametrize("left_hand", [False, True])
@pytest.mark.parametrize("angle", [15, 30, 50, 80, 110])
@pytest.mark.parametrize("heights", [(25, -25), (25, 25), (5, -25)])
def test_connecting_roads_on_a_slope_are_no_steeper_than_the_streets(
    scene, tmp_path, angle, heights, left_hand
):
    # a hairpin on a hillside: the two streets come close to each other at different heights
    arms = [
        (100 * np.cos(t), 100 * np.sin(t), z) for t, z in zip((0, np.radians(angle)), heights, strict=True)
    ]
    graph = road_graph([(0, 0, 0), *arms], [(0, 1), (0, 2)], width=6.0)
    path = _write(graph, _keeping(scene, left_hand), tmp_path)
    assert _check_links(path) >= 2
    _, found = _roads(path)
    streets = max(_steepest(road) for road in found.values() if road.element.get("junction") == "-1")
    turns = [road for road in found.values() if road.element.get("junction") != "-1"]
    assert len(turns) == 2
    for road in turns:
        assert _steepest(road) <= streets * 1.001


CROSSING = [(-200, 0), (0, 0), (200, 0), (0, 200), (0, -200)]
ARMS = [(0, 1), (1, 2), (1, 3), (1, 4)]  # one road in; straight on, to the left, to the right


def _crossing(kinds="", turns="", widths="", *, lanes=3.0, ahead=2.0):
    """A one-way road of several lanes that ends at a crossing of two-way streets."""
    oneway = [False, False, True, True]
    graph = road_graph(CROSSING, ARMS, twoway=oneway, width=9.75)
    count = np.where(graph.tail == 0, lanes, np.where(graph.twin < 0, ahead, 1.0))
    first = graph.tail == 0
    columns = {"lane_kinds": kinds, "lane_turns": turns, "lane_widths": widths}
    texts = {name: np.where(first, text, "") for name, text in columns.items()}
    return replace(graph, lanes=count.astype(float), **texts)


def _lanes_by_target(path):
    """Lanes of the first road that lead into each other road."""
    document, _ = _roads(path)
    road_of = {e.get("id"): e.find("link/successor").get("elementId") for e in document.iter("road")
               if e.get("junction") != "-1"}  # fmt: skip
    found: dict[str, list[int]] = {}
    for connection in document.iter("connection"):
        if connection.get("incomingRoad") == "1":
            links = [int(link.get("from")) for link in connection.iter("laneLink")]
            found.setdefault(road_of[connection.get("connectingRoad")], []).extend(links)
    return {target: sorted(lanes, key=abs) for target, lanes in found.items()}


@pytest.mark.parametrize(
    ("turns", "right_hand", "left_hand"),
    [
        # roads 2 straight on, 3 to the left, 4 to the right
        ("left|through|right", {"2": [-2], "3": [-1], "4": [-3]}, {"2": [2], "3": [3], "4": [1]}),
        ("left|left;through|right", {"2": [-2], "3": [-1], "4": [-3]}, {"2": [2], "3": [3], "4": [1]}),
        ("left|through|through;right", {"2": [-2, -3], "3": [-1], "4": [-3]},
         {"2": [1, 2], "3": [3], "4": [1]}),
        ("left||", {"2": [-2, -3], "3": [-1], "4": [-3]}, {"2": [1, 2], "3": [3], "4": [1]}),
        ("||right", {"2": [-1, -2], "3": [-1], "4": [-3]}, {"2": [2, 3], "3": [3], "4": [1]}),
        ("left|none|right", {"2": [-2], "3": [-1], "4": [-3]}, {"2": [2], "3": [3], "4": [1]}),
        ("||merge_to_left", {"2": [-1, -2, -3], "3": [-1], "4": [-2]}, {"2": [1, 2, 3], "3": [3], "4": [2]}),
        ("slight_left|through|slight_right", {"2": [-2], "3": [-1], "4": [-3]},
         {"2": [2], "3": [3], "4": [1]}),
    ],
)  # fmt: skip
def test_lanes_lead_where_their_arrows_point(scene, tmp_path, turns, right_hand, left_hand):
    turns = turns.replace("none", "")
    for keeps_left, expected in ((False, right_hand), (True, left_hand)):
        path = _write(_crossing(turns=turns), _keeping(scene, keeps_left), tmp_path)
        assert _lanes_by_target(path) == expected
        _check_links(path)


def _lane_pairs(path, incoming):
    """Lanes joined by the connections from a road: (road after, lane before, lane after)."""
    document, found = _roads(path)
    pairs = []
    for connection in document.iter("connection"):
        if connection.get("incomingRoad") != incoming:
            continue
        road = found[connection.get("connectingRoad")].element
        after = road.find("link/successor").get("elementId")
        for lane in road.iter("lane"):
            if lane.get("id") != "0":
                ends = [int(lane.find(f"link/{word}").get("id")) for word in ("predecessor", "successor")]
                pairs.append((after, *ends))
    return sorted(pairs)


@pytest.mark.parametrize(("keeps_left", "side"), [(False, -1), (True, 1)])
def test_lanes_stay_in_line_past_a_driveway_that_their_arrows_do_not_mean(scene, tmp_path, keeps_left, side):
    # lanes for the junction ahead; a driveway on the kerb's side between them and it
    graph = road_graph(
        [(-200, 0), (0, 0), (200, 0), (0, side * 100)],
        [(0, 1), (1, 2), (1, 3)],
        twoway=[False, False, True],
        width=9.75,
    )
    through = graph.twin < 0
    turns = "left|left|through"
    turns = "|".join(turns.replace("left", "right").split("|")[::-1]) if keeps_left else turns
    graph = replace(
        graph, lanes=np.where(through, 3.0, 1.0), lane_turns=np.where(through, turns, "").astype(str)
    )
    path = _write(graph, _keeping(scene, keeps_left), tmp_path)
    _check_links(path)
    straight = [(a, b) for after, a, b in _lane_pairs(path, "1") if after == "2"]
    assert {(side * k, side * k) for k in (1, 2, 3)} <= set(straight)


@pytest.mark.parametrize("keeps_left", [False, True])
def test_cars_enter_every_lane_for_cars_past_the_end_of_a_bus_lane(scene, tmp_path, keeps_left):
    nodes = [(-200, 0), (0, 0), (200, 20)]
    graph = road_graph(nodes, [(0, 1), (1, 2)], twoway=False, width=6.5, lanes=2.0)
    kinds = "bus|driving" if keeps_left else "driving|bus"
    graph = replace(graph, lane_kinds=np.where(graph.tail == 0, kinds, "").astype(str))
    path = _write(graph, _keeping(scene, keeps_left), tmp_path)
    _check_links(path)
    side = 1 if keeps_left else -1
    links = _lane_pairs(path, "1")
    assert {b for _, a, b in links if a == side} == {side, 2 * side}


def test_without_arrows_every_lane_leads_somewhere(scene, tmp_path):
    path = _write(_crossing(), _keeping(scene, left_hand=False), tmp_path)
    assert _lanes_by_target(path) == {"2": [-1, -2], "3": [-1], "4": [-3]}
    ending = _write(_crossing(turns="|through|", ahead=1.0), _keeping(scene, left_hand=False), tmp_path)
    assert {lane for lanes in _lanes_by_target(ending).values() for lane in lanes} == {-1, -2, -3}


@pytest.mark.parametrize("keeps_left", [False, True])
def test_lanes_for_buses_have_their_type_and_their_own_connections(scene, tmp_path, keeps_left):
    kinds = "bus|driving|driving" if keeps_left else "driving|driving|bus"
    path = _write(_crossing(kinds=kinds), _keeping(scene, keeps_left), tmp_path)
    _, roads_by_id = _roads(path)
    side = "left" if keeps_left else "right"
    types = {
        abs(int(lane.get("id"))): lane.get("type")
        for lane in roads_by_id["1"].element.findall(f"lanes/laneSection/{side}/lane")
    }
    assert types == {1: "driving", 2: "driving", 3: "bus"}
    through = [r for r in roads_by_id.values() if r.element.get("junction") != "-1"]
    from_bus = [
        lane.get("type")
        for road in through
        for lane in road.element.iter("lane")
        if (before := lane.find("link/predecessor")) is not None
        and abs(int(before.get("id"))) == 3
        and road.element.find("link/predecessor").get("elementId") == "1"
    ]
    assert from_bus
    assert set(from_bus) == {"bus"}
    _check_links(path)


def test_a_lane_for_buses_against_a_one_way_road_is_on_its_other_side(scene, tmp_path):
    graph = road_graph([(0, 0), (200, 0)], [(0, 1)], twoway=False, width=9.75, lanes=2.0)
    graph = replace(graph, contraflow=np.ones(1))
    _, found = _roads(_write(graph, scene, tmp_path))
    types = {int(lane.get("id")): lane.get("type") for lane in found["1"].element.iter("lane")}
    assert types == {1: "bus", 0: "none", -1: "driving", -2: "driving"}
    lanes = found["1"].lanes(0)
    np.testing.assert_allclose(lanes[1][:, 1], [1.625, 4.875], atol=1e-5)
    np.testing.assert_allclose(lanes[-2][:, 1], [-1.625, -4.875], atol=1e-5)


@pytest.mark.parametrize("keeps_left", [False, True])
def test_lanes_of_their_own_widths_are_continuous(scene, tmp_path, keeps_left):
    graph = _crossing(widths="3|3.5|2.5", turns="left|through|right")
    path = _write(graph, _keeping(scene, keeps_left), tmp_path)
    assert _check_links(path) >= 8
    _, found = _roads(path)
    side = "left" if keeps_left else "right"
    lanes = found["1"].element.findall(f"lanes/laneSection/{side}/lane")
    lanes = [lane for lane in lanes if lane.get("type") == "driving"]
    widths = [
        float(lane.find("width").get("a")) for lane in sorted(lanes, key=lambda e: abs(int(e.get("id"))))
    ]
    assert widths == ([2.5, 3.5, 3.0] if keeps_left else [3.0, 3.5, 2.5])


def _graph_gradient(graph, edge):
    """Greatest gradient of an edge of the road graph, metres a metre."""
    step = np.diff(graph.geometry[edge], axis=0)
    run = np.hypot(step[:, 0], step[:, 1])
    return np.max(np.abs(step[run > 1e-3, 2]) / run[run > 1e-3])


@pytest.mark.shared
def test_junctions_of_a_real_town_on_a_slope(shared_osm, shared_dem, tmp_path):
    dem = (str(shared_dem("heidelberg_srtm3_utm32n.tif")),)
    options = BuildOptions(dem=dem, only=("roads",), use="map")
    scene = build(read_osm(shared_osm("heidelberg_altstadt.osm.pbf")), tmp_path / "town", options=options)
    path = export_scene(scene, tmp_path / "a.xodr").path
    assert _check_links(path) > 500
    document, found = _roads(path)
    # a movement that the map permits has a connection, and any lane for cars leads somewhere by it
    graph = scene.road_graph()
    leaving = {(e.get("incomingRoad"), link.get("from")) for e in document.iter("connection") for link in e}
    net = road_net(graph)
    before, after = turn_table(graph)
    for edge in np.unique(before[graph.twin[before] != after]).tolist():
        k = net.road_of[edge]
        if k < 0 or not net.junctions[graph.head[edge]]:
            continue
        for lane in driven_lanes(net.roads[k], edge, left_hand=False):
            assert lane.lane.kind != "driving" or (str(k + 1), str(lane.number)) in leaving
    # the inner side of a bend is shorter than its centre line, and steeper by as much
    for road in found.values():
        if road.element.get("junction") != "-1":
            joined = [
                found[road.element.find(f"link/{word}").get("elementId")]
                for word in ("predecessor", "successor")
            ]
            edges = [net.roads[int(other.id) - 1].edge for other in joined]
            assert _steepest(road) <= 1.5 * max(0.02, *(_graph_gradient(graph, k) for k in edges))
