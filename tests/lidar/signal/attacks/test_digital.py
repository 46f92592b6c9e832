"""Attacks on recorded data: bounds and budgets, truth, navigation and images."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from geoscene.classes import Class
from geoscene.geometry.frames import Frame as SceneFrame
from lidar.errors import InputError
from lidar.geometry.attitude import OPTICAL_QUAT, Mount
from lidar.geometry.poses import Trajectory
from lidar.sensors.camera.render import CameraImage
from lidar.sensors.laser.cloud import Cloud
from lidar.sensors.navigation.measurements import Fixes
from lidar.sensors.physics.origin import Origin
from lidar.sensors.rig.specs import CameraSpec
from lidar.signal.registry import stages_of
from lidar.signal.run import altered_cloud
from lidar.signal.situation import Situation
from lidar.signal.truth import Altered, cloud_truth, trace_unaltered

CAMERA = CameraSpec("front", Mount(), 80, 60, 40.0, 40.0, 39.5, 29.5)


def cloud(n=4000, *, seed=0):
    """Returns all around between 5 and 40 m; those of a car ahead, 8 m away."""
    rng = np.random.default_rng(seed)
    azimuth, ring = rng.uniform(-np.pi, np.pi, n), rng.integers(0, 16, n)
    elevation, away = np.radians(ring * 2.0 - 15), rng.uniform(5, 40, n)
    car = (np.abs(azimuth) < 0.1) & (ring < 8)
    away[car] = 8.0
    way = np.column_stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth)])
    xyz = away[:, None] * np.column_stack([way, np.sin(elevation)])
    return Cloud(
        0,
        xyz.astype(np.float32),
        np.sort(rng.integers(0, 10**8, n)).astype(np.int32),
        ring.astype(np.uint16),
        np.arange(n, dtype=np.int32),
        away,
        rng.uniform(0, 100, n).astype(np.float32),
        np.where(car, Class.CAR, Class.ROAD).astype(np.uint8),
        np.where(car, 900, 5).astype(np.int32),
        np.zeros(n, np.float32),
        away,
        *np.ones((2, n), np.uint8),
    )


def attacked(original, *, start_ns=0, **table):
    stages, at = stages_of([table], seed=5), Situation("top", 3, start_ns=start_ns)
    return Altered(altered_cloud(trace_unaltered(original).cloud, stages, at=at), original)


def restored(altered):
    """The original, put together from the attacked cloud and its truth."""
    truth = cloud_truth(altered, start_ns=0)
    xyz = np.full_like(altered.original.xyz, np.nan)
    kept = (altered.cloud.source >= 0) & (altered.cloud.origin != Origin.MOVED)
    xyz[altered.cloud.source[kept]] = altered.cloud.xyz[kept]
    xyz[truth["removed"]] = truth["removed_xyz"]
    return xyz


ALL = [
    {"name": "perturb", "bound": 0.3},
    {"name": "perturb", "bound": 0.3, "how": "beam", "share": 0.4},
    {"name": "insert", "distance": 6.0},
    {"name": "insert", "distance": 6.0, "replaces": False},
    {"name": "delete", "target": "road_user"},
    {"name": "delete", "distance": 12.0, "long": 10.0, "wide": 10.0, "high": 6.0},
    {"name": "move", "target": "road_user", "turn": 30.0},
    {"name": "false_weather", "share": 0.3},
]


@pytest.mark.parametrize("table", ALL, ids=lambda t: f"{t['name']}-{len(t)}")
def test_truth_gives_the_original_back(table):
    original = cloud()
    found = attacked(original, **table)
    assert len(cloud_truth(found, start_ns=0)["removed"]) or not table.get("replaces", True)
    np.testing.assert_array_equal(restored(found), original.xyz)
    longer = np.linalg.norm(found.cloud.xyz, axis=1) - found.cloud.range
    np.testing.assert_allclose(longer, 0, atol=1e-4)
    again = attacked(original, **table)
    np.testing.assert_array_equal(again.cloud.xyz, found.cloud.xyz)


@pytest.mark.parametrize("table", ALL, ids=lambda t: f"{t['name']}-{len(t)}")
def test_the_budget_and_the_times_hold(table):
    original = cloud()
    few = attacked(original, **table | {"points": 7})
    touched = (few.cloud.origin != Origin.SURFACE).sum() + len(original) - (few.cloud.source >= 0).sum()
    changed = max((few.cloud.origin != Origin.SURFACE).sum(), len(original) - len(few.cloud))
    assert changed == 7
    assert touched in (7, 14)
    late = attacked(original, start_ns=int(2e9), **table | {"stop": 2.0})
    np.testing.assert_array_equal(late.cloud.xyz, original.xyz)
    early = attacked(original, start_ns=int(2e9) - 1, **table | {"start": 2.0})
    np.testing.assert_array_equal(early.cloud.xyz, original.xyz)


@settings(max_examples=25, deadline=None)
@given(bound=st.floats(0, 10), how=st.sampled_from(["ball", "beam"]), seed=st.integers(0, 99))
def test_no_return_is_shifted_beyond_the_bound(bound, how, seed):
    original = cloud(300, seed=seed)
    found = attacked(original, name="perturb", bound=bound, how=how).cloud
    shift = np.linalg.norm(found.xyz.astype(float) - original.xyz, axis=1)
    assert shift.max() <= bound + 1e-5
    assert (found.origin == Origin.MOVED).all()


def test_an_inserted_box_lies_on_beams_and_casts_a_shadow():
    original = cloud(20_000)
    found = attacked(original, name="insert", distance=6.0, noise=0.0).cloud
    new = found.origin == Origin.INJECTED
    way, before = (v / np.linalg.norm(v, axis=1)[:, None] for v in (found.xyz[new], original.xyz[new]))
    np.testing.assert_allclose(way, before, atol=1e-6)
    assert (found.range[new] < original.range[found.hidden[new]]).all()
    assert found.xyz[new].min(axis=0) == pytest.approx([3.75, -0.9, -1.03], abs=0.1)
    behind = np.abs(np.degrees(np.arctan2(found.xyz[:, 1], found.xyz[:, 0]))) < 6
    behind &= (found.ring >= 2) & (found.ring <= 4)
    assert not (behind & ~new & (found.range > 9)).any()
    careless = attacked(original, name="insert", distance=6.0, noise=0.0, replaces=False).cloud
    assert len(careless) == len(original) + new.sum()
    assert (np.diff(careless.time_ns) >= 0).all()
    assert (careless.hidden == -1).all()


def test_the_nearest_road_user_is_deleted_or_moved():
    original = cloud()
    car = original.feature == 900
    assert (attacked(original, name="delete", target="road_user").cloud.feature != 900).all()
    moved = attacked(original, name="move", target="road_user", left=3.0, ahead=-1.0).cloud
    np.testing.assert_allclose(
        moved.xyz[car] - original.xyz[car], np.tile([-1, 3, 0], (car.sum(), 1)), atol=1e-5
    )
    np.testing.assert_array_equal(moved.xyz[~car], original.xyz[~car])
    none = replace(original, feature=np.full(len(original), -1, np.int32))
    np.testing.assert_array_equal(attacked(none, name="delete", target="road_user").cloud.xyz, none.xyz)


def test_false_weather_is_near_and_dark():
    original = cloud(20_000)
    found = attacked(original, name="false_weather", share=0.2).cloud
    new = found.origin == Origin.INJECTED
    assert 0.15 < new.mean() < 0.2  # some would be behind the genuine return
    assert (found.range[new] < original.range[new]).all()
    assert found.range[new].min() >= 1.5
    assert found.intensity[new].mean() == pytest.approx(3, rel=0.1)


def fixes(n=400, *, speed=10.0, course=0.5):
    none = np.zeros(n, np.int8)
    lonlath = np.tile([9.5, 47.1, 450.0], (n, 1))
    lonlath[3] = np.nan
    full = np.full(n, speed), np.full(n, course)
    empty = np.zeros((n, 3))
    return Fixes(
        (np.arange(n) * 1e8).astype(np.int64),
        *(none, none, none, empty, lonlath, *full, empty, empty, empty),
        np.zeros((n, 0), bool),
        np.empty(0, str),
    )


def offset(found, before):
    """Metres east, north, up (n, 3) in a local frame."""
    frame = SceneFrame.at(9.5, 47.1)
    x, y = frame.from_geographic(found.lonlath[:, 0], found.lonlath[:, 1])
    x0, y0 = frame.from_geographic(before.lonlath[:, 0], before.lonlath[:, 1])
    return np.column_stack([x - x0, y - y0, found.lonlath[:, 2] - before.lonlath[:, 2]])


@pytest.mark.parametrize("kind", ["step", "ramp", "smooth"])
def test_a_spoofed_receiver_is_led_away_as_told(kind):
    before = fixes()
    table = {"name": "gnss_spoof", "kind": kind, "left": 0.0, "east": 3.0, "north": -4.0, "up": 1.0}
    stage = stages_of([table | {"start": 5.0, "ramp": 20.0, "stop": 30.0}]).stages[0].stage
    found = stage.fixes(before, at=Situation("gnss", 0), rng=np.random.default_rng(0))
    away, time = offset(found, before), before.time_ns / 1e9
    seen = ~np.isnan(before.lonlath[:, 0])
    np.testing.assert_array_equal(found.lonlath[seen & ((time < 5) | (time >= 30))][:, 0], 9.5)
    np.testing.assert_allclose(away[(time > 25) & (time < 30)], np.tile([3, -4, 1], (49, 1)), atol=5e-3)
    assert np.isnan(found.lonlath[3]).all()
    middle = away[time == 15.0][0]
    np.testing.assert_allclose(middle, np.array([3, -4, 1]) * (1 if kind == "step" else 0.5), atol=5e-3)
    # Speed and course are those of the spoofed positions.
    drift = np.diff(away[:, :2], axis=0) / 0.1
    true = 10 * np.array([np.sin(0.5), np.cos(0.5)])
    velocity = found.speed[:, None] * np.column_stack([np.sin(found.course), np.cos(found.course)])
    inside = (time[:-1] > 6) & (time[:-1] < 24)
    middles = (velocity[1:] + velocity[:-1]) / 2
    np.testing.assert_allclose(middles[inside], (true + drift)[inside], atol=0.02)


@pytest.mark.parametrize(("course", "left"), [(np.pi / 2, [0, 3, 0]), (0.0, [-3, 0, 0])])
def test_an_offset_to_the_left_is_across_the_driven_direction(course, left):
    stage = stages_of([{"name": "gnss_spoof", "kind": "step", "left": 3.0, "start": 0.0}]).stages[0].stage
    before = fixes(course=course)  # clockwise from north
    found = stage.fixes(before, at=Situation("gnss", 0), rng=np.random.default_rng(0))
    np.testing.assert_allclose(offset(found, before)[10], left, atol=5e-3)


def picture(depth=20.0):
    shape = (60, 80)
    rgb = np.full((*shape, 3), 90, np.uint8)
    return CameraImage(
        rgb, np.full(shape, depth, np.float32), np.zeros(shape, np.uint8), np.zeros(shape, np.int32)
    )


def photographed(frame, *, poses=None, geo=None, **table):
    stage = stages_of([table]).stages[0].stage
    at = Situation("front", 0, camera=CAMERA, poses=poses, geo=geo)
    return stage.image(frame, at=at, rng=np.random.default_rng(0)).rgb


def test_a_lamp_saturates_around_its_direction_and_veils_the_rest():
    rgb = photographed(picture(), name="camera_blind", right=20.0, power=100.0, core=0.5)
    column = round(39.5 + 40 * np.tan(np.radians(20)))
    assert (rgb[30, column] == 255).all()
    assert (rgb >= 90).all()
    assert rgb[30, 0].max() < 255  # 5 degrees around the lamp are saturated: power * core^2 / angle^2 = 1
    saturated = (rgb == 255).all(axis=2)
    assert 5 < saturated[30].sum() < 12
    red = photographed(picture(), name="camera_blind", tint="red", power=100.0)[30, 50].astype(int)
    assert red[0] > red[1] > red[2] >= 90


def test_a_patch_on_the_image_covers_its_share(tmp_path):
    Image.fromarray(np.full((10, 20, 3), [255, 0, 0], np.uint8)).save(tmp_path / "red.png")
    rgb = photographed(picture(), name="patch", file=str(tmp_path / "red.png"), size=0.25, x=0.5, y=0.5)
    red = (rgb == [255, 0, 0]).all(axis=2)
    rows, columns = np.flatnonzero(red.any(axis=1)), np.flatnonzero(red.any(axis=0))
    assert (len(rows), len(columns)) == (10, 20)
    assert columns.mean() == pytest.approx(39.5)


def test_a_patch_in_the_world_has_its_size_and_is_hidden_by_nearer_surfaces(tmp_path):
    Image.fromarray(np.full((4, 4, 3), [0, 255, 0], np.uint8)).save(tmp_path / "green.png")
    table = {"name": "patch", "on": "world", "file": str(tmp_path / "green.png"), "wide": 2.0, "ahead": 8.0}
    green = (photographed(picture(), **table) == [0, 255, 0]).all(axis=2)
    assert green.sum() == pytest.approx((40 * 2 / 8) ** 2, rel=0.05)
    assert not (photographed(picture(depth=5.0), **table) == [0, 255, 0]).all(axis=2).any()


def test_a_patch_at_a_place_is_seen_from_its_front_only(tmp_path):
    Image.fromarray(np.full((4, 4, 3), [0, 255, 0], np.uint8)).save(tmp_path / "green.png")
    geo = SceneFrame.at(9.5, 47.1)
    lon, lat = geo.to_geographic(10.0, 0.0)  # 10 m east of the camera, which looks east
    track = Trajectory(
        np.array([0, 10**9]), np.zeros((2, 3)), np.tile([0.0, 0, 0, 1], (2, 1)), np.zeros((2, 3)), np.ones(2)
    )
    mount = Mount((0, 0, 0), OPTICAL_QUAT)
    known = {
        "poses": lambda time_ns: track.at(time_ns).mounted(mount.translation, mount.rotation),
        "geo": geo,
        "place": f"{float(lat):.9f},{float(lon):.9f},0",
    }
    table = {"name": "patch", "on": "world", "file": str(tmp_path / "green.png"), "wide": 2.0, **known}
    front = (photographed(picture(), **table, facing=270.0) == [0, 255, 0]).all(axis=2)
    assert front.sum() == pytest.approx((40 * 2 / 10) ** 2, rel=0.3)
    assert np.argwhere(front).mean(axis=0) == pytest.approx([29.5, 39.5], abs=0.6)
    assert not (photographed(picture(), **table, facing=90.0) == [0, 255, 0]).all(axis=2).any()


@pytest.mark.parametrize(
    ("table", "says"),
    [
        ({"name": "perturb", "bound": 11.0}, "bound = 11 is not within 0 to 10"),
        ({"name": "move", "target": "bus"}, "target = 'bus' is none of box, road_user"),
        ({"name": "patch", "file": "none.png"}, "file = 'none.png' cannot be read as a picture"),
        ({"name": "patch", "place": "here"}, "place = 'here' is not LAT,LON,HEIGHT"),
        ({"name": "perturb", "start": 5.0, "stop": 2.0}, "stop = 2 is not after start = 5"),
        ({"name": "inject", "start": -1.0}, "start = -1 is not at least 0 s"),
        ({"name": "gnss_spoof", "kind": "jump"}, "kind = 'jump' is none of step, ramp, smooth"),
    ],
)
def test_bad_parameters_are_one_line(table, says):
    with pytest.raises(InputError, match=says):
        stages_of([table])
