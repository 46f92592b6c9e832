"""Passages through buildings are open at the height of the street, and the buildings stay closed solids."""

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import affinity

from geoscene.classes import Class
from geoscene.geometry.frames import Frame
from geoscene.geometry.mesh import FLOOR, concatenate
from geoscene.geometry.watertight import validate_mesh
from geoscene.ground.partition import rows_at, values_at
from geoscene.options import BuildOptions
from geoscene.pipeline.plan import make_plan
from geoscene.pipeline.tiles import make_solids
from geoscene.sources.data import Area, OsmData, Way
from geoscene.support.progress import silent

FRAME = Frame.at(10.0, 50.0)
BOUNDS = (9.9985, 49.999, 10.0015, 50.001)
HOUSE = shapely.box(-6, -20, 6, 20)
"""A house across the street, which runs along x."""

PASSAGE = {"tunnel": "building_passage"}


def lonlat(xy):
    return np.column_stack(FRAME.to_geographic(*np.asarray(xy, float).reshape(-1, 2).T))


def house(shape=HOUSE, number=900, **tags):
    shape = shapely.transform(shape, lonlat)
    colon = {
        key.replace("__", ":"): value
        for key, value in ({"building": "yes", "height": "12", "roof__shape": "flat"} | tags).items()
    }
    return Area(f"way/{number}", colon, shape, np.empty(0, np.int64))


def part(shape, number, **tags):
    area = house(shape, number, **({"building__part": "yes"} | tags))
    return Area(
        area.osm_id, {k: v for k, v in area.tags.items() if k != "building"}, area.geometry, area.nodes
    )


def street(*places, inside=PASSAGE, highway="residential", **tags):
    """A street with nodes at places (x, y); ``inside`` are tags of its middle stretch."""
    where = lonlat(places)
    nodes = np.arange(1, len(places) + 1)
    middle = len(places) // 2 - 1
    return [
        Way(
            f"way/{k + 1}",
            {"highway": highway, **tags, **(inside if k == middle else {})},
            nodes[k : k + 2],
            where[k : k + 2],
        )
        for k in range(len(places) - 1)
    ]


STREET = ((-60, 0), (-6, 0), (6, 0), (60, 0))


def built(areas, ways, **options):
    """The plan of a map, the mesh of its buildings, which are closed solids, and the problems."""
    osm = OsmData(BOUNDS, list(ways), list(areas), [], [])
    plan, problems = make_plan(osm, BuildOptions(relief="off", **options), progress=silent)
    made = [make_solids(plan, tile, lod=2) for tile in plan.rows["buildings"]]
    mesh = concatenate([mesh for mesh, _ in made])
    assert validate_mesh(mesh).ok.all()
    return plan, mesh, problems + [problem for _, found in made for problem in found]


def heights(mesh, x, y):
    """Heights of faces of the mesh above and below a place, ascending."""
    corners = mesh.vertices[mesh.faces]
    above = shapely.intersects_xy(shapely.polygons(corners[..., :2]), x, y)
    a, b, c = corners[above].transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    lying = np.abs(normal[:, 2]) > 1e-2 * np.linalg.norm(normal, axis=1)
    a, normal = a[lying], normal[lying]
    away = (np.array([x, y]) - a[:, :2]) * normal[:, :2]
    return sorted(set(np.round(a[:, 2] - away.sum(axis=1) / normal[:, 2], 3).tolist()))


def classes(plan, *places):
    return values_at(
        plan.ground.layers.klass, rows_at(plan.ground, np.array(places, float)), base=255
    ).tolist()


