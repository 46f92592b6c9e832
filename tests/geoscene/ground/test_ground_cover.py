"""Land cover has the right class, the sea lies right of coastlines, and water is level."""

import numpy as np
import pytest
import shapely
from helpers.surfaces import partition

from geoscene.classes import GROUND, Class, class_codes, materials
from geoscene.geometry.frames import Frame
from geoscene.geometry.mesh import concatenate
from geoscene.ground import (
    Layers,
    building_pads,
    ground_tile,
    landcover,
    plan_ground,
    water_levels,
)
from geoscene.ground.landcover import paved_fabric, sea
from geoscene.ground.terrain import open_terrain
from geoscene.roadgraph.paths import path_surfaces, square_surfaces
from geoscene.sources import read_osm
from geoscene.sources.data import Area, OsmData, Way
from geoscene.support.problems import Problem

FRAME = Frame.at(9.0, 50.0)
EXTENT = (-100.0, -100.0, 100.0, 100.0)
NONE = np.empty(0, np.int64)


def lonlat(xy):
    return np.column_stack(FRAME.to_geographic(*np.asarray(xy, float).T))


def area(number, polygon, **tags):
    return Area(f"way/{number}", tags, shapely.transform(polygon, lonlat), NONE)


def way(number, xy, **tags):
    return Way(f"way/{number}", tags, np.arange(len(xy)), lonlat(xy))


def osm_of(*features):
    ways = [f for f in features if isinstance(f, Way)]
    areas = [f for f in features if isinstance(f, Area)]
    return OsmData((8.9, 49.9, 9.1, 50.1), ways, areas, [], [])


def cover(*features):
    return landcover(osm_of(*features), FRAME, extent=EXTENT)


def names(layers):
    by_code = {m.code: name for name, m in materials().items()}
    return [(Class(k).name, by_code[m]) for k, m in zip(layers.klass, layers.material, strict=True)]


BOX = shapely.box(-50, -50, 50, 50)


@pytest.mark.parametrize(
    ("tags", "expected"),
    [
        ({"landuse": "forest"}, ("FOREST_FLOOR", "soil")),
        ({"natural": "beach"}, ("SAND", "sand")),
        ({"natural": "beach", "surface": "gravel"}, ("TERRAIN", "gravel")),
        ({"natural": "bare_rock", "surface": "rock"}, ("TERRAIN", "stone")),
        ({"natural": "wood", "surface": "asphalt"}, ("FOREST_FLOOR", "asphalt")),
        ({"landuse": "retail"}, ("PAVED", "paving")),
        ({"landuse": "industrial", "surface": "concrete"}, ("PAVED", "concrete")),
        ({"landuse": "commercial", "surface": "gravel"}, ("TERRAIN", "gravel")),
        ({"man_made": "courtyard", "surface": "sett"}, ("PAVED", "stone")),
        ({"leisure": "schoolyard", "surface": "grass"}, ("GRASS", "grass")),
        ({"leisure": "pitch", "surface": "asphalt"}, ("PAVED", "asphalt")),
        ({"leisure": "pitch", "surface": "sand"}, ("SAND", "sand")),
        ({"leisure": "playground", "surface": "rubber"}, ("PAVED", "asphalt")),
        ({"leisure": "garden", "surface": "bricks;grass"}, ("PAVED", "brick")),
        ({"place": "square"}, ("SIDEWALK", "paving")),
        ({"place": "square", "surface": "cobblestone"}, ("SIDEWALK", "stone")),
        ({"place": "square", "surface": "grass"}, ("GRASS", "grass")),
        ({"amenity": "marketplace", "surface": "dirt"}, ("TERRAIN", "dirt")),
        ({"amenity": "parking"}, ("PARKING", "asphalt")),
        ({"amenity": "parking", "surface": "grass_paver"}, ("PARKING", "grass")),
        ({"natural": "water", "surface": "asphalt"}, ("WATER", "water")),
        ({"leisure": "park", "landuse": "grass"}, ("GRASS", "grass")),
    ],
)
def test_tags_decide_class_and_material(tags, expected):
    layers, problems = cover(area(1, BOX, **tags))
    assert names(layers) == [expected]
    assert layers.source[0] == ("surface" if "surface" in tags and expected[1] != "water" else "tags")
    assert problems == []


