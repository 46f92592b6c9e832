"""Reading extracts: all formats, any order of elements, and defects."""

import bz2
import gzip
import json
import random
from pathlib import Path

import numpy as np
import osmium
import pytest
import shapely
from helpers.extracts import same
from hypothesis import given, settings
from hypothesis import strategies as st

from geoscene.errors import InputError, SourceNotFoundError
from geoscene.sources import OsmData, demo_path, read_osm
from geoscene.sources.areas import is_multipolygon
from geoscene.sources.data import is_building
from geoscene.sources.pbf import rewrite_texts
from geoscene.support.problems import Problem

ALL = [
    "baltimore_harbor.osm.pbf",
    "basque_forest_multipolygon.osm.gz",
    "bayreuth_north.osm.gz",
    "berlin_neukoelln.osm.gz",
    "berlin_siegessaeule.osm.gz",
    "brumadinho.osm.gz",
    "campo_grande_roads.osm.gz",
    "gibraltar.osm.pbf",
    "heidelberg_altstadt.osm.pbf",
    "helsinki_center.osm.pbf",
    "kotka_karhula.osm.pbf",
    "krems.osm.gz",
    "lena_delta_water.osm.gz",
    "liechtenstein.osm.pbf",
    "monaco.osm.pbf",
    "moscow_ostankino.osm.gz",
    "norfolk_east_28th_buildings.osm.gz",
    "norfolk_odu_roads.osm.gz",
    "nyc_lower_east_side.osm.pbf",
    "oslo_skoyen.osm.pbf",
    "portland_central_roads.osm.pbf",
    "porto_alegre_roads.osm.pbf",
    "singapore_bayfront.osm.pbf",
    "st_petersburg_galernaya.osm.gz",
    "testgrid_multipolygons.osm.gz",
]

METRE = 9e-6  # degrees of latitude


def square(x: float, y: float, side: float = 20.0) -> list[tuple[float, float]]:
    """Corners of a square in metres, counter-clockwise."""
    return [(x, y), (x + side, y), (x + side, y + side), (x, y + side)]


class Map:
    """A small map near 0, 0 in metres; written as XML in any order."""

    def __init__(self, box: tuple[float, float, float, float] | None = None) -> None:
        self.items: list[tuple[str, int, str]] = []
        self.box = box
        self.count = 0

    def node(self, x: float, y: float, tags: dict | None = None) -> int:
        self.count += 1
        place = f'lat="{y * METRE:.7f}" lon="{x * METRE:.7f}"'
        self.items.append(("node", self.count, f"{place}>{self._tags(tags)}"))
        return self.count

    def nodes(self, points: list[tuple[float, float]]) -> list[int]:
        return [self.node(*p) for p in points]

    def way(self, refs: list[int], tags: dict | None = None) -> int:
        self.count += 1
        body = "".join(f'<nd ref="{r}"/>' for r in refs)
        self.items.append(("way", self.count, f">{body}{self._tags(tags)}"))
        return self.count

    def ring(self, points: list[tuple[float, float]], tags: dict | None = None) -> int:
        refs = self.nodes(points)
        return self.way([*refs, refs[0]], tags)

    def relation(self, members: list[tuple[int, str]], tags: dict) -> int:
        self.count += 1
        body = "".join(f'<member type="way" ref="{r}" role="{role}"/>' for r, role in members)
        self.items.append(("relation", self.count, f">{body}{self._tags(tags)}"))
        return self.count

    @staticmethod
    def _tags(tags: dict | None) -> str:
        return "".join(f'<tag k="{k}" v="{v}"/>' for k, v in (tags or {}).items())

    def xml(self, *, order: random.Random | None = None, negative: bool = False) -> str:
        items = list(self.items)
        if order:
            order.shuffle(items)
        lines = [f'<{kind} id="{i}" {body}</{kind}>' for kind, i, body in items]
        text = "\n".join(lines)
        if negative:
            text = text.replace(' id="', ' id="-').replace(' ref="', ' ref="-')
        bounds = ""
        if self.box:
            w, s, e, n = (v * METRE for v in self.box)
            bounds = f'<bounds minlon="{w:.7f}" minlat="{s:.7f}" maxlon="{e:.7f}" maxlat="{n:.7f}"/>'
        return f'<osm version="0.6">{bounds}\n{text}\n</osm>'

    def read(self, folder: Path, **options) -> OsmData:
        path = folder / "map.osm"
        path.write_text(self.xml())
        return read_osm(path, **options)


def square_metres(area) -> float:
    return area.geometry.area / METRE**2


def reasons(data: OsmData) -> list[tuple[str, str, str]]:
    return [(p.kind, p.action, p.reason) for p in data.problems]


# --- what is what


