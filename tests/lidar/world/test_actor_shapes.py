"""Bodies of road users are closed solids with the expected sizes and materials."""

import numpy as np
import pytest
import trimesh

from geoscene.classes import Class, materials
from lidar.raycast import Caster
from lidar.world.actor_shapes import KINDS, PAINTS, catalogue

SIZES = {
    "sedan": (4.4, 5.0, 1.7, 1.95, 1.35, 1.55),
    "hatchback": (3.7, 4.4, 1.6, 1.9, 1.4, 1.6),
    "suv": (4.2, 4.9, 1.75, 2.0, 1.55, 1.85),
    "van": (4.8, 6.0, 1.9, 2.2, 2.0, 2.8),
    "truck": (7.0, 12.0, 2.3, 2.6, 3.0, 4.0),
    "bus": (10.0, 18.0, 2.4, 2.6, 2.8, 3.4),
    "motorcycle": (1.8, 2.3, 0.6, 1.0, 1.4, 1.9),
    "parked_motorcycle": (1.8, 2.3, 0.6, 1.0, 0.9, 1.2),
    "bicycle": (1.6, 1.9, 0.4, 0.7, 0.9, 1.2),
    "cyclist": (1.6, 1.9, 0.4, 0.8, 1.5, 2.0),
    "adult": (0.2, 1.1, 0.4, 0.7, 1.65, 1.9),
    "small_adult": (0.2, 1.1, 0.35, 0.7, 1.5, 1.75),
    "child": (0.15, 0.9, 0.25, 0.6, 1.0, 1.4),
}


def pieces(mesh):
    """The closed solids of a mesh by the vertices they share; touching ones stay apart."""
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).split(only_watertight=False)


@pytest.mark.parametrize("kind", KINDS)
def test_every_body_is_made_of_closed_solids_that_face_outwards(kind):
    bodies = [s for s in catalogue().values() if s.kind == kind]
    assert bodies
    for body in (bodies[0], bodies[-1]):
        parts = pieces(body.mesh)
        assert all(part.is_watertight and part.volume > 0 for part in parts), body.name
        assert body.mesh.closed.all()
        assert (body.mesh.klass == body.klass).all()


@pytest.mark.parametrize("kind", KINDS)
def test_bodies_stand_on_the_ground_in_the_middle_of_a_box_of_the_usual_size(kind):
    figures = {}
    for body in (s for s in catalogue().values() if s.kind == kind):
        figures.setdefault("/".join(body.name.split("/")[:2]), []).append(body)
    for poses in figures.values():
        points = np.concatenate([body.mesh.vertices for body in poses])
        low, high = points.min(axis=0), points.max(axis=0)
        np.testing.assert_allclose((low + high)[:2], 0, atol=1e-9)
        assert abs(low[2]) < 0.03
        for body in poses:
            size = (body.length, body.width, body.height)
            np.testing.assert_allclose(size, [*(high - low)[:2], high[2]])
            assert body.mesh.vertices[:, 2].min() < 0.03
        for value, small, large in zip(size, SIZES[kind][::2], SIZES[kind][1::2], strict=True):
            assert small <= value <= large, (body.name, size)


def test_bodies_have_few_enough_triangles_for_hundreds_of_instances():
    assert max(len(s.mesh) for s in catalogue().values()) < 1000


def test_plates_and_rear_lamps_of_vehicles_are_retro_reflective():
    code = materials()["retroreflector"].code
    for kind in (
        "sedan",
        "hatchback",
        "suv",
        "van",
        "truck",
        "bus",
        "motorcycle",
        "parked_motorcycle",
        "bicycle",
    ):
        body = next(s for s in catalogue().values() if s.kind == kind)
        caster = Caster(body.mesh.vertices, body.mesh.faces)
        # from before and from behind; motorcycles bear no plate in front
        for way in (-1.0,) if "motorcycle" in kind else (1.0, -1.0):
            y, z = np.meshgrid(np.arange(-1.3, 1.3, 0.01), np.arange(0.2, 1.2, 0.01))
            start = np.stack([np.full(y.size, way * 20.0), y.ravel(), z.ravel()], axis=1)
            hits = caster.cast(start, np.tile([-way, 0.0, 0.0], (len(start), 1)))
            seen = body.mesh.material[hits.face[hits.face >= 0]]
            assert (seen == code).sum() >= 15, (kind, way)


def test_beams_at_the_windows_of_a_car_hit_glass_on_either_side():
    body = catalogue()["sedan/white"]
    caster = Caster(body.mesh.vertices, body.mesh.faces)
    hits = caster.cast([[0.0, 5.0, 1.15], [0.0, -5.0, 1.15]], [[0.0, -1.0, 0.0], [0.0, 1.0, 0.0]])
    assert (hits.face >= 0).all()
    assert (body.mesh.material[hits.face] == materials()["glass"].code).all()


def test_paint_shares_add_up_to_one():
    assert sum(share for _, share in PAINTS.values()) == pytest.approx(1.0)


def test_pedestrians_cycle_through_the_poses_of_a_stride():
    """The feet are up to one step apart and swap places within a stride."""
    poses = [catalogue()[f"adult/navy/{k}"].mesh for k in range(4)]
    feet = [m.vertices[m.vertices[:, 2] < 0.12] for m in poses]
    left = [f[f[:, 1] > 0, 0].mean() for f in feet]
    right = [f[f[:, 1] < 0, 0].mean() for f in feet]
    assert left[1] - right[1] > 0.4
    assert right[3] - left[3] > 0.4
    assert catalogue()["adult/navy/0"].klass == Class.PEDESTRIAN