@pytest.mark.parametrize(
    ("surface", "expected"),
    [
        ("", "SIDEWALK"), ("sett", "SIDEWALK"), ("wood", "SIDEWALK"), ("grass", "GRASS"), ("sand", "SAND"),
        ("compacted", "TERRAIN"), ("dirt", "TERRAIN"),
    ],
)  # fmt: skip
def test_footways_and_squares_are_sidewalks_where_they_are_paved(surface, expected):
    tags = {"highway": "footway"} | ({"surface": surface} if surface else {})
    line, square = way(1, [(-30, 0), (30, 0)], **tags), area(2, BOX, **tags)
    for rows in (path_surfaces(osm_of(line), FRAME), square_surfaces(osm_of(square), FRAME)):
        assert [Class(k).name for k in rows.klass] == [expected]


def test_no_paved_ground_of_a_scene_is_labelled_terrain(scene):
    """Terrain is 72 in SemanticKITTI, 27 in nuScenes, 21 in Waymo's segmentation and 22 in KITTI-360."""
    paving = [materials()[name].code for name in ("asphalt", "concrete", "paving", "brick")]
    codes, paved = class_codes(), set()
    for index in scene.tile_indices:
        mesh = scene.tile(*index).mesh
        ground = mesh.take(~mesh.closed & np.isin(mesh.klass, GROUND))
        paved |= set(ground.klass[np.isin(ground.material, paving)].tolist())
    assert Class.PAVED in paved
    assert not {Class.TERRAIN, Class.GRASS, Class.FOREST_FLOOR, Class.SAND} & paved
    klass = sorted(paved)
    assert 72 not in codes.semantic_kitti[klass]
    assert 27 not in codes.nuscenes[klass]
    assert set(codes.asprs[klass]) <= {2, 10, 11}


@pytest.mark.parametrize(
    "tags",
    [
        {"amenity": "parking", "parking": "underground"},
        {"amenity": "parking", "building": "yes"},
        {"natural": "water", "tunnel": "culvert"},
        {"leisure": "swimming_pool", "location": "roof"},
        {"landuse": "nonsense"},
    ],
)
def test_features_above_or_below_the_ground_are_no_land_cover(tags):
    assert len(cover(area(1, BOX, **tags))[0]) == 0


def test_rivers_are_distinguished_from_standing_water():
    layers, _ = cover(
        area(1, BOX, natural="water", water="river"),
        area(2, BOX, natural="water", water="lake"),
        area(3, BOX, waterway="riverbank"),
    )
    assert layers.body.tolist() == ["river", "standing", "river"]


def test_lines_are_as_wide_as_their_tag_or_their_kind():
    line = [(-300, 0), (300, 0)]
    layers, problems = cover(
        way(1, line, waterway="stream", width="5"),
        way(2, line, waterway="river"),
        way(3, line, waterway="stream", width="narrow"),
        way(4, line, railway="rail", tunnel="yes"),
        way(5, line, railway="rail"),
    )
    within = shapely.area(shapely.intersection(layers.polygon, shapely.box(*EXTENT))) / 200
    np.testing.assert_allclose(within, [5, 12, 2, 3.6], rtol=1e-6)
    assert layers.source.tolist() == ["width", "default-width", "default-width", "default-width"]
    assert [(p.osm_id, p.reason) for p in problems] == [("way/3", "unreadable-width")]


def test_smaller_area_of_the_same_kind_covers_the_larger():
    big, small = (
        area(1, BOX, landuse="grass"),
        area(2, shapely.box(0, 0, 9, 9), leisure="garden", surface="sand"),
    )
    for features in ([big, small], [small, big]):
        cells = partition(EXTENT, cover(*features)[0])
        sand = shapely.area(cells.polygon[cells.material == materials()["sand"].code]).sum()
        assert sand == pytest.approx(81, rel=1e-5)


def test_land_cover_outside_the_extent_is_left_out():
    layers, _ = cover(area(1, shapely.box(200, 0, 300, 50), landuse="grass"), area(2, BOX, landuse="grass"))
    assert layers.osm_id.tolist() == ["way/2"]


def sea_area(coasts, extent=EXTENT):
    polygons, problems = sea([np.array(c, float) for c in coasts], extent)
    return shapely.union_all(polygons), problems


def test_the_sea_lies_right_of_the_coast():
    north_going = [(20, -300), (20, 300)]
    water, problems = sea_area([north_going])
    assert water.equals(shapely.box(20, -100, 100, 100))
    assert sea_area([north_going[::-1]])[0].equals(shapely.box(-100, -100, 20, 100))
    assert problems == []


def test_islands_and_lagoons_follow_the_direction_of_their_ring():
    coast = [(20, -300), (20, 300)]
    ring = [(50, -10), (70, -10), (70, 10), (50, 10), (50, -10)]  # land inside
    water, _ = sea_area([coast, ring])
    assert water.area == pytest.approx(80 * 200 - 400)
    alone, _ = sea_area([ring])  # an island: the sea is all around it
    assert alone.area == pytest.approx(200 * 200 - 400)