@pytest.mark.parametrize(
    ("tags", "area", "line"),
    [
        ({"building": "yes"}, True, False),
        ({"building": "no"}, False, True),
        ({"building:part": "yes"}, True, False),
        ({"highway": "residential"}, False, True),
        ({"highway": "pedestrian", "area": "yes"}, True, False),
        ({"barrier": "fence"}, False, True),
        ({"barrier": "wall", "area": "yes"}, True, False),
        ({"leisure": "playground", "barrier": "fence"}, True, True),
        ({"leisure": "track"}, False, True),
        ({"leisure": "track", "area": "yes"}, True, False),
        ({"natural": "water"}, True, False),
        ({"natural": "coastline"}, False, True),
        ({"natural": "tree_row"}, False, True),
        ({"landuse": "grass"}, True, False),
        ({"landuse": "grass", "area": "no"}, False, True),
        ({"amenity": "parking"}, True, False),
        ({"railway": "rail"}, False, True),
        ({"waterway": "river"}, False, True),
        ({"waterway": "riverbank"}, True, False),
        ({"name": "unknown"}, False, True),
        ({"source": "survey"}, False, False),
    ],
)
def test_tags_decide_whether_a_closed_way_is_an_area(tmp_path, tags, area, line):
    town = Map()
    town.ring(square(0, 0), tags)
    data = town.read(tmp_path)
    assert (len(data.areas), len(data.ways)) == (area, line)
    assert data.problems == []


def test_an_area_is_counter_clockwise_with_its_nodes_in_the_order_of_its_corners(tmp_path):
    town = Map()
    town.ring(square(0, 0)[::-1], {"building": "yes"})
    (area,) = town.read(tmp_path).areas
    assert area.geometry.exterior.is_ccw
    place = {i: (x, y) for i, (x, y) in enumerate(square(0, 0)[::-1], 1)}
    corners = np.array([place[i] for i in area.nodes.tolist()]) * METRE
    np.testing.assert_allclose(np.array(area.geometry.exterior.coords), corners, atol=1e-7)


def test_points_and_other_relations_have_their_tags(tmp_path):
    town = Map()
    town.node(1, 2, {"natural": "tree", "height": "7"})
    street = town.way(town.nodes([(0, 0), (9, 0)]), {"highway": "service"})
    town.relation([(street, "from"), (street, "to")], {"type": "restriction", "restriction": "no_u_turn"})
    data = town.read(tmp_path)
    (tree,) = data.points
    assert (tree.osm_id, tree.tags) == ("node/1", {"natural": "tree", "height": "7"})
    assert (tree.lon, tree.lat) == (0.000009, 0.000018)
    (turn,) = data.relations
    assert turn.members == (("way", street, "from"), ("way", street, "to"))


# --- order, ids, formats


@pytest.mark.full
@given(st.integers(0, 2**32 - 1), st.booleans())
@settings(max_examples=20, deadline=None)
def test_order_and_sign_of_ids_do_not_change_the_features(tmp_path_factory, seed, negative):
    town = Map()
    outer = town.nodes(square(0, 0, 50))
    one, two = town.way(outer[:3]), town.way([*outer[2:], outer[0]])
    hole = town.ring(square(10, 10))
    town.relation(
        [(one, "outer"), (hole, "inner"), (two, "outer")], {"type": "multipolygon", "building": "yes"}
    )
    town.ring(square(100, 0), {"building": "yes"})
    town.way([outer[0], town.node(200, 200, {"highway": "crossing"})], {"highway": "primary"})
    folder = tmp_path_factory.mktemp("order")
    (folder / "sorted.osm").write_text(town.xml(negative=negative))
    (folder / "mixed.osm").write_text(town.xml(order=random.Random(seed), negative=negative))
    data = read_osm(folder / "mixed.osm")
    same(read_osm(folder / "sorted.osm"), data)
    assert [round(square_metres(a)) for a in data.areas if "building" in a.tags] == [400, 2100]
    assert len(data.ways) == len(data.points) == 1


@pytest.mark.full
def test_every_format_gives_the_same_features_under_any_file_name(tmp_path):
    demo = demo_path()
    xml = tmp_path / "a.osm"
    with osmium.SimpleWriter(str(xml), header=osmium.io.Reader(str(demo)).header()) as writer:
        for item in osmium.FileProcessor(demo):
            writer.add(item)
    text = xml.read_bytes()
    (tmp_path / "b.osm.gz").write_bytes(gzip.compress(text))
    (tmp_path / "c.osm.bz2").write_bytes(bz2.compress(text))
    (tmp_path / "d.osm").write_bytes(gzip.compress(text))
    (tmp_path / "e.dat").write_bytes(demo.read_bytes())
    expected = read_osm(demo)
    for name in ("a.osm", "b.osm.gz", "c.osm.bz2", "d.osm", "e.dat"):
        same(expected, read_osm(tmp_path / name))


def test_overpass_json_is_read_from_gzip_and_bzip2(tmp_path):
    places = [(x * METRE, y * METRE) for x, y in square(0, 0)]
    corners = [{"type": "node", "id": k, "lon": x, "lat": y} for k, (x, y) in enumerate(places, 1)]
    house = {"type": "way", "id": 9, "nodes": [1, 2, 3, 4, 1], "tags": {"building": "yes"}}
    text = json.dumps({"elements": [house, *corners]}).encode()
    read = []
    for name, pack in (("a.json", bytes), ("b.json.gz", gzip.compress), ("c.json.bz2", bz2.compress)):
        (tmp_path / name).write_bytes(pack(text))
        read.append(read_osm(tmp_path / name))
    same(read[0], read[1])
    same(read[0], read[2])


