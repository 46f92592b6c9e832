"""A village measured in a cloud: heights, roofs, trees and ground, by any number of processes."""

import json
import re
from dataclasses import replace

import numpy as np
import pyogrio
import pytest
import shapely
from helpers.clouds import write_las

from geoscene.clouds.apply import check_unit
from geoscene.clouds.survey import with_clouds
from geoscene.errors import InputError
from geoscene.geometry.frames import Frame
from geoscene.ground.terrain import open_terrain
from geoscene.options import BuildOptions, CloudOptions
from geoscene.pipeline.build import build
from geoscene.sources.data import Area, OsmData, TaggedNode, Way
from geoscene.support.digests import file_digest

CENTRE = (9.5, 47.1)
FRAME = Frame.at(*CENTRE)
NO_NODES = np.empty(0, np.int64)
SLOPE = 0.05
HOUSES = {  # id: middle, size along x and y, eaves above the base, rise, shape
    "way/1": ((-30.0, -20.0), (14.0, 9.0), 6.0, 3.0, "gabled"),
    "way/2": ((25.0, -25.0), (16.0, 10.0), 8.0, 0.0, "flat"),
    "way/3": ((-20.0, 30.0), (15.0, 9.0), 5.0, 2.5, "hipped"),
    "way/4": ((30.0, 30.0), (12.0, 8.0), 4.0, 1.5, "gabled"),  # without points on it
}
TREES = [((0.0, 5.0), 11.0, 6.0), ((45.0, 5.0), 8.0, 5.0)]  # middle, height, crown diameter


def ground(x):
    return 400 + SLOPE * x


def base(name):
    (x, _), (width, _), *_ = HOUSES[name]
    return ground(x - width / 2)


