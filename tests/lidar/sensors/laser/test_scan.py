"""Scans of small worlds."""

from dataclasses import fields, replace

import numpy as np
import pytest
from helpers.sensor_worlds import MeshWorld, box, driven, plate, world

from geoscene.classes import Class, materials
from lidar.geometry.attitude import Mount
from lidar.sensors.laser.scan import cast, scan
from lidar.sensors.physics.settings import LEVELS, PLAIN, ScannerSettings
from lidar.sensors.rig.scanner import firings, load_sensor
from lidar.sensors.rig.specs import load_rig

ROOF = Mount((1.2, 0.0, 1.9))
ROOM = world(
    box((-40, -30, -1), (40, 30, 0), feature=7, klass=Class.ROAD, material="asphalt"),
    box((12, -20, 0), (15, 25, 9), feature=8),
    box((-30, 6, 0), (10, 7, 3), feature=9, klass=Class.WALL, material="concrete"),
)


def same(a, b):
    return all(np.array_equal(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))


def placed(cloud, mount, trajectory):
    """Scene coordinates of a cloud's points, each from the pose of its own time."""
    poses = trajectory.at(cloud.start_ns + cloud.time_ns.astype(np.int64)).mounted(
        mount.translation, mount.rotation
    )
    return poses.place(cloud.xyz.astype(float))


def test_points_of_a_moving_turning_vehicle_lie_on_the_surfaces():
    drive = driven((20.0, 3.0, 0.0), yaw_rate=0.8, start=(-20, -10, 0))
    sensor = load_sensor("vlp16")
    cloud = scan(sensor, ROOF, trajectory=drive, world=ROOM, frame=3)
    p = placed(cloud, ROOF, drive)
    assert len(cloud) > 5000
    on = {
        7: np.abs(p[:, 2]),
        8: np.min(np.abs(p[:, [0, 0, 1, 1, 2]] - [12, 15, -20, 25, 9]), axis=1),
        9: np.min(np.abs(p[:, [0, 0, 1, 1, 2]] - [-30, 10, 6, 7, 3]), axis=1),
    }
    for feature, off in on.items():
        mine = cloud.feature == feature
        assert mine.any()
        assert off[mine].max() < 2e-5  # float32 metres


def test_one_pose_per_frame_distorts_the_cloud():
    drive = driven((20.0, 0.0, 0.0), start=(-20, -10, 0))
    one_pose = ScannerSettings(poses="frame")
    cloud = scan(load_sensor("vlp16"), ROOF, trajectory=drive, world=ROOM, frame=3, settings=one_pose)
    assert not cloud.time_ns.any()
    late = replace(cloud, time_ns=np.full(len(cloud), 90_000_000, np.int32))
    moved = placed(late, ROOF, drive) - placed(cloud, ROOF, drive)
    assert moved[:, 0] == pytest.approx(1.8, abs=1e-4)


def test_one_pose_per_column_is_that_of_its_first_pulse():
    drive, sensor = driven((20.0, 0.0, 0.0), start=(-20, -10, 0)), load_sensor("vlp16")
    by_column = ScannerSettings(poses="column")
    sweep = cast(sensor, ROOF, trajectory=drive, world=ROOM, frame=3, settings=by_column)
    own, shared = firings(sensor, 3), sweep.firings
    assert (np.diff(own.column) >= 0).all()
    late = own.time_ns - shared.time_ns
    assert 0 == late.min() < late.max() < 55_296
    assert (np.diff(shared.time_ns)[np.diff(shared.column) == 0] == 0).all()
    exact = cast(sensor, ROOF, trajectory=drive, world=ROOM, frame=3)
    _, one, two = np.intersect1d(exact.echoes.pulse, sweep.echoes.pulse, return_indices=True)
    off = np.abs(exact.echoes.range[one] - sweep.echoes.range[two])
    assert 0 < np.quantile(off, 0.9) < 20 * 55.296e-6


def test_ranges_are_true_metres_where_the_projection_stretches():
    """A wall 10 true metres ahead of the sensor is 10.4 grid metres ahead in a grid of scale 1.04."""
    scale = 1.04
    cloud = scan(
        load_sensor("utm30lx"),
        Mount(),
        trajectory=driven(scale=scale),
        world=world(plate(10 * scale)),
        frame=0,
    )
    ahead = np.argmin(np.abs(cloud.xyz[:, 1]))
    assert cloud.range[ahead] == pytest.approx(10.0, abs=1e-9)


