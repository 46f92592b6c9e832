"""A world of tiles with facades: what rays hit, and what it is."""

import json
from dataclasses import replace

import numpy as np
import pytest
from helpers.facades import plane_mesh, random_relief
from helpers.sensor_worlds import driven

from geoscene.classes import Class
from geoscene.geometry.frames import Frame
from geoscene.geometry.mesh import Mesh, concatenate
from geoscene.scene import SceneFiles, open_scene
from geoscene.scene.layout import SCHEMA, manifest_digest
from geoscene.scene.tile_files import Tile, write_tile
from lidar.geometry.attitude import Mount
from lidar.raycast import Hits
from lidar.raycast.relief import FRAME, INFILL, PARTS, SILL
from lidar.sensors.laser.scan import scan
from lidar.sensors.physics.settings import ScannerSettings
from lidar.sensors.rig.scanner import load_sensor
from lidar.world.settings import WorldSettings
from lidar.world.world import World

TILE = 100.0
FEET = ([30.0, 50.0, 0.0], [20.0, 60.0, 1.0], [45.0, 40.0, 2.0])


def wall_of(rank):
    """The facade of a tile; it looks to the south."""
    return random_relief(np.random.default_rng(rank), angle=0.0, foot=FEET[rank], feature=100 + rank)


def tile(rank):
    """Ground, then a wall; the wall's faces come second, so that their numbers differ from their rows."""
    relief = wall_of(rank)
    ground = Mesh.of(
        np.array([[0, 0, 0], [TILE, 0, 0], [TILE, TILE, 0], [0, TILE, 0.0]]),
        [[0, 1, 2], [0, 2, 3]],
        klass=Class.TERRAIN,
        feature=rank,
    )
    mesh = concatenate([ground, plane_mesh(relief)])
    relief = replace(relief, wall=np.array([-1, -1, 0, 0], np.int32))
    return Tile(np.array([rank * TILE, 0.0, 0.0]), mesh, relief=relief)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene")
    files = SceneFiles(folder)
    files.tiles.mkdir()
    for rank in range(len(FEET)):
        write_tile(files.tile(rank, 0), tile(rank))
    manifest = {
        "schema": SCHEMA,
        "frame": Frame.at(2.0, 48.0).to_json(),
        "bounds": [0, 0, TILE * len(FEET), TILE],
        "tile_size": TILE,
        "tiles": [(rank, 0, 1) for rank in range(len(FEET))],
        "layers": {},
    }
    files.manifest.write_text(json.dumps(manifest | {"digest": manifest_digest(manifest)}))
    return open_scene(folder)


def looks(rank, count=4000):
    """Rays from the south at the wall of a tile."""
    relief, rng = wall_of(rank), np.random.default_rng(5)
    width, height = relief.facades.size[0] - 0.01
    foot = relief.facades.foot[0] + [rank * TILE, 0, 0]
    aim = foot + np.column_stack(
        [rng.uniform(0.01, width, count), 0 * rng.random(count), rng.uniform(0.01, height, count)]
    )
    start = np.broadcast_to(foot + np.array([3.0, -12.0, 2.0]), aim.shape)
    way = aim - start
    return start, way / np.linalg.norm(way, axis=1, keepdims=True)


def hits_of(world, rank, **options):
    start, way = looks(rank)
    hits = world.caster.cast(start, way, normals=True, **options)
    return hits, world.lookup(hits)


@pytest.mark.parametrize("rank", range(len(FEET)))
def test_what_a_ray_hits_in_a_window_belongs_to_its_building_and_has_its_own_material(scene, rank):
    world = World.load(scene)
    hits, found = hits_of(world, rank)
    relief = wall_of(rank)
    assert (found.feature == 100 + rank).all()
    assert (found.klass == Class.BUILDING).all()
    first = world._first[rank] + len(scene.tile(rank, 0).mesh)
    part = np.where(hits.face >= first, 1 + (hits.face - first) % PARTS, 0)
    used = np.unique(relief.cells[relief.cells >= 0])
    for code, materials, colors in (
        (SILL, relief.openings.trim, relief.openings.trim_color),
        (FRAME, relief.openings.frame_material, relief.openings.frame_color),
        (INFILL, relief.openings.infill, relief.openings.infill_color),
    ):
        rows = part == code
        assert rows.any()
        assert set(found.material[rows].tolist()) <= set(materials[used].tolist())
        assert {tuple(c) for c in found.color[rows].tolist()} <= {tuple(c) for c in colors[used].tolist()}
    packed = world.faces.packed[hits.face + world.faces.start[hits.instance]]
    assert np.array_equal(packed >> 32, found.feature)
    assert np.array_equal(packed & 255, found.material)


def test_without_relief_walls_are_planes(scene):
    world = World.load(scene, settings=WorldSettings(relief="off"))
    hits, found = hits_of(world, 1)
    start, way = looks(1)
    np.testing.assert_allclose((start + hits.range[:, None] * way)[:, 1], FEET[1][1], atol=1e-9)
    assert not found.material.any()


def test_windows_do_not_depend_on_the_regions_that_were_loaded_before(scene):
    fresh = World.load(scene, region=(250, 0, 300, 100))
    moved = World.load(scene, region=(0, 0, 50, 100))
    for region in ((100, 0, 150, 100), (250, 0, 300, 100)):
        moved.follow(region)
    wanted, surfaces = hits_of(fresh, 2)
    found, others = hits_of(moved, 2)
    assert np.array_equal(wanted.range, found.range)
    assert np.array_equal(wanted.normal, found.normal)
    for name, column in surfaces.columns().items():
        assert np.array_equal(column, getattr(others, name)), name


def test_a_wet_world_has_no_water_on_windows(scene):
    dry, wet = World.load(scene), World.load(scene, settings=WorldSettings(wetness=1.0))
    (_, wanted), (_, found) = hits_of(dry, 0), hits_of(wet, 0)
    assert np.array_equal(wanted.material, found.material)


def test_a_miss_stays_a_miss(scene):
    world = World.load(scene)
    one = np.full(1, -1, np.int32)
    miss = Hits(np.full(1, np.inf), one, one, np.zeros(1, np.float32), np.empty((0, 3)))
    assert world.lookup(miss).feature[0] == -1


def test_pulses_pass_panes_and_return_from_the_room_behind(scene):
    world, relief = World.load(scene), wall_of(0)
    start = (FEET[0][0] + 3.0, FEET[0][1] - 9.0, 0.0)
    sensor = load_sensor("vlp16", return_mode="dual")
    options = {"trajectory": driven((0.0, 0.0, 0.0), start=start), "world": world, "frame": 0}
    plain = scan(sensor, Mount((0.0, 0.0, 3.0)), **options)
    cloud = scan(sensor, Mount((0.0, 0.0, 3.0)), settings=ScannerSettings(mirrors=True), **options)
    depth = cloud.xyz[:, 1].astype(float) - 9.0
    wall = (cloud.feature == 100) & (cloud.klass == Class.BUILDING)
    behind = wall & (depth > relief.openings.pane_depth.max() + 0.01)
    assert (plain.xyz[plain.feature == 100, 1] < 9.0 + relief.openings.pane_depth.max() + 1e-5).all()
    assert behind.sum() > 50
    assert depth[behind].max() < relief.openings.room.max() + 1e-4
    x = cloud.xyz[behind, 0].astype(float) + 3.0 - relief.facades.start[0, 0]
    assert x.min() > -1e-4
    assert x.max() < relief.facades.grid[0, 0] * relief.facades.cell[0, 0] + 1e-4
