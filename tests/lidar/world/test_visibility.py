"""Visible share of a road user from a point and in an image; velocities of points on it."""

import numpy as np
import pytest
import shapely
from helpers.sensor_worlds import box, world
from hypothesis import given, settings
from hypothesis import strategies as st

from geoscene.classes import Class
from lidar.sensors.camera.outline import outline
from lidar.sensors.laser.doppler import surface_velocity
from lidar.world.actor_shapes import ActorShape
from lidar.world.actors import Actors
from lidar.world.visibility import Visibility

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
