"""Rays through crowns and hedges."""

import numpy as np
import pytest
from helpers.sensor_worlds import LEAVES, box, driven, plate, world

from geoscene.classes import Class
from lidar.geometry.attitude import Mount
from lidar.sensors.laser.scan import scan
from lidar.sensors.laser.surface_echoes import PROJECTION
from lidar.sensors.physics.settings import ScannerSettings
from lidar.sensors.rig.scanner import load_sensor

HERE = Mount((0.0, 0.0, 0.0))
BARE, LEAFY = ScannerSettings(), ScannerSettings(foliage=True)


def hedge(low, high, feature=7):
    return box(low, high, feature=feature, klass=Class.HEDGE, material="foliage")


def seen(scene, settings=LEAFY, *, name="hdl64e_s3", frame=0, seed=1, start=(0, 0, 0), **options):
    return scan(
        load_sensor(name),
        HERE,
        trajectory=driven(start=start),
        world=scene,
        frame=frame,
        seed=seed,
        settings=settings,
        **options,
    )


def along(cloud):
    """Cosine of each beam with the x axis."""
    xyz = cloud.xyz.astype(float)
    return xyz[:, 0] / np.linalg.norm(xyz, axis=1)


@pytest.mark.parametrize("depth", [0.5, 2.0, 5.0])
def test_transmission_follows_the_beer_lambert_law(depth):
    slab, wall = hedge((10, -40, -40), (10 + depth, 40, 40)), plate(30.0, feature=3)
    cloud = seen(world(slab, wall))
    ahead = along(cloud) > 0.7
    length = depth / along(cloud)[ahead]
    passed = cloud.feature[ahead] == 3
    expected = np.exp(-PROJECTION * LEAVES * length)
    spread = np.sqrt((expected * (1 - expected)).sum()) / len(expected)
    assert len(expected) > 20_000
    assert passed.mean() == pytest.approx(expected.mean(), abs=4 * spread)


def test_hits_in_foliage_have_exponential_depths_and_random_incidence():
    cloud = seen(world(hedge((10, -400, -400), (200, 400, 400))))
    front = along(cloud) > 0.7
    depth = cloud.range[front] - 10 / along(cloud)[front]
    assert depth.min() >= -0.02  # beams start a little off the middle
    mean = 1 / (PROJECTION * LEAVES)
    assert depth.mean() == pytest.approx(mean, rel=0.03)
    assert np.quantile(depth, 0.9) == pytest.approx(mean * np.log(10), rel=0.03)
    assert np.cos(cloud.incidence[front]).mean() == pytest.approx(2 / 3, rel=0.02)
    assert (cloud.klass[front] == Class.HEDGE).all()
    assert (cloud.feature[front] == 7).all()


def test_surfaces_behind_foliage_keep_their_exact_range():
    slab, wall = hedge((10, -40, -40), (11, 40, 40)), plate(30.0, feature=3)
    through, bare = seen(world(slab, wall)), seen(world(wall), BARE)
    behind = through.feature == 3
    key = {(int(r), int(t)): d for r, t, d in zip(bare.ring, bare.time_ns, bare.range, strict=True)}
    ranges = [key[int(r), int(t)] for r, t in zip(through.ring[behind], through.time_ns[behind], strict=True)]
    assert through.range[behind] == pytest.approx(ranges, abs=1e-9)


def test_a_ray_that_starts_inside_a_crown_hits_a_leaf_or_leaves_it():
    around = world(hedge((-2, -2, -2), (2, 2, 2)), plate(30.0, feature=3))
    cloud = seen(around, name="vlp16")
    passed = (along(cloud) > 0.9) & (cloud.feature == 3)
    # Nothing is reported below the minimum range: count passed rays against fired ones.
    fired = along(seen(world(plate(30.0, feature=3)), BARE, name="vlp16"))
    expected = np.exp(-PROJECTION * LEAVES * 2 / fired[fired > 0.9])
    assert passed.sum() / len(expected) == pytest.approx(expected.mean(), abs=0.03)


def test_densities_of_overlapping_crowns_add_up():
    both = world(
        hedge((10, -40, -40), (12, 40, 40), 7),
        hedge((10.5, -39, -39), (12.5, 39, 39), 8),
        plate(30.0, feature=3),
    )
    cloud = seen(both)
    ahead = along(cloud) > 0.9
    expected = np.exp(-PROJECTION * LEAVES * 4 / along(cloud)[ahead])
    assert (cloud.feature[ahead] == 3).mean() == pytest.approx(expected.mean(), abs=0.01)


def test_hits_in_foliage_differ_between_frames_but_not_with_threads():
    scene = world(hedge((10, -40, -40), (12, 40, 40)), plate(30.0, feature=3))
    one, two = seen(scene), seen(scene, threads=2)
    assert np.array_equal(one.range, two.range)
    other = seen(scene, frame=1)
    assert not np.array_equal(one.range[:1000], other.range[:1000])
    assert not np.array_equal(one.range, seen(scene, seed=2).range)


def test_hedges_are_opaque_by_default():
    cloud = seen(world(hedge((10, -40, -40), (12, 40, 40)), plate(30.0, feature=3)), BARE)
    assert (cloud.feature[along(cloud) > 0.9] == 7).all()