def test_coastlines_are_joined_and_open_ends_extended_to_the_border():
    pieces = [[(20, 0), (20, 300)], [(20, -300), (20, -50)], [(20, -50), (20, 0)]]
    assert sea_area(pieces)[0].equals(shapely.box(20, -100, 100, 100))
    water, problems = sea_area([[(20, -300), (20, 60)]])
    assert [p.reason for p in problems] == ["open-end"]
    assert water.area == pytest.approx(80 * 200, rel=1e-3)  # straight on is the shortest way to the edge


def test_without_a_coastline_there_is_no_sea():
    assert sea_area([])[0].is_empty
    assert sea_area([[(500, -300), (500, 300)]])[0].is_empty


def test_a_contradictory_coast_is_reported():
    _, problems = sea_area([[(-20, -300), (-20, 300)], [(20, -300), (20, 300)]])
    assert [p.reason for p in problems] == ["conflict"]
    assert isinstance(problems[0], Problem)


def rising(x, y):
    """Height of a bumpy slope that rises to the east."""
    return 50 + 0.2 * np.asarray(x) + np.sin(np.asarray(y) / 7)


def wet_layers(*bodies):
    polygons, kinds = zip(*bodies, strict=True)
    return Layers.of(polygons, klass=Class.WATER, material=11, priority=40, body=kinds)


@pytest.mark.parametrize("size", [30.0, 64.0, 500.0])
def test_lakes_are_level_and_the_ground_closes_on_them_across_tiles(size):
    lake = shapely.Point(3, 4).buffer(37)
    touching_the_side = shapely.box(60, 30, 90, 60)
    layers = wet_layers((lake, "standing"), (touching_the_side, "standing"))
    plan = plan_ground(EXTENT, layers, tile_size=size, lines=15.0)
    levels = water_levels(layers, [], frame=FRAME, height=rising)
    mesh = concatenate([ground_tile(plan, i, j=j, height=rising, levels=levels) for i, j in plan.tiles])
    water = mesh.klass == Class.WATER
    z = mesh.vertices[mesh.faces][water][..., 2]
    east = mesh.vertices[mesh.faces][water][..., 0].mean(axis=1) > 50
    shore = shapely.get_coordinates(shapely.segmentize(lake.exterior, 1.0))
    assert np.ptp(z[~east]) == 0.0
    assert np.ptp(z[east]) == 0.0
    assert z[~east][0, 0] == pytest.approx(rising(*shore.T).min(), abs=0.5)
    # One surface in space: an edge that has one face lies on the extent's border.
    points, number = np.unique(mesh.vertices, axis=0, return_inverse=True)
    faces = number.reshape(-1)[mesh.faces]
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    unique, count = np.unique(edges, axis=0, return_counts=True)
    ends = points[unique[count == 1]][:, :, :2]
    assert (np.abs(ends) == 100).all(axis=1).any(axis=1).all()
    assert set(count) == {1, 2}


def test_connected_waters_have_one_level_that_of_the_sea_if_they_touch():
    layers = wet_layers(
        (shapely.box(-90, -90, -50, 90), "sea"),
        (shapely.box(-50, 0, -20, 20), "standing"),
        (shapely.box(-20, 5, 0, 10), "standing"),
        (shapely.box(40, 0, 60, 20), "standing"),
        (shapely.box(80, -90, 90, 90), "sea"),
    )
    level = water_levels(layers, [], frame=FRAME, height=rising).level
    assert level[0] == level[1] == level[2] == level[4]
    assert level[3] == pytest.approx(rising(40, 0), abs=0.01)  # the lowest of its corners


def test_a_river_never_flows_uphill_and_is_reversed_if_mapped_so():
    """The river is mapped eastward, up the slope; its water level falls to the west."""
    stream = way(1, [(-90, 0), (0, 5), (90, 0)], waterway="river")
    layers, _ = cover(stream)
    levels = water_levels(layers, [stream], frame=FRAME, height=rising)
    assert levels.reversed == ("way/1",)
    order = np.argsort(-levels.station[:, 0])
    assert (np.diff(levels.height[order]) <= 0).all()
    assert (levels.height <= rising(*levels.station.T) + 1e-9).all()
    plan = plan_ground(EXTENT, layers, tile_size=50.0, lines=10.0)
    mesh = concatenate([ground_tile(plan, i, j=j, height=rising, levels=levels) for i, j in plan.tiles])
    corners = mesh.vertices[mesh.faces][mesh.klass == Class.WATER].reshape(-1, 3)
    assert np.abs(corners[:, 2] - (50 + 0.2 * corners[:, 0])).max() < 3.5


