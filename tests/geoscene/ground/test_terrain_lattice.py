"""Bare ground that follows the terrain: closed, independent of neighbours, and within the tolerance."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
from helpers.surfaces import assert_one_surface, welded
from hypothesis import given, settings
from hypothesis import strategies as st

from geoscene.classes import Class, materials
from geoscene.geometry.mesh import concatenate
from geoscene.ground import Layers, ground_tile, ground_tiles, join_tiles, plan_ground, tile_box, tile_span
from geoscene.ground.partition import follows_terrain, tile_lattice
from geoscene.ground.terrain_lattice import TerrainHeights

GRASS = materials()["grass"].code
EXTENTS = ((0.0, 0.0, 1600.0, 1600.0), (-730.0, 35.0, 190.0, 1511.0), (13.0, -1399.0, 640.0, 17.0))


def waves(seed):
    rng = np.random.default_rng(seed)
    ways, phases = rng.normal(0, 1 / 150, (8, 2)), rng.uniform(0, 6, 8)

    def height(x, y):
        x, y = np.asarray(x, float), np.asarray(y, float)
        return 6 * sum(np.sin(u * x + v * y + p) for (u, v), p in zip(ways, phases, strict=True))

    return height


def bare_plan(extent, terrain, *, houses=(), size=100.0):
    layers = Layers.of(
        [shapely.Point(xy).buffer(20) for xy in houses], klass=Class.GRASS, material=GRASS, priority=0
    )
    lines = {"lines": 10.0, "ruled": [(3, 4), (4, 4)], "coarse": terrain.spacing}
    return join_tiles(plan_ground(extent, layers, tile_size=size, terrain=terrain, **lines), {(2, 2)})


@pytest.mark.full
@given(st.integers(0, 2**32), st.sampled_from(EXTENTS), st.sampled_from([0.05, 0.5, 5.0]))
@settings(max_examples=10, deadline=None)
def test_ground_on_terrain_is_one_surface_across_tiles(seed, extent, tolerance):
    terrain = TerrainHeights(waves(seed), tolerance, 14.0)
    houses = np.random.default_rng(seed).uniform(extent[:2], extent[2:], (3, 2))
    plan = bare_plan(extent, terrain, houses=houses)
    meshes = [ground_tile(plan, i, j=j, height=terrain.height) for i, j in ground_tiles(plan)]
    assert any(follows_terrain(plan, i, j=j) for i, j in ground_tiles(plan))
    assert_one_surface(*welded(concatenate(meshes)), extent)


@pytest.mark.full
@given(st.integers(0, 2**32), st.sampled_from(EXTENTS), st.sampled_from([0.05, 0.5, 5.0]))
@settings(max_examples=10, deadline=None)
def test_heights_differ_from_the_lattice_by_no_more_than_the_tolerance(seed, extent, tolerance):
    terrain = TerrainHeights(waves(seed), tolerance, 14.0)
    plan = bare_plan(extent, terrain)
    for i, j in ground_tiles(plan):
        if tile_span(plan, i, j=j) > 1:
            mesh = ground_tile(plan, i, j=j, height=terrain.height)
            points = tile_lattice(plan, i, j=j)
            x, y = (v.ravel() for v in np.meshgrid(points.x, points.y))
            z = heights_on(mesh, x, y)
            assert np.abs(z - terrain.height(x, y)).max() <= tolerance + 1e-3


def heights_on(mesh, x, y):
    """Heights of a mesh over places, by the triangle that holds each."""
    corners = mesh.vertices[mesh.faces]
    tree = shapely.STRtree(shapely.polygons(corners[:, :, :2]))
    place, face = tree.query(shapely.points(x, y), predicate="intersects")
    place, first = np.unique(place, return_index=True)
    assert len(place) == len(x)
    a, b, c = (corners[face[first], k] for k in range(3))
    u, v, w = b - a, c - a, np.column_stack([x, y]) - a[:, :2]
    double = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
    p = (w[:, 0] * v[:, 1] - w[:, 1] * v[:, 0]) / double
    q = (u[:, 0] * w[:, 1] - u[:, 1] * w[:, 0]) / double
    return a[:, 2] + p * u[:, 2] + q * v[:, 2]


def test_level_and_sloping_ground_needs_vertices_at_squares_only():
    for height in (lambda x, y: 0 * (x + y) + 7.0, lambda x, y: 0.25 * x - 0.125 * y):
        plan = bare_plan((0.0, 0.0, 3200.0, 3200.0), TerrainHeights(height, 0.01, 14.0))
        tile = next(t for t in ground_tiles(plan) if tile_span(plan, t[0], j=t[1]) == 16)
        mesh = ground_tile(plan, *tile[:1], j=tile[1], height=height)
        assert (mesh.vertices[:, :2] % 100 == 0).all()
        assert len(mesh) < 2 * 16**2


def test_a_tile_does_not_depend_on_the_size_of_those_beside_it_where_nothing_is_joined():
    terrain = TerrainHeights(waves(3), 0.5, 14.0)
    plan = bare_plan(EXTENTS[0], terrain, houses=[(x, y) for x in (850, 950, 1050) for y in (850, 950, 1050)])
    lined = replace(plan, terrain=None)
    alone = [
        (i, j)
        for i, j in ground_tiles(plan)
        if all(tile_span(plan, i + a, j=j + b) == 1 for a in (-1, 0, 1) for b in (-1, 0, 1))
    ]
    assert alone
    for i, j in alone:
        one, other = (ground_tile(p, i, j=j, height=terrain.height) for p in (plan, lined))
        np.testing.assert_array_equal(one.vertices, other.vertices)


def test_still_water_is_level_and_has_no_vertices_within():
    sea = Layers.of(
        [shapely.box(-1e4, -1e4, 1e4, 1e4)], klass=Class.WATER, material=GRASS, priority=0, body="sea"
    )
    terrain = TerrainHeights(waves(1), 0.1, 14.0)
    plan = join_tiles(
        plan_ground(EXTENTS[0], sea, tile_size=100.0, coarse=14.0, ruled=(), terrain=terrain), ()
    )
    for i, j in ground_tiles(plan):
        xmin, ymin, xmax, ymax = tile_box(plan, i, j=j)
        x, y = ground_tile(plan, i, j=j).vertices[:, :2].T
        assert ((x == xmin) | (x == xmax) | (y == ymin) | (y == ymax)).all()
