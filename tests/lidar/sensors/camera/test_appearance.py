"""What images show on signs, plates, clothes and paint."""

import numpy as np
import pytest

from geoscene.classes import Class, materials
from geoscene.objects.shapes import shapes
from geoscene.objects.signs import sign_codes
from lidar.raycast import Caster, MeshInstances
from lidar.sensors.camera.appearance import SIGN_HEIGHT, colors
from lidar.sensors.camera.sign_faces import OF_SHAPE, face_levels, known, plate_levels, sample
from lidar.world.actor_shapes import CLOTHES, PAINTS, catalogue
from lidar.world.actor_solids import WHITE


def at(face, x, y, *, width=0.0):
    return sample(face_levels(face), np.array([[x, y]]), width=np.array([width]))[0].astype(int)


def red(color):
    return color[0] > 2 * color[1]


def blue(color):
    return color[2] > 1.5 * color[0]


def white(color):
    return color.min() > 200


def test_every_face_of_the_tables_is_drawn():
    words = {face.partition(" ")[0] for country in sign_codes().values() for face in country.values()}
    assert words <= known()
    assert {face.partition(" ")[0] for face in OF_SHAPE.values()} <= known()


def test_sign_faces_read_as_drawn():
    assert red(at("stop", 0.3, 0.1))
    assert white(at("no_entry", 0.0, 0.0))
    assert red(at("no_entry", 0.0, 0.15))
    assert red(at("limit 50", 0.28, 0.0))
    assert white(at("limit 50", 0.0, 0.2))
    assert blue(at("parking", 0.25, 0.25))
    assert blue(at("ahead right", 0.0, 0.2))
    assert white(at("ahead right", 0.1, -0.02))
    assert not white(at("ahead right", 0.24, 0.1))
    # The arrow's head is on the right, its tail on the left: more white to the right of the middle.
    level = face_levels("ahead right")[0]
    disc = np.hypot(*(np.mgrid[:256, :256] - 127.5)) < 44
    bright = (level.min(axis=2) > 0.5) & disc
    assert bright[:, 128:].sum() > 1.3 * bright[:, :128].sum()


def test_numbers_and_names_differ_and_fit_their_plates():
    ink = {}
    for words in ("5", "50", "130"):
        level = face_levels(f"limit {words}")[0]
        ink[words] = level.max(axis=2) < 0.05
        rows, columns = np.nonzero(ink[words])
        assert np.hypot(rows - 127.5, columns - 127.5).max() < 0.245 / 1.5 * 256
    assert all(mask.any() for mask in ink.values())
    assert (ink["50"] != ink["130"]).any()
    long = face_levels("street Hauptwachtmeistersgattinnenallee")[0].min(axis=2) > 0.1
    columns = np.flatnonzero(long.any(axis=0))
    assert np.ptp(columns) < 0.6 / 1.5 * 256


@pytest.mark.parametrize("face", ["stop", "limit 50", "priority", "signal"])
def test_a_distant_face_has_the_mean_of_its_light(face):
    levels = face_levels(face)
    assert [len(level) for level in levels] == [256, 128, 64, 32, 16, 8, 4, 2, 1]
    for level in levels[1:]:
        np.testing.assert_allclose(level.mean((0, 1), float), levels[0].mean((0, 1), float), rtol=1e-4)


class Street:
    """One instance of a body in front of a camera, in its own frame."""

    def __init__(self, mesh):
        shape = Caster(mesh.vertices, mesh.faces)
        still = np.eye(3, 4)[None]
        self.mesh, self.shape = mesh, shape
        self.caster = Caster(instances=[MeshInstances((shape,), np.zeros(1, np.int32), still)])

    def shot(self, start, direction, *, feature):
        """Colours where rays hit, and the faces that they hit."""
        count = len(start)
        hits = self.caster.cast(np.array(start, float), np.broadcast_to(direction, (count, 3)), far=100.0)
        assert (hits.instance == 0).all()
        place = np.array(start) + hits.range[:, None] * np.array(direction)
        row = hits.face
        return colors(
            self,
            instance=hits.instance,
            face=row,
            klass=self.mesh.klass[row],
            material=self.mesh.material[row],
            feature=np.full(count, feature, np.int32),
            color=self.mesh.color[row],
            place=lambda rows: place[rows],
            width=np.full(count, 0.001),
        ), row


def test_number_plates_read_from_left_to_right_in_front_and_behind():
    body = catalogue()["sedan/white"]
    street = Street(body.mesh)
    sheet = materials()["retroreflector"].code
    plate = (body.mesh.material == sheet) & (body.mesh.color == WHITE).all(axis=1)
    corners = body.mesh.vertices[body.mesh.faces[plate]]
    for sign in (1.0, -1.0):
        z = corners[np.sign(corners[:, :, 0].mean(axis=1)) == sign][:, :, 2]
        height = (z.min() + z.max()) / 2
        across = np.linspace(-0.25, 0.25, 200)
        start = np.column_stack([np.full(200, sign * 5.0), sign * across, np.full(200, height)])
        found, row = street.shot(start, (-sign, 0.0, 0.0), feature=77)
        assert plate[row].all()
        drawn = sample(
            plate_levels(77), np.column_stack([across, np.zeros(200)]), width=np.full(200, 0.001), side=0.52
        )
        np.testing.assert_allclose(found.astype(int), drawn.astype(int), atol=3)
        assert (found.max(axis=1) < 80).any()
    assert not np.array_equal(plate_levels(77)[0], plate_levels(78)[0])


def test_people_wear_different_clothes_and_keep_their_own():
    body = catalogue()["adult/navy/0"]
    street = Street(body.mesh)
    chest = [[3.0, 0.0, 0.72 * body.height]]
    first = [street.shot(chest, (-1.0, 0.0, 0.0), feature=k)[0][0] for k in range(40)]
    again = [street.shot(chest, (-1.0, 0.0, 0.0), feature=k)[0][0] for k in range(40)]
    np.testing.assert_array_equal(first, again)
    assert len(np.unique(first, axis=0)) > 2 * len(CLOTHES)


def test_cars_keep_the_colours_of_the_catalogue_but_for_their_shade():
    for name, (paint, _) in PAINTS.items():
        street = Street(catalogue()[f"sedan/{name}"].mesh)
        down = [[-0.5, 0.0, 5.0]], (0.0, 0.0, -1.0)
        roof = [street.shot(*down, feature=k)[0][0].astype(int) for k in range(9)]
        assert len(np.unique(roof, axis=0)) > 1
        np.testing.assert_allclose(np.mean(roof, axis=0), paint, atol=2 + 0.06 * max(paint))


def test_plates_of_signs_have_their_centre_where_faces_are_drawn():
    for name in OF_SHAPE:
        mesh = shapes()[name]
        front = mesh.material == materials()["retroreflector"].code
        assert (mesh.klass[front] == Class.TRAFFIC_SIGN).all()
        corners = mesh.vertices[mesh.faces[front]].reshape(-1, 3)
        outline = np.unique(corners[:, 1:], axis=0)
        assert outline.mean(axis=0) == pytest.approx([0.0, SIGN_HEIGHT], abs=0.02)
        assert np.abs(outline - [0.0, SIGN_HEIGHT]).max() < 0.75