def test_intensity_is_reflectance_times_cosine():
    cloud = scan(
        load_sensor("vlp16"),
        Mount((0, 0, 2.0)),
        trajectory=driven(),
        world=world(plate(8.0, material="brick")),
        frame=0,
    )
    expected = 100 * materials()["brick"].reflectance[0] * np.cos(cloud.incidence)
    assert cloud.intensity == pytest.approx(expected, rel=1e-5)
    assert cloud.intensity.max() > 39
    # At normal incidence the beam's direction is the wall's normal.
    x = cloud.xyz - firings(load_sensor("vlp16"), 0).origin[0]
    assert np.cos(cloud.incidence) == pytest.approx(cloud.xyz[:, 0] / np.linalg.norm(x, axis=1), abs=5e-3)


def test_the_range_has_hard_limits():
    vlp16 = load_sensor("vlp16")
    near = scan(vlp16, Mount(), trajectory=driven(), world=world(plate(0.49)), frame=0)
    assert near.range.min() >= 0.5
    far = scan(vlp16, Mount(), trajectory=driven(), world=world(plate(99.0)), frame=0)
    # No beam is level: the nearest points are at 1 degree.
    assert far.range.min() == pytest.approx(99.0 / np.cos(np.radians(1)), abs=1e-3)
    assert far.range.max() <= 100.0
    assert len(scan(vlp16, Mount(), trajectory=driven(), world=world(plate(100.01)), frame=0)) == 0


def test_a_surface_within_the_minimum_range_still_occludes():
    blocked = world(box((0.1, -5, -5), (0.2, 5, 5)), plate(10.0, feature=3))
    cloud = scan(load_sensor("vlp16"), Mount(), trajectory=driven(), world=blocked, frame=0)
    assert np.abs(cloud.xyz[cloud.feature == 3, 1]).min(initial=99) > 5


@pytest.mark.full
def test_a_frame_scanned_alone_equals_that_of_a_run():
    sensor = load_sensor("vlp16")
    drive = driven((10.0, 0.0, 0.0), start=(-20, -10, 0))
    run = [
        scan(sensor, ROOF, trajectory=drive, world=ROOM, frame=k, seed=5, settings=LEVELS["survey"])
        for k in range(3)
    ]
    alone = scan(
        load_sensor("vlp16"),
        ROOF,
        trajectory=drive,
        world=ROOM,
        frame=2,
        seed=5,
        settings=LEVELS["survey"],
        threads=2,
    )
    assert same(run[2], alone)
    assert not np.array_equal(
        run[2].range,
        scan(sensor, ROOF, trajectory=drive, world=ROOM, frame=2, seed=6, settings=LEVELS["survey"]).range,
    )


def test_every_setting_changes_the_returns_and_none_is_on_by_default():
    """Each setting alone changes the returns, in a world that has what it acts on."""
    sensor = load_sensor("vlp16", return_mode="dual")
    scene = world(
        ROOM.mesh,
        box((5, -8, 0), (5.2, -6, 3), feature=10, material="glass"),
        box((3, 3, 0), (3.5, 3.1, 2.5), feature=11, klass=Class.TRAFFIC_SIGN, material="retroreflector"),
    )
    turned = {
        "poses": "column",
        "law": "oren-nayar",
        "spread": 0.2,
        "link": True,
        "detection": True,
        "rays": 7,
        "mirrors": True,
        "blooming": True,
        "interference": 2000,
        "range_noise": "signal",
        "stretch": True,
        "bias": True,
        "walk": True,
        "quantise": True,
    }
    drive = driven((10.0, 0.0, 0.0), start=(-20, -10, 0))
    plain = scan(sensor, ROOF, trajectory=drive, world=scene, frame=0, settings=PLAIN)
    assert np.array_equal(plain.range, plain.true_range)
    for name, value in turned.items():
        assert getattr(ScannerSettings(), name) == type(value)() or name in (
            "poses",
            "law",
            "rays",
            "range_noise",
        )
        other = scan(
            sensor, ROOF, trajectory=drive, world=scene, frame=0, settings=ScannerSettings(**{name: value})
        )
        assert not same(plain, other), name


