"""The geometry that exports have of facades is that which rays meet."""

from dataclasses import replace

import numpy as np
from helpers.facades import with_windows
from helpers.sensor_worlds import MeshWorld, box

from geoscene.buildings.facades.solids import relief_mesh
from geoscene.geometry.mesh import ROOF, WALL
from lidar.raycast import Caster


def test_rays_hit_the_modelled_facade_where_they_hit_the_described_one():
    mesh = box((10, -8, 0), (22, 8, 10), feature=1)
    upright = np.abs(mesh.normals()[:, 2]) < 0.5
    mesh = replace(mesh, surface=np.where(upright, WALL, ROOF).astype(np.uint8))
    world = MeshWorld(mesh, relief=with_windows(mesh))
    model = relief_mesh(mesh, world.relief)
    rng = np.random.default_rng(0)
    way = np.column_stack([np.ones(20_000), rng.uniform(-0.7, 0.7, 20_000), rng.uniform(-0.1, 0.7, 20_000)])
    found = world.caster.cast(np.array([0.0, 0.0, 1.7]), way)
    wanted = Caster(model.vertices, model.faces).cast(np.array([0.0, 0.0, 1.7]), way)
    assert np.array_equal(found.face >= 0, wanted.face >= 0)
    hit = found.face >= 0
    close = np.abs(found.range[hit] - wanted.range[hit]) < 1e-3
    assert close.mean() > 0.999  # vertices of the model are rounded, which moves edges
    assert np.array_equal(world.lookup(found).feature[hit], model.feature[wanted.face[hit]])
    deep = found.range[hit] * way[hit, 0] > 10.01
    assert deep.any()
