"""Road users in a real place: positions, visibility, bounding boxes, no collisions."""

import itertools
import json
from dataclasses import replace

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from geoscene.classes import Class
from lidar.dataset.ground_truth import COLUMNS
from lidar.dataset.layout import Paths
from lidar.errors import DatasetError, InputError
from lidar.geometry.attitude import Mount
from lidar.motion.road_drive import RoadDriveOptions, plan_road_drive
from lidar.motion.vehicle import load_vehicle
from lidar.sensors.camera.render import render
from lidar.sensors.camera.settings import CameraSettings
from lidar.sensors.laser.scan import scan
from lidar.sensors.rig.scanner import load_sensor
from lidar.sensors.rig.specs import CameraSpec
from lidar.simulation.boxes import box_rows, count_points, image_boxes, merge_box_files
from lidar.traffic.ego_drive import drive_with_signals
from lidar.traffic.options import TrafficOptions
from lidar.traffic.populate import populate
from lidar.traffic.sweep import rectangles
from lidar.world.actors import actor_shapes, actor_transforms, existing_actors, rotations, states, velocities
from lidar.world.world import World

CAR = load_vehicle("car")
BUSY = TrafficOptions(vehicles=25.0, cyclists=4.0, pedestrians=40.0, parked=0.7, radius=150.0)


@pytest.fixture(scope="module")
def ego(scene):
    options = RoadDriveOptions("car", seed=2, duration=15.0)
    travel = plan_road_drive(scene, "random", options=options)
    return drive_with_signals(
        travel.path, load_vehicle("car"), graph=scene.road_graph(), seed=2, bounds=scene.bounds,
        duration=15.0, at_speed=travel.at_speed,
    )  # fmt: skip


@pytest.fixture(scope="module")
def actors(scene, ego):
    return populate(scene, scene.road_graph(), ego=ego, vehicle=CAR, seed=5, options=BUSY)


def outlines(actors, rows, t):
    at = states(actors, rows, time_ns=t)
    return rectangles(
        at.position[:, :2], at.angles[:, 0], length=actors.size[rows, 0], width=actors.size[rows, 1]
    )


def test_there_are_road_users_of_every_kind(actors):
    moving = set(actors.kind[~actors.parked])
    assert {"cyclist", "adult"} <= moving
    assert moving & {"sedan", "hatchback", "suv"}
    assert actors.parked.sum() > 5
    assert "bicycle" in actors.kind[actors.parked]
    assert not {"cyclist", "motorcycle"} & set(actors.kind[actors.parked])
    assert not {"bicycle", "parked_motorcycle"} & moving
    v = np.hypot(*actors.velocity[:, :2].T)
    assert 3.0 < v.max() < 20.0
    assert not v[np.repeat(actors.parked, np.diff(actors.first))].any()


def test_no_road_user_touches_another_or_the_ego(actors, ego):
    for t in range(0, ego.duration_ns, 300_000_000):
        rows = existing_actors(actors, t, end_ns=t)
        boxes = outlines(actors, rows, t)
        a, b = shapely.STRtree(boxes).query(boxes, predicate="intersects")
        assert not (a < b).any()
        pose = ego.at([t])
        forward = pose.rotation[:, :2, 0]
        middle = pose.position[:, :2] + (CAR.length / 2 - CAR.rear_overhang) * forward
        own = rectangles(
            middle, np.arctan2(forward[:, 1], forward[:, 0]), length=CAR.length, width=CAR.width
        )[0]
        assert not shapely.intersects(own, boxes).any()


def test_no_road_user_stands_in_a_building(actors, scene):
    layer = scene.features("buildings")
    walls = shapely.STRtree(layer.geometry[np.asarray(layer.columns["min_height"], float) < 2.5])
    for t in (0, 7_000_000_000):
        rows = existing_actors(actors, t, end_ns=t)
        assert not len(walls.query(outlines(actors, rows, t), predicate="intersects")[0])


