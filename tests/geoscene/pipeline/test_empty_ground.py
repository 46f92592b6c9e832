"""Wide maps with next to nothing on them: ground in few tiles that readers find their way on."""

import itertools

import numpy as np
import pytest
import shapely

from geoscene.export import export_scene
from geoscene.options import BuildOptions, ExportOptions, ViewOptions
from geoscene.pipeline.build import build
from geoscene.scene.validate import check_scene
from geoscene.sources import read_osm
from geoscene.view import view_scene
from lidar.motion.road_drive import edges_on_tiles
from lidar.world.ground import ground_heights
from lidar.world.world import World

HOUSES = [(60.002, 24.003), (60.21, 24.2), (60.21, 24.61)]


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Three houses and a road of 200 m on 26 x 34 km."""
    nodes, ways = [], []

    def way(places, tags):
        numbers = itertools.count(len(nodes) + 1)
        own = list(zip(numbers, places, strict=False))
        nodes.extend(f'<node id="{k}" version="1" lat="{lat}" lon="{lon}"/>' for k, (lat, lon) in own)
        refs = [k for k, _ in own] + ([own[0][0]] if "building" in tags else [])
        body = "".join(f'<nd ref="{k}"/>' for k in refs)
        body += "".join(f'<tag k="{key}" v="{value}"/>' for key, value in tags.items())
        ways.append(f'<way id="{len(ways) + 1}" version="1">{body}</way>')

    for lat, lon in HOUSES:
        corners = [(lat, lon), (lat, lon + 2e-4), (lat + 1e-4, lon + 2e-4), (lat + 1e-4, lon)]
        way(corners, {"building": "yes", "height": "6"})
    way([(60.2105, 24.2), (60.2105, 24.2036)], {"highway": "residential"})
    folder = tmp_path_factory.mktemp("empty")
    bounds = '<bounds minlat="60" minlon="24" maxlat="60.23" maxlon="24.62"/>'
    path = folder / "map.osm"
    path.write_text(f'<osm version="0.6">{bounds}{"".join(nodes + ways)}</osm>')
    return build(read_osm(path), folder / "scene", options=BuildOptions(relief="off"))


def test_empty_ground_is_in_few_tiles_that_cover_it_without_gaps(scene):
    assert len(scene.tile_indices) < 250  # 14,000 squares
    assert scene.tile_spans.max() == 16
    xmin, ymin, xmax, ymax = scene.bounds
    assert scene.manifest["ground"]["area"] == pytest.approx((xmax - xmin) * (ymax - ymin), rel=1e-12)
    boxes = shapely.box(*scene.tile_boxes.T)
    assert shapely.union_all(boxes).area == pytest.approx(shapely.area(boxes).sum(), rel=1e-12)
    found = check_scene(scene)
    assert found["solids"] == 3
    assert not found["broken"]
    assert not found["broken_surfaces"]


def test_every_point_is_on_one_tile(scene):
    rng = np.random.default_rng(1)
    xy = rng.uniform(scene.bounds[:2], scene.bounds[2:], (500, 2))
    on = scene.tiles_at(xy)
    boxes = scene.tile_boxes[on]
    assert ((xy >= boxes[:, :2]) & (xy < boxes[:, 2:])).all()
    assert scene.tiles_at(xy + 1e6).tolist() == [-1] * 500


def test_rays_roads_and_heights_meet_the_ground_of_joined_tiles(scene):
    span = scene.tile_spans.argmax()
    low, high = scene.tile_boxes[span, :2], scene.tile_boxes[span, 2:]
    places = np.random.default_rng(2).uniform(low, high, (20, 2))
    world = World.load(scene, region=(*places[0], *places[0]), margin=100.0)
    assert world.caster.cast([*places[0], 7.0], [[0.0, 0.0, -1.0]]).range == pytest.approx(7.0)
    assert ground_heights(scene, np.column_stack([places, np.ones(20)])).tolist() == [0.0] * 20
    assert edges_on_tiles(scene.road_graph(), scene).all()


@pytest.mark.full
def test_exports_and_views_have_the_ground_of_joined_tiles(scene, tmp_path):
    faces = scene.manifest["counts"]["faces"]
    assert export_scene(scene, tmp_path / "a.city.json", options=ExportOptions(roofs="guess")).faces == faces
    assert view_scene(scene, tmp_path / "a.html").faces == faces
    lon, lat = scene.frame.to_geographic(
        *np.array(scene.tile_boxes[scene.tile_spans.argmax()]).reshape(2, 2).T
    )
    middle = (lon.mean(), lat.mean(), lon.mean() + 1e-4, lat.mean() + 1e-4)
    part = view_scene(scene, tmp_path / "b.html", options=ViewOptions(bounds_deg=middle))
    assert 2 <= part.faces < 200