def test_a_ring_of_random_nodes_is_dropped_at_once(tmp_path):
    draw = random.Random(0)
    m = Map()
    m.ring([(draw.uniform(0, 900), draw.uniform(0, 900)) for _ in range(5000)], {"building": "yes"})
    m.ring(square(0, 0), {"building": "yes"})
    data = m.read(tmp_path)
    assert reasons(data) == [("building", "dropped", "tangled")]
    assert len(data.areas) == 1


def test_a_long_outline_with_few_crossings_is_kept(tmp_path):
    turn = np.linspace(0, 2 * np.pi, 3000, endpoint=False)
    m = Map()
    m.ring(list(zip(500 * np.cos(turn), 500 * np.sin(2 * turn), strict=True)), {"natural": "wood"})
    data = m.read(tmp_path)
    assert [action for _, action, _ in reasons(data)] == ["repaired"]
    assert len(data.areas) == 1


@pytest.mark.parametrize("joined", [False, True])
def test_of_hundreds_of_roads_in_one_place_32_stay(joined, tmp_path):
    m = Map()
    middle = [m.node(0, 0)] if joined else []
    for a in np.linspace(0, np.pi, 300, endpoint=False):
        dx, dy = 400 * np.cos(a), 400 * np.sin(a)
        m.way([m.node(-dx, -dy), *middle, m.node(dx, dy)], {"highway": "residential"})
    data = m.read(tmp_path)
    assert 32 <= len(data.ways) <= 4 * 32
    assert set(reasons(data)) == {("road", "dropped", "crowded")}
    assert len(data.ways) + len(data.problems) == 300


def test_files_cut_in_any_way_are_one_map(tmp_path):
    whole = Map((0, 0, 200, 100))
    for k in range(6):
        whole.ring(square(30 * k, 20), {"building": "yes"})
    whole.way(whole.nodes([(0, 5), (200, 5)]), {"highway": "residential"})
    expected = whole.read(tmp_path)
    draw = random.Random(0)
    parts = []
    for k in range(3):
        part = Map((0, 0, 200, 100) if k < 2 else None)
        part.items = [item for item in whole.items if draw.random() < 0.7]
        parts.append(part)
    missing = [item for item in whole.items if not any(item in part.items for part in parts)]
    parts[0].items += missing
    paths = [tmp_path / f"{k}.osm" for k in range(3)]
    for path, part in zip(paths, parts, strict=True):
        path.write_text(part.xml(order=draw))
    same(read_osm(paths), expected)
    assert read_osm(paths).source == "0.osm, 1.osm, 2.osm"


def test_negative_ids_of_different_objects_are_refused(tmp_path):
    for name, x in (("a", 0), ("b", 500)):
        part = Map()
        part.ring(square(x, 0), {"building": "yes"})
        (tmp_path / f"{name}.osm").write_text(part.xml(negative=True))
    with pytest.raises(InputError, match=r"b\.osm: its node/-4"):
        read_osm([tmp_path / "a.osm", tmp_path / "b.osm"])
    same(read_osm([tmp_path / "a.osm", tmp_path / "a.osm"]), read_osm(tmp_path / "a.osm"))


def test_overpass_json_in_a_file_is_read(tmp_path):
    path = tmp_path / "answer.json"
    corners = [
        {"type": "node", "id": i, "lon": x * METRE, "lat": y * METRE} for i, (x, y) in enumerate(square(0, 0))
    ]
    house = {"type": "way", "id": 9, "nodes": [0, 1, 2, 3, 0], "tags": {"building": "yes"}}
    path.write_text(json.dumps({"elements": [house, *corners]}))
    (area,) = read_osm(path).areas
    assert square_metres(area) == pytest.approx(400, rel=0.02)


@pytest.mark.parametrize(
    "item",
    [
        {"type": "node", "id": 1, "lon": 0, "lat": 0, "tags": 1.5},
        {"type": "node", "id": 1, "lon": 0, "lat": 0, "tags": {"highway": 3}},
        {"type": "way", "id": 1, "nodes": [{}]},
        {"type": "way", "id": [], "nodes": []},
        {"type": "relation", "id": 1, "members": [{"type": "way", "ref": "x", "role": ""}]},
    ],
)
def test_overpass_json_with_other_values_is_refused(tmp_path, item):
    path = tmp_path / "answer.json"
    path.write_text(json.dumps({"elements": [item]}))
    with pytest.raises(InputError, match=r"answer\.json: JSON, but not as Overpass"):
        read_osm(path)


# --- defects


