"""The ground is one surface without gaps, overlaps or T-junctions, also across tiles."""

import numpy as np
import pytest
import shapely
import shapely.affinity
from helpers.surfaces import assert_one_surface, partition, welded
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from geoscene.classes import Class, materials
from geoscene.errors import InputError
from geoscene.geometry.mesh import concatenate
from geoscene.geometry.watertight import degenerate_faces
from geoscene.ground import (
    Layers,
    building_pads,
    drape,
    ground_tile,
    ground_tiles,
    join_tiles,
    partition_tile,
    plan_ground,
    triangulate,
)
from geoscene.ground.partition import PRECISION, SLIVER, tile_box, tile_span

EXTENT = (-30.0, -20.0, 30.0, 45.0)
GRASS = materials()["grass"].code


def blobs(seed, count=12):
    """Stars at arbitrary coordinates, some with holes, some partly outside the extent."""
    rng = np.random.default_rng(seed)
    out = []
    for _ in range(count):
        middle, reach = rng.uniform(-35, 50, 2), rng.uniform(0.5, 25)
        turn = np.sort(rng.uniform(0, 2 * np.pi, rng.integers(3, 12)))
        radius = reach * rng.uniform(0.3, 1, len(turn))
        star = shapely.Polygon(middle + radius[:, None] * np.column_stack([np.cos(turn), np.sin(turn)]))
        star = shapely.make_valid(star, method="structure", keep_collapsed=False)
        if rng.random() < 0.4:
            star = star.difference(shapely.Point(middle).buffer(reach / 4, quad_segs=3))
        out.append(star)
    return out


def layers_of(polygons, rng):
    n = len(polygons)
    klass = rng.choice([Class.GRASS, Class.WATER, Class.ROAD], n)
    return Layers.of(
        polygons, klass=klass, material=GRASS, priority=rng.integers(0, 5, n), feature=np.arange(n)
    )


@pytest.mark.full
@given(st.integers(0, 2**32), st.sampled_from([0.0, 4.0, 7.0]), st.sampled_from([16.0, 25.0, 200.0]))
@settings(max_examples=40, deadline=None)
def test_the_ground_is_one_surface_across_tiles(seed, lines, size):
    rng = np.random.default_rng(seed)
    plan = plan_ground(EXTENT, layers_of(blobs(seed), rng), tile_size=size, lines=lines)
    mesh = concatenate([ground_tile(plan, i, j=j) for i, j in plan.tiles])
    assert_one_surface(*welded(mesh), EXTENT)


def rolling(x, y):
    return 4 * np.sin(np.asarray(x) / 9) + np.asarray(y) ** 2 / 900


@pytest.mark.full
@given(st.integers(0, 2**32), st.sampled_from([0.0, 3.0, 5.0]))
@settings(max_examples=15, deadline=None)
def test_the_ground_is_one_surface_across_joined_tiles_and_the_others_do_not_change(seed, lines):
    rng = np.random.default_rng(seed)
    polygons = [shapely.affinity.scale(b, 0.2, 0.2) for b in blobs(seed, 4)]
    ruled = [tuple(square) for square in rng.integers(-4, 6, (3, 2)).tolist()]
    apart = plan_ground(EXTENT, layers_of(polygons, rng), tile_size=4.0, lines=1.0, ruled=ruled, coarse=lines)
    plan = join_tiles(apart, {(2, 3)})
    tiles = ground_tiles(plan)
    assert len(tiles) < len(apart.tiles)
    meshes = {tile: ground_tile(plan, tile[0], j=tile[1], height=rolling) for tile in tiles}
    assert_one_surface(*welded(concatenate(list(meshes.values()))), EXTENT)
    for i, j in {(2, 3), *ruled}.intersection(map(tuple, apart.tiles.tolist())):
        assert tile_span(plan, i, j=j) == 1
    for i, j in tiles:
        alone = ground_tile(apart, i, j=j, height=rolling)
        if tile_span(plan, i, j=j) == 1:
            np.testing.assert_array_equal(meshes[i, j].vertices, alone.vertices)
            np.testing.assert_array_equal(meshes[i, j].faces, alone.faces)
        elif lines:  # the same lines, so the same heights at their crossings
            assert np.isin(alone.vertices[:, :2], meshes[i, j].vertices[:, :2]).all()


def test_a_tile_that_nothing_crosses_has_the_vertices_that_noding_gives_it():
    field, hidden = (
        shapely.box(-20, -20, 20, 20),
        shapely.box(4, 0, 8, 4),
    )  # the tile's sides, below the field

    def cells(polygons):
        layers = Layers.of(
            polygons, klass=Class.TERRAIN, material=GRASS, priority=np.arange(len(polygons))[::-1]
        )
        plan = plan_ground((-12, -12, 12, 12), layers, tile_size=4.0, lines=1.0, ruled=[(0, 0)])
        return partition_tile(plan, 1, j=0)

    bare, noded = cells([field]), cells([field, hidden])
    assert bare.row.tolist() == noded.row.tolist() == [0]
    corners = shapely.get_coordinates(bare.polygon)
    assert shapely.equals_exact(*shapely.normalize([bare.polygon[0], noded.polygon[0]]))
    assert {(4.0, y) for y in range(5)} <= set(map(tuple, corners.tolist()))  # the lines of the tile beside


