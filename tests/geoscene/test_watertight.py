"""Checks of solids: valid ones pass, and each kind of defect is found."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from geoscene.mesh import Mesh, concatenate
from geoscene.watertight import validate_mesh

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


BROKEN = {
    without_a_face: "not-closed",
    with_a_face_turned: "not-oriented",
    doubled: "not-closed",
    with_nan: "not-finite",
    inside_out: "no-volume",
    flattened: "degenerate-faces",
    with_a_twin_at_an_edge: "not-closed",
    with_a_point_on_an_edge: "degenerate-faces",
}


@given(
    st.tuples(*[st.integers(-(10**7), 10**7)] * 3),
    st.tuples(*[st.integers(1, 10**6)] * 3),
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
