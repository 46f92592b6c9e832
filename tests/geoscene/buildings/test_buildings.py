"""Buildings become closed solids without losses or overlaps, and all assumptions and repairs are recorded."""

import importlib
import random
from dataclasses import replace
from itertools import pairwise

import manifold3d as m3
import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import affinity
from shapely.errors import GEOSException

from geoscene.buildings import BuildingOptions, build_solids, footprints, read_buildings
from geoscene.buildings.appearance import read_walls
from geoscene.buildings.footprints import subtract
from geoscene.buildings.heights import infer_heights
from geoscene.buildings.shells import prisms
from geoscene.buildings.unions import unite
from geoscene.classes import Class, materials
from geoscene.errors import InputError
from geoscene.geometry.frames import Frame
from geoscene.geometry.mesh import FLOOR, ROOF, WALL
from geoscene.geometry.watertight import check_solids, validate_mesh
from geoscene.sources.data import Area, OsmData, Relation
from geoscene.support.problems import summarise

FRAME = Frame.at(8.7, 49.4)


def box(x, y, width, depth):
    return shapely.box(x, y, x + width, y + depth)


def area(osm_id, shape, **tags):
    """A map area with the scene coordinates of a shape; ``__`` in a key stands for a colon."""
    lonlat = shapely.transform(shape, lambda xy: np.column_stack(FRAME.to_geographic(xy[:, 0], xy[:, 1])))
    tags = {key.replace("__", ":"): value for key, value in tags.items()}
    return Area(osm_id, tags, lonlat, np.empty(0, np.int64))


def house(number, shape, **tags):
    return area(f"way/{number}", shape, **({"building": "yes"} | tags))


def part(number, shape, **tags):
    return area(f"way/{number}", shape, **({"building__part": "yes"} | tags))


def osm(*areas, relations=()):
    return OsmData((8.6, 49.3, 8.8, 49.5), [], list(areas), [], list(relations))


def built(*areas, relations=(), base=0.0, lod=2, options=None):
    """Table, mesh and problems of a map."""
    table, problems = read_buildings(osm(*areas, relations=relations), FRAME, options=options)
    mesh, more = build_solids(table, base=np.full(table.count, base), lod=lod)
    verdict = validate_mesh(mesh)
    assert verdict.ok.all()
    assert verdict.feature.tolist() == list(range(table.count))
    return table, mesh, verdict, problems + more


def manifold(mesh, feature):
    """The solid of a feature as manifold3d reads it."""
    mine = mesh.take(mesh.feature == feature)
    body = m3.Manifold(m3.Mesh64(mine.vertices, mine.faces.astype(np.uint64)))
    assert body.status() == m3.Error.NoError
    return body


def reasons(problems):
    return {(p.osm_id, p.action, p.reason) for p in problems}