def test_outlines_along_the_border_of_the_extent_do_not_keep_squares_apart():
    sea = shapely.box(0, 0, 1500, 1600) - shapely.box(500, 500, 520, 520)
    layers = Layers.of([sea], klass=Class.WATER, material=GRASS, priority=0)
    plan = join_tiles(plan_ground((0, 0, 1500, 1600), layers, tile_size=100.0), set())
    spans = {tile: tile_span(plan, tile[0], j=tile[1]) for tile in ground_tiles(plan)}
    assert sorted(spans.values()) == [1] * 4 + [2] * 3 + [4] * 3 + [8] * 3
    mesh = concatenate([ground_tile(plan, i, j=j) for i, j in spans])
    assert_one_surface(*welded(mesh), plan.extent)


def test_squares_with_forest_keep_their_size():
    wood = shapely.box(-1000, -1000, 300, 3000)
    layers = Layers.of([wood], klass=Class.FOREST_FLOOR, material=GRASS, priority=0)
    plan = join_tiles(plan_ground((0, 0, 1600, 1600), layers, tile_size=100.0), {(12, 12)})
    spans = {tile: tile_span(plan, tile[0], j=tile[1]) for tile in ground_tiles(plan)}
    assert all(spans[i, j] == 1 for i in range(4) for j in range(16))
    assert spans[8, 0] == 8
    assert spans[12, 12] == 1
    assert sum(span**2 for span in spans.values()) == 16 * 16


@pytest.mark.full
@given(st.integers(0, 2**32), st.sampled_from([0.0, 7.0]))
@settings(max_examples=15, deadline=None)
def test_no_two_vertices_of_the_ground_are_within_a_millimetre_and_no_face_is_a_line(seed, lines):
    rng = np.random.default_rng(seed)
    jittered = [shapely.affinity.translate(b, *rng.normal(0, 3e-4, 2)) for b in blobs(seed)]
    layers = layers_of([*blobs(seed), *jittered], rng)  # as mapped twice, almost alike
    plan = plan_ground(EXTENT, layers, tile_size=25.0, lines=lines)
    points, faces = welded(concatenate([ground_tile(plan, i, j=j) for i, j in plan.tiles]))
    assert not cKDTree(points).query_pairs(1.5e-3)
    assert not degenerate_faces(points, faces).any()


@pytest.mark.full
@given(st.integers(0, 2**32))
@settings(max_examples=25, deadline=None)
def test_a_point_belongs_to_the_highest_polygon_over_it(seed):
    rng = np.random.default_rng(seed)
    layers = layers_of(blobs(seed), rng)
    cells = partition(EXTENT, layers, tile_size=25.0)
    xy = rng.uniform(EXTENT[:2], EXTENT[2:], (300, 2))
    points = shapely.points(xy)
    # Within a sliver's width of an outline either side may have it.
    clear = shapely.distance(points, shapely.union_all(shapely.boundary(layers.polygon))) > SLIVER
    for x, y in xy[clear]:
        over = shapely.contains_xy(layers.polygon, x, y)
        ranked = np.where(over, layers.priority, -1)
        expected = int(np.argmax(ranked)) if over.any() else -1
        [cell] = np.flatnonzero(shapely.contains_xy(cells.polygon, x, y))
        assert cells.row[cell] == expected


@given(st.integers(0, 2**32))
@settings(max_examples=15, deadline=None)
def test_a_tile_is_independent_of_other_tiles(seed):
    rng = np.random.default_rng(seed)
    layers = layers_of(blobs(seed), rng)
    plan = plan_ground(EXTENT, layers, tile_size=16.0, lines=8.0)
    i, j = plan.tiles[rng.integers(len(plan.tiles))]
    alone = ground_tile(plan, i, j=j)
    xmin, ymin, xmax, ymax = tile_box(plan, i, j=j)
    near = shapely.intersects(layers.polygon, shapely.box(xmin - 1, ymin - 1, xmax + 1, ymax + 1))
    without_the_far = ground_tile(plan_ground(EXTENT, layers.take(near), tile_size=16.0, lines=8.0), i, j=j)
    np.testing.assert_array_equal(alone.vertices, without_the_far.vertices)
    np.testing.assert_array_equal(alone.faces, without_the_far.faces)
    np.testing.assert_array_equal(alone.feature, without_the_far.feature)