def test_a_line_is_split_where_nodes_are_missing(tmp_path):
    town = Map()
    a, b, c, d = town.nodes([(0, 0), (10, 0), (500, 0), (510, 0)])
    street = town.way([a, b, 999, c, d, 998], {"highway": "residential"})
    data = town.read(tmp_path)
    assert [w.nodes.tolist() for w in data.ways] == [[a, b], [c, d]]
    assert {w.osm_id for w in data.ways} == {f"way/{street}"}
    assert reasons(data) == [("road", "repaired", "missing-nodes")]


def test_a_building_cut_at_the_edge_is_closed_if_most_of_its_outline_is_there(tmp_path):
    town = Map(box=(0, 0, 1000, 1000))
    whole = town.nodes([(5, 900), (5, 910), (30, 910), (30, 880), (5, 880)])
    town.way([*whole, 999, whole[0]], {"building": "yes"})  # a node beyond the edge is missing
    town.way(town.nodes([(0, 500), (40, 500), (40, 520), (0, 520)]), {"building": "yes"})  # open at the edge
    town.way(town.nodes([(5, 5), (6, 12), (5, 20)]), {"building": "yes"})  # hardly anything of it
    town.way(town.nodes([(500, 500), (540, 500), (540, 520), (500, 520)]), {"building": "yes"})  # open inland
    data = town.read(tmp_path)
    assert [round(square_metres(a)) for a in data.areas] == [750, 800]
    assert reasons(data) == [
        ("building", "repaired", "missing-nodes"),
        ("building", "repaired", "open-ring"),
        ("building", "dropped", "open-ring"),
        ("building", "dropped", "open-ring"),
    ]


def test_a_bow_tie_keeps_both_its_halves(tmp_path):
    town = Map()
    town.ring([(0, 0), (20, 20), (20, 0), (0, 20)], {"building": "yes"})
    data = town.read(tmp_path)
    assert square_metres(data.areas[0]) == pytest.approx(200, rel=1e-3)
    assert shapely.is_valid(data.areas[0].geometry)
    assert reasons(data) == [("building", "repaired", "self-crossing")]


def test_repeated_nodes_are_left_out_and_flat_rings_dropped(tmp_path):
    town = Map()
    a, b, c, d = town.nodes(square(0, 0))
    twin = town.node(*square(0, 0)[1])
    town.way([a, a, b, twin, c, d, a], {"building": "yes"})
    town.way([a, b, a], {"building": "yes"})
    town.ring([(0, 50), (10, 50), (20, 50)], {"building": "yes"})
    data = town.read(tmp_path)
    (area,) = data.areas
    assert area.nodes.tolist() == [a, b, c, d, a]
    assert reasons(data) == [
        ("building", "repaired", "repeated-node"),
        ("building", "dropped", "no-area"),
        ("building", "dropped", "no-area"),
    ]


@pytest.mark.parametrize("place", ['lat="NaN" lon="0"', 'lat="95" lon="0"', 'lat="1e9" lon="0"', ""])
def test_a_node_without_a_position_is_dropped_and_the_rest_is_read(tmp_path, place):
    town = Map()
    town.ring(square(0, 0), {"building": "yes"})
    path = tmp_path / "a.osm"
    path.write_text(town.xml().replace("</osm>", f'<node id="77" {place}/></osm>'))
    data = read_osm(path)
    assert len(data.areas) == 1
    assert data.problems == [
        Problem("node/77", "node", "dropped", "bad-coordinates", "missing or out of range")
    ]


def test_a_courtyard_whose_outer_way_is_tagged_too_is_one_building(tmp_path):
    town = Map()
    outer = town.ring(square(0, 0, 50), {"building": "yes", "height": "12"})
    inner = town.ring(square(10, 10))
    town.relation([(outer, "outer"), (inner, "inner")], {"type": "multipolygon", "building": "office"})
    data = town.read(tmp_path)
    (area,) = data.areas
    assert area.tags == {"type": "multipolygon", "building": "office", "height": "12"}
    assert round(square_metres(area)) == 2100
    assert data.problems[0].osm_id == f"way/{outer}"
    assert reasons(data) == [("building", "dropped", "tagged-twice")]


def test_a_multipolygon_without_tags_has_those_of_its_outer_way(tmp_path):
    town = Map()
    outer = town.ring(square(0, 0, 50), {"building": "yes"})
    inner = town.ring(square(10, 10), {"landuse": "grass"})
    town.relation([(outer, "outer"), (inner, "inner")], {"type": "multipolygon"})
    data = town.read(tmp_path)
    assert {a.osm_id.split("/")[0]: round(square_metres(a)) for a in data.areas} == {
        "relation": 2100,
        "way": 400,
    }
    assert data.problems == []


def test_closed_rings_of_a_broken_multipolygon_are_kept(tmp_path):
    town = Map()
    whole = town.ring(square(0, 0, 50))
    half = town.way(town.nodes(square(100, 0)[:3]))
    hole = town.ring(square(10, 10))
    forest = {"type": "multipolygon", "natural": "wood"}
    town.relation([(whole, "outer"), (half, "outer"), (hole, "inner"), (999, "outer")], forest)
    town.relation([(999, "outer"), (hole, "inner")], forest)  # its hole must not become a wood
    data = town.read(tmp_path)
    assert [round(square_metres(a)) for a in data.areas] == [2100]
    assert reasons(data) == [
        ("area", "repaired", "incomplete-relation"),
        ("area", "dropped", "incomplete-relation"),
    ]