@st.composite
def blocks(draw):
    """Rotated unions of boxes, often with courtyards, with coordinates that are not round numbers."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    corner, size = rng.uniform(-20, 20, (5, 2)), rng.uniform(1, 25, (5, 2))
    shape = shapely.union_all([shapely.box(*c, *(c + s)) for c, s in zip(corner, size, strict=True)])
    return affinity.rotate(shape, float(rng.uniform(0, 90)))


@pytest.mark.full
@given(blocks(), st.floats(1, 300), st.floats(-50, 500))
@settings(max_examples=40, deadline=None)
def test_a_flat_building_has_the_volume_of_its_footprint_times_its_height(shape, height, base):
    table, mesh, verdict, _ = built(house(1, shape, height=f"{height:.2f}"), base=base)
    top, bottom = np.round(base + round(height, 2), 4), np.round(base, 4)
    assert verdict.volume[0] == pytest.approx(shapely.area(table.footprint[0]) * (top - bottom), rel=1e-9)
    assert manifold(mesh, 0).volume() == pytest.approx(verdict.volume[0], rel=1e-9)
    assert mesh.vertices[:, 2].min() == bottom
    assert mesh.vertices[:, 2].max() == top
    np.testing.assert_array_equal(mesh.vertices, np.round(mesh.vertices, 4))


def test_faces_have_class_surface_material_and_colour():
    table, mesh, _, _ = built(
        house(1, box(0, 0, 10, 8), height="9", building__colour="#102030", roof__material="slate"),
        house(2, box(30, 0, 10, 8), height="9", roof__shape="gabled"),
    )
    up, down = mesh.normals()[:, 2] > 0.1, mesh.normals()[:, 2] < -0.9
    assert (mesh.surface[up] == ROOF).all()
    assert (mesh.surface[down] == FLOOR).all()
    assert (mesh.surface[~up & ~down] == WALL).all()
    assert (mesh.klass == Class.BUILDING).all()
    first = mesh.feature == 0
    assert (mesh.color[first & (mesh.surface == WALL)] == (0x10, 0x20, 0x30)).all()
    assert (mesh.material[first & (mesh.surface == ROOF)] == materials()["slate"].code).all()
    assert (mesh.material[~first & (mesh.surface == ROOF)] == materials()["roof_tile"].code).all()
    assert table.wall_source.tolist() == ["tag", "default"]
    assert table.roof_look_source.tolist() == ["tag", "default"]


@pytest.mark.parametrize(
    ("tags", "height", "source"),
    [
        ({"height": "48.5 m"}, 48.5, "tag"),
        ({"height": "574'"}, 574 * 0.3048, "tag"),
        ({"building__height": "9,5"}, 9.5, "tag"),
        ({"height": "tall", "building__levels": "4"}, 12.0, "levels"),
        ({"est_height": "20"}, 20.0, "est_height"),
        ({"building__levels": "3", "roof__levels": "2"}, 15.0, "levels"),
        ({"building__levels": "3", "roof__height": "2", "roof__shape": "hipped"}, 11.0, "levels"),
        ({"height": "-5"}, None, "inferred-type"),
        ({"height": "20000"}, None, "inferred-type"),
        ({}, None, "inferred-type"),
    ],
)
def test_the_source_of_a_height_is_recorded(tags, height, source):
    table, mesh, _, _ = built(house(1, box(0, 0, 10, 10), **tags))
    assert table.height_source[0] == source
    assert 0 < table.height_sigma[0] < table.height[0]
    if height is not None:
        assert table.height[0] == pytest.approx(height)
        assert mesh.vertices[:, 2].max() == pytest.approx(height, abs=1e-4)


def test_parts_replace_the_outline_they_cover():
    table, _, verdict, problems = built(
        house(1, box(0, 0, 20, 10), height="30"),
        part(2, box(0, 0, 10, 10), height="30", min_height="10"),
        part(3, box(10, 0, 10, 10), height="12"),
    )
    assert table.count == 1
    assert table.drawn.tolist() == [False, True, True]
    assert verdict.volume[0] == pytest.approx(10 * 10 * 20 + 10 * 10 * 12, rel=1e-6)
    assert problems == []


@pytest.mark.parametrize(("use", "storeys", "low", "high"), [("church", "1", 10, 30), ("house", "1", 2, 4)])
def test_the_single_storey_of_a_hall_does_not_set_its_height(use, storeys, low, high):
    table, *_ = built(house(1, box(0, 0, 40, 20), building=use, **{"building:levels": storeys}))
    assert low < table.height[0] < high
    assert table.height_source[0] == ("inferred-type" if use == "church" else "levels")


def test_building_has_the_height_uncertainty_of_its_highest_part():
    table, *_ = built(
        house(1, box(0, 0, 20, 10)),
        part(2, box(0, 0, 10, 10), height="12"),
        part(3, box(10, 0, 10, 10), **{"building:levels": "20"}),
    )
    assert table.height[0] == pytest.approx(60)
    assert table.height_source[0] == "parts"
    assert table.height_sigma[0] == pytest.approx(0.15 * 60)


def test_uncovered_part_of_an_outline_keeps_its_height():
    table, _, verdict, problems = built(
        house(1, box(0, 0, 20, 10), height="6"), part(2, box(0, 0, 5, 10), height="30")
    )
    assert table.height.tolist() == [30.0, 30.0, 6.0]
    assert table.osm_id.tolist() == ["way/1", "way/2", "way/1"]
    assert table.outline.tolist() == [0, 0, 0]
    assert verdict.volume[0] == pytest.approx(5 * 10 * 30 + 15 * 10 * 6, rel=1e-6)
    assert reasons(problems) == {("way/1", "repaired", "partly-covered")}


def test_an_uncovered_tenth_of_an_outline_stays_unless_it_is_a_strip():
    _, _, verdict, problems = built(
        house(1, box(0, 0, 50, 20), height="12"),
        part(2, box(0, 0, 46, 19.2), height="20"),
        house(3, box(0, 40, 50, 20), height="12"),
        part(4, box(0.5, 40.5, 49, 19), height="20"),
    )
    assert verdict.volume[0] == pytest.approx(46 * 19.2 * 20 + (1000 - 46 * 19.2) * 12, rel=1e-6)
    assert verdict.volume[1] == pytest.approx(49 * 19 * 20, rel=1e-6)
    assert [(p.osm_id, p.reason, p.detail) for p in problems] == [
        ("way/1", "partly-covered", "parts cover 88%; 116.8 m2 of the outline stay as a part"),
        ("way/3", "uncovered-strips", "69.0 m2 of the outline that no part covers, narrower than 1 m"),
    ]


@pytest.mark.parametrize(
    "tags",
    [
        {"building:facade:colour": "#102030"},
        {"building:cladding": "brick"},
        {"building:facade:material": "brick"},
    ],
)
def test_walls_look_as_their_face_not_as_what_is_behind_it(tags):
    behind = read_walls({"building:colour": "red", "building:material": "concrete"})
    walls = read_walls({"building:colour": "red", "building:material": "concrete", **tags})
    changed = walls.color != behind.color, walls.material != behind.material
    assert changed == ("building:facade:colour" in tags, "building:facade:colour" not in tags)


def test_parts_inherit_missing_height_and_colour_from_their_building():
    table, *_ = built(
        house(1, box(0, 0, 20, 10), height="21", building__colour="red"),
        part(2, box(0, 0, 10, 10)),
        part(3, box(10, 0, 10, 10), height="5", building__colour="blue"),
    )
    assert table.height.tolist() == [21.0, 21.0, 5.0]
    assert table.height_source.tolist() == ["tag", "outline", "tag"]
    assert table.wall_color[1:].tolist() == [[255, 0, 0], [0, 0, 255]]


def test_parts_without_an_outline_become_a_building():
    table, _, verdict, problems = built(
        part(5, box(0, 0, 10, 10), height="4"), part(6, box(2, 2, 3, 3), height="9", min_height="4")
    )
    assert table.count == 1
    assert verdict.volume[0] == pytest.approx(400 + 45, rel=1e-6)
    assert reasons(problems) == {("way/5", "repaired", "parts-without-outline")}


def test_a_relation_assigns_a_part_outside_the_outline():
    relation = Relation("relation/9", {"type": "building"}, (("way", 1, "outline"), ("way", 3, "part")))
    areas = (
        house(1, box(0, 0, 10, 10), height="9"),
        house(2, box(10, 0, 10, 10), height="9"),
        part(3, box(11, 1, 3, 3), height="15", min_height="10"),
    )
    assert built(*areas, relations=[relation])[0].outline.tolist()[2] == 0
    assert built(*areas)[0].outline.tolist()[2] == 1


@pytest.mark.full
@given(st.integers(0, 2**32 - 1))
@settings(max_examples=30, deadline=None)
def test_any_stack_of_parts_is_one_solid_with_the_volume_of_the_union(seed):
    rng = np.random.default_rng(seed)
    # coordinates on a coarse grid, so that faces, edges and corners coincide as often as they can
    areas, bodies = [], []
    for number in range(int(rng.integers(2, 9))):
        (x, y), (w, d) = rng.integers(0, 6, 2), rng.integers(1, 4, 2)
        low, tall = int(rng.integers(0, 4)), int(rng.integers(1, 4))
        areas.append(part(number, box(x, y, w, d), height=str(low + tall), min_height=str(low)))
        bodies.append(m3.Manifold.cube((w, d, tall)).translate((float(x), float(y), float(low))))
    _, mesh, verdict, _ = built(
        house(99, box(0, 0, 9, 9), height="3"), *areas, options=BuildingOptions(strip=1e3)
    )
    union = m3.Manifold.batch_boolean(bodies, m3.OpType.Add).volume()
    # a bead of a centimetre along an edge adds a tenth of a litre a metre
    assert verdict.volume[0] == pytest.approx(union, abs=2e-2)
    manifold(mesh, 0)


def test_bodies_that_share_an_edge_are_joined_and_reported():
    _, _, verdict, problems = built(
        house(1, box(0, 0, 20, 20), height="5"),
        part(2, box(0, 0, 10, 10), height="5"),
        part(3, box(10, 10, 10, 10), height="5"),
        options=BuildingOptions(strip=1e3),
    )
    assert verdict.volume[0] == pytest.approx(500 + 500, rel=1e-5)
    assert ("way/1", "repaired", "touching-bodies") in reasons(problems)


SQUARE = [(0, 0), (10, 0), (10, 10), (0, 10)]
TOUCHING = [(0, 5), (4, 3), (4, 7)]


@pytest.mark.parametrize(
    ("shape", "size", "reason"),
    [
        (shapely.Polygon([(0, 0), (10, 10), (10, 0), (0, 10)]), 50, "invalid-footprint"),
        (shapely.Polygon([*SQUARE[:3], (5, 10), (5, 20), (5, 10), (0, 10)]), 100, "invalid-footprint"),
        (shapely.Polygon([(0, 0), (10, 0), (10, 0), (10, 10), (0, 10)]), 100, None),
        (shapely.Polygon([(0, 0), (0, 10), (10, 10), (10, 0)]), 100, None),
        # a courtyard that touches the outline in a corner
        (shapely.Polygon(SQUARE, [TOUCHING]), 92, "invalid-footprint"),
        (shapely.Polygon([*SQUARE, (0, 5)], [TOUCHING]), 92, "invalid-footprint"),
        (shapely.Polygon(SQUARE, [[(8, 4), (12, 4), (12, 6), (8, 6)]]), 96, "invalid-footprint"),
        (shapely.MultiPolygon([box(0, 0, 5, 5), box(5, 5, 5, 5)]), 50, "invalid-footprint"),
        (shapely.MultiPolygon([box(0, 0, 5, 5), box(8, 8, 5, 5)]), 50, None),
    ],
)  # fmt: skip
def test_invalid_footprints_become_valid_solids(shape, size, reason):
    _, mesh, verdict, problems = built(house(1, shape, height="10"))
    assert verdict.volume[0] == pytest.approx(10 * size, abs=0.01)
    assert {p.reason for p in problems} == ({reason} if reason else set())
    manifold(mesh, 0)


@pytest.mark.parametrize(
    "shape", [shapely.Polygon([(0, 0), (5, 0), (10, 0)]), box(0, 0, 0.3, 0.3), shapely.Polygon()]
)
def test_footprints_without_area_are_dropped_and_reported(shape):
    table, _, _, problems = built(house(1, shape, height="10"), house(2, box(30, 0, 10, 10)))
    assert table.osm_id.tolist() == ["way/2"]
    assert reasons(problems) == {("way/1", "dropped", "too-small")}


def test_a_self_crossing_footprint_with_an_edge_through_its_own_corner_is_split():
    lat = [48.2002413, 48.2004413, 48.2003413, 48.2007413, 48.2003413]
    lon = [16.3701767, 16.3704767, 16.3707767, 16.3710767, 16.3702767]
    # the repair leaves a part of some nanometres, which vanishes on the 0.1 mm grid
    shape = shapely.make_valid(shapely.Polygon(np.column_stack([lon, lat])), method="structure")
    assert shapely.area(shapely.get_parts(shape)).min() < 1e-15
    way = Area("way/1", {"building": "yes"}, shape, np.empty(0, np.int64))
    frame = Frame.at((lon[0] + lon[3]) / 2, (lat[0] + lat[3]) / 2)
    table, problems = read_buildings(OsmData(shape.bounds, [], [way], [], []), frame)
    assert table.osm_id.tolist() == ["way/1"]
    assert shapely.get_num_geometries(table.footprint[0]) == 2
    assert shapely.area(table.footprint[0]) == pytest.approx(661, abs=1)
    assert reasons(problems) == {("way/1", "repaired", "invalid-footprint")}


@pytest.mark.parametrize(
    ("value", "shape", "reported"),
    [(";gabled", "gabled", False), ("gabled;;", "gabled", False), (";", "flat", True), (" ", "flat", True)],
)
def test_blank_roof_shapes_do_not_end_the_build(value, shape, reported):
    table, _, _, problems = built(house(1, box(0, 0, 10, 8), height="9", roof__shape=value))
    assert table.roof_shape.tolist() == [shape]
    assert reasons(problems) == ({("way/1", "repaired", "unknown-roof-shape")} if reported else set())


def fails_for(monkeypatch, place, chosen):
    """Make a function raise when ``chosen`` says so of its first argument."""
    module, name = place.rsplit(".", 1)
    whole = getattr(importlib.import_module(module), name)

    def failing(first, *args, **kwargs):
        if chosen(first):
            raise ZeroDivisionError("no\nway")
        return whole(first, *args, **kwargs)

    monkeypatch.setattr(place, failing)


def test_a_building_that_cannot_be_read_is_dropped_alone(monkeypatch):
    fails_for(
        monkeypatch, "geoscene.buildings.features.read_roof_tags", lambda tags: tags.get("name") == "odd"
    )
    areas = [
        house(n, box(20 * n, 0, 10, 10), height="9", name="odd" if n in (2, 5) else "") for n in range(7)
    ]
    table, _, _, problems = built(*areas)
    assert table.osm_id.tolist() == [f"way/{n}" for n in (0, 1, 3, 4, 6)]
    assert reasons(problems) == {(f"way/{n}", "dropped", "unexpected-error") for n in (2, 5)}
    assert problems[0].detail == "ZeroDivisionError: no way"


def test_a_roof_that_cannot_be_built_is_made_flat(monkeypatch):
    fails_for(
        monkeypatch, "geoscene.buildings.roofs._nearly_rectangular", lambda polygon: polygon.bounds[0] < 5
    )
    areas = [house(n, box(20 * n, 0, 10, 8), height="9", roof__shape="gabled") for n in range(2)]
    _, _, verdict, problems = built(*areas)
    assert verdict.volume[0] == pytest.approx(720)
    assert verdict.volume[1] < 650
    assert reasons(problems) == {("way/0", "repaired", "roof-fallback")}


def test_an_overlap_of_less_than_the_grid_is_no_negative_loss():
    """Subtraction on the grid may add more area than the overlap had."""
    details = []
    for angle in np.linspace(1, 40, 30).tolist():
        wide, narrow = affinity.rotate(box(0, 0, 40, 20), angle), box(39.999985, 2, 20, 15)
        narrow = affinity.rotate(narrow, angle, origin=(20, 10))
        _, problems = footprints.cut_overlaps(
            ["way/1", "way/2"],
            np.array([wide, narrow]),
            owner=np.arange(2),
            rank=np.zeros(2, np.int64),
            low=np.zeros(2),
            high=np.full(2, 5.0),
        )
        details += [problem.detail for problem in problems]
    assert len(details) == 30
    assert set(details) == {"lost under 0.01 m2 of 800.0 m2 to way/2"}


def test_an_overlap_that_cannot_be_cut_drops_only_the_larger_building(monkeypatch):
    def failing(*_):
        raise GEOSException("TopologyException")

    monkeypatch.setattr("geoscene.buildings.footprints.subtract", failing)
    table, _, _, problems = built(
        house(1, box(0, 0, 10, 10), height="9"),
        house(2, box(8, 0, 20, 10), height="9"),
        house(3, box(50, 0, 9, 9)),
    )
    assert table.osm_id.tolist() == ["way/1", "way/3"]
    assert reasons(problems) == {("way/2", "dropped", "unexpected-error")}


def test_of_duplicates_the_one_with_more_tags_is_kept():
    shape = box(0, 0, 10, 10)
    table, _, _, problems = built(
        house(1, shape), house(2, shape, height="12"), house(3, affinity.translate(shape, 0.2, 0.1))
    )
    assert table.osm_id.tolist() == ["way/2"]
    assert summarise(problems)["dropped"]["building"] == {"duplicate": 2}


@pytest.mark.full
@given(st.integers(0, 2**32 - 1))
@settings(max_examples=25, deadline=None)
def test_overlapping_buildings_share_no_volume_and_leave_no_hole(seed):
    rng = np.random.default_rng(seed)
    shapes = []
    for _ in range(5):
        corner, size = rng.uniform(0, 20, 2), rng.uniform(4, 15, 2)
        shapes.append(affinity.rotate(shapely.box(*corner, *(corner + size)), float(rng.uniform(0, 90))))
    table, _, verdict, problems = built(*(house(i, s, height="10") for i, s in enumerate(shapes)))
    total = shapely.area(shapely.union_all(shapes))
    lost = sum(shapes[int(p.osm_id[4:])].area for p in problems if p.action == "dropped")
    assert verdict.volume.sum() / 10 <= total + 0.01
    # slivers narrower than 4 cm between cuts are let go
    assert verdict.volume.sum() / 10 >= total - lost - 0.02 * sum(s.length for s in shapes)
    for i in range(len(table)):
        for j in range(i):
            assert shapely.intersection(table.footprint[i], table.footprint[j]).area < 1e-2


def test_a_difference_with_pieces_below_the_grid_is_a_polygon():
    kite = shapely.Polygon([(1.3333, 0.6667), (1, 0), (0.6667, 0.6667), (1, 0.3333)])
    wedge = shapely.Polygon([(0, 0), (0, 1), (1.3333, 0.3333)])
    raw = shapely.difference(kite, wedge, grid_size=1e-4)
    assert shapely.get_type_id(raw) == shapely.GeometryType.GEOMETRYCOLLECTION  # with a line of 0.1 mm
    rest = subtract(kite, wedge)
    assert shapely.get_dimensions(rest) == 2
    assert shapely.area(rest) == pytest.approx(shapely.area(raw), abs=0.01)


def test_of_overlapping_buildings_the_one_with_a_known_height_keeps_its_shape():
    table, _, _, problems = built(
        house(1, box(0, 0, 30, 20), **{"building:levels": "12"}, layer="1"),
        house(2, box(0, 0, 12, 12)),
        house(3, box(13, 0, 14, 19), name="Villa"),
        house(4, box(0, 15, 10, 20)),
        # of two without a height the named one, else the smaller
        house(5, box(60, 0, 30, 20), name="Palace"),
        house(6, box(70, 5, 5, 30)),
        house(7, box(100, 0, 30, 20)),
        house(8, box(110, 5, 5, 30)),
        # a tower stands out of a low hall with a known height
        house(9, box(140, 0, 30, 20), height="3"),
        house(10, box(150, 5, 5, 5), building="tower"),
    )
    names = [f"way/{n}" for n in (1, 4, 5, 6, 7, 8, 9, 10)]
    assert table.osm_id.tolist() == names
    area = dict(zip(names, shapely.area(table.footprint), strict=True))
    assert area == pytest.approx(
        dict(zip(names, (600, 150, 600, 75, 525, 150, 575, 25), strict=True)), rel=1e-6
    )
    assert reasons(problems) == {
        *((f"way/{n}", "dropped", "inside-another") for n in (2, 3)),
        *((f"way/{n}", "repaired", "overlap") for n in (4, 6, 7, 9)),
    }


def test_thousands_of_equal_outlines_are_compared_once(monkeypatch):
    compared = []
    query = footprints.overlapping_pairs

    def counted(polygons):
        compared.append(len(polygons))
        return query(polygons)

    monkeypatch.setattr(footprints, "overlapping_pairs", counted)
    square = shapely.box(0, 0, 10, 20)
    outlines = np.array([square, square.reverse()] * 1000 + [shapely.box(50, 0, 60, 10)], object)
    score = np.zeros(2001)
    score[77] = 3
    repeated, problems = footprints.duplicates([f"way/{k}" for k in range(2001)], outlines, score=score)
    assert np.flatnonzero(~repeated).tolist() == [77, 2000]
    assert compared == [2]
    assert len(problems) == 1999


def test_pairs_that_overlap_are_found_once():
    rng = np.random.default_rng(3)
    low = rng.uniform(0, 50, (200, 2))
    boxes = shapely.box(*low.T, *(low + rng.uniform(2, 8, (200, 2))).T)
    a, b, shared = footprints.overlapping(boxes, boxes)
    once = a < b
    for mine, theirs in zip(footprints.overlapping_pairs(boxes), (a, b, shared), strict=True):
        np.testing.assert_array_equal(mine, theirs[once])


def test_of_duplicates_the_one_with_storeys_is_kept():
    table, *_ = built(
        house(1, box(0, 0, 10, 10), name="a", source="b", height="high", note="c"),
        house(2, box(0, 0, 10, 10), **{"building:levels": "5"}),
    )
    assert table.osm_id.tolist() == ["way/2"]


def test_building_raised_above_another_keeps_its_footprint():
    table, _, verdict, problems = built(
        house(1, box(0, 0, 10, 10), height="5"), house(2, box(0, 4, 10, 2), height="12", min_height="8")
    )
    assert problems == []
    assert verdict.volume.tolist() == pytest.approx([500, 80], rel=1e-6)
    assert table.min_height.tolist() == [0.0, 8.0]


def test_neighbours_keep_their_common_wall():
    shared = [(10, 0), (10.00004, 3.3333), (9.7, 10)]
    left = shapely.Polygon([(0, 0), *shared, (0, 10)])
    right = shapely.Polygon([*shared[::-1], (20, 0), (20, 10)][::-1])
    table, *_ = built(house(1, left, height="8"), house(2, right.buffer(0), height="9"))
    corners = [set(map(tuple, shapely.get_coordinates(f))) for f in table.footprint]
    assert len(corners[0] & corners[1]) == 3


@pytest.mark.parametrize(
    ("tags", "below"),
    [
        ({"layer": "-2"}, True),
        ({"level": "-1"}, True),
        ({"level": "-1;-2"}, True),
        ({"parking": "underground"}, True),
        ({"level": "-1;0"}, False),
        ({"layer": "-1", "height": "9"}, False),
        ({"layer": "-1", "building:levels": "3"}, False),
        ({"layer": "-1", "location": "surface"}, False),
        ({"layer": "-1", "min_height": "0"}, False),
        ({"layer": "1"}, False),
    ],
)
def test_a_building_is_below_the_ground_if_its_layer_or_storeys_are_and_no_height_is_mapped(tags, below):
    table, problems = read_buildings(osm(house(1, box(0, 0, 10, 10), **tags)), FRAME)
    assert len(table) == (not below)
    assert reasons(problems) == ({("way/1", "dropped", "underground")} if below else set())


def test_a_canopy_is_open_below_and_an_underground_building_is_dropped():
    table, _, verdict, problems = built(
        house(1, box(0, 0, 10, 10), building="roof", height="5"),
        house(2, box(20, 0, 10, 10), location="underground"),
    )
    assert table.min_height_source[0] == "canopy"
    assert verdict.volume[0] == pytest.approx(100 * BuildingOptions().canopy, rel=1e-6)
    assert reasons(problems) == {("way/2", "dropped", "underground")}


def test_contradictory_heights_of_parts_are_repaired_and_reported():
    _, _, verdict, problems = built(
        house(1, box(0, 0, 10, 10), height="10"),
        part(2, box(0, 0, 10, 10), height="8", min_height="9"),
        house(3, box(20, 0, 10, 10), height="4", roof__shape="pyramidal", roof__height="7"),
        house(4, box(40, 0, 10, 10), height="4", roof__shape="9.0"),
    )
    assert verdict.volume.tolist() == pytest.approx([800, 400 / 3, 400], rel=1e-3)
    assert reasons(problems) == {
        ("way/2", "repaired", "underside-over-top"),
        ("way/3", "repaired", "roof-over-height"),
        ("way/4", "repaired", "unknown-roof-shape"),
    }


@pytest.mark.parametrize(
    ("tags", "low", "top", "roof"),
    [
        # storeys, storeys that are skipped and storeys in the roof
        ("levels=2 min_level=2 roof:levels=1 roof:shape=gabled", 6, 9, 3),
        ("levels=2 min_level=2 roof:height=4 roof:shape=hipped", 6, 10, 4),
        ("levels=2 min_level=2 roof:shape=gabled", 6, 6 + 5 / 3**0.5, 5 / 3**0.5),
        ("levels=5 min_level=2 roof:levels=1 roof:shape=gabled", 6, 18, 3),
        ("levels=5 min_level=2", 6, 15, 0),
        ("levels=2 min_level=2", 6, 12, 0),
        ("levels=1 min_level=2 roof:levels=1 roof:shape=gabled", 6, 12, 3),
        ("roof:levels=1 min_level=2 roof:shape=gabled", 6, 9, 3),
        # with heights
        ("height=20 levels=5 min_level=2", 8, 20, 0),
        ("height=20 levels=4 min_level=2 roof:levels=1 roof:shape=gabled", 8, 20, 4),
        ("height=20 levels=4 min_level=2 roof:height=4 roof:shape=gabled", 8, 20, 4),
        ("height=9 levels=2 min_level=2 roof:height=3 roof:shape=gabled", 6, 9, 3),
        ("min_height=8 levels=3 min_level=2", 8, 12, 0),
        ("min_height=7 levels=2 min_level=2 roof:height=3 roof:shape=gabled", 7, 10, 3),
        ("min_height=10 levels=2", 10, 16, 0),
        ("min_height=10 levels=5", 10, 15, 0),
        ("min_height=4.5 levels=2 roof:levels=1 roof:shape=gabled", 4.5, 9, 3),
    ],
)  # fmt: skip
def test_storeys_count_from_the_ground_with_those_that_a_part_skips(tags, low, top, roof):
    tagged = dict(tag.replace(":", "__").split("=") for tag in tags.split())
    below = part(2, box(0, 0, 10, 10), height=str(low))
    table, mesh, _, _ = built(house(1, box(0, 0, 10, 10)), below, part(3, box(0, 0, 10, 10), **tagged))
    assert (table.min_height[2], table.height[2], table.roof_height[2]) == pytest.approx((low, top, roof))
    assert mesh.vertices[:, 2].max() == pytest.approx(top, abs=1e-3)


@pytest.mark.parametrize(
    ("tags", "top", "detail"),
    [({"levels": "3"}, 10.5, "; walls of 10.5 m, with it"), ({"height": "9"}, 9, "")],
)
def test_walls_reach_up_to_the_top_of_a_flat_roof_with_a_height(tags, top, detail):
    roof = {"roof__shape": "flat", "roof__height": "1.5"}
    table, mesh, _, problems = built(house(1, box(0, 0, 10, 10), **tags, **roof))
    assert (table.height[0], table.roof_height[0]) == (top, 0)
    assert mesh.vertices[:, 2].max() == top
    assert [(p.reason, p.detail) for p in problems] == [("flat-roof-height", f"flat roof of 1.5 m{detail}")]


def test_a_part_of_a_multipolygon_belongs_to_its_building_by_relation():
    outline = area("relation/5", box(0, 0, 10, 10), building="yes", height="10")
    relation = Relation("relation/5", {"type": "building"}, (("way", 9, "outline"), ("way", 2, "part")))
    table, _, _, _ = built(outline, part(2, box(9, 0, 10, 10), height="12"), relations=[relation])
    assert table.outline.tolist() == [0, 0, 0]


def test_the_order_of_the_map_does_not_matter():
    rng = np.random.default_rng(3)
    shapes = [affinity.rotate(box(*rng.uniform(0, 60, 2), *rng.uniform(4, 15, 2)), 30) for _ in range(40)]
    areas = [house(i, s) if i % 3 else house(i, s, height=str(5 + i)) for i, s in enumerate(shapes)]
    _, one, _, first = built(*areas)
    random.Random(5).shuffle(areas)
    _, other, _, second = built(*areas)
    assert first == second
    np.testing.assert_array_equal(one.vertices, other.vertices)
    np.testing.assert_array_equal(one.faces, other.faces)


@pytest.mark.parametrize(
    ("tags", "top", "source", "ignored"),
    [
        ({"height": "9999"}, None, "inferred-type", "height=9999 is not from 0.01 to 1000"),
        ({"height": "-5", "building:levels": "3"}, 9.0, "levels", "height=-5 is not from 0.01 to 1000"),
        ({"height": "1e-3", "est_height": "8"}, 8.0, "est_height", "height=1e-3 is unreadable"),
        ({"height": "nan", "building:height": "7"}, 7.0, "tag", "height=nan is unreadable"),
        ({"building:levels": "1000000", "levels": "2"}, 6.0, "levels", "levels=1000000 is not from 0 to 200"),
        ({"building:levels": "0"}, None, "inferred-type", "building:levels=0 gives no height"),
        ({"height": "9", "min_height": "-1000"}, 9.0, "tag", "min_height=-1000 is not from -50"),
        ({"height": "9", "building:min_level": "x"}, 9.0, "tag", "building:min_level=x is unreadable"),
        ({"height": "9", "roof:height": "900"}, 9.0, "tag", "roof:height=900 is not from 0 to 300"),
        ({"height": "9", "roof:levels": "90"}, 9.0, "tag", "roof:levels=90 is not from 0 to 20"),
        ({"height": "9", "roof:angle": "89.9"}, 9.0, "tag", "roof:angle=89.9 is not from 0.1 to 80"),
        ({"height": "9", "roof:direction": "up"}, 9.0, "tag", "roof:direction=up is unreadable"),
    ],
)
def test_every_ignored_tag_is_reported_with_what_was_built_instead(tags, top, source, ignored):
    table, mesh, _, problems = built(house(1, box(0, 0, 10, 10), **tags))
    assert table.height_source.tolist() == [source]
    assert table.height[0] == pytest.approx(top) if top else 5 < table.height[0] < 20
    assert mesh.vertices[:, 2].min() == 0
    assert reasons(problems) == {("way/1", "repaired", "unusable-tags")}
    assert ignored in problems[0].detail
    assert problems[0].detail.endswith(f"; built from 0 to {table.height[0]:.4g} m ({source})")


@pytest.mark.parametrize(("low", "underside"), [("4.999", 4.99), ("5", 4.99), ("4.98", 4.98), ("5.5", 0)])
def test_a_thin_body_stays_thin(low, underside):
    table, _, verdict, problems = built(house(1, box(0, 0, 10, 10), height="5", min_height=low))
    assert table.min_height[0] == pytest.approx(underside)
    assert verdict.volume[0] == pytest.approx(100 * (5 - underside))
    reason = {"4.98": set(), "5.5": {"underside-over-top"}}.get(low, {"too-thin"})
    assert {p.reason for p in problems} == reason


@pytest.mark.parametrize(
    ("storeys", "shape", "width", "roof"),
    [
        ("2", "gabled", 40, 3.0),
        ("1", "hipped", 40, 3.0),
        ("4", "gabled", 40, 6.0),
        ("2", "dome", 40, 6.0),
        ("9", "gabled", 40, 8.0),
        ("2", "gabled", 8, 4 * 3**-0.5),
    ],
)
def test_a_guessed_roof_is_bounded_by_the_storeys_below(storeys, shape, width, roof):
    tags = {"building:levels": storeys, "roof:shape": shape}
    table, *_ = built(house(1, box(0, 0, width, width), **tags))
    walls = 3.0 * int(storeys)
    assert table.roof_height[0] == pytest.approx(roof, rel=0.02)
    assert table.height[0] == pytest.approx(walls + roof, rel=0.01)
    # the guess adds half its height to the uncertainty of the storeys
    assert table.height_sigma[0] == pytest.approx(np.hypot(max(0.15 * walls, 1.0), roof / 2), rel=0.02)


@pytest.mark.parametrize(
    ("tags", "source"),
    [({}, "assumed"), ({"roof:shape": "odd"}, "assumed"), ({"roof:shape": "flat"}, "tag")],
)
def test_a_flat_roof_says_whether_its_shape_is_mapped(tags, source):
    table, *_ = built(house(1, box(0, 0, 10, 10), height="9", **tags))
    assert (table.roof_shape.tolist(), table.roof_source.tolist()) == (["flat"], [source])


def test_a_steep_angle_over_a_large_footprint_gives_no_giant_roof():
    tags = {"building:levels": "2", "roof:shape": "hipped", "roof:angle": "75"}
    table, *_ = built(house(1, box(0, 0, 40, 40), **tags))
    assert table.roof_source.tolist() == ["angle"]
    assert table.height[0] == pytest.approx(6 + 18)


def test_higher_levels_of_detail_add_parts_and_roofs():
    areas = (
        house(1, box(0, 0, 20, 10), height="12", roof__shape="gabled", roof__height="4"),
        house(2, box(40, 0, 20, 10)),
        part(3, box(40, 0, 10, 10), height="6"),
        part(4, box(50, 0, 10, 10), height="12", min_height="6"),
    )
    volumes = [built(*areas, lod=lod)[2].volume for lod in (0, 1, 2)]
    assert volumes[0].tolist() == pytest.approx([2400, 200 * 9], rel=1e-6)
    # a bead joins the two parts along the edge they share
    assert volumes[1].tolist() == pytest.approx([2400, 600 + 600], rel=1e-5)
    assert volumes[2].tolist() == pytest.approx([200 * 10, 600 + 600], rel=1e-5)


def test_the_base_lifts_a_building_with_all_its_parts():
    areas = (
        house(1, box(0, 0, 20, 10)),
        part(2, box(0, 0, 20, 10), height="6"),
        house(3, box(50, 0, 5, 5), height="3"),
    )
    table, _ = read_buildings(osm(*areas), FRAME)
    mesh, _ = build_solids(table, base=np.array([100.0, -7.25]))
    for feature, low, high in ((0, 100.0, 106.0), (1, -7.25, -4.25)):
        z = mesh.take(mesh.feature == feature).vertices[:, 2]
        assert (z.min(), z.max()) == (low, high)


@pytest.mark.parametrize("lod", [0, 1, 2])
def test_what_stands_on_the_ground_reaches_down_to_the_foot(lod):
    areas = (house(1, box(0, 0, 20, 10)), part(2, box(0, 0, 15, 10), height="6"),
             part(3, box(15, 0, 5, 10), height="9", min_height="3"))  # fmt: skip
    table, _ = read_buildings(osm(*areas), FRAME)
    mesh, _ = build_solids(table, base=np.array([100.0]), foot=np.array([97.5]), lod=lod)
    assert validate_mesh(mesh).ok.all()
    raised = mesh.vertices[:, 0] > mesh.vertices[:, 0].max() - 4.0
    assert mesh.vertices[:, 2].min() == 97.5
    assert mesh.vertices[raised, 2].min() == (97.5 if lod == 0 else 103.0)
    assert mesh.vertices[:, 2].max() == pytest.approx(106.75 if lod == 0 else 109.0)


@pytest.mark.parametrize("lod", [0, 1, 2])
def test_a_house_over_a_street_leaves_it_free_at_every_level_of_detail(lod):
    areas = (house(1, box(0, 0, 20, 10), height="9", min_height="4"), house(2, box(50, 0, 5, 5)),
             part(3, box(50, 0, 5, 5), height="7", min_height="5"),
             part(4, box(50, 0, 5, 5), height="9", min_height="7"))  # fmt: skip
    table, _ = read_buildings(osm(*areas), FRAME)
    mesh, _ = build_solids(table, base=np.zeros(table.count), lod=lod)
    assert [mesh.take(mesh.feature == k).vertices[:, 2].min() for k in (0, 1)] == [4.0, 5.0]


def test_a_part_on_top_stands_on_the_outline_and_not_over_a_hole():
    areas = (house(1, box(0, 0, 20, 10), height="15"),
             part(2, box(5, 2, 6, 6), height="18", min_height="15"))  # fmt: skip
    table, _, verdict, problems = built(*areas)
    assert verdict.volume[0] == pytest.approx(200 * 15 + 36 * 3, rel=1e-6)
    assert shapely.area(table.footprint[table.drawn]).sum() == pytest.approx(200 + 36, rel=1e-6)
    assert "touching-bodies" not in {p.reason for p in problems}


def test_a_slit_between_stacked_parts_is_closed():
    areas = (
        house(1, box(0, 0, 20, 10)),
        part(2, box(0, 0, 20, 10), height="26"),
        part(3, box(4, 2, 10, 6), height="29.3", building__levels="9", min_height="26.04"),
    )
    _, _, verdict, problems = built(*areas)
    assert verdict.volume[0] == pytest.approx(200 * 26 + 60 * 3.3, rel=1e-6)
    assert ("way/3", "repaired", "slit-between-parts") in reasons(problems)


def dotted(shape, count):
    """A rectangle with ``count`` points on each side."""
    corners = shapely.get_coordinates(shape)
    return shapely.Polygon([a + (b - a) * k / count for a, b in pairwise(corners) for k in range(count)])


@pytest.mark.parametrize("turn", [0.0, 17.3])
@pytest.mark.parametrize(
    ("tags", "faces"), [({}, 12), ({"roof__shape": "gabled"}, 22), ({"roof__shape": "hipped"}, 16)]
)
def test_points_in_straight_walls_are_left_out(tags, faces, turn):
    whole = affinity.rotate(box(0, 0, 40, 30), turn, origin=(0, 0))
    _, mesh, verdict, _ = built(house(1, dotted(whole, 400), height="10", **tags))
    _, same, expected, _ = built(house(1, whole, height="10", **tags))
    assert len(mesh) == len(same) == faces
    assert verdict.volume[0] == pytest.approx(expected.volume[0], rel=1e-4)


def test_points_in_straight_walls_stay_where_another_part_has_a_corner():
    # the small part ends in the middle of the walls of its neighbours, 0.1 to 1 mm off their straight lines
    left = shapely.Polygon([(0, 0), (10, 0), (10.0002, 8), (9.9990, 12), (10, 20), (0, 20)])
    right = shapely.Polygon([(10, 0), (20, 0), (20, 20), (10, 20), (9.9990, 12), (10.0002, 8)])
    _, mesh, verdict, problems = built(
        house(1, box(0, 0, 20, 20), height="3"),
        part(2, dotted(left, 50), height="6"),
        part(3, right, height="9"),
        part(
            4, shapely.Polygon([(10.0002, 8), (20, 8), (20, 12), (9.9990, 12)]), height="12", min_height="9"
        ),
    )
    assert not [p for p in problems if p.reason != "partly-covered"]
    assert verdict.volume[0] == pytest.approx(200 * 6 + 200 * 9 + 40 * 3, rel=1e-3)
    assert len(mesh) < 60


def test_parts_that_meet_within_a_millimetre_become_one_clean_solid():
    # a strip of slices whose corners lie 0.3 to 0.8 mm off one another, at nearly equal heights
    rng = np.random.default_rng(3)
    xs = np.linspace(0, 30, 13)
    slices = []
    for k, (a, b) in enumerate(pairwise(xs)):
        (p, q), (r, s) = rng.uniform(-8e-4, 8e-4, (2, 2))
        ring = [(a + p, -5 + q), (b + r, -5 + s), (b + p, 5 + r), (a + s, 5 + p)]
        low = str(round(3 + k * 0.05, 2))
        slices.append(part(k + 2, shapely.Polygon(ring), height="12", min_height=low))
    _, _, verdict, problems = built(house(1, shapely.box(-1, -9, 31, 9), height="12"), *slices)
    assert not [p for p in problems if p.reason == "no-solid"]
    assert verdict.volume[0] == pytest.approx(32 * 18 * 12 - 300 * 3.3, rel=0.01)


@pytest.mark.parametrize("seed", range(8))
def test_parts_side_by_side_keep_their_roofs(seed):
    # a church: corners of the roofs on common walls lie a rounding error off these walls' planes
    rng = np.random.default_rng(seed)
    turn, long, wide = rng.uniform(0, 90), rng.uniform(20, 40), rng.uniform(8, 14)

    def piece(number, x, y, to_x, to_y, height, roof):
        shape = affinity.rotate(shapely.box(x, y, to_x, to_y), turn, origin=(0, 0))
        return part(number, shape, height=str(height), roof__shape=roof, roof__height="4")

    nave = piece(2, 0, 0, long, wide, 15, "gabled")
    tower = piece(3, -5, wide / 4, 0, wide * 3 / 4, 12, "pyramidal")
    chapels = [
        piece(4 + k, k * long / 4, -4, (k + 1) * long / 4, 0, 8, roof)
        for k, roof in enumerate(("round", "hipped", "gambrel", "skillion"))
    ]
    whole = affinity.rotate(shapely.box(-5, -4, long, wide), turn, origin=(0, 0))
    _, mesh, _, problems = built(house(1, whole, height="3"), nave, tower, *chapels)
    assert not {"flat-roof", "no-solid", "roof-fallback"} & {p.reason for p in problems}
    steep = (mesh.surface == ROOF) & (np.abs(mesh.normals()[:, 2]) < 0.98)
    assert np.count_nonzero(steep) > 20


def test_a_roof_direction_is_from_true_north():
    frame = Frame.at(8.7, 49.4, crs="EPSG:32633")  # a zone too far east: grid north is well off true north
    lon, lat = 8.7, 49.4
    square = shapely.box(lon - 1e-4, lat - 6e-5, lon + 1e-4, lat + 6e-5)
    tags = {"building": "yes", "height": "9", "roof:shape": "skillion", "roof:direction": "180"}
    data = replace(osm(Area("way/1", tags, square, np.empty(0, np.int64))), bounds=square.bounds)
    table, _ = read_buildings(data, frame)
    south = np.subtract(frame.from_geographic(lon, lat - 1e-4), frame.from_geographic(lon, lat))
    assert abs(frame.convergence(lon, lat)) > 0.05
    assert np.exp(1j * table.roof_direction[0]) == pytest.approx(
        complex(*south) / abs(complex(*south)), abs=1e-5
    )


def test_unknown_height_is_inferred_from_neighbours():
    rng = np.random.default_rng(0)
    n = 200
    xy = rng.uniform(0, 400, (n, 2))
    use, area_ = np.full(n, "house", dtype=object), np.full(n, 120.0)
    truth = np.where(xy[:, 0] < 200, 6.0, 18.0)
    known = np.where(rng.random(n) < 0.5, truth, np.nan)
    height, sigma, rule = infer_heights(xy, use, area=area_, height=known)
    hidden = np.isnan(known) & (np.abs(xy[:, 0] - 200) > 60)
    assert np.abs(height - truth)[hidden].max() < 1.0
    assert set(rule) == {"inferred-neighbours"}
    lone, lone_sigma, lone_rule = infer_heights(xy[:1], use[:1], area=area_[:1], height=np.array([np.nan]))
    assert lone_rule[0] == "inferred-type"
    assert lone_sigma[0] / lone[0] > 2 * np.median(sigma[hidden] / height[hidden])
    assert 4 < lone[0] < 10


def test_tower_height_is_not_used_for_houses_nearby():
    xy = np.column_stack([np.arange(6) * 60.0, np.zeros(6)])
    use, area_ = np.full(6, "yes", dtype=object), np.array([2324.0, 2000.0, 900.0, 300.0, 700.0, 4400.0])
    alone = infer_heights(xy, use, area=area_, height=np.full(6, np.nan))[0]
    beside = infer_heights(xy, use, area=area_, height=np.array([540.0, *[np.nan] * 5]))[0]
    np.testing.assert_array_equal(beside[1:], alone[1:])
    block = infer_heights(xy, use, area=area_, height=np.array([48.0, *[np.nan] * 5]))[0]
    assert (block[1:3] > 1.2 * alone[1:3]).all()


def test_a_neighbour_of_the_same_use_counts_as_much_as_four_of_another():
    around = 2 * np.pi * np.arange(5) / 5
    xy = np.vstack([[0.0, 0.0], 30 * np.column_stack([np.cos(around), np.sin(around)])])
    use, area_ = np.array(["house"] * 2 + ["apartments"] * 4, dtype=object), np.full(6, 120.0)
    typical = infer_heights(xy, use, area=area_, height=np.full(6, np.nan))[0]
    height = typical * [np.nan, 1.5, *[1 / 1.5] * 4]  # the house is high for its use, the others are low
    for others, factor in ((4, 1.0), (1, 1.2)):
        some = slice(2 + others)
        inferred = infer_heights(xy[some], use[some], area=area_[some], height=height[some])[0]
        assert inferred[0] / typical[0] == pytest.approx(factor, rel=1e-9 if others == 4 else 0.1)


def test_bodies_that_share_an_edge_with_a_narrow_gap_are_joined():
    upper = shapely.Polygon([(0, 0), (10, 0.0005), (10, 10), (-10, 10), (-10, 0.0005)])
    lower = shapely.Polygon([(0, 0), (-10, -0.0005), (-10, -10), (10, -10), (10, -0.0005)])
    footprints = shapely.set_precision(np.array([upper, lower]), 1e-4)
    shells = prisms(footprints, np.arange(2), low=np.zeros(2), high=np.full(2, 9.0))
    [(body, told)] = unite([shells], [[]])
    assert "joined by beads of" in told
    assert check_solids(body.corners, np.zeros(len(body), np.int64), n=1).ok.all()
    assert body.corners[..., 2].max() < 9.01


def test_cavities_thinner_than_surfaces_may_move_are_filled():
    whole = shapely.box(0, 0, 10, 8)
    split = whole.difference(shapely.box(2, 4, 7, 4.0016))
    shells = prisms(
        np.array([split, whole, whole]), np.arange(3), low=np.array([0, 0, 7.0]), high=np.array([8.0, 1, 8])
    )
    [(body, told)] = unite([shells], [[]])
    assert told == ""
    found = check_solids(body.corners, np.zeros(len(body), np.int64), n=1)
    assert found.ok.all()
    assert found.volume == pytest.approx(whole.area * 8, rel=1e-9)


def test_faces_that_nearly_touch_are_parted():
    wall = shapely.Polygon([(0, 0), (10, 0), (10, 1)])
    edges = [
        shapely.Polygon([(x, y), (x + 0.5, y + 2), (x - 0.5, y + 2)])
        for x, y in ((2.9999, 0.3), (6.9999, 0.7))
    ]
    shells = prisms(np.array([wall, *edges]), np.arange(3), low=np.zeros(3), high=np.array([9.0, 8.0, 7.0]))
    one = np.zeros(len(shells), np.int64)
    assert check_solids(shells.corners, one, n=1).valid.all()
    assert not check_solids(shells.corners, one, n=1).ok.any()
    [(body, told)] = unite([shells], [[]])
    assert told == ""
    assert check_solids(body.corners, np.zeros(len(body), np.int64), n=1).ok.all()
    before, after = (
        shapely.multipoints(np.unique(c.reshape(-1, 3), axis=0)) for c in (shells.corners, body.corners)
    )
    assert shapely.hausdorff_distance(before, after) < 2e-4


def test_one_atypical_height_does_not_set_those_of_a_whole_centre():
    rng = np.random.default_rng(1)
    xy = np.vstack([[0.0, 0.0], rng.uniform(-120, 120, (55, 2))])
    area_ = np.append(120.0, rng.uniform(80, 900, 55))
    use, height = np.full(56, "yes", dtype=object), np.append(38.0, np.full(55, np.nan))
    inferred, sigma, _ = infer_heights(xy, use, area=area_, height=height)
    alone, *_ = infer_heights(xy, use, area=area_, height=np.full(56, np.nan))
    assert (inferred[1:] < 35).all()
    assert (inferred[1:] < 2.3 * alone[1:]).all()
    assert np.median(sigma[1:] / inferred[1:]) > 0.6
    use[0] = "bell_tower"
    np.testing.assert_array_equal(infer_heights(xy, use, area=area_, height=height)[0][1:], alone[1:])


def test_inferred_heights_suit_their_footprints():
    n = 30
    xy = np.column_stack([np.arange(n) * 15.0, np.zeros(n)])
    use, area_ = np.full(n, "yes", dtype=object), np.append(np.full(n - 1, 900.0), 20.0)
    height = np.append(np.full(n - 1, 100.0), np.nan)
    inferred, *_ = infer_heights(xy, use, area=area_, height=height)
    assert inferred[-1] == pytest.approx(3 * 20**0.5)


def test_inferred_height_excludes_the_building_itself():
    xy = np.array([[0.0, 0.0], [10.0, 0.0]])
    use, area_ = np.array(["yes", "yes"], dtype=object), np.array([400.0, 400.0])
    first, _, _ = infer_heights(xy, use, area=area_, height=np.array([30.0, np.nan]))
    again, _, _ = infer_heights(xy, use, area=area_, height=np.array([60.0, np.nan]))
    assert first[0] == again[0]
    assert again[1] == pytest.approx(first[1] * 2**0.5, rel=0.03)  # one neighbour counts half


def test_an_empty_map_has_no_buildings():
    table, mesh, _, problems = built()
    assert len(table) == table.count == len(mesh) == len(problems) == 0


def test_invalid_arguments_are_refused():
    table, _ = read_buildings(osm(house(1, box(0, 0, 5, 5))), FRAME)
    with pytest.raises(InputError, match="level of detail 3"):
        build_solids(table, base=np.zeros(1), lod=3)
    with pytest.raises(InputError, match="2 bases for 1 buildings"):
        build_solids(table, base=np.zeros(2))
