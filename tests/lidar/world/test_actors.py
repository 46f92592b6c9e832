"""Bodies of road users are closed solids with the expected sizes and materials."""

import numpy as np
import pytest
import shapely
import trimesh
from helpers.sensor_worlds import box, world
from hypothesis import given, settings
from hypothesis import strategies as st

from geoscene.classes import Class, materials
from lidar.raycast import Caster
from lidar.sensors.camera.outline import outline
from lidar.sensors.laser.doppler import surface_velocity
from lidar.world.actor_shapes import KINDS, PAINTS, ActorShape, catalogue
from lidar.world.actors import Actors
from lidar.world.visibility import Visibility

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


@pytest.mark.parametrize("kind", ["adult", "small_adult", "child"])
def test_arms_join_the_trunk_at_the_shoulders(kind):
    """From ahead, the highest rows of rays that hit both arms have no gap between an arm and the trunk."""
    for body in [s for s in catalogue().values() if s.kind == kind][:9]:
        caster = Caster(body.mesh.vertices, body.mesh.faces)
        y, z = np.meshgrid(np.arange(-0.3, 0.3, 0.001), np.arange(0.9, 0.7, -0.003) * body.height)
        start = np.stack([np.full(y.size, 3.0), y.ravel(), z.ravel()], axis=1)
        hit = caster.cast(start, np.tile([-1.0, 0.0, 0.0], (len(start), 1))).face.reshape(y.shape) >= 0
        spans = [np.flatnonzero(row) for row in hit]
        wide = [k for k, row in enumerate(spans) if len(row) and np.ptp(row) > 220 * body.height]
        for k in wide[:3]:
            assert np.diff(spans[k]).max() == 1, body.name


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


LENGTH, WIDTH, HEIGHT = 4.0, 2.0, 1.5


def one_car(place=(20.0, 0.0, 0.0), *, yaw=0.0, velocity=(0.0, 0.0, 0.0), turning=0.0, seconds=2.0):
    """One box, feature 100, that drives straight or turns on the spot."""
    mesh = box((-LENGTH / 2, -WIDTH / 2, 0.0), (LENGTH / 2, WIDTH / 2, HEIGHT), klass=Class.CAR)
    shape = ActorShape("box", "sedan", Class.CAR, LENGTH, WIDTH, HEIGHT, 2.5, mesh)
    t = np.arange(0, round(seconds * 1e9) + 1, 100_000_000, dtype=np.int64)
    n, s = len(t), t * 1e-9
    angles = np.zeros((n, 3))
    angles[:, 0] = yaw + turning * s
    return Actors(
        shapes=(shape,),
        shape=np.zeros(1, np.int32),
        poses=np.ones(1, np.int32),
        stride=np.ones(1),
        kind=np.array(["sedan"]),
        klass=np.array([Class.CAR], np.uint8),
        size=np.array([[LENGTH, WIDTH, HEIGHT]]),
        stretch=np.ones((1, 3)),
        parked=np.array([not (any(velocity) or turning)]),
        feature=np.array([100], np.int32),
        first=np.array([0, n]),
        begin_ns=t[:1],
        end_ns=t[-1:],
        time_ns=t,
        position=np.array(place) + s[:, None] * np.array(velocity),
        angles=angles,
        velocity=np.tile(np.array(velocity, float), (n, 1)),
        travelled=np.zeros(n),
        scale=1.0,
    )


def seen(*others, eye=(0.0, 0.0, 0.75), yaw=0.0):
    car = one_car(yaw=yaw)
    c, s = np.cos(yaw), np.sin(yaw)
    mesh = car.shapes[0].mesh
    turned = mesh.vertices @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + [20.0, 0.0, 0.0]
    body = type(mesh).of(
        turned, mesh.faces, feature=100, klass=Class.CAR, material=int(mesh.material[0]), closed=True
    )
    return Visibility(car).seen_from(eye, world(body, *others), rows=np.array([0]), time_ns=0)[0]