def test_vehicles_stand_on_the_ground(actors, scene):
    """Rays cast up from below the tyres hit the road under the vehicle."""
    world = World.load(scene)
    rows = existing_actors(actors, 0, end_ns=0)
    at = states(actors, rows, time_ns=0)
    start = at.position + np.array([0.0, 0.0, 1.0])
    hits = world.caster.cast(start, np.tile([0.0, 0.0, -1.0], (len(rows), 1)))
    off = at.position[:, 2] - (start[:, 2] - hits.range)
    assert np.abs(off).max() < 0.15


@pytest.mark.full
def test_road_users_are_there_only_while_they_are_on_the_scene(scene, ego, actors):
    """Streets of a part of a map lead beyond it, where there is no ground."""
    part = replace(scene, manifest=scene.manifest | {"bounds": np.divide(scene.bounds, 2).tolist()})
    low, high = np.reshape(part.bounds, (2, 2))
    found = populate(part, scene.road_graph(), ego=ego, vehicle=CAR, seed=5, options=BUSY)
    assert 3 < (~found.parked).sum() < (~actors.parked).sum()
    for t in range(0, ego.duration_ns, 500_000_000):
        rows = existing_actors(found, t, end_ns=t)
        corners = shapely.bounds(outlines(found, rows[~found.parked[rows]], t)).reshape(-1, 4)
        assert (corners[:, :2] >= low - 0.6).all()  # bodies at an angle reach further than half their length
        assert (corners[:, 2:] <= high + 0.6).all()


def test_feature_numbers_follow_those_of_the_scene(actors, scene):
    beyond = max(stop for _, stop in scene.layers.values())
    np.testing.assert_array_equal(actors.feature, beyond + np.arange(len(actors)))


@pytest.mark.full
def test_the_same_seed_gives_the_same_actors_and_another_seed_others(actors, scene, ego):
    again = populate(scene, scene.road_graph(), ego=ego, vehicle=CAR, seed=5, options=BUSY)
    for name in ("shape", "size", "time_ns", "position", "angles", "velocity"):
        assert getattr(again, name).tobytes() == getattr(actors, name).tobytes()
    other = populate(scene, scene.road_graph(), ego=ego, vehicle=CAR, seed=6, options=BUSY)
    assert other.position.tobytes() != actors.position.tobytes()


@pytest.mark.full
def test_an_empty_scene_has_no_road_users(scene, ego):
    none = TrafficOptions(vehicles=0.0, cyclists=0.0, pedestrians=0.0, parked=0.0)
    actors = populate(scene, scene.road_graph(), ego=ego, vehicle=CAR, seed=1, options=none)
    assert len(actors) == 0
    assert actor_shapes(actors) == []
    shape, transform, feature = actor_transforms(actors, 0, end_ns=10**8)
    assert transform.shape == (0, 3, 3, 4)
    assert len(shape) == len(feature) == 0
    assert {len(column) for column in box_rows(actors, ego, time_ns=0, frame=0).values()} == {0}
    assert count_points(actors, [], feature=np.array([-1, 3, 10**6])).tolist() == []


@settings(max_examples=20, deadline=None)
@given(t=st.integers(100_000_000, 14_000_000_000), dt=st.integers(1_000_000, 50_000_000))
def test_velocities_are_the_derivatives_of_positions(actors, t, dt):
    rows = existing_actors(actors, t, end_ns=t + dt)
    born = actors.time_ns[actors.first[rows]] <= t
    lasts = actors.time_ns[actors.first[rows + 1] - 1] >= t + dt
    rows = rows[(born & lasts) | actors.parked[rows]]
    times = np.linspace(t, t + dt, 9).astype(np.int64)
    steps = [states(actors, rows, time_ns=x) for x in times]
    moved = steps[-1].position - steps[0].position
    mean = np.mean([(a.velocity + b.velocity) / 2 for a, b in itertools.pairwise(steps)], axis=0)
    np.testing.assert_allclose(moved, mean * (times[-1] - times[0]) * 1e-9, atol=2e-3)