@pytest.mark.full
@pytest.mark.parametrize(
    ("tags", "free"),
    [
        (PASSAGE, 4.5),
        (PASSAGE | {"maxheight": "3.8"}, 3.8),
        (PASSAGE | {"maxheight": "12'6\""}, 3.81),
        (PASSAGE | {"maxheight": "default"}, 4.5),
        (PASSAGE | {"maxheight": "3.8", "maxheight:physical": "4"}, 4.0),
        (PASSAGE | {"maxheight": "3.8", "height": "4.2 m"}, 4.2),
        (PASSAGE | {"layer": "-1"}, 4.5),
        (PASSAGE | {"layer": "1"}, 4.5),
        (PASSAGE | {"level": "-2"}, 4.5),
        ({"covered": "yes"}, 4.5),
        ({"tunnel": "covered"}, 4.5),
        ({"tunnel": "yes"}, 4.5),
        ({"tunnel": "yes", "layer": "0"}, 4.5),
    ],
)
def test_a_street_runs_through_a_house_as_high_as_its_tags_say(tags, free):
    plan, mesh, problems = built([house()], street(*STREET, inside=tags))
    half = plan.graph.width.max() / 2
    free = np.ceil(free / 0.05 - 1e-3) * 0.05  # undersides are whole multiples of 5 cm
    for x in (-5.99, 0.7, 5.99):
        assert heights(mesh, x, half - 0.1) == pytest.approx([free, 12.0])
        assert heights(mesh, x, half + 0.2) == pytest.approx([0.0, 12.0])
    assert classes(plan, (0.7, 0.9), (-5.9, 0.9), (0.7, half + 0.5)) == [
        Class.ROAD,
        Class.ROAD,
        Class.BUILDING_PAD,
    ]
    assert all(line[:, 2].max() == 0 == line[:, 2].min() for line in plan.graph.geometry)
    assert not len(plan.structures)
    assert (mesh.surface[np.isclose(mesh.vertices[mesh.faces][..., 2], free).all(axis=1)] == FLOOR).all()
    expected = [("way/2", "tunnel-in-building")] if tags.get("tunnel") == "yes" else []
    found = [(p.osm_id, p.reason) for p in problems if p.reason != "layer-without-structure"]
    assert found == expected


def test_streets_to_a_passage_are_as_wide_as_the_one_in_it():
    plan, _, problems = built([house()], street(*STREET))
    assert len(set(plan.graph.width.tolist())) == 1
    assert plan.graph.width[0] > 5
    assert problems == []


@pytest.mark.parametrize(
    ("tags", "width", "free"),
    [
        ({"highway": "footway"}, 2.0, 2.5),
        ({"highway": "steps"}, 2.0, 2.5),
        ({"highway": "cycleway", "width": "3"}, 3.0, 2.5),
        ({"highway": "path", "est_width": "1"}, 1.0, 2.5),
        ({"highway": "pedestrian"}, 5.0, 2.5),
        ({"highway": "footway", "maxheight": "2.1"}, 2.0, 2.1),
        ({"highway": "service", "service": "driveway"}, 3.0, 4.5),
        ({"highway": "track", "width": "2.6"}, 2.6, 4.5),
        ({"railway": "tram"}, 4.4, 4.7),
    ],
)
def test_ways_have_passages_of_their_kind(tags, width, free):
    nodes, places = np.array([1, 2, 3, 4]), lonlat(STREET)
    way = Way("way/1", tags | PASSAGE, nodes, places)
    plan, mesh, problems = built([house()], [way])
    assert heights(mesh, 0.7, width / 2 - 0.1) == pytest.approx([free, 12.0])
    assert heights(mesh, 0.7, width / 2 + 0.2) == pytest.approx([0.0, 12.0])
    assert classes(plan, (0.7, 0.3)) != [Class.BUILDING_PAD]
    layer = {layer.name: layer for layer in plan.layers}["passages"]
    assert {name: column[0] for name, column in layer.columns.items()} == {
        "osm_id": "way/1",
        "building": 0,
        "width": width,
        "height": free,
        "height_source": "maxheight" if "maxheight" in tags else "default",
    }
    assert problems == []


@pytest.mark.full
@pytest.mark.parametrize(
    ("tags", "why"),
    [
        ({"tunnel": "yes", "layer": "-1"}, "underground"),
        ({"covered": "yes", "level": "1"}, "upper storey"),
        ({"covered": "yes", "bridge": "yes", "layer": "1"}, "bridge"),
        ({"highway": "footway"}, "corridor"),
        ({"access": "private"}, "private"),
    ],
)
def test_other_ways_have_none(tags, why):
    plan, _, _ = built([house()], street(*STREET, inside=tags))
    assert "passages" not in {layer.name for layer in plan.layers}, why


AISLE = {"highway": "service", "service": "parking_aisle"}


@pytest.mark.parametrize("tags", [{}, {"tunnel": "culvert"}, {"covered": "no"}, AISLE])
def test_a_house_across_a_street_is_open_there_and_listed(tags):
    _, mesh, problems = built([house()], street(*STREET, inside=tags))
    assert heights(mesh, 0.7, 0.9) == [4.5, 12]
    assert heights(mesh, 0.7, 5) == [0, 12]
    assert [(p.osm_id, p.reason) for p in problems] == [("way/2", "street-in-building")]