def test_outlines_on_tile_borders_and_grid_ties_leave_no_gaps():
    """Edges and corners on a tile's side, and crossings half a grid step away from it."""
    half = PRECISION / 2
    polygons = [
        shapely.box(-10, 0, 16, 10),  # ends on a side
        shapely.box(16, 5, 25, 20),  # begins on it
        shapely.Polygon([(16, -5), (24, -12), (8, -12)]),  # a corner on it
        shapely.Polygon([(0, 30), (16 - half, 38), (32, 30)]),
        shapely.Polygon([(0, 31 + half), (16 + half, 39 + half), (30, 31)]),
        shapely.Polygon([(-3, 16), (29, 16 + half), (29, 16 - half)]),  # thinner than the grid
    ]
    layers = Layers.of(polygons, klass=Class.GRASS, material=GRASS, priority=np.arange(6))
    plan = plan_ground(EXTENT, layers, tile_size=16.0)
    mesh = concatenate([ground_tile(plan, i, j=j) for i, j in plan.tiles])
    assert_one_surface(*welded(mesh), EXTENT)


def test_vertices_are_exact_in_tile_coordinates():
    """The grid is a power of two, so subtracting and adding whole metres is exact."""
    plan = plan_ground(EXTENT, layers_of(blobs(3), np.random.default_rng(3)), tile_size=25.0)
    mesh = ground_tile(plan, 0, j=0)
    assert (mesh.shifted((-5000, 4000, 0)).shifted((5000, -4000, 0)).vertices == mesh.vertices).all()


def test_slivers_are_merged_and_kerbs_are_kept():
    gap = SLIVER / 2
    left, right = shapely.box(0, 0, 10, 10), shapely.box(10 + gap, 0, 20, 10)
    kerb = shapely.box(0, 10, 20, 10.1)
    layers = Layers.of(
        [left, right, kerb], klass=[Class.GRASS, Class.ROAD, Class.KERB], material=GRASS, priority=[1, 2, 3]
    )
    cells = partition((0, 0, 20, 20), layers)
    assert cells.slivers == 1
    assert not shapely.contains_xy(cells.polygon[cells.row < 0], 10 + gap / 2, 5).any()
    assert shapely.area(cells.polygon[cells.klass == Class.KERB]).sum() == pytest.approx(2.0, abs=0.01)


def test_building_pads_cover_roads_and_have_the_feature_of_the_building():
    house = shapely.box(0, 0, 10, 10)
    road = Layers.of([shapely.box(-20, 4, 20, 6)], klass=Class.ROAD, material=1, priority=100.0)
    layers = Layers.concatenate([building_pads([None, house], feature=[7, 8]), road])
    cells = partition((-20, -20, 20, 20), layers)
    area = {int(k): shapely.area(cells.polygon[cells.klass == k]).sum() for k in np.unique(cells.klass)}
    assert area == pytest.approx({Class.BUILDING_PAD: 100.0, Class.ROAD: 60.0, Class.TERRAIN: 1440.0})
    assert set(cells.feature[cells.klass == Class.BUILDING_PAD]) == {8}


def test_rings_touching_in_a_point_and_courtyards_are_triangulated_completely():
    holes = [[(2, 2), (4, 5), (2, 8)], [(4, 5), (8, 2), (8, 8)]]  # they touch at (4, 5)
    block = shapely.Polygon([(0, 0), (10, 0), (10, 10), (0, 10)], holes)
    cells = partition((-5, -5, 15, 15), Layers.of([block], klass=Class.GRASS, material=GRASS, priority=1))
    triangles = triangulate(cells)
    covered = triangles.cell[np.argsort(triangles.cell)]
    assert len(np.unique(covered)) == len(cells)
    assert shapely.area(cells.polygon[cells.row == 0]).sum() == pytest.approx(block.area)


def test_faces_keep_class_material_and_feature_of_their_cell():
    layers = Layers.of([shapely.box(0, 0, 5, 5)], klass=Class.SAND, material=10, priority=1, feature=42)
    plan = plan_ground((-5, -5, 10, 10), layers)
    cells = partition_tile(plan, 0, j=0)
    mesh = drape(plan, cells, triangles=triangulate(cells))
    middle = mesh.vertices[mesh.faces].mean(axis=1)
    sandy = (middle[:, :2] > 0).all(axis=1) & (middle[:, :2] < 5).all(axis=1)
    assert sandy.any()
    assert (mesh.klass == np.where(sandy, Class.SAND, Class.TERRAIN)).all()
    assert (mesh.feature == np.where(sandy, 42, -1)).all()
    assert (mesh.material[sandy] == 10).all()
    assert (mesh.color[sandy] == materials()["sand"].color).all()


@pytest.mark.parametrize("extent", [(0, 0, 0, 5), (0, 0, np.nan, 5), (3, 0, 1, 5)])
def test_an_extent_without_area_is_refused(extent):
    with pytest.raises(InputError, match="extent"):
        plan_ground(extent, Layers.empty())


def test_a_tile_outside_the_extent_is_refused():
    with pytest.raises(InputError, match=r"\(9, 9\)"):
        partition_tile(plan_ground(EXTENT, Layers.empty()), 9, j=9)