def village_cloud(*, seed=1, shift=(0.0, 0.0), noise=0.02):
    """Points (n, 3) of the village, scene metres, by the equations of its surfaces."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-60, 60, (90_000, 2))
    z, gone = ground(xy[:, 0]), np.zeros(len(xy), bool)
    for name, (middle, (width, depth), eaves, rise, shape) in HOUSES.items():
        u, v = (xy - middle).T
        inside = (np.abs(u) < width / 2) & (np.abs(v) < depth / 2)
        side, end = 1 - np.abs(v) / (depth / 2), (width / 2 - np.abs(u)) / (depth / 2)
        share = {"flat": 0 * u, "gabled": side, "hipped": np.minimum(side, end)}[shape]
        z = np.where(inside, base(name) + eaves + rise * share, z)
        gone |= inside & (name == "way/4")
    for middle, height, crown in TREES:
        off = np.hypot(*(xy - middle).T) / (crown / 2)
        leaves = (off < 1) & (rng.random(len(xy)) < 0.8)
        top = 0.6 * height + 0.4 * height * np.sqrt(np.clip(1 - off**2, 0, 1))
        z = np.where(leaves, ground(xy[:, 0]) + top * rng.uniform(0.75, 1.0, len(xy)) ** 0.3, z)
    xyz = np.column_stack([xy + shift, z + rng.normal(0, noise, len(xy))])
    return xyz[~gone]


def village_map(*, tags=None):
    def ring(middle, size):
        corners = np.array(middle) + np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * np.array(size) / 2
        return shapely.Polygon(np.column_stack(FRAME.to_geographic(*corners.T)))

    areas = [
        Area(name, {"building": "yes", **((tags or {}).get(name, {}))}, ring(middle, size), NO_NODES)
        for name, (middle, size, *_) in HOUSES.items()
    ]
    lon, lat = FRAME.to_geographic(*TREES[0][0])
    west, south = FRAME.to_geographic(-50, -50)
    east, north = FRAME.to_geographic(50, 50)
    middle = (float(west + east) / 2, float(south + north) / 2)
    bounds = (middle[0] - 0.0007, middle[1] - 0.00045, middle[0] + 0.0007, middle[1] + 0.00045)
    tree = TaggedNode("node/1", {"natural": "tree"}, float(lon), float(lat))
    return OsmData(bounds, [], areas, [tree], [], source="village")


@pytest.fixture(scope="module")
def cloud_file(tmp_path_factory):
    return las_of(village_cloud(), tmp_path_factory.mktemp("cloud") / "village.laz")


def las_of(xyz, path):
    east, north = FRAME.to_crs(xyz[:, 0], xyz[:, 1], crs="EPSG:32632")
    return write_las(path, np.column_stack([east, north, xyz[:, 2]]), crs="EPSG:32632")


def measured(osm, path, cache, *, workers=1, **options):
    cloud = CloudOptions(cloud=(str(path),), **options)
    return with_clouds(osm, BuildOptions(), cloud=cloud, cache_dir=cache, workers=workers)


def tags_of(osm):
    return {area.osm_id: area.tags for area in osm.areas}


@pytest.mark.full
def test_heights_roofs_trees_and_ground_of_a_village_are_measured(cloud_file, tmp_path):
    osm, options = measured(village_map(), cloud_file, tmp_path, cloud_licence="CC-BY-4.0")
    tags = tags_of(osm)
    for name in ("way/1", "way/2", "way/3"):
        _, _, eaves, rise, shape = HOUSES[name]
        assert float(tags[name]["height"]) == pytest.approx(eaves + rise, abs=0.1)
        assert tags[name]["roof:shape"] == shape
        assert float(tags[name]["roof:height"]) == pytest.approx(rise, abs=0.1)
    assert "height" not in tags["way/4"]
    assert osm.cloud["buildings"]["not_measured"] == 1
    assert osm.cloud["trees"]["mapped_measured"] == 1
    assert osm.cloud["trees"]["added"] == 1
    heights = sorted(float(point.tags["height"]) for point in osm.points)
    assert heights == pytest.approx([8.0, 11.0], abs=0.5)
    assert options.dem

    scene = build(osm, tmp_path / "scene", options=options)
    assert scene.manifest["heights"] == {"cloud": 3, "inferred-neighbours": 1}
    assert scene.manifest["cloud"]["files"][0]["digest"] == file_digest(cloud_file)
    row = next(row for row in scene.manifest["sources"] if row["kind"] == "cloud")
    assert row["licence"] == "CC-BY-4.0"
    assert scene.manifest["counts"]["trees"] == 2
    terrain = open_terrain(options.dem, FRAME, bounds=(-45, -45, 45, 45))
    x, y = np.random.default_rng(0).uniform(-45, 45, (2, 2000))
    assert np.percentile(np.abs(terrain.height(x, y) - ground(x)), 95) < 0.05


@pytest.mark.full
def test_the_result_does_not_depend_on_the_number_of_workers(cloud_file, tmp_path):
    one = measured(village_map(), cloud_file, tmp_path / "one", workers=1)
    two = measured(village_map(), cloud_file, tmp_path / "two", workers=2)
    assert one[0].digest == two[0].digest
    assert json.dumps(one[0].cloud) == json.dumps(two[0].cloud)
    files = [next(iter((tmp_path / name).glob("*.tif"))) for name in ("one", "two")]
    assert files[0].name == files[1].name
    assert files[0].read_bytes() == files[1].read_bytes()


def test_several_files_are_one_cloud_and_a_file_beside_the_map_is_named(cloud_file, tmp_path):
    xyz = village_cloud()
    west = xyz[:, 0] < 3.0
    files = [
        las_of(xyz[west], tmp_path / "west.laz"),
        las_of(xyz[~west], tmp_path / "east.las"),
        las_of(xyz[west] + (5000.0, 0.0, 0.0), tmp_path / "far.laz"),
    ]
    one, _ = measured(village_map(), cloud_file, tmp_path)
    cloud = CloudOptions(cloud=tuple(map(str, files)))
    several, _ = with_clouds(village_map(), BuildOptions(), cloud=cloud, cache_dir=tmp_path)
    assert tags_of(several) == tags_of(one)
    within = [row["within"] for row in several.cloud["files"]]
    assert within[2] == 0
    assert within[0] + within[1] == one.cloud["files"][0]["within"] == one.cloud["points"]["read"]
    assert several.cloud["points"]["beside_the_map"] == west.sum()
    told = [p.detail for p in several.problems if p.reason == "beside-the-map"]
    assert told == ["far.laz: no point within the map"]


def test_tags_win_when_they_are_preferred_and_disagreements_are_reported_anyway(cloud_file, tmp_path):
    tagged = {"way/1": {"height": "14", "roof:shape": "hipped", "roof:height": "3"}}
    for prefer, height, shape in (("tags", "14", "hipped"), ("cloud", "8.9", "gabled")):
        osm, _ = measured(village_map(tags=tagged), cloud_file, tmp_path, prefer=prefer)
        tags = tags_of(osm)["way/1"]
        assert float(tags["height"]) == pytest.approx(float(height), abs=0.2)
        assert tags["roof:shape"] == shape
        found = [p.detail for p in osm.problems if p.reason == "cloud-height-differs"]
        assert len(found) == 1
        assert found[0].endswith(f"{prefer.rstrip('s')} used")


def test_a_shift_between_map_and_cloud_is_reported_and_removed_on_request(tmp_path):
    path = las_of(village_cloud(shift=(1.5, -1.0)), tmp_path / "moved.laz")
    for align in (False, True):
        osm, _ = measured(village_map(), path, tmp_path, cloud_align=align)
        shift = osm.cloud["shift_m"]
        assert (shift["east"], shift["north"]) == pytest.approx((-1.5, 1.0), abs=0.25)
        assert shift["applied"] is align
    assert tags_of(osm)["way/1"]["roof:shape"] == "gabled"
    assert float(tags_of(osm)["way/1"]["height"]) == pytest.approx(9.0, abs=0.15)


@pytest.mark.full
def test_tops_lie_where_the_cloud_saw_them_on_ground_that_a_road_has_moved(cloud_file, tmp_path):
    # the road levels the slope across its width and on its shoulders, where way/1 stands
    lon, lat = FRAME.to_geographic(np.array([-41.0, -41.0]), np.array([-45.0, 45.0]))
    road = Way("way/9", {"highway": "residential"}, np.arange(2), np.column_stack([lon, lat]))
    osm, options = measured(village_map(), cloud_file, tmp_path)
    scene = build(replace(osm, ways=[road]), tmp_path / "scene", options=options)
    rows = pyogrio.read_dataframe(scene.files.features, layer="buildings").set_index("osm_id")
    moved = []
    for name in ("way/1", "way/2", "way/3"):
        _, _, eaves, rise, _ = HOUSES[name]
        top = rows.base[name] + rows.height[name]
        assert top == pytest.approx(float(tags_of(osm)[name]["cloud:top"]), abs=0.002)
        assert top == pytest.approx(base(name) + eaves + rise, abs=0.1)
        moved.append(abs(rows.base[name] - base(name)))
    assert max(moved) > 0.1


def two_level_village():
    """The map with way/5, a tower of 12 m and a hall of 5 m in one outline, and points of it."""
    rng = np.random.default_rng(4)
    corners = np.array([(0, -40), (0, -30), (24, -30), (24, -40)], float)
    shape = shapely.Polygon(np.column_stack(FRAME.to_geographic(*corners.T)))
    osm = village_map()
    xyz = village_cloud()
    inside = ((xyz[:, :2] > (0, -40)) & (xyz[:, :2] < (24, -30))).all(axis=1)
    xy = rng.uniform((0, -40), (24, -30), (2500, 2))
    z = ground(0.0) + np.where(xy[:, 0] < 8, 12.0, 5.0) + rng.normal(0, 0.02, len(xy))
    points = np.concatenate([xyz[~inside], np.column_stack([xy, z])])
    return replace(osm, areas=[*osm.areas, Area("way/5", {"building": "yes"}, shape, NO_NODES)]), points


def test_an_outline_over_a_tower_and_a_hall_becomes_two_parts(tmp_path):
    osm, points = two_level_village()
    osm, options = measured(osm, las_of(points, tmp_path / "two.laz"), tmp_path)
    assert osm.cloud["buildings"]["split"] == osm.cloud["buildings"]["parts_added"] == 1
    scene = build(osm, tmp_path / "scene", options=options)
    rows = pyogrio.read_dataframe(scene.files.features, layer="building_parts")
    heights = dict(zip(rows.osm_id, rows.height, strict=True))
    assert heights == pytest.approx({"way/5": 12.0, "cloud:way/5_1": 5.0}, abs=0.1)
    assert set(rows.height_source) == {"cloud"}
    areas = rows.to_crs(FRAME.crs.to_wkt()).area.tolist()
    assert sorted(areas) == pytest.approx([80.0, 160.0], rel=0.05)
    assert scene.manifest["counts"]["watertight"] == scene.manifest["counts"]["closed_objects"]


@pytest.mark.full
def test_points_that_no_roof_explains_give_heights_only_where_tags_give_none(tmp_path):
    osm, points = two_level_village()
    rng = np.random.default_rng(5)
    heap = (points[:, :2] > (0, -40)).all(axis=1) & (points[:, :2] < (24, -30)).all(axis=1)
    points[heap, 2] = ground(0.0) + 5.0 + 4.0 * rng.random(heap.sum())
    path = las_of(points, tmp_path / "heap.laz")
    for tags, height in (({}, 5 + 4 * 0.7), ({"height": "8.5", "roof:shape": "hipped"}, 8.5)):
        areas = [replace(a, tags=a.tags | tags) if a.osm_id == "way/5" else a for a in osm.areas]
        made, _ = measured(replace(osm, areas=areas), path, tmp_path)
        found = tags_of(made)["way/5"]
        assert float(found["height"]) == pytest.approx(height, abs=0.15)
        assert found.get("roof:shape") == tags.get("roof:shape")
        assert made.cloud["buildings"]["without_shape"] == 1
        assert [p.osm_id for p in made.problems if p.reason == "no-roof-shape"] == ["way/5"]


def test_a_cloud_from_the_street_tells_walls_and_leaves_heights_to_the_map(tmp_path):
    rng = np.random.default_rng(6)
    xyz = village_cloud()
    xyz = xyz[np.abs(xyz[:, 2] - ground(xyz[:, 0])) < 0.2]  # no roofs, no trees
    (x, y), (width, depth), *_ = HOUSES["way/2"]
    along = x - width / 2 + width * rng.random(3000)
    wall = np.column_stack(
        [along, np.full(3000, y - depth / 2), ground(x - width / 2) + 6 * rng.random(3000)]
    )
    osm, _ = measured(village_map(), las_of(np.concatenate([xyz, wall]), tmp_path / "street.laz"), tmp_path)
    found = osm.cloud["buildings"]
    assert (found["walls_only"], found["not_measured"]) == (1, 4)
    assert not any("height" in tags for tags in tags_of(osm).values())
    told = [(p.osm_id, p.detail) for p in osm.problems if p.reason == "walls-only"]
    ((feature, text),) = told
    assert feature == "way/2"
    assert re.fullmatch(r"walls seen up to (5\.9|6\.0) m, no roof; height by the map's rules", text)


def test_heights_in_feet_that_were_taken_for_metres_are_told_by_the_tags():
    with pytest.raises(InputError, match=r"3\.28 times as high as tagged.*`cloud_unit`"):
        check_unit([3.28] * 12)
    check_unit([3.28] * 3)
    check_unit([1.0] * 12)


def test_a_cloud_that_leaves_ground_unknown_needs_elevation_or_leave(tmp_path):
    xyz = village_cloud()
    osm = village_map()
    wide = (osm.bounds[0] - 0.004, *osm.bounds[1:])
    path = las_of(xyz, tmp_path / "part.laz")
    osm = OsmData(wide, [], osm.areas, osm.points, [], source="village")
    # the scene's frame is that of the wider map
    with pytest.raises(InputError, match=r"% of the scene is over 100 m from any ground return.*`dem_gaps`"):
        with_clouds(osm, BuildOptions(), cloud=CloudOptions((str(path),)), cache_dir=tmp_path)
    _, options = with_clouds(
        osm, BuildOptions(dem_gaps="nearest"), cloud=CloudOptions((str(path),)), cache_dir=tmp_path
    )
    assert len(options.dem) == 1


def test_options_of_clouds_without_a_cloud_are_refused():
    with pytest.raises(InputError, match="`cloud_align`: has no effect without `cloud`"):
        CloudOptions(cloud_align=True)
