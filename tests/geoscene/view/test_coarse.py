"""Coarse copies stay close to the scene, leave no gaps, and cover as much with fewer trees."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from geoscene.classes import Class
from geoscene.geometry.mesh import FLOOR, ROOF, WALL, Mesh, ShapeInstances, concatenate
from geoscene.view.streamed import coarser_mesh, fewer_instances

BOX = (0.0, 0.0, 64.0, 64.0)


def terrain(seed, count, box=BOX, edge=()):
    """A triangulated surface over a box; ``edge`` are further points (x, y, z) on its sides."""
    rng = np.random.default_rng(seed)
    xmin, ymin, xmax, ymax = box
    inner = rng.uniform((xmin, ymin), (xmax, ymax), (count, 2))
    corners = [(x, y) for x in (xmin, xmax) for y in (ymin, ymax)]
    points = np.vstack([inner, corners, *[[(x, y)] for x, y, _ in edge]])
    z = np.concatenate([rng.uniform(0, 9, count), np.zeros(4), [z for *_, z in edge]])
    triangles = shapely.delaunay_triangles(shapely.MultiPoint(points)).geoms
    lookup = {tuple(p): k for k, p in enumerate(points.tolist())}
    faces = [[lookup[c] for c in list(t.exterior.coords)[2::-1]] for t in triangles]
    area = np.array([shapely.Polygon(points[f]).exterior.is_ccw for f in faces])
    faces = np.array([f if ccw else f[::-1] for f, ccw in zip(faces, area, strict=True)])
    return Mesh.of(np.column_stack([points, z]), faces, feature=np.arange(len(faces)))


def sides(mesh):
    """Directed edges of a mesh by the places of their ends, with how often they occur."""
    corners = [tuple(map(tuple, mesh.vertices[face].tolist())) for face in mesh.faces]
    return Counter(edge for a, b, c in corners for edge in ((a, b), (b, c), (c, a)))


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(3, 120), st.sampled_from([0.5, 4.0, 20.0, 100.0]))
def test_vertices_stay_vertices_of_the_surface_within_their_cell(seed, count, cell):
    mesh = terrain(seed, count)
    coarse = coarser_mesh(mesh, cell=cell, box=BOX)
    known = {tuple(v) for v in mesh.vertices.tolist()}
    assert {tuple(v) for v in coarse.vertices.tolist()} <= known
    a, b, c = coarse.faces.T
    assert ((a != b) & (b != c) & (c != a)).all()
    cells = np.floor(mesh.vertices / cell)
    for face, number in zip(coarse.faces, coarse.feature, strict=True):
        before = {tuple(row) for row in cells[mesh.faces[number]].tolist()}
        assert {tuple(row) for row in np.floor(coarse.vertices[face] / cell).tolist()} == before


@settings(max_examples=40, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.integers(3, 120),
    st.lists(st.tuples(st.integers(1, 639), st.floats(0, 9)), max_size=30, unique_by=lambda p: p[0]),
    st.sampled_from([1.0, 5.0, 24.0]),
)
def test_neighbours_keep_their_common_side_without_gaps(seed, count, edge, cell):
    points = [(64.0, y / 10, z) for y, z in edge]
    west = coarser_mesh(terrain(seed, count, edge=points), cell=cell, box=BOX)
    box = (64.0, 0.0, 128.0, 64.0)
    east = coarser_mesh(terrain(seed + 1, count, box, points), cell=cell, box=box)
    at = [
        {
            edge: n
            for edge, n in sides(mesh).items()
            if edge[0][0] == edge[1][0] == 64.0 and edge[::-1] not in sides(mesh)
        }
        for mesh in (west, east)
    ]
    ends = [sorted({end for edge in side for end in edge}) for side in at]
    assert ends[0] == ends[1]


def test_a_coarser_cell_gives_fewer_faces_and_keeps_the_outline():
    mesh = terrain(1, 4000)
    counts = []
    for cell in (1.0, 4.0, 16.0):
        coarse = coarser_mesh(mesh, cell=cell, box=BOX)
        counts.append(len(coarse))
        covered = shapely.union_all(shapely.polygons(coarse.vertices[coarse.faces][:, :, :2]))
        assert shapely.area(covered) == pytest.approx(64.0**2, rel=0.02)
    assert counts[0] > 2 * counts[1] > 8 * counts[2]


def test_bare_ground_is_coarser_than_what_is_mapped_and_keeps_its_edge_with_it():
    mesh = terrain(2, 3000)
    west = mesh.vertices[mesh.faces][:, :, 0].max(axis=1) < 32.0
    klass = np.where(west, np.uint8(Class.GRASS), np.uint8(Class.TERRAIN))
    half = replace(mesh, klass=klass)
    coarse, all_mapped = (coarser_mesh(m, cell=2.0, box=BOX) for m in (half, mesh))
    assert (coarse.klass == Class.GRASS).sum() == len(all_mapped.take(west[all_mapped.feature]))
    assert (coarse.klass == Class.TERRAIN).sum() < 0.3 * len(all_mapped.take(~west[all_mapped.feature]))
    covered = shapely.union_all(shapely.polygons(coarse.vertices[coarse.faces][:, :, :2]))
    assert shapely.area(covered) == pytest.approx(64.0**2, rel=0.02)


def test_solids_keep_walls_and_roofs_but_no_undersides():
    low, high = np.array([10.0, 10.0, 0.0]), np.array([30.0, 25.0, 12.0])
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * (high - low) + low
    quads = {
        FLOOR: [(0, 2, 6, 4)],
        ROOF: [(1, 5, 7, 3)],
        WALL: [(0, 4, 5, 1), (2, 3, 7, 6), (0, 1, 3, 2), (4, 6, 7, 5)],
    }
    faces = [(q[0], q[k], q[k + 1]) for side in quads.values() for q in side for k in (1, 2)]
    surface = [side for side, rows in quads.items() for _ in rows for _ in (1, 2)]
    house = Mesh.of(corners, np.array(faces), surface=np.array(surface), closed=True)
    small = house.shifted((0.2, 0.2, 0.2))
    coarse = coarser_mesh(concatenate([house, terrain(3, 50)]), cell=2.0, box=BOX)
    solid = coarse.take(coarse.closed)
    assert np.array_equal(solid.vertices, house.vertices)
    assert sorted(set(solid.surface.tolist())) == [WALL, ROOF]
    assert len(solid) == 10
    assert not coarser_mesh(small, cell=100.0, box=BOX).closed.any()


def test_fewer_trees_cover_as_much_and_do_not_depend_on_the_others():
    rng = np.random.default_rng(5)
    count = 6000
    matrix = np.zeros((count, 3, 4))
    for axis in range(3):
        matrix[:, axis, axis] = rng.uniform(3, 9, count)
    matrix[:, :2, 3] = rng.uniform(-500, 500, (count, 2))
    trees = ShapeInstances(np.zeros(count, np.int32), matrix, np.arange(count, dtype=np.int32))
    sizes = np.ones((1, 3))
    some = fewer_instances(trees, sizes, cell=2.0, share=0.25, seed=1)
    assert len(some) == pytest.approx(0.25 * count, rel=0.08)

    def covered(copies):
        return (copies.transform[:, 0, 0] * copies.transform[:, 1, 1]).sum()

    assert covered(some) == pytest.approx(covered(trees), rel=0.08)
    assert np.array_equal(some.transform[:, 2], matrix[some.feature, 2])
    half = fewer_instances(trees.take(slice(0, count // 2)), sizes, cell=2.0, share=0.25, seed=1)
    assert half.feature.tolist() == [f for f in some.feature.tolist() if f < count // 2]
    other = fewer_instances(trees, sizes, cell=2.0, share=0.25, seed=2)
    assert len(np.intersect1d(other.feature, some.feature)) < 0.5 * len(some)
    assert len(fewer_instances(trees, sizes, cell=100.0, share=0.25, seed=1)) == 0