def test_the_seed_rig_scans():
    rig = load_rig("seed")
    drive = driven((5.0, 0.0, 0.0), start=(-10, -5, 0))
    for spec in rig.lidars:
        sensor = load_sensor(spec.preset, name=spec.name, rate_hz=spec.rate_hz)
        assert len(scan(sensor, spec.mount, trajectory=drive, world=ROOM, frame=0)) > 500


def test_chosen_pulses_of_a_frame_give_their_own_echoes():
    sensor, rows = load_sensor("vlp16"), np.arange(5, 20_000, 37)
    common = {"trajectory": driven((3.0, 0.0, 0.0)), "world": world(plate(10.0)), "frame": 2}
    whole = cast(sensor, Mount(), **common)
    part = cast(sensor, Mount(), pulses=rows, **common)
    chosen = np.isin(whole.echoes.pulse, rows)
    assert rows[part.echoes.pulse].tolist() == whole.echoes.pulse[chosen].tolist()
    np.testing.assert_array_equal(part.echoes.range, whole.echoes.range[chosen])


def test_cheap_casts_change_ranges_by_less_than_their_bound():
    drive = driven((20.0, 3.0, 0.0), yaw_rate=0.8, start=(-20, -10, 0))
    exact, cheap = (
        scan(load_sensor("vlp16"), ROOF, trajectory=drive, world=ROOM, frame=3, settings=settings)
        for settings in (ScannerSettings(), ScannerSettings(precision="float32", retrace=False))
    )
    pulses = [cloud.column * np.int64(16) + cloud.ring for cloud in (exact, cheap)]
    both, one, two = np.intersect1d(*pulses, return_indices=True)
    assert len(both) >= len(exact) - 2  # beside the faces' edges
    off = np.abs(cheap.range[two] - exact.range[one]) * np.cos(exact.incidence[one])
    assert 0 < np.median(off) < off[cheap.feature[two] == exact.feature[one]].max() < 4e-4


def test_nothing_beyond_the_reach_of_the_world_returns():
    near = MeshWorld(ROOM.mesh)
    near.reach = 8.0
    whole, part = (
        scan(load_sensor("vlp16"), ROOF, trajectory=driven(), world=one, frame=0) for one in (ROOM, near)
    )
    within = whole.range <= 8.0
    assert 0 < within.sum() < len(whole)
    np.testing.assert_array_equal(part.range, whole.range[within])


ROAD = box((-200, -200, -1), (200, 200, 0), feature=7, klass=Class.ROAD, material="asphalt")
BEYOND = box((12, -20, 0), (15, 25, 9), feature=8)


def on_road(**settings):
    """Ranges and intensities of the returns of a road in a world with these settings."""
    cloud = scan(
        load_sensor("hdl32e"),
        ROOF,
        trajectory=driven(),
        world=world(ROAD, BEYOND, **settings),
        frame=0,
        settings=ScannerSettings(link=True),
    )
    return cloud, cloud.feature == 7


def test_returns_of_a_wet_road_vanish_the_farthest_first():
    count, farthest = [], []
    for wetness in (0.0, 0.3, 0.7, 1.0):
        cloud, road = on_road(wetness=wetness)
        count.append(np.count_nonzero(road))
        farthest.append(np.quantile(cloud.range[road], 0.999))
    assert count == sorted(count, reverse=True)
    assert count[-1] < 0.9 * count[0]
    assert farthest == sorted(farthest, reverse=True)
    assert farthest[-1] < 0.75 * farthest[0]


def test_walls_stay_dry_and_without_snow():
    (dry, _), (wet, _) = on_road(), on_road(wetness=1.0, snow=0.5)
    assert np.array_equal(dry.intensity[dry.feature == 8], wet.intensity[wet.feature == 8])


def test_snow_is_bright_at_905_nm():
    (dry, road), (snowy, under) = on_road(), on_road(snow=1.0)
    assert np.median(snowy.intensity[under][:100]) > 3 * np.median(dry.intensity[road][:100])