def test_a_building_whose_inner_ring_is_its_outer_ring_is_dropped(tmp_path):
    town = Map()
    ring, again = town.ring(square(0, 0, 50)), town.ring(square(0, 0, 50)[::-1])
    tags = {"type": "multipolygon", "building": "yes"}
    town.relation([(ring, "outer"), (ring, "inner")], tags)
    town.relation([(ring, "outer"), (again, "inner")], tags)
    town.ring(square(100, 0), {"building": "yes"})
    data = town.read(tmp_path)
    assert [round(square_metres(a)) for a in data.areas] == [400]
    assert reasons(data) == [("building", "dropped", "both-roles")] * 2
    assert {p.detail for p in data.problems} == {"2 member ways; the inner rings leave no area"}


def test_members_with_the_role_of_a_part_bound_no_multipolygon(tmp_path):
    town = Map()
    outer, inner = town.ring(square(0, 0, 50)), town.ring(square(10, 10))
    part = town.ring(square(5, 5), {"building:part": "yes", "min_height": "12"})
    members = [(outer, "outer"), (inner, "inner"), (part, "part")]
    town.relation(members, {"type": "multipolygon", "building": "yes"})
    data = town.read(tmp_path)
    sizes = {a.osm_id: round(square_metres(a)) for a in data.areas}
    assert sizes == {f"way/{part}": 400, f"relation/{town.count}": 2100}
    assert data.problems == []


def test_a_relation_of_type_building_with_the_tags_of_its_outline_is_a_building(tmp_path):
    town = Map()
    outline = town.ring(square(0, 0, 50))
    part = town.ring(square(10, 10), {"building:part": "yes", "height": "20"})
    town.relation([(outline, "outline"), (part, "part")], {"type": "building", "building": "yes"})
    tagged = town.ring(square(100, 0), {"building": "yes"})
    town.relation([(tagged, "outline")], {"type": "building", "building": "yes"})
    data = town.read(tmp_path)
    assert {a.osm_id for a in data.areas} == {f"way/{part}", f"relation/{part + 1}", f"way/{tagged}"}
    assert len(data.relations) == 2  # which assign parts
    assert data.problems == []


# --- what editors and changes mark


MARKS = ('action="delete"', "action='delete'", 'visible="false"')


@pytest.mark.parametrize("mark", MARKS)
@pytest.mark.parametrize("packed", [False, True])
def test_deleted_objects_are_not_read(tmp_path, mark, packed):
    town = Map()
    kept = town.ring(square(0, 0), {"building": "yes"})
    gone = town.ring(square(50, 0), {"building": "yes"})
    tree = town.node(80, 0, {"natural": "tree"})
    outer = town.ring(square(100, 0))
    forest = town.relation([(outer, "outer")], {"type": "multipolygon", "natural": "wood"})
    text = town.xml()
    for kind, i in (("way", gone), ("node", tree), ("relation", forest)):
        assert f'<{kind} id="{i}"' in text
        text = text.replace(f'<{kind} id="{i}"', f'<{kind} id="{i}" {mark}')
    path = tmp_path / "map"
    path.write_bytes(gzip.compress(text.encode()) if packed else text.encode())
    data = read_osm(path)
    assert [a.osm_id for a in data.areas] == [f"way/{kept}"]
    assert data.points == data.problems == []


def test_a_deleted_node_is_missing_from_its_way(tmp_path):
    town = Map()
    nodes = town.nodes([(0, 0), (10, 0), (20, 0), (30, 0), (40, 0)])
    town.way(nodes, {"highway": "residential"})
    path = tmp_path / "map.osm"
    path.write_text(town.xml().replace(f'<node id="{nodes[2]}"', f'<node id="{nodes[2]}" action="delete"'))
    data = read_osm(path)
    assert [len(way.nodes) for way in data.ways] == [2, 2]
    assert reasons(data) == [("road", "repaired", "missing-nodes")]