REAL = ["helsinki_center.osm.pbf", "nyc_lower_east_side.osm.pbf", "monaco.osm.pbf", "gibraltar.osm.pbf"]


@pytest.mark.shared
@pytest.mark.parametrize("name", REAL)
def test_the_ground_of_real_places_is_one_surface(shared_osm, name):
    osm = read_osm(shared_osm(name))
    west, south, east, north = osm.bounds
    frame = Frame.at((west + east) / 2, (south + north) / 2)
    x, y = frame.from_geographic([west, east], [south, north])
    extent = (x.min(), y.min(), x.max(), y.max())
    layers, _ = landcover(osm, frame, extent=extent)
    houses = [a.geometry for a in osm.areas if "building" in a.tags]
    houses = shapely.transform(
        np.array(houses, object), lambda c: np.column_stack(frame.from_geographic(*c.T))
    )
    plan = plan_ground(extent, Layers.concatenate([layers, building_pads(houses)]))
    mesh = concatenate([ground_tile(plan, i, j=j) for i, j in plan.tiles])
    points, number = np.unique(mesh.vertices, axis=0, return_inverse=True)
    faces = number.reshape(-1)[mesh.faces]
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    unique, count = np.unique(edges, axis=0, return_counts=True)
    assert set(count) == {1, 2}
    xmin, ymin, xmax, ymax = plan.extent
    ends = points[unique[count == 1]][:, :, :2]
    assert ((ends == (xmin, ymin)).all(axis=1) | (ends == (xmax, ymax)).all(axis=1)).any(axis=1).all()
    (ux, uy), (vx, vy) = ((points[faces[:, k]] - points[faces[:, 0]])[:, :2].T for k in (1, 2))
    area_m2 = (ux * vy - uy * vx) / 2
    assert (area_m2 > 0).all()
    assert area_m2.sum() == pytest.approx((xmax - xmin) * (ymax - ymin), rel=1e-9)
    pads = shapely.union_all(shapely.intersection(houses, shapely.box(*plan.extent))).area
    assert area_m2[mesh.klass == Class.BUILDING_PAD].sum() == pytest.approx(pads, rel=1e-4)


@pytest.mark.shared
def test_monaco_starts_at_sea_level_and_rises_inland(shared_osm, shared_dem):
    osm = read_osm(shared_osm("monaco.osm.pbf"))
    frame = Frame.at(7.42, 43.735)
    extent = (-600.0, -600.0, 1000.0, 600.0)
    terrain = open_terrain([shared_dem("N43E007.hgt.zip")], frame, bounds=extent)
    layers, _ = landcover(osm, frame, extent=extent)
    plan = plan_ground(extent, layers, lines=terrain.lines)
    levels = water_levels(layers, osm.ways, frame=frame, height=terrain.height)
    mesh = concatenate(
        [ground_tile(plan, i, j=j, height=terrain.height, levels=levels) for i, j in plan.tiles]
    )
    middle = mesh.vertices[mesh.faces].mean(axis=1)
    harbour = (np.abs(middle[:, 0] - 450) < 60) & (np.abs(middle[:, 1]) < 60)
    assert (mesh.klass[harbour] == Class.WATER).any()
    z = mesh.vertices[mesh.faces][:, :, 2]
    assert np.abs(z[harbour & (mesh.klass == Class.WATER)]).max() < 1.0
    land = ~np.isin(mesh.klass, [Class.WATER])
    error = middle[land, 2] - terrain.height(middle[land, 0], middle[land, 1])
    assert np.median(np.abs(error)) < 0.3
    assert z.max() > 100.0


@pytest.mark.parametrize(("gap", "paved"), [(8.0, True), (45.0, False)])
def test_between_blocks_that_stand_apart_land_is_paved_beside_them_alone(gap, paved):
    """Slabs of 14 x 60 m in rows: closer together, all of the yards are paved."""
    step = 14.0 + gap
    slabs = np.array([shapely.box(x, y, x + 14, y + 60) for x in step * np.arange(8) for y in (0, 70, 140)])
    layers = paved_fabric(slabs)
    found = shapely.union_all(layers.polygon)
    assert found.contains(shapely.Point(3 * step + 17.0, 100.0))
    assert found.contains(shapely.Point(3 * step + 14.0 + gap / 2, 100.0)) == paved
    assert set(layers.source) == {"assumed-built-up"}
