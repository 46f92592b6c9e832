"""Trees with relief keep the size, the leaves and the place of plain ones, and are cheap closed shapes."""

import json

import manifold3d
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from geoscene.classes import Class
from geoscene.geometry.frames import Frame
from geoscene.geometry.mesh import Mesh
from geoscene.objects.crowns import HABITS, VARIANTS, habit_of, tree_shapes
from geoscene.objects.forests import Forests, forest_trees
from geoscene.objects.shapes import LEAF_AREA_DENSITY, leaf_area_density, shapes
from geoscene.objects.solids import lathe
from geoscene.objects.vegetation import CROWN, read_trees, tree_instances
from geoscene.sources.data import OsmData, TaggedNode

FRAME = Frame.at(11.0, 50.0)


def volume(points, faces):
    a, b, c = (points[faces[:, k]] for k in range(3))
    return np.einsum("nk,nk->n", a, np.cross(b, c)).sum() / 6


def trees_of(*tags, relief=True):
    points = [
        TaggedNode(f"node/{k}", {"natural": "tree", **t}, 11.0 + k / 1000, 50.0) for k, t in enumerate(tags)
    ]
    return read_trees(OsmData((10.9, 49.9, 11.1, 50.1), [], [], points, []), FRAME, with_relief=relief)[0]


@pytest.mark.parametrize("name", tree_shapes())
def test_shapes_are_closed_solids_facing_outward_within_the_budget(name):
    shape = tree_shapes()[name]
    part = manifold3d.Manifold(
        manifold3d.Mesh(shape.vertices.astype(np.float32), shape.faces.astype(np.uint32))
    )
    assert part.status() == manifold3d.Error.NoError
    assert all(piece.volume() > 0 for piece in part.decompose())
    assert shape.closed.all()
    assert len(shape) <= 2800


@pytest.mark.parametrize("name", [name for name in tree_shapes() if name.startswith("crown")])
def test_crowns_fill_the_unit_box_and_no_more(name):
    shape = tree_shapes()[name]
    leaves = shape.vertices[shape.faces[shape.klass == Class.TREE_CROWN]].reshape(-1, 3)
    assert np.hypot(*leaves[:, :2].T).max() == pytest.approx(0.5)
    assert leaves[:, 2].max() == pytest.approx(1.0)
    assert shape.vertices[:, 2].min() >= 0.0


@pytest.mark.parametrize("name", ["round", "ovoid", "umbrella"])
def test_no_face_of_a_leafy_crown_is_as_large_as_a_leaf_cluster(name):
    """Of a crown of 8 m the edges are about 0.7 m long, and the outline is as finely broken."""
    shape = tree_shapes()[f"crown_{name}_0"]
    corners = shape.vertices[shape.faces[shape.klass == Class.TREE_CROWN]]
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    assert edges.max() < 0.45 * HABITS[name].cluster[0]
    assert np.median(edges) < 0.09


@pytest.mark.parametrize("name", HABITS)
def test_a_tree_has_the_leaves_of_its_evenly_filled_envelope(name):
    """Clusters overlap; their leaves add up there, as the extinction of rays does."""
    envelope = volume(*lathe(HABITS[name].profile)) * LEAF_AREA_DENSITY[f"crown_{HABITS[name].form}"]
    for nth in range(VARIANTS):
        shape = tree_shapes()[f"crown_{name}_{nth}"]
        held = volume(shape.vertices, shape.faces[shape.klass == Class.TREE_CROWN])
        density = leaf_area_density(with_relief=True)[f"crown_{name}_{nth}"]
        assert held * density == pytest.approx(envelope, rel=1e-3)


def test_a_default_tree_has_as_many_leaves_with_relief_as_without():
    for form, habit in (("broadleaved", "round"), ("palm", "palm")):
        plain = shapes()[f"crown_{form}"]
        leaves = volume(plain.vertices, plain.faces)
        assert volume(*lathe(HABITS[habit].profile)) == pytest.approx(leaves)


def test_every_shape_with_leaves_has_a_leaf_area_density():
    leafy = {n for n, shape in shapes(with_relief=True).items() if (shape.klass == Class.TREE_CROWN).any()}
    assert leafy | {"hedge"} == set(leaf_area_density(with_relief=True))


def test_numbers_of_shapes_are_the_same_with_and_without_relief():
    assert list(shapes(with_relief=True))[: len(shapes())] == list(shapes())


@pytest.mark.parametrize(
    ("names", "form", "habit"),
    [
        ("Populus nigra Italica", "broadleaved", "columnar"),
        ("Quercus robur Fastigiata", "broadleaved", "columnar"),
        ("Salix babylonica", "broadleaved", "weeping"),
        ("Betula pendula", "broadleaved", "ovoid"),
        ("Fagus sylvatica Pendula", "broadleaved", "weeping"),
        ("Pinus pinea", "needleleaved", "umbrella"),
        ("Cupressus sempervirens", "needleleaved", "cypress"),
        ("Picea abies", "needleleaved", "conical"),
        ("Tilia cordata", "broadleaved", "round"),
        ("Phoenix canariensis", "palm", "palm"),
    ],
)
def test_botanical_names_tell_the_habit(names, form, habit):
    assert habit_of(names, form=form)[0] == habit


def test_the_habit_and_its_source_are_recorded():
    trees = trees_of({"species": "Pinus pinea"}, {"leaf_type": "needleleaved"}, {})
    assert trees.habit.tolist() == ["umbrella", "conical", "round"]
    assert trees.habit_source.tolist() == ["species", "form", "form"]
    assert trees.crown.tolist() == [12 * HABITS[h].crown for h in trees.habit]


def test_a_default_tree_keeps_its_size_with_relief():
    plain, grown = trees_of({}, relief=False), trees_of({})
    assert plain.crown == grown.crown == 12 * CROWN["broadleaved"]
    low, high = (tree_instances(t).transform[1, 2, 3] for t in (plain, grown))
    assert low == high


def test_a_mapped_crown_is_as_wide_with_relief():
    assert trees_of({"diameter_crown": "3", "genus": "Populus"}).crown.tolist() == [3.0]


@pytest.mark.full
@given(st.integers(0, 2**20))
def test_the_variant_depends_on_the_place_alone(shift):
    """A tree keeps its shape and heading whatever other trees are read with it."""
    tags = [{"genus": "Tilia"}] * 3
    alone, among = trees_of(tags[0]), trees_of(*tags)
    assert np.array_equal(tree_instances(alone).shape[1], tree_instances(among).shape[3])
    moved = alone.take(np.zeros(1, np.int64))
    moved.xy[:] += shift
    assert tree_instances(moved).shape[1] in {
        list(shapes(with_relief=True)).index(f"crown_round_{k}") for k in range(VARIANTS)
    }


def test_forests_with_relief_have_habits_and_survive_the_manifest():
    corners = np.array([[0.0, 0, 0], [200, 0, 0], [200, 200, 0], [0, 200, 0]])
    ground = Mesh.of(corners, np.array([[0, 1, 2], [0, 2, 3]]), klass=Class.FOREST_FLOOR, feature=4)
    forests = Forests(np.array([4]), np.array([0.5]), with_relief=True)
    assert Forests.from_json(json.loads(json.dumps(forests.to_json()))).with_relief
    assert "relief" not in Forests(np.array([4]), np.array([0.5])).to_json()
    trees, _ = forest_trees(ground, forests, box=(0, 0, 200, 200))
    assert set(trees.habit[trees.form == "needleleaved"]) == {"conical"}
    assert (trees.habit != "").all()