def test_a_file_of_changes_changes_the_map_before_it(tmp_path):
    town = Map()
    house = town.ring(square(0, 0), {"building": "yes"})
    shed = town.ring(square(50, 0), {"building": "yes"})
    (tmp_path / "a.osm").write_text(town.xml())
    corners = "".join(f'<nd ref="{i}"/>' for i in (1, 2, 3, 4, 1))
    changes = (
        f'<modify><way id="{house}">{corners}<tag k="building" v="church"/></way></modify>'
        f'<delete><way id="{shed}"/></delete>'
        '<create><node id="99" lat="0.0001" lon="0.0001"><tag k="natural" v="tree"/></node></create>'
    )
    (tmp_path / "b.osc").write_text(f'<osmChange version="0.6">{changes}</osmChange>')
    data = read_osm([tmp_path / "a.osm", tmp_path / "b.osc"])
    assert [(a.osm_id, a.tags["building"]) for a in data.areas] == [(f"way/{house}", "church")]
    assert [p.osm_id for p in data.points] == ["node/99"]
    data = read_osm([tmp_path / "b.osc", tmp_path / "a.osm"])  # the map is newer than the change
    assert [a.osm_id for a in data.areas] == [f"way/{house}", f"way/{shed}"]
    (tmp_path / "c.osc").write_text(
        f'<osmChange version="0.6"><delete><way id="{house}"/></delete></osmChange>'
    )
    assert not [a for a in read_osm([tmp_path / "a.osm", tmp_path / "c.osc"]).areas if "church" in a.tags]
    with pytest.raises(SourceNotFoundError):
        read_osm(tmp_path / "c.osc")


@pytest.mark.parametrize("form", ["xml", "json"])
def test_a_tag_that_is_too_long_is_left_out_alone(tmp_path, form):
    town = Map()
    house = town.ring(square(0, 0), {"building": "yes", "note": "x" * 100_000, "name": "y" * 1024})
    path = tmp_path / "map"
    path.write_text(town.xml())
    if form == "json":
        data = read_osm(path)
        nodes = [
            {"type": "node", "id": i, "lat": y * METRE, "lon": x * METRE}
            for i, (x, y) in enumerate(square(0, 0), 1)
        ]
        tags = data.areas[0].tags | {"note": "x" * 100_000}
        way = {"type": "way", "id": house, "nodes": [1, 2, 3, 4, 1], "tags": tags}
        path.write_text(json.dumps({"elements": [*nodes, way]}))
    data = read_osm(path)
    assert data.areas[0].tags == {"building": "yes", "name": "y" * 1024}
    detail = "tag note of 100,000 bytes left out, maximum is 1,024"
    assert data.problems == [Problem(f"way/{house}", "way", "repaired", "overlong-tag", detail)]


def test_a_tag_of_a_pbf_file_that_is_too_long_is_left_out_alone(tmp_path):
    town = Map()
    house = town.ring(square(0, 0), {"building": "yes", "note": "short", "name": "y" * 1024})
    town.node(5, 5, {"natural": "tree", "short": "oak"})
    (tmp_path / "map.osm").write_text(town.xml())
    with osmium.SimpleWriter(str(tmp_path / "map.osm.pbf")) as writer:
        for item in osmium.FileProcessor(str(tmp_path / "map.osm")):
            writer.add(item)
    before = read_osm(tmp_path / "map.osm.pbf")
    long = {b"short": b"x" * 100_000}
    rewrite_texts(tmp_path / "map.osm.pbf", tmp_path / "long.pbf", changed=lambda text: long.get(text, text))
    data = read_osm(tmp_path / "long.pbf")
    assert data.areas[0].tags == {"building": "yes", "name": "y" * 1024}
    assert data.points[0].tags == {"natural": "tree"}
    assert shapely.equals(data.areas[0].geometry, before.areas[0].geometry)
    details = [f"tag {key} of 100,000 bytes left out, maximum is 1,024" for key in ("x" * 40, "note")]
    tree = data.points[0].osm_id
    assert data.problems == [
        Problem(f"way/{house}", "way", "repaired", "overlong-tag", details[1]),
        Problem(tree, "node", "repaired", "overlong-tag", details[0]),
    ]


# --- what does not exist


@pytest.mark.parametrize(
    ("tags", "kept"),
    [
        ({"building": "proposed", "height": "60"}, None),
        ({"building": "demolished"}, None),
        ({"building": "collapsed"}, None),
        ({"building": "yes", "demolished": "yes"}, None),
        ({"building:part": "razed"}, None),
        ({"demolished:building": "yes"}, None),
        ({"proposed:building": "house", "landuse": "grass"}, {"landuse": "grass"}),
        ({"building": "demolished", "landuse": "brownfield"}, {"landuse": "brownfield"}),
        ({"building": "construction"}, {"building": "construction"}),
        ({"building": "yes", "construction": "yes"}, {"building": "yes", "construction": "yes"}),
        ({"building": "ruins"}, {"building": "ruins"}),
        ({"building": "yes", "abandoned": "yes"}, {"building": "yes", "abandoned": "yes"}),
        ({"disused:building": "school"}, {"building": "school"}),
        ({"building": "house", "was:building": "barn"}, {"building": "house", "was:building": "barn"}),
        ({"building": "house", "demolished:building": "barn"}, {"building": "house"}),
        ({"highway": "residential", "bridge": "proposed"}, {"highway": "residential"}),
        ({"highway": "construction", "construction": "primary"}, None),
        ({"highway": "proposed", "proposed": "primary"}, None),
        ({"abandoned:highway": "residential"}, None),
        ({"railway": "razed"}, None),
        ({"railway": "disused"}, {"railway": "disused"}),
        ({"barrier": "wall", "removed": "yes"}, None),
        ({"removed:barrier": "fence"}, None),
        ({"razed:natural": "tree"}, None),
    ],
)
def test_what_is_planned_or_gone_is_left_out_and_listed(tmp_path, tags, kept):
    town = Map()
    town.ring(square(0, 0), tags)
    town.node(50, 0, tags)
    data = town.read(tmp_path)
    stated = ("building", "building:part", "highway", "railway", "barrier", "natural", "bridge", "landuse")
    for feature in (*data.areas, *data.ways, *data.points):
        assert {k for k in feature.tags if k in stated} == {k for k in kept or () if k in stated}
    absent = kept is None or "landuse" in tags or "bridge" in tags
    assert [(p.action, p.reason) for p in data.problems] == 2 * absent * [("dropped", "does-not-exist")]