def test_a_house_is_open_to_streets_that_go_on_in_it_and_closed_where_one_ends():
    one, two, *_ = street((-60, 0), (0, 0), (60, 0), inside={})
    _, mesh, _ = built([house()], [one, two])
    assert heights(mesh, -3, 0.9) == heights(mesh, 3, 0.9) == [4.5, 12]
    plan, mesh, problems = built([house()], [one])
    assert heights(mesh, -3, 0.9) == [0, 12]
    assert ("way/1", "closed-by-building") in {(p.osm_id, p.reason) for p in problems}
    assert np.concatenate(plan.graph.geometry)[:, 0].max() == pytest.approx(-6.1, abs=0.01)


def test_aisles_of_a_car_park_are_closed_and_no_part_of_the_road_graph():
    """Two aisles that join in the building, and one beyond it that is a street of its own."""
    where = lonlat([(-60, 0), (-6, 0), (0, 0), (0, 15), (6, 0), (60, 0)])
    lines = [({"highway": "service"}, [0, 1]), (AISLE, [1, 2, 3]), (AISLE, [2, 4]), (AISLE, [4, 5])]
    ways = [
        Way(f"way/{k + 1}", tags, np.array(nodes) + 1, where[nodes]) for k, (tags, nodes) in enumerate(lines)
    ]
    plan, mesh, problems = built([house()], ways)
    assert all(heights(mesh, x, 0.9) == [0, 12] for x in (-3, 3))
    closed = [p.osm_id for p in problems if p.reason == "closed-by-building"]
    assert closed == ["way/1;way/2", "way/2", "way/3;way/4"]
    kept = shapely.union_all([shapely.LineString(line[:, :2]) for line in plan.graph.geometry])
    assert kept.distance(HOUSE) == pytest.approx(0.1, abs=0.01)
    assert kept.length == pytest.approx(108 - 0.2, abs=0.1)


def test_a_long_tunnel_below_a_house_stays_a_tunnel():
    plan, _, problems = built(
        [house()], street((-190, 0), (-90, 0), (90, 0), (190, 0), inside={"tunnel": "yes"})
    )
    assert plan.structures.tunnel.any()
    assert [p.reason for p in problems if "passage" in p.detail] == []


@pytest.mark.full
@given(
    st.floats(-0.9, 0.9),
    st.floats(-0.1, 0.1),
    st.floats(-3, 3),
    st.floats(-0.9, 0.9),
    st.sampled_from(["flat", "gabled", "hipped"]),
)
@settings(max_examples=8, deadline=None)
def test_any_street_through_any_house_is_open_and_the_house_closed(turn, bend, shift, inset, roof):
    shape = affinity.rotate(HOUSE, turn, use_radians=True)
    across = shapely.LineString([(-60, shift), (60, shift + 120 * bend)])
    first, last = sorted(across.intersection(shape).coords)
    ends = [(first[0] + inset, first[1] + inset * bend), (last[0] - inset, last[1] - inset * bend)]
    _, mesh, _ = built(
        [house(shape, roof__shape=roof, roof__height="3")], street((-60, shift), *ends, (60, 20))
    )
    for x, y in shapely.get_coordinates(shapely.segmentize(across.intersection(shape.buffer(-0.02)), 0.31)):
        found = heights(mesh, x, y)
        assert not found or found[0] == pytest.approx(4.5), (x, y)


def test_a_way_that_ends_in_its_house_has_a_passage_up_to_there():
    _, mesh, _ = built([house()], street((-60, 0), (-6, 0), (1, 0), (1, 5)))
    assert heights(mesh, -0.5, 0.3) == [4.5, 12]
    assert heights(mesh, 5.5, 0.3) == [0, 12]


def test_a_way_that_touches_a_house_cuts_nothing_and_one_across_its_corner_all_its_width():
    touching = street((-60, 20), (-6, 20), (6, 20), (60, 20))
    _, mesh, _ = built([house()], touching)
    assert heights(mesh, 0.3, 19.5) == [0, 12]
    across = street((-60, 10), (-8, 18), (4, 23), (60, 40))
    _, mesh, _ = built([house()], across)
    assert heights(mesh, -5.9, 19) == [4.5, 12]
    assert heights(mesh, 0, 5) == [0, 12]


def test_a_neighbour_beside_the_street_is_not_cut():
    neighbour = house(shapely.box(-6, 1.5, 6, 20), 901)
    _, mesh, _ = built([house(shapely.box(-6, -20, 6, 1.5)), neighbour], street(*STREET))
    assert heights(mesh, 0.3, 2) == [0, 12]
    assert heights(mesh, 0.3, -2) == [4.5, 12]