def test_transforms_agree_with_the_states(actors):
    start, end = 2_000_000_000, 2_100_000_000
    shape, transform, feature = actor_transforms(actors, start, end_ns=end, moments=3)
    rows = feature - actors.feature[0]
    for k, t in enumerate((start, (start + end) // 2, end)):
        at = states(actors, rows, time_ns=t)
        np.testing.assert_allclose(transform[:, k, :, 3], at.position)
        # the body's front points along its yaw
        nose = transform[:, k, :, 0] / np.linalg.norm(transform[:, k, :, 0], axis=1, keepdims=True)
        np.testing.assert_allclose(nose, rotations(at.angles)[:, :, 0], atol=1e-12)
    assert (shape < len(actor_shapes(actors))).all()
    parts = [actor_transforms(actors, start, end_ns=end, which=w)[2] for w in ("moving", "parked")]
    assert sorted(np.concatenate(parts)) == sorted(feature)
    x, y = transform[:, 0, :2, 3].T
    region = (float(np.median(x)), y.min() - 1, x.max() + 1, y.max() + 1)
    some = actor_transforms(actors, start, end_ns=end, region=region)[2]
    assert 0 < len(some) < len(feature)
    assert set(feature[x > region[0]]) <= set(some)


def test_pedestrians_change_pose_as_they_walk(actors):
    t = np.arange(0, 3_000_000_000, 100_000_000)
    seen = {}
    for k in t:
        shape, _, feature = actor_transforms(actors, int(k), end_ns=int(k) + 1000, moments=2, which="moving")
        for f, s in zip(feature.tolist(), shape.tolist(), strict=True):
            seen.setdefault(f, set()).add(s)
    walkers = actors.feature[(actors.klass == Class.PEDESTRIAN) & ~actors.parked]
    assert max(len(seen.get(f, ())) for f in walkers.tolist()) == 4


@pytest.mark.full
def test_points_on_actors_lie_in_their_boxes_and_are_counted(actors, scene, ego):
    """With every firing at its own time, the points of moving actors fall into the boxes of those times."""
    sensor = load_sensor("vlp16")
    mount = Mount((0.8, 0.0, 1.7))
    xy = ego.position[:, :2]
    world = World.load(
        scene, region=(*xy.min(axis=0), *xy.max(axis=0)), margin=100.0, actors=actor_shapes(actors)
    )
    low, on_moving = int(actors.feature[0]), 0
    for frame in (10, 40, 80, 120):
        start_ns, end_ns = sensor.window_ns(frame)
        shape, transform, feature = actor_transforms(actors, start_ns, end_ns=end_ns)
        world.place_actors(shape, transform, feature=feature)
        cloud = scan(sensor, mount, trajectory=ego, world=world, frame=frame)
        time = cloud.start_ns + cloud.time_ns.astype(np.int64)
        xyz = ego.place(cloud.xyz, time, translation=mount.translation, rotation=mount.rotation)
        mine = cloud.feature >= low
        rows = cloud.feature[mine] - low
        at = states(actors, rows, time_ns=time[mine])
        local = np.einsum("nji,nj->ni", rotations(at.angles), xyz[mine] - at.position)
        assert (np.abs(local[:, :2]) <= actors.size[rows, :2] / 2 + 0.002).all()
        assert (local[:, 2] <= actors.size[rows, 2] + 0.002).all()
        on_moving += int((~actors.parked[rows]).sum())
        everyone = np.arange(len(actors))
        counts = count_points(actors, everyone, feature=cloud.feature)
        assert counts.sum() == mine.sum()
        assert counts.tolist() == [int((cloud.feature == actors.feature[k]).sum()) for k in everyone]
    assert on_moving > 30


def test_boxes_are_the_same_in_the_scene_and_about_the_ego(actors, ego):
    t = 6_000_000_000
    rows = box_rows(actors, ego, time_ns=t, frame=60, radius=100.0)
    assert tuple(rows) == COLUMNS
    assert len(rows["id"]) > 3
    pose = ego.at([t])
    local = np.stack([rows[f"ego_{c}"] for c in "xyz"], axis=1)
    middle = np.stack([rows[c] for c in "xyz"], axis=1)
    np.testing.assert_allclose(pose.place(local), middle, atol=1e-9)
    speed = np.linalg.norm([rows[f"v{c}"] for c in "xyz"], axis=0)
    np.testing.assert_allclose(speed, np.linalg.norm([rows[f"ego_v{c}"] for c in "xyz"], axis=0))
    np.testing.assert_allclose(
        velocities(actors, t)[rows["id"]] / [actors.scale, actors.scale, 1.0],
        np.stack([rows[f"v{c}"] for c in "xyz"], axis=1),
    )
    assert (np.hypot(local[:, 0], local[:, 1]) < 105.0).all()
    assert (speed[~rows["moving"]] == 0).all()
    quat = np.stack([rows[c] for c in ("qx", "qy", "qz", "qw")], axis=1)
    np.testing.assert_allclose(np.linalg.norm(quat, axis=1), 1.0)


def test_a_road_user_that_appears_during_a_frame_or_beyond_the_radius_has_a_box(actors, ego):
    begin = actors.time_ns[actors.first[:-1]]
    late = int(np.flatnonzero(~actors.parked & (begin > 0) & (begin < ego.duration_ns))[0])
    feature = actors.feature[[late]]
    start, end = int(begin[late]) - 40_000_000, int(begin[late]) + 60_000_000
    assert late not in box_rows(actors, ego, time_ns=start, frame=0)["id"]
    rows = box_rows(actors, ego, time_ns=start, end_ns=end, frame=0, radius=0.1, feature=feature)
    assert late in rows["id"]
    first = actors.position[actors.first[late]]
    k = rows["id"].tolist().index(late)
    # the centre of a body that leans with the camber is not right above its foot
    up = Rotation.from_quat([rows[c][k] for c in ("qx", "qy", "qz", "qw")]).apply([0.0, 0.0, 1.0])
    foot = np.array([rows[c][k] for c in "xyz"]) - up * rows["height"][k] / 2
    np.testing.assert_allclose(foot[:2], first[:2], atol=1e-6)
    assert len(box_rows(actors, ego, time_ns=start, end_ns=end, frame=0, radius=0.1)["id"]) == 0


def test_boxes_of_a_dataset_include_those_that_only_its_second_scanner_has(tmp_path):
    sensors = {
        name: {
            "kind": "lidar",
            "rate_hz": 10.0,
            "time_offset_ns": late,
            "vehicle_from_sensor": np.eye(4).tolist(),
        }
        for name, late in (("a", 0), ("b", 90_000_000))
    }
    (tmp_path / "calibration.json").write_text(json.dumps({"sensors": sensors}))
    rows = {"a": ["0,0,5,7", "0,0,6,0"], "b": ["0,90000000,5,3", "0,90000000,8,2", "0,90000000,9,0"]}
    for name, lines in rows.items():
        path = Paths(tmp_path).frame_boxes(name, 0)
        path.parent.mkdir(parents=True)
        path.write_text("\n".join(["frame,time_ns,id,points", *lines]) + "\n")
    merge_box_files(tmp_path)
    assert Paths(tmp_path).boxes.read_text().split() == [
        "frame,time_ns,id,points,points_a,points_b",
        *("0,0,5,7,7,3", "0,0,6,0,0,0", "0,90000000,8,2,0,2"),
    ]
    Paths(tmp_path).frame_boxes("b", 0).write_text("frame,time_ns,id,pixels\n0,0,5,7\n")  # of a camera
    with pytest.raises(DatasetError, match=r"calibration\.json: damaged"):
        merge_box_files(tmp_path)


SIDES = ("left", "top", "right", "bottom")


def test_every_road_user_in_an_image_has_a_box(actors, ego):
    k = int(np.flatnonzero(actors.parked)[0])
    camera = CameraSpec("c", Mount(), 40, 24, 30.0, 30.0, 19.5, 11.5, near=0.1, far=np.inf)
    away = states(actors, [k], time_ns=0).position + np.array([500.0, 0.0, 0.0])
    pose = type(ego.at([0]))(away, np.eye(3)[None], np.ones((1, 3)))
    instance = np.full((24, 40), -1)
    instance[3:5, 7:11] = actors.feature[k]
    boxes = image_boxes(actors, camera, pose=pose, frame=0, time_ns=0, instance=instance)
    row = boxes["id"].tolist().index(k)
    assert [boxes[side][row] for side in SIDES] == [6.5, 2.5, 10.5, 4.5]
    assert [boxes[f"seen_{side}"][row] for side in SIDES] == [6.5, 2.5, 10.5, 4.5]
    assert (boxes["pixels"][row], boxes["visibility"][row]) == (8, 1.0)


def test_image_boxes_give_the_visible_share(actors, scene, ego):
    """A parked car alone before the camera is all visible; behind another body it is partly so."""
    k = int(np.flatnonzero(actors.parked & (actors.klass == Class.CAR))[0])
    at = states(actors, [k], time_ns=0)
    ahead = rotations(at.angles)[0, :, 0]
    camera = CameraSpec("c", Mount(), 400, 240, 300.0, 300.0, 199.5, 119.5, near=0.1, far=np.inf)
    # two metres behind the car, one up, looking where it points
    eye = at.position[0] - (actors.size[k, 0] / 2 + 3.0) * ahead + [0.0, 0.0, 1.0]
    left = np.cross([0.0, 0.0, 1.0], ahead)
    left /= np.linalg.norm(left)
    axes = np.stack([-left, -np.cross(ahead, left), ahead], axis=1)
    pose = type(ego.at([0]))(eye[None], axes[None], np.ones((1, 3)))
    region = (eye[0] - 1, eye[1] - 1, eye[0] + 1, eye[1] + 1)
    world = World.load(scene, region=region, margin=60.0, actors=actor_shapes(actors))
    shown = []
    for blocked in (False, True):
        shape, transform, feature = actor_transforms(actors, 0, end_ns=1000, moments=2)
        mine = feature == actors.feature[k]
        # a small body of the same kind, half in front of the car or far above it
        board = transform[mine].copy()
        board[:, :, :, :3] *= 0.1
        board[:, :, :, 3] = eye + 1.0 * ahead - np.array([0.0, 0.0, 0.25]) + 0.15 * left
        board[:, :, 2, 3] += 0.0 if blocked else 1000.0
        world.place_actors(
            np.repeat(shape[mine], 2),
            np.concatenate([transform[mine], board]),
            feature=np.append(feature[mine], np.int32(10**6)),
        )
        image = render(camera, pose, world=world, sun=(0.0, 0.0, 1.0), settings=CameraSettings())
        boxes = image_boxes(actors, camera, pose=pose, frame=0, time_ns=0, instance=image.feature)
        row = int(np.flatnonzero(boxes["id"] == k)[0])
        shown.append(boxes["visibility"][row])
        v, u = np.nonzero(image.feature == actors.feature[k])
        assert boxes["pixels"][row] == len(u)
        seen = [boxes[f"seen_{side}"][row] for side in SIDES]
        assert seen == [u.min() - 0.5, v.min() - 0.5, u.max() + 0.5, v.max() + 0.5]
        if not blocked:
            np.testing.assert_allclose([boxes[side][row] for side in SIDES], seen, atol=1.01)
    assert shown[0] > 0.97
    assert 0.3 < shown[1] < 0.95


@pytest.mark.parametrize(
    "change",
    [{"vehicles": -1.0}, {"parked": 1.2}, {"radius": 5.0}, {"side": "middle"}, {"pedestrians": float("nan")}],
)
def test_invalid_densities_are_refused(change):
    with pytest.raises(InputError, match=next(iter(change))):
        TrafficOptions(**change)
