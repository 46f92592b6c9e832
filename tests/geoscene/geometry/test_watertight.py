"""Checks of solids: valid ones pass, and each kind of defect is found."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

from geoscene.geometry.intersections import close_faces, distances, intersecting_faces
from geoscene.geometry.mesh import Mesh, concatenate
from geoscene.geometry.watertight import validate_mesh

CORNERS = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)], float)
BOX = np.array(
    [[0, 2, 3], [0, 3, 1], [4, 5, 7], [4, 7, 6], [0, 1, 5], [0, 5, 4], [1, 3, 7], [1, 7, 5], [3, 2, 6],
     [3, 6, 7],
     [2, 0, 4], [2, 4, 6]]
)  # fmt: skip


def box(feature=0, *, at=(0.0, 0.0, 0.0), size=(1.0, 1.0, 1.0)):
    return Mesh.of(CORNERS * size + at, BOX, feature=feature, closed=True)


def soup(mesh):
    """The same triangles without shared vertices."""
    return replace(
        mesh,
        vertices=mesh.vertices[mesh.faces].reshape(-1, 3),
        faces=np.arange(3 * len(mesh), dtype=np.int32).reshape(-1, 3),
    )


def without_a_face(mesh):
    return mesh.take(np.arange(len(mesh)) != 3)


def with_a_face_turned(mesh):
    faces = mesh.faces.copy()
    faces[5] = faces[5, ::-1]
    return replace(mesh, faces=faces)


def doubled(mesh):
    return concatenate([mesh, mesh])


def with_nan(mesh):
    vertices = mesh.vertices.copy()
    vertices[2, 1] = np.nan
    return replace(mesh, vertices=vertices)


def inside_out(mesh):
    return replace(mesh, faces=mesh.faces[:, ::-1].copy())


def flattened(mesh):
    return replace(mesh, vertices=mesh.vertices * (1, 1, 0))


def with_a_twin_at_an_edge(mesh):
    span = np.ptp(mesh.vertices, axis=0)
    return concatenate([mesh, mesh.shifted(span * (1, 1, 0))])


def with_a_point_on_an_edge(mesh):
    """The mesh with a degenerate face that closes the surface."""
    vertices = np.vstack([mesh.vertices, mesh.vertices[[0, 1]].mean(axis=0)])
    split = np.array([[8, 1, 5], [0, 8, 5], [0, 1, 8]])
    faces = np.vstack([np.delete(mesh.faces, 4, axis=0), split])
    return Mesh.of(vertices, faces, feature=int(mesh.feature[0]), closed=True)


def with_a_twin_at_a_vertex(mesh):
    return concatenate([mesh, mesh.shifted(np.ptp(mesh.vertices, axis=0))])


def with_a_body_that_crosses_it(mesh):
    return concatenate([mesh, mesh.shifted(np.ptp(mesh.vertices, axis=0) * (0.5, 0.4, 0.3))])


def with_a_body_that_stands_on_it(mesh):
    """A smaller body whose floor lies on the top, without an edge or a vertex in common."""
    middle, span = mesh.vertices.mean(axis=0), np.ptp(mesh.vertices, axis=0)
    small = replace(mesh, vertices=middle + (mesh.vertices - middle) * 0.5)
    return concatenate([mesh, small.shifted(span * (0, 0, 0.75))])


def with_a_body_that_pierces_it_by_a_hair(mesh):
    span = np.ptp(mesh.vertices, axis=0)
    return concatenate([mesh, mesh.shifted(span * (1, 0.3, 0.3) - (2e-4, 0, 0))])


def with_vertices_half_a_millimetre_apart(mesh):
    """One vertex split in two along an edge."""
    a, b = mesh.faces[0, 0], mesh.faces[0, 1]
    start, way = mesh.vertices[a], mesh.vertices[b] - mesh.vertices[a]
    twin = len(mesh.vertices)
    faces = []
    for face in mesh.faces.tolist():
        following = dict(zip(face, [*face[1:], face[0]], strict=True))
        if a in face and b in face:
            other = next(v for v in face if v not in (a, b))
            faces += (
                [[a, twin, other], [twin, b, other]]
                if following[a] == b
                else [[twin, a, other], [b, twin, other]]
            )
        else:
            faces.append(face)
    vertices = np.vstack([mesh.vertices, start + way / np.linalg.norm(way) * 5e-4])
    return Mesh.of(vertices, np.array(faces), feature=int(mesh.feature[0]), closed=True)


def upright(triangle, at):
    """A triangle (3, 2), extruded by 5 m."""
    vertices = np.column_stack([np.tile(triangle, (2, 1)), np.repeat([0.0, 5.0], 3)]) + at
    faces = np.array([[0, 2, 1], [3, 4, 5], [0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4], [2, 0, 3], [2, 3, 5]])
    return Mesh.of(vertices, faces, feature=7, closed=True)


def with_a_body_a_hair_from_another(mesh):
    """Two more bodies, an edge of one 0.01 mm from a wall of the other, which runs 1 m in 10 m."""
    at = mesh.vertices.max(axis=0) + 1
    return concatenate(
        [mesh, upright([(0, 0), (10, 0), (10, 1)], at), upright([(4.9999, 0.5), (5.5, 2), (4.5, 2)], at)]
    )


BROKEN = {
    without_a_face: "not-closed",
    with_a_face_turned: "not-oriented",
    doubled: "not-closed",
    with_nan: "not-finite",
    inside_out: "no-volume",
    flattened: "degenerate-faces",
    with_a_twin_at_an_edge: "not-closed",
    with_a_point_on_an_edge: "degenerate-faces",
    with_a_twin_at_a_vertex: "touches-in-a-vertex",
    with_a_body_that_crosses_it: "self-intersection",
    with_a_body_that_stands_on_it: "self-intersection",
    with_a_body_that_pierces_it_by_a_hair: "self-intersection",
    with_vertices_half_a_millimetre_apart: "vertices-within-1-mm",
    with_a_body_a_hair_from_another: "faces-within-0.02-mm",
}


@given(
    st.tuples(*[st.integers(-(10**7), 10**7)] * 3),
    st.tuples(*[st.integers(10, 10**6)] * 3),
    st.booleans(),
)
@settings(max_examples=60, deadline=None)
def test_box_on_the_grid_is_valid_and_has_its_volume(at, size, as_soup):
    at, size = np.array(at) / 1e4, np.array(size) / 1e4
    mesh = box(at=at, size=size)
    verdict = validate_mesh(soup(mesh) if as_soup else mesh)
    assert verdict.ok.tolist() == [True]
    assert verdict.fault(0) == ""
    assert verdict.volume[0] == pytest.approx(size.prod(), rel=1e-6)


@pytest.mark.parametrize("spoil", BROKEN, ids=lambda f: f.__name__)
@pytest.mark.parametrize("as_soup", [False, True])
def test_broken_solid_is_found_among_valid_ones(spoil, as_soup):
    broken = spoil(box(7, at=(3, 4, 5), size=(2, 3, 4)))
    mesh = concatenate([box(2), broken, box(9, at=(3, 4, 9), size=(2, 3, 4))])
    verdict = validate_mesh(soup(mesh) if as_soup else mesh)
    assert verdict.feature.tolist() == [2, 7, 9]
    assert verdict.ok.tolist() == [True, False, True]
    assert verdict.fault(1) == BROKEN[spoil]


def test_features_are_checked_separately_from_their_neighbours():
    mesh = concatenate([box(0), box(1, at=(1, 0, 0)), box(2, at=(1, 1, 0)), box(3)])
    assert validate_mesh(mesh).ok.all()


def test_open_faces_are_not_checked():
    ground = Mesh.of(CORNERS, BOX[:2], feature=5)
    verdict = validate_mesh(concatenate([ground, box(6)]))
    assert verdict.feature.tolist() == [6]
    assert len(validate_mesh(ground)) == len(validate_mesh(Mesh.empty())) == 0


def test_cavity_reduces_the_volume():
    hole = inside_out(box(at=(0.25, 0.25, 0.25), size=(0.5, 0.5, 0.5)))
    verdict = validate_mesh(concatenate([box(), hole]))
    assert verdict.ok.all()
    assert verdict.volume[0] == pytest.approx(1 - 0.125)


def test_gaps_are_welded_up_to_the_grid_size():
    for crack, whole in ((2e-5, True), (3e-4, False)):
        mesh = soup(box())
        vertices = mesh.vertices.copy()
        vertices[0] += crack
        assert validate_mesh(replace(mesh, vertices=vertices)).closed[0] == whole


def common_points(first, second, *, shared):
    """Whether two triangles have a point in common outside shared corners and edges; by linear programs."""
    cost = np.ones(6)
    for i, j in shared:
        cost[i] = cost[3 + j] = 0.0
    equal = np.zeros((5, 6))
    equal[:3, :3], equal[:3, 3:] = first.T, -second.T
    equal[3, :3] = equal[4, 3:] = 1.0
    found = linprog(-cost, A_eq=equal, b_eq=[0, 0, 0, 1, 1], bounds=[(0, None)] * 6)
    return bool(found.status == 0 and (not shared or -found.fun > 1e-7))


def test_faces_intersect_as_linear_programs_say():
    rng = np.random.default_rng(5)
    for _ in range(400):
        # few grid points, so that corners, edges and planes coincide as often as they can
        first, second = rng.integers(0, rng.integers(3, 6), (2, 3, 3))
        if rng.random() < 0.3:
            first[:, 2] = second[:, 2] = 0
        common = int(rng.integers(0, 3))
        second[:common] = first[:common]
        corners = np.concatenate([first, rng.permutation(second)])
        points, ids = np.unique(corners, axis=0, return_inverse=True)
        faces = ids.reshape(2, 3)
        if any(not np.cross(t[1] - t[0], t[2] - t[0]).any() for t in points[faces]):
            continue
        shared = [(i, j) for i in range(3) for j in range(3) if faces[0, i] == faces[1, j]]
        if len(shared) == 3:
            continue
        far = points + rng.integers(-(10**7), 10**7, 3)
        hit = len(intersecting_faces(far, faces, owner=np.zeros(2, np.int64))) == 1
        assert hit == common_points(*points[faces].astype(float), shared=shared)


@pytest.mark.parametrize("seed", range(5))
def test_of_several_bodies_only_faces_of_different_ones_count(seed):
    rng = np.random.default_rng(seed)
    cells = rng.integers(0, 400, (120, 3))
    faces, none = np.arange(120).reshape(40, 3), np.zeros(40, np.int64)
    body = np.sort(rng.integers(0, 4, 40))
    pairs, _ = close_faces(cells, faces, owner=none)
    between = pairs[body[pairs[:, 0]] != body[pairs[:, 1]]]
    found, _ = close_faces(cells, faces, owner=none, body=body)
    assert 0 < len(between) < len(pairs)
    assert sorted(found.tolist()) == sorted(between.tolist())


def test_pairs_of_close_faces_are_those_of_all_pairs():
    rng = np.random.default_rng(7)
    # owners long and narrow in different directions
    at = rng.integers(0, [[[400, 40, 40]], [[40, 40, 400]], [[40, 400, 40]]], (3, 20, 3)).reshape(60, 1, 3)
    cells = (at + rng.integers(-60, 60, (60, 3, 3))).reshape(-1, 3)
    faces, owner = np.arange(180).reshape(60, 3), np.repeat(np.arange(3), 20)
    pairs, crossing = close_faces(cells, faces, owner=owner)
    alone = [
        (i, j)
        for j in range(60)
        for i in range(j)
        if owner[i] == owner[j] and len(close_faces(cells, faces[[i, j]], owner=np.zeros(2, np.int64))[0])
    ]
    assert len(alone) > 10
    assert pairs.tolist() == [list(pair) for pair in alone]
    assert crossing.any()


def test_a_triangle_without_area_is_as_far_away_as_its_edges():
    flat = np.array([[[0, 0, 0], [4, 0, 0], [2, 0, 0]]])
    other = np.array([[[0, 0, 3], [4, 0, 3], [2, 5, 3]]])
    apart = np.zeros((3, 3, 1), bool)
    assert distances(flat, other, same=apart) == pytest.approx(3)
    assert distances(other, flat, same=apart) == pytest.approx(3)