@pytest.mark.parametrize("yaw", [0.0, 0.4, 1.2, 3.0])
def test_an_unoccluded_actor_is_fully_visible(yaw):
    assert seen(yaw=yaw) == pytest.approx(1.0)
    behind = box((40.0, -9.0, 0.0), (41.0, 9.0, 9.0), feature=5)
    assert seen(behind, yaw=yaw) == pytest.approx(1.0)


def test_an_actor_behind_a_wall_is_invisible():
    assert seen(box((10.0, -9.0, 0.0), (10.5, 9.0, 9.0), feature=5)) == 0.0


@pytest.mark.parametrize("share", [0.25, 0.5, 0.75])
def test_a_wall_hides_the_part_that_it_covers(share):
    """The end of the car, 2 m wide and 18 m away, behind a wall whose edge is 9 m away."""
    edge = (WIDTH / 2 - share * WIDTH) / 2
    assert seen(box((8.9, edge, 0.0), (9.0, 9.0, 9.0), feature=5)) == pytest.approx(1 - share, abs=0.05)


def test_a_road_user_that_does_not_exist_yet_has_no_row():
    assert (
        Visibility(one_car())
        .seen_from((0, 0, 0), world(box((0, 0, 0), (1, 1, 1))), rows=np.empty(0, int), time_ns=0)
        .size
        == 0
    )


@given(
    st.integers(0, 10_000),
    st.integers(1, 12),
    st.floats(2.0, 200.0),
)
@settings(max_examples=60, deadline=None)
def test_outlines_are_the_union_of_triangles_within_the_image(seed, count, size):
    rng = np.random.default_rng(seed)
    middle = rng.uniform(-40, 140, (count, 1, 2))
    corners = middle + rng.uniform(-size, size, (count, 3, 2))
    frame = shapely.box(-0.5, -0.5, 99.5, 59.5)
    union = shapely.intersection(shapely.union_all(shapely.polygons(corners)), frame)
    bounds, pixels = outline(corners, 100, height=60)
    if union.area < 1e-9:
        assert pixels == 0
        return
    np.testing.assert_allclose(bounds, union.bounds, atol=1e-6)
    u, v = np.meshgrid(np.arange(100), np.arange(60))
    inside = shapely.intersects_xy(shapely.union_all(shapely.polygons(corners)), u.ravel(), v.ravel())
    assert pixels == pytest.approx(inside.sum(), abs=2)  # centres on an edge may fall to either side


def test_triangles_with_nonfinite_corners_are_left_out():
    good = np.array([[[10.0, 10.0], [20.0, 10.0], [10.0, 20.0]]])
    bad = good.copy()
    bad[0, 0, 0] = np.nan
    assert outline(np.concatenate([good, bad]), 100, height=60) == outline(good, 100, height=60)
    bounds, pixels = outline(bad, 100, height=60)
    assert np.isnan(bounds).all()
    assert pixels == 0


def test_points_on_a_car_go_with_it_and_points_on_a_wall_stay():
    car = one_car(velocity=(7.0, -3.0, 0.0))
    where = np.array([[21.0, 0.5, 1.0], [3.0, 3.0, 3.0]])
    found = surface_velocity(
        car, np.array([100, 5]), placed=where, time_ns=np.array([500_000_000, 500_000_000])
    )
    np.testing.assert_allclose(found, [[7.0, -3.0, 0.0], [0, 0, 0]], atol=1e-6)


def test_points_on_a_turning_body_go_round_its_middle():
    car = one_car(turning=0.8)
    where = np.array([[22.0, 0.0, 1.0], [20.0, 1.0, 0.2]])
    found = surface_velocity(car, np.array([100, 100]), placed=where, time_ns=np.full(2, 1_000_000_000))
    np.testing.assert_allclose(found, [[0.0, 1.6, 0.0], [-0.8, 0.0, 0.0]], atol=1e-5)


def test_parked_cars_do_not_move():
    found = surface_velocity(
        one_car(), np.array([100]), placed=np.array([[20.0, 0.0, 1.0]]), time_ns=np.array([10**9])
    )
    assert (found == 0).all()
