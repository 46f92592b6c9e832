"""Defences on frames with forged cars and missing returns, against the same frames as they were measured."""

import numpy as np
import pytest
from helpers.forgery import CAR, observed, with_car
from helpers.sensor_worlds import box, world

from geoscene.classes import Class
from lidar.defences.occlusion import Occlusion
from lidar.defences.shadow import Shadow

STREET = (
    box((-60, -60, -1), (60, 60, 0), feature=7, klass=Class.ROAD, material="asphalt"),
    box((-40, 12, 0), (40, 14, 8), feature=8),
    box((30, -8, 0), (32, 8, 6), feature=9),
)
GENUINE = (9.0, -3.0)


def car(x, y):
    """A solid with the size of a car."""
    length, width, height = CAR
    return box((x - length / 2, y - width / 2, 0.2), (x + length / 2, y + width / 2, height), klass=Class.CAR)


@pytest.fixture(scope="module")
def frame():
    return observed(world(*STREET, car(*GENUINE)))[0]


def judged(defence, *frames, scene=None):
    return defence.judge(frames, scene=scene, rng=np.random.default_rng(1))


def split(frame, forged, suspicion):
    """Greatest suspicion of the boxes with mostly forged returns, and of the others."""
    is_forged = np.array([len(rows) > 0 and forged[rows].mean() > 0.5 for rows in frame.members])
    assert is_forged.any(), "the detector finds the forged car"
    return suspicion[is_forged].max(), suspicion[~is_forged].max(initial=0)


@pytest.mark.parametrize(("defence", "points"), [(Occlusion(), 60), (Occlusion(), 200), (Shadow(), 60)])
def test_a_car_of_few_points_lets_rays_pass_and_a_genuine_one_does_not(frame, defence, points):
    attacked, forged = with_car(frame, (9.0, 4.0, -0.98), points=points)
    verdict = judged(defence, attacked)
    fake, genuine = split(attacked, forged, verdict.objects)
    assert fake > 0.3 > 2 * genuine
    assert verdict.frame == fake
    assert verdict.returns[forged].mean() > 5 * verdict.returns[~forged].mean()
    assert judged(defence, frame).frame < 0.15


def test_a_car_that_stops_every_ray_is_beyond_occlusion_and_shadow(frame):
    """What the physics allows: an attacker who replaces all echoes of a car leaves nothing behind it."""
    attacked, forged = with_car(frame, (9.0, 4.0, -0.98), points=10**6, noise=0.0, window=np.pi)
    for defence in (Occlusion(), Shadow()):
        assert split(attacked, forged, judged(defence, attacked).objects)[0] < 0.3