def test_parts_with_a_mapped_underside_leave_the_street_free():
    parts = [
        part(shapely.box(-6, -20, 6, -4), 901),
        part(shapely.box(-6, -4, 6, 4), 902, min_height="3.6"),
        part(shapely.box(-6, 4, 6, 20), 903),
    ]
    for tags in (PASSAGE, {"tunnel": "yes"}, {}):
        plan, mesh, _ = built([house(), *parts], street(*STREET, inside=tags))
        assert heights(mesh, 0.7, 0.9) == [3.6, 12]
        assert heights(mesh, 0.7, 5) == [0, 12]
        assert classes(plan, (0.7, 0.9), (0.7, 5)) == [Class.ROAD, Class.BUILDING_PAD]
        assert not len(plan.structures)


def test_a_street_through_several_parts_cuts_those_on_the_ground():
    parts = [part(shapely.box(-6, -20, 0, 20), 901), part(shapely.box(0, -20, 6, 20), 902, min_height="3")]
    _, mesh, _ = built([house(), *parts], street(*STREET))
    assert heights(mesh, -3, 0.3) == [4.5, 12]
    assert heights(mesh, 3, 0.3) == [3, 12]
    stacked = [part(HOUSE, 901, height="3"), part(HOUSE, 902, min_height="3")]
    _, mesh, _ = built([house(), *stacked], street(*STREET))
    assert heights(mesh, -3, 0.3) == [4.5, 12]


@pytest.mark.parametrize(
    ("tags", "free", "reasons"),
    [
        ({"height": "4.6"}, 4.3, ["low-passage"]),
        ({"height": "3"}, 2.7, ["low-passage"]),
        ({"height": "6", "roof__shape": "gabled", "roof__height": "3"}, 2.7, ["low-passage"]),
        ({"height": "3", "roof__shape": "gabled", "roof__height": "2"}, 2.0, ["low-passage"]),
        ({"height": "2.1"}, None, []),
    ],
)
def test_a_passage_under_low_eaves_is_lower_unless_there_is_no_room(tags, free, reasons):
    _, mesh, problems = built([house(**tags)], street(*STREET))
    found = heights(mesh, 0.7, 0.9)
    assert (found[0] if found else None) == pytest.approx(free)
    assert [p.reason for p in problems] == reasons


@pytest.mark.full
@pytest.mark.parametrize(
    ("areas", "tags", "height", "source"),
    [
        ([house()], PASSAGE, 4.5, "default"),
        ([house(height="3")], PASSAGE, 2.7, "building"),
        ([house(height="4.6")], PASSAGE | {"maxheight": "4.4"}, 4.4, "maxheight"),
        ([house(building="roof", height="3")], {"covered": "yes"}, 2.6, "building"),
        ([house(), part(HOUSE, 901, min_height="3")], PASSAGE, 3.0, "building"),
        ([house(), part(HOUSE, 901, height="3"), part(HOUSE, 902, min_height="3")], PASSAGE, 2.7, "building"),
    ],
)
def test_the_table_of_passages_has_their_free_height(areas, tags, height, source):
    plan, _, _ = built(areas, street(*STREET, inside=tags))
    columns = {layer.name: layer for layer in plan.layers}["passages"].columns
    assert columns["height"][0] == pytest.approx(height)
    assert columns["height_source"].tolist() == [source]


def test_a_mapped_height_is_kept_under_low_eaves():
    _, mesh, problems = built([house(height="4.4")], street(*STREET, inside=PASSAGE | {"maxheight": "4.2"}))
    assert heights(mesh, 0.7, 0.9) == pytest.approx([4.2, 4.4])
    assert problems == []


@pytest.mark.parametrize("kind", ["arcade", "colonnade", "yes"])
def test_an_arcade_is_open_to_the_side(kind):
    walk = [(-5, -60), (-5, -20), (-5, 20), (-5, 60)]
    _, mesh, _ = built(
        [house(shapely.box(-6.8, -20, 6, 20))], street(*walk, inside={"covered": kind}, highway="footway")
    )
    assert heights(mesh, -5.3, 3) == [2.5, 12]
    assert heights(mesh, -6.5, 3) == ([0, 12] if kind == "yes" else [2.5, 12])


def test_a_passage_on_a_slope_is_free_above_its_highest_ground(tmp_path):
    from helpers.rasters import write_slope  # noqa: PLC0415

    path = tmp_path / "dem.tif"
    write_slope(path, BOUNDS, rise=5.0)
    plan, mesh, _ = built([house()], street(*STREET), dem=(str(path),))
    z = plan.height(np.array([-6.0, 6.0]), np.zeros(2))
    assert np.ptp(z) > 0.1
    underside = heights(mesh, 0.3, 0.9)[0]
    assert 4.5 <= underside - z.max() < 4.6
