"""Streets of built scenes have the heights of their graph, and nothing stands on them: measured by rays."""

import importlib

import numpy as np
import pytest
import rasterio
from helpers import ROOT

from geoscene.geometry.frames import Frame
from geoscene.options import BuildOptions
from geoscene.pipeline.build import build
from geoscene.sources import read_osm

FRAME = Frame.at(10.0, 50.0)
STREET = {"highway": "residential"}
ROAD = {"highway": "tertiary"}
BRIDGE = ROAD | {"bridge": "yes", "layer": "1"}


@pytest.fixture
def bench(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    return importlib.import_module("road_heights")


def write_map(path, places, ways, *, reach=250.0):
    """A map of ways through places in metres around 50 N 10 E."""
    lon, lat = FRAME.to_geographic(*np.array(list(places.values()), float).T)
    nodes = [
        f'<node id="{n}" version="1" lat="{v:.9f}" lon="{u:.9f}"/>'
        for n, u, v in zip(places, lon, lat, strict=True)
    ]
    lines = [
        f'<way id="{100 + k}" version="1">'
        + "".join(f'<nd ref="{n}"/>' for n in line)
        + "".join(f'<tag k="{key}" v="{value}"/>' for key, value in tags.items())
        + "</way>"
        for k, (tags, line) in enumerate(ways)
    ]
    (west, east), (south, north) = FRAME.to_geographic(np.array([-reach, reach]), np.array([-reach, reach]))
    box = f'<bounds minlat="{south:.7f}" minlon="{west:.7f}" maxlat="{north:.7f}" maxlon="{east:.7f}"/>'
    path.write_text(f'<osm version="0.6">{box}{"".join(nodes + lines)}</osm>')
    return path


def write_terrain(path, height, *, step=25.0, reach=400.0):
    """A GeoTIFF of the heights at x, y around 50 N 10 E."""
    count = int(2 * reach / step) + 1
    lon, lat = FRAME.to_geographic(np.array([-reach, reach]), np.array([-reach, reach]))
    across, down = (lon[1] - lon[0]) / (count - 1), (lat[1] - lat[0]) / (count - 1)
    x, y = np.meshgrid(np.linspace(-reach, reach, count), np.linspace(reach, -reach, count))
    transform = rasterio.Affine(across, 0.0, lon[0] - across / 2, 0.0, -down, lat[1] + down / 2)
    profile = {"driver": "GTiff", "width": count, "height": count, "count": 1, "dtype": "float32"}
    with rasterio.open(path, "w", **profile, crs="EPSG:4326", transform=transform) as out:
        out.write(height(x, y).astype(np.float32), 1)
    return str(path)


def built(folder, places, ways, *, terrain=None, **options):
    osm = read_osm(write_map(folder / "map.osm", places, ways))
    dem = (write_terrain(folder / "dem.tif", terrain),) if terrain else ()
    return build(osm, folder / "scene", options=BuildOptions(relief="off", dem=dem, **options))


def faults(bench, scene):
    """Numbers of samples with a fault, those without any left out."""
    counts = bench.report(scene, worst=0)["counts"]
    assert sum(row["samples"] for row in counts.values()) > 1000
    return {
        (kind, fault): n
        for kind, row in counts.items()
        for fault, n in row.items()
        if fault != "samples" and n
    }


def heights(scene, way):
    """Heights of the vertices of a way's edges."""
    graph = scene.road_graph()
    chosen = [edge for edge, ids in enumerate(graph.osm_id) if f"way/{way}" in ids.split(";")]
    assert chosen
    return np.concatenate([graph.geometry[edge][:, 2] for edge in chosen])


def problems(scene):
    return scene.files.problems.read_text().splitlines()[1:]


# A street over or under another without a common node.
CROSSING = {
    1: (-120, 0), 2: (-30, 0), 3: (30, 0), 4: (120, 0),
    5: (0, -120), 6: (0, -20), 7: (0, 20), 8: (0, 120),
}  # fmt: skip


def crossing(upper, lower):
    return [
        (ROAD, [1, 2]),
        (ROAD | upper, [2, 3]),
        (ROAD, [3, 4]),
        (STREET, [5, 6]),
        (STREET | lower, [6, 7]),
        (STREET, [7, 8]),
    ]


@pytest.mark.full
@pytest.mark.parametrize(
    ("upper", "lower"),
    [
        ({"layer": "1"}, {}),
        ({"layer": "-1"}, {}),
        ({}, {"layer": "-1"}),
        ({"layer": "5"}, {"layer": "-5"}),
        ({"level": "1"}, {}),
        ({"level": "-1"}, {"level": "2"}),
        ({"layer": "0.5"}, {}),
    ],
)
def test_layers_without_a_structure_have_no_effect(upper, lower, bench, tmp_path):
    scene = built(tmp_path, CROSSING, crossing(upper, lower))
    assert not faults(bench, scene)
    assert all(not heights(scene, way).any() for way in (101, 104))
    odd = [tags for tags in (upper, lower) if tags and tags != {"layer": "0.5"}]
    assert sum(",layer-without-structure," in row for row in problems(scene)) == len(odd)


@pytest.mark.full
@pytest.mark.parametrize("layer", ["-1", "-5", "0", "1", "0.5", None])
def test_a_bridge_passes_over_a_street_whatever_its_layer(layer, bench, tmp_path):
    tags = {"bridge": "yes"} | ({} if layer is None else {"layer": layer})
    scene = built(tmp_path, CROSSING, crossing(tags, {"layer": "0"}))
    assert not faults(bench, scene)
    assert heights(scene, 101).max() > 5.4
    assert np.abs(heights(scene, 104)).max() < 0.03
    assert any(",odd-layer," in row for row in problems(scene)) == (layer in ("-1", "-5"))


@pytest.mark.full
@pytest.mark.parametrize("layer", ["1", "-1", "0", None])
def test_a_tunnel_passes_under_a_street_whatever_its_layer(layer, bench, tmp_path):
    tags = {"tunnel": "yes"} | ({} if layer is None else {"layer": layer})
    scene = built(tmp_path, CROSSING | {2: (-60, 0), 3: (60, 0)}, crossing(tags, {}))
    assert not faults(bench, scene)
    assert heights(scene, 101).min() < -5.4
    assert np.abs(heights(scene, 104)).max() < 0.03
    assert any(",odd-layer," in row for row in problems(scene)) == (layer == "1")


@pytest.mark.full
def test_streets_that_cross_on_terrain_without_a_node_have_one_height(bench, tmp_path):
    scene = built(tmp_path, CROSSING, crossing({"layer": "1"}, {}), terrain=HILLS)
    assert not faults(bench, scene)


@pytest.mark.full
def test_a_level_street_beside_the_ramp_of_a_tunnel_stays_level(bench, tmp_path):
    beside = {
        1: (-200, 0),
        2: (-60, 0),
        3: (60, 0),
        4: (200, 0),
        9: (-240, 7.5),
        10: (-66, 7.5),
        11: (-66, 200),
    }
    ways = [(ROAD, [1, 2]), (ROAD | {"tunnel": "yes"}, [2, 3]), (ROAD, [3, 4]), (STREET, [5, 8])]
    scene = built(tmp_path, CROSSING | beside, [*ways, (STREET, [9, 10, 11])], only=("roads",))
    assert heights(scene, 100).min() < -3.0
    assert not heights(scene, 104).any()
    assert not faults(bench, scene)


@pytest.mark.full
def test_a_passage_is_no_fault_if_it_is_as_low_as_its_sign_says(bench, tmp_path):
    corners = {11: (-30, -9), 12: (30, -9), 13: (30, 9), 14: (-30, 9)}
    inside = STREET | {"tunnel": "building_passage", "maxheight": "1.8"}
    ways = [(STREET, [1, 2]), (inside, [2, 3]), (STREET, [3, 4]), (STREET, [5, 6])]
    ways.append(({"building": "yes", "height": "9"}, [11, 12, 13, 14, 11]))
    assert not faults(bench, built(tmp_path, CROSSING | corners, ways))


@pytest.mark.full
def test_a_ramp_has_its_height_also_where_the_bridge_is_beyond_the_bounds(tmp_path):
    places = {n: (x + 80, y) for n, (x, y) in CROSSING.items()}
    path = write_map(tmp_path / "map.osm", places, crossing({"bridge": "yes"}, {}))
    terrain = (write_terrain(tmp_path / "dem.tif", SLOPE),)
    found = []
    for reach in (250.0, 30.0):
        (west, east), (south, north) = FRAME.to_geographic(np.array([-250.0, reach]), np.array([-99.0, 99.0]))
        osm = read_osm(path, bounds=(west, south, east, north))
        scene = build(osm, tmp_path / str(reach), options=BuildOptions(dem=terrain, use="map"))
        graph = scene.road_graph()
        line = graph.geometry[np.flatnonzero(graph.osm_id == "way/100")[0]]
        x, _ = FRAME.from_geographic(*scene.frame.to_geographic(line[:, 0], line[:, 1]))
        found.append(np.interp([-20.0, 0.0, 10.0, 25.0], x, line[:, 2]))
    np.testing.assert_allclose(*found, atol=0.001)
    assert found[0][-1] > SLOPE(25.0, 0.0) + 2.0
    assert set(graph.osm_id) == {"way/100"}


def HILLS(x, y):  # noqa: N802 - a constant
    return 300.0 + 12.0 * np.sin(x / 40.0) * np.cos(y / 55.0) + 0.1 * x


GRID = {10 * i + j: (60.0 * i - 150.0 + 7.0 * j, 60.0 * j - 150.0) for i in range(6) for j in range(6)}
GRID_WAYS = [(STREET, [10 * i + j for j in range(6)]) for i in range(6)]
GRID_WAYS += [(ROAD, [10 * i + j for i in range(6)]) for j in range(6)]


@pytest.mark.full
def test_streets_on_steep_terrain_lie_on_the_ground(bench, tmp_path):
    scene = built(tmp_path, GRID, GRID_WAYS, terrain=HILLS)
    assert not faults(bench, scene)


@pytest.mark.full
def test_streets_that_leave_the_extent_end_there(bench, tmp_path):
    """Through the whole scene, along its border, into it, and out of it and in again."""
    places = {
        1: (-400, 30), 2: (0, 40), 3: (400, 30), 4: (0, -100), 5: (240, -300), 6: (400, -100), 7: (230, -60),
        8: (300, -400), 9: (300, 400),
    }  # fmt: skip
    oneway = STREET | {"oneway": "yes"}
    ways = [(ROAD, [1, 2, 3]), (oneway, [2, 4]), (STREET, [4, 5, 6, 7]), (ROAD, [8, 9])]
    scene = built(tmp_path, places, ways, terrain=HILLS, dem_gaps="nearest")
    assert not faults(bench, scene)
    graph = scene.road_graph()
    assert (graph.node_id < 0).sum() == 4
    assert "way/103" not in graph.osm_id
    (xmin, ymin, xmax, ymax) = scene.bounds
    points = np.concatenate(list(graph.geometry))
    assert ((points[:, :2] > (xmin, ymin)) & (points[:, :2] < (xmax, ymax))).all()
    two_way = graph.twin >= 0
    assert (graph.twin[graph.twin[two_way]] == np.flatnonzero(two_way)).all()
    plan = [np.hypot(*np.diff(line[:, :2], axis=0).T).sum() for line in graph.geometry]
    np.testing.assert_allclose(graph.length, plan, rtol=1e-5)
    np.testing.assert_array_equal(graph.node_xyz[graph.tail], [line[0] for line in graph.geometry])
    np.testing.assert_array_equal(graph.node_xyz[graph.head], [line[-1] for line in graph.geometry])


def SLOPE(x, y):  # noqa: N802 - a constant
    return 100.0 + 0.25 * y + 0.05 * x


@pytest.mark.full
def test_a_street_beside_a_bridge_on_a_slope_keeps_its_ground(bench, tmp_path):
    """The bridge's edge reaches over the street, and their heights differ by a metre or two."""
    places = {1: (-200, 0), 2: (-60, 0), 3: (60, 0), 4: (200, 0), 5: (-200, 6), 6: (200, 6)}
    wide = {"width": "8"}
    ways = [(ROAD | wide, [1, 2]), (BRIDGE | wide, [2, 3]), (ROAD | wide, [3, 4]), (STREET, [5, 6])]
    assert not faults(bench, built(tmp_path, places, ways, terrain=SLOPE))


@pytest.mark.parametrize("tags", [{"bridge": "yes"}, {"tunnel": "yes"}])
@pytest.mark.parametrize("angle", [12.0, 30.0, 55.0, 90.0])
def test_a_structure_that_forks_from_a_street_blocks_neither(tags, angle, bench, tmp_path):
    turn = np.radians(angle)
    far = (120 * np.cos(turn), 120 * np.sin(turn))
    places = {1: (-150, 0), 2: (0, 0), 3: (200, 0), 4: far, 5: (1.6 * far[0], 1.6 * far[1])}
    ways = [(ROAD, [1, 2, 3]), (STREET | tags, [2, 4]), (STREET, [4, 5])]
    assert not faults(bench, built(tmp_path, places, ways, terrain=SLOPE))


@pytest.mark.full
@pytest.mark.parametrize("tags", [{"bridge": "yes"}, {"tunnel": "yes"}])
def test_a_structure_that_ends_nowhere_is_free_up_to_its_end(tags, bench, tmp_path):
    scene = built(tmp_path, {1: (-200, 0), 2: (-80, 0), 3: (80, 0)}, [(ROAD, [1, 2]), (ROAD | tags, [2, 3])])
    assert not faults(bench, scene)


FOOT = {"highway": "footway"}


@pytest.mark.full
@pytest.mark.parametrize(
    "path",
    [
        [(0, -80), (0, -3), (0, 3), (0, 80)],  # the bridge is as long as the street is wide
        [(-80, 1), (-60, 1), (60, 1), (80, 1)],  # on the street
        [(-30, -80), (-4, -2), (0, 4), (60, 40)],  # it ends in the street
    ],
)
@pytest.mark.parametrize("tags", [{"bridge": "yes", "layer": "1"}, {"tunnel": "yes", "layer": "-1"}])
def test_railings_and_walls_of_footways_do_not_stand_in_streets(path, tags, bench, tmp_path):
    places = {1: (-150, 0), 2: (150, 0)} | {3 + k: place for k, place in enumerate(path)}
    ways = [(STREET, [1, 2]), (FOOT, [3, 4]), (FOOT | tags, [4, 5]), (FOOT, [5, 6])]
    assert not faults(bench, built(tmp_path, places, ways))
    (tmp_path / "steep").mkdir()
    assert not faults(bench, built(tmp_path / "steep", places, ways, terrain=SLOPE))


@pytest.mark.full
def test_a_footbridge_passes_over_a_road_bridge_wherever_its_stations_lie(bench, tmp_path):
    places = CROSSING | {1: (-200, 0), 4: (200, 0), 5: (0, -160), 6: (0, -60), 7: (0, 60), 8: (0, 160)}
    ways = [(ROAD, [1, 2]), (BRIDGE, [2, 3]), (ROAD, [3, 4])]
    ways += [(FOOT, [5, 6]), (FOOT | {"bridge": "yes", "layer": "2"}, [6, 7]), (FOOT, [7, 8])]
    assert not faults(bench, built(tmp_path, places, ways))


@pytest.mark.full
@pytest.mark.parametrize("level", ["1", "-1", "2", "0"])
def test_footways_with_a_level_alone_are_no_structures(level, bench, tmp_path):
    places = {1: (-150, 0), 2: (150, 0), 3: (0, -80), 4: (0, 80)}
    scene = built(tmp_path, places, [(STREET, [1, 2]), (FOOT | {"level": level}, [3, 4])])
    assert not faults(bench, scene)
    assert not scene.table_length("structures")
    assert any("way/101,road,repaired,layer-without-structure" in row for row in problems(scene)) == (
        level != "0"
    )


@pytest.mark.parametrize("half", [1.0, 3.0, 4.5, 8.0])
@pytest.mark.parametrize("kind", ["bridge", "tunnel"])
def test_structures_that_end_beside_or_within_the_street_they_cross_pass_it(kind, half, bench, tmp_path):
    places = CROSSING | {1: (-200, 0), 2: (-half, 0), 3: (half, 0), 4: (200, 0)}
    scene = built(tmp_path, places, crossing({kind: "yes"}, {}))
    assert not faults(bench, scene)
    assert np.abs(heights(scene, 104)).max() < 0.05
    assert np.abs(heights(scene, 101)).max() > 5.0
    rows = [row for row in problems(scene) if row.startswith(f"way/101,road,repaired,short-{kind}")]
    assert len(rows) == (2 if half < 4.0 else 0)
    at = np.array([(x, y, 0.0) for x in (-2.8, -1.5, 1.5, 2.8) for y in (-20.0, -3.0, 0.0, 3.0, 20.0)])
    caster, _ = bench.mesh_of(scene)
    down = np.broadcast_to([0.0, 0.0, -1.0], at.shape)
    np.testing.assert_allclose(1.0 - caster.cast(at + np.array([0, 0, 1.0]), down).range, 0.0, atol=0.05)


def test_drives_end_at_the_walls_of_garages_and_aisles_lead_through_canopies(bench, tmp_path):
    corners = {11: (-30, -9), 12: (30, -9), 13: (30, 9), 14: (-30, 9)}
    corners |= {21: (-90, -9), 22: (-70, -9), 23: (-70, 9), 24: (-90, 9)}
    house = {"building": "yes", "height": "9"}
    service = {"highway": "service"}
    ways = [(service | {"service": "parking_aisle"}, [1, 2]), (service, [2, 3]), (STREET, [5, 6])]
    ways += [(house, [11, 12, 13, 14, 11]), (house, [21, 22, 23, 24, 21])]
    places = CROSSING | {2: (-50, 0), 3: (20, 0), 5: (-60, -200), 6: (-60, 200)}
    scene = built(tmp_path, places | corners, ways)
    assert not faults(bench, scene)
    rows = [
        row for row in problems(scene) if row.split(",")[3] in ("street-in-building", "closed-by-building")
    ]
    assert [row.split(",")[:4] for row in rows] == [
        ["way/100", "road", "repaired", "street-in-building"],
        ["way/101", "road", "dropped", "closed-by-building"],
    ]
    assert max(line[:, 0].max() for line in scene.road_graph().geometry) == pytest.approx(-30.1, abs=0.05)


PRIVATE = {"highway": "service", "access": "private"}


@pytest.mark.parametrize("far", [18.0, 60.0, 150.0])
def test_a_private_tunnel_passes_below_a_street_and_leaves_the_street_at_its_mouth_as_it_is(
    far, bench, tmp_path
):
    """Near its mouths there is no room for a tunnel of full height below a street."""
    places = {1: (-200, 0), 2: (-far, 0), 3: (far, 0), 4: (200, 0), 5: (0, -120), 8: (0, 120)}
    tunnel = PRIVATE | {"tunnel": "yes", "layer": "-1"}
    ways = [(STREET, [1, 2]), (tunnel, [2, 3]), (STREET, [3, 4]), (STREET, [5, 8])]
    scene = built(tmp_path, places, ways)
    assert not faults(bench, scene)
    assert not any(",no-ramp," in row for row in problems(scene))


@pytest.mark.parametrize("layer", ["-1", "-3"])
def test_a_private_tunnel_leaves_a_streets_tunnel_that_it_crosses_free(layer, bench, tmp_path):
    places = {1: (-300, 0), 2: (-120, 0), 3: (120, 0), 4: (300, 0)}
    places |= {5: (0, -300), 6: (0, -150), 7: (0, 150), 8: (0, 300)}
    ways = [(STREET, [1, 2]), (STREET | {"tunnel": "yes", "layer": "-2"}, [2, 3]), (STREET, [3, 4])]
    ways += [(PRIVATE, [5, 6]), (PRIVATE | {"tunnel": "yes", "layer": layer}, [6, 7]), (PRIVATE, [7, 8])]
    scene = built(tmp_path, places, ways)
    assert not faults(bench, scene)
    assert heights(scene, 101).min() < -5.0


@pytest.mark.parametrize("kind", ["bridge", "tunnel"])
def test_a_footway_that_begins_on_a_bridge_or_in_a_tunnel_leaves_its_carriageway(kind, bench, tmp_path):
    tags = {kind: "yes", "layer": "1" if kind == "bridge" else "-1"}
    places = CROSSING | {1: (-200, 0), 2: (-100, 0), 3: (100, 0), 4: (200, 0), 9: (0, 0), 10: (4, 60)}
    ways = [(ROAD, [1, 2]), (ROAD | tags, [2, 9, 3]), (ROAD, [3, 4]), (FOOT | tags, [9, 10])]
    assert not faults(bench, built(tmp_path, places, ways))


SERVICE = {"highway": "service"}


def test_a_tunnel_that_is_a_ring_has_one_height_where_it_closes(bench, tmp_path):
    places = {1: (-150, 0), 2: (-60, 0), 3: (0, 0), 4: (22, 6), 5: (13, 36), 6: (-14, 28), 7: (-6, 3)}
    inside = SERVICE | {"tunnel": "yes", "layer": "-1"}
    ways = [(STREET, [1, 2]), (inside, [2, 3]), (inside | {"oneway": "yes"}, [3, 4, 5, 6, 7, 3])]
    ways.append((STREET, [8, 9]))
    places |= {8: (-150, -100), 9: (150, -100)}
    assert not faults(bench, built(tmp_path, places, ways))


def test_a_subway_over_a_streets_tunnel_at_a_small_angle_leaves_it_whole(bench, tmp_path):
    places = {1: (-300, 0), 2: (-120, 0), 3: (120, 0), 4: (300, 0)}
    places |= {5: (-110, -18), 6: (-60, -10), 7: (60, 10), 8: (110, 18)}
    ways = [(STREET, [1, 2]), (STREET | {"tunnel": "yes", "layer": "-2"}, [2, 3]), (STREET, [3, 4])]
    ways += [(FOOT, [5, 6]), (FOOT | {"tunnel": "yes", "layer": "-1"}, [6, 7]), (FOOT, [7, 8])]
    assert not faults(bench, built(tmp_path, places, ways))


def test_storeys_of_a_garage_drawn_upon_one_another_are_left_out_of_the_graph(bench, tmp_path):
    """Two ramps from one place to storeys of their own, the second one along the first."""
    places = {1: (-200, 0), 2: (-100, 0), 3: (0, 0), 4: (0.2, 0.3), 5: (60, 60), 6: (60, -60), 7: (-60, 0.1)}
    inside = SERVICE | {"tunnel": "yes"}
    ways = [(STREET, [1, 2]), (inside | {"layer": "-1"}, [2, 7, 3, 5])]
    ways.append((inside | {"layer": "-3"}, [2, 4, 6]))
    ways.append((STREET, [8, 9]))
    places |= {8: (-150, -100), 9: (150, -100)}
    scene = built(tmp_path, places, ways)
    assert not faults(bench, scene)
    rows = [row.split(",")[:4] for row in problems(scene) if ",tunnel-in-tunnel," in row]
    assert rows == [[f"way/{way}", "road", "dropped", "tunnel-in-tunnel"] for way in (101, 102)]
    assert {"way/100", "way/103"} <= set(scene.road_graph().osm_id)


def VALLEY(x, y):  # noqa: N802 - a constant
    return 20.0 + 0.02 * x - 0.1 * np.abs(y)


@pytest.mark.parametrize("terrain", [None, VALLEY])
def test_a_street_keeps_its_height_where_it_ends_above_water(terrain, bench, tmp_path):
    """At a bridge over a canal between shores nearer than its ramps, and at a quay."""
    places = {1: (-120, 0), 2: (-12, 0), 3: (12, 0), 4: (120, 0), 5: (0, -120), 6: (0, 120), 7: (-120, 60)}
    places |= {11: (-12, -60), 12: (12, -60), 13: (12, 70), 14: (-12, 70), 8: (-12.1, 60)}
    ways = [(ROAD, [1, 2]), (BRIDGE, [2, 3]), (ROAD, [3, 4]), (STREET, [7, 8])]
    ways.append(({"natural": "water", "water": "canal"}, [11, 12, 13, 14, 11]))
    ways.append(({"waterway": "canal"}, [5, 6]))
    assert not faults(bench, built(tmp_path, places, ways, terrain=terrain))


def test_a_ramp_that_leaves_a_fork_of_bridges_keeps_its_carriageway(bench, tmp_path):
    places = {
        1: (150, -200),
        2: (60, -120),
        3: (0, 0),
        4: (-60, -30),
        5: (-7, 11),
        6: (-10, 30),
        7: (-200, -100),
    }
    places |= {8: (-60, -150), 9: (90, 0), 10: (-100, 30), 11: (100, 30)}
    wide, narrow = {"width": "8"}, {"width": "3.5"}
    ways = [(ROAD, [1, 2]), (BRIDGE | wide, [2, 3]), (BRIDGE | wide, [3, 4]), (ROAD, [4, 7])]
    ways.append((ROAD | narrow, [3, 5, 6]))
    ways += [(STREET, [8, 9]), (STREET, [10, 6, 11])]
    scene = built(tmp_path, places, ways)
    assert heights(scene, 104).max() > 1.5
    assert not {key for key in faults(bench, scene) if key[0] == "ground" and key[1] != "road"}