def test_what_does_not_exist_outside_the_bounds_is_not_listed(tmp_path):
    town = Map()
    town.ring(square(0, 0), {"building": "yes"})
    town.ring(square(500, 0), {"building": "proposed"})
    town.node(500, 500, {"removed:natural": "tree"})
    data = town.read(tmp_path, bounds=(-METRE, -METRE, 50 * METRE, 50 * METRE))
    assert data.problems == []


# --- bounds and errors


def test_bounds_keep_intersecting_features_whole(tmp_path):
    town = Map()
    town.ring(square(-10, 0), {"building": "yes"})
    town.ring(square(500, 500), {"building": "yes"})
    town.way(town.nodes([(-900, 5), (900, 5)]), {"highway": "primary"})  # passes through, no node within
    town.node(5, 5, {"natural": "tree"})
    town.node(600, 5, {"natural": "tree"})
    town.ring([(600, 0), (620, 20), (620, 0), (600, 20)], {"building": "yes"})
    bounds = (0.0, 0.0, 50 * METRE, 50 * METRE)
    data = town.read(tmp_path, bounds=bounds)
    assert data.bounds == bounds
    assert [round(square_metres(a)) for a in data.areas] == [400]
    assert len(data.ways) == len(data.points) == 1
    assert data.problems == []


@pytest.mark.parametrize("bounds", [(0, 0, 1), (5, 0, 4, 1), (0, 0, float("nan"), 1), (-400, 0, 1, 1)])
def test_invalid_bounds_are_refused(tmp_path, bounds):
    with pytest.raises(InputError, match="bounds"):
        read_osm(tmp_path / "never-opened.osm", bounds=bounds)


def test_a_file_that_is_not_a_map_is_refused_in_one_line(tmp_path):
    pbf = demo_path().read_bytes()
    text = b'<osm version="0.6"><node id="1" lat="1" lon="2"/></osm>'
    bad = {
        "empty.osm": b"",
        "empty.osm.gz": gzip.compress(b""),
        "cut.osm.pbf": pbf[:20000],
        "header.osm.pbf": pbf[:8],
        "flipped.osm.pbf": pbf[:3000] + bytes(b ^ 0x5A for b in pbf[3000:3400]) + pbf[3400:],
        "cut.osm": text[:40],
        "cut.osm.gz": gzip.compress(text)[:-20],
        "cut.osm.bz2": bz2.compress(text)[:-20],
        "page.osm": b"<!DOCTYPE html><html><body>Not found</body></html>",
        "text.osm.pbf": b"version https://git-lfs.github.com/spec/v1",
        "nothing.osm": b'<osm version="0.6"></osm>',
        "geo.json": b'{"type": "FeatureCollection", "features": []}',
        "way.json": b'{"elements": [{"type": "way"}]}',
    }
    for name, content in bad.items():
        path = tmp_path / name
        path.write_bytes(content)
        with pytest.raises(InputError) as caught:
            read_osm(path)
        message = str(caught.value)
        assert str(path) in message
        assert "\n" not in message
        assert ".osm.pbf" in message
    with pytest.raises(SourceNotFoundError, match="no such file"):
        read_osm(tmp_path / "absent.osm")
    with pytest.raises(InputError, match="a directory"):
        read_osm(tmp_path)


# --- real extracts


@pytest.mark.shared
@pytest.mark.parametrize("name", ALL)
def test_no_building_of_a_real_extract_is_dropped_without_a_problem(shared_osm, name):
    """Every element tagged as a building is an area, a problem, or a member of an area's relation."""
    path = shared_osm(name)
    data = read_osm(path)
    made = {a.osm_id for a in data.areas}
    told = {p.osm_id for p in data.problems}
    bounding: set[str] = set()
    tagged = set()
    for item in osmium.FileProcessor(path, osmium.osm.WAY | osmium.osm.RELATION):
        tags = {tag.k: tag.v for tag in item.tags}
        if item.is_relation() and is_multipolygon(tags) and f"relation/{item.id}" in made:
            bounding |= {f"way/{m.ref}" for m in item.members if m.type == "w"}
        if is_building(tags) and (item.is_way() or is_multipolygon(tags)):
            tagged.add(f"{'way' if item.is_way() else 'relation'}/{item.id}")
    assert tagged <= made | told | bounding
    geometry = np.array([a.geometry for a in data.areas], object)
    assert shapely.is_valid(geometry).all()
    assert (shapely.area(geometry) > 0).all()
    parts = shapely.get_parts(geometry)
    assert shapely.is_ccw(shapely.get_exterior_ring(parts)).all()
    assert all(len(w.nodes) == len(w.lonlat) >= 2 for w in data.ways)


@pytest.mark.shared
def test_number_of_buildings_equals_that_of_libosmium(shared_osm):
    """Compared for files that libosmium can read completely (positive, sorted ids; no cut features).

    Of the buildings of Brumadinho 66 collapsed, which a problem says of each.
    """
    collapsed = 0
    for name in ("monaco.osm.pbf", "bayreuth_north.osm.gz", "brumadinho.osm.gz"):
        path = shared_osm(name)
        factory = osmium.geom.WKBFactory()
        theirs = {}
        for item in osmium.FileProcessor(path).with_areas():
            if item.is_area() and item.tags.get("building", "no") != "no":
                osm_id = f"{'way' if item.from_way() else 'relation'}/{item.orig_id()}"
                theirs[osm_id] = shapely.from_wkb(factory.create_multipolygon(item))
        data = read_osm(path)
        ours = {a.osm_id: a.geometry for a in data.areas if a.tags.get("building", "no") != "no"}
        gone = {p.osm_id for p in data.problems if "building=collapsed" in p.detail}
        collapsed += len(gone)
        assert ours.keys() == theirs.keys() - gone
        assert gone <= theirs.keys()
        assert all(shapely.equals(ours[i], theirs[i]) for i in ours)
    assert collapsed == 66


REPAIRED = {"710", "740", "745", "746", "768", "771", "773"}
"""Boundaries that libosmium's test grid calls invalid and lists no repair of."""


@pytest.mark.shared
def test_multipolygons_of_the_test_grid_have_their_known_areas(shared_osm):
    data = read_osm(shared_osm("testgrid_multipolygons.osm.gz"))
    made: dict[str, dict] = {}
    for area in data.areas:
        made.setdefault(area.tags["test:id"], {})[area.osm_id] = area.geometry
    agree, disagree = 0, set()
    for case in json.loads(shared_osm("testgrid_multipolygons.expected.json").read_text()):
        variants = case.get("areas", {}).values()
        if not any(a["from_type"] == "relation" for v in variants for a in v):
            continue
        ours = made.get(str(case["test_id"]), {})
        fits = False
        for variant in variants:
            known = {
                f"{a['from_type']}/{a['from_id']}": shapely.from_wkt(a["wkt"])
                for a in variant
                if a["wkt"] != "INVALID"
            }
            fits |= known.keys() == ours.keys() and all(
                shapely.symmetric_difference(known[i], ours[i]).area < 1e-12 for i in known
            )
        agree += fits
        if not fits:
            disagree.add(str(case["test_id"]))
    boundary = {"950"}  # type=boundary stays a relation
    assert disagree == REPAIRED | boundary
    assert agree == 88
    told = {p.osm_id: p.action for p in data.problems}
    assert all(told[f"relation/{i}900"] == "repaired" for i in REPAIRED)


@pytest.mark.parametrize("ids", [(1, 2, 3), (3, 2, 1), (-1, -2, -3), (1, 2, 1)])
def test_nodes_of_pbf_files_are_read_with_any_ids_in_any_order(tmp_path, ids):
    places = [(10.0, 50.0), (10.001, 50.0), (10.001, 50.001)]
    with osmium.SimpleWriter(str(tmp_path / "a.osm.pbf")) as writer:
        for k, (osm_id, place) in enumerate(zip(ids, places, strict=True)):
            tags = {"n": str(k)} if k else {}
            writer.add_node(osmium.osm.mutable.Node(id=osm_id, location=place, tags=tags))
        writer.add_way(osmium.osm.mutable.Way(id=7, nodes=sorted(set(ids)), tags={"highway": "service"}))
    osm = read_osm(tmp_path / "a.osm.pbf")
    where = dict(zip(ids, places, strict=True))  # of equal ids the last counts
    np.testing.assert_allclose(osm.ways[0].lonlat, [where[i] for i in sorted(set(ids))], atol=1e-7)
    assert {p.osm_id for p in osm.points} == {f"node/{i}" for i in ids[1:]}


@pytest.mark.parametrize(
    "data",
    [
        b'{"elements": [' + b" " * 2**26,
        b"<osm version='0.6'>" + b"<node id='1' lat='1' lon='1'/>\n" * 2**22 + b"</osm>",
    ],
)
def test_a_file_that_unpacks_to_gigabytes_is_refused(tmp_path, data):
    path = tmp_path / "a.gz"
    path.write_bytes(gzip.compress(data))
    with pytest.raises(InputError, match=r"a\.gz: is unpacked to more than 64 MiB"):
        read_osm(path)
