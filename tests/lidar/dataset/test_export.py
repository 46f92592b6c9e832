"""Exported datasets equal the recorded ones, read with independent parsers."""

import json
import shlex
from datetime import UTC, datetime

import numpy as np
import pytest
from helpers.sensor_worlds import driven
from scipy.spatial.transform import Rotation

from geoscene.errors import InputError as FolderError
from geoscene.geometry.frames import Frame
from geoscene.support.columns import write_columns
from geoscene.support.files import write_json
from lidar.dataset.checksums import CHECKSUMS
from lidar.dataset.formats import FORMATS
from lidar.dataset.ground_truth import COLUMNS
from lidar.dataset.layout import Paths, open_dataset
from lidar.dataset.layouts import EXPORTERS
from lidar.dataset.layouts.kitti import truncation
from lidar.dataset.layouts.kitti_drive import KittiDrive
from lidar.dataset.layouts.kitti_raw import oxts_columns
from lidar.dataset.recorded import Stream
from lidar.errors import DatasetError, InputError
from lidar.geometry.attitude import OPTICAL
from lidar.geometry.trajectory_files import write_trajectory

START = datetime(2026, 6, 21, 8, 0, 0, 250_000, tzinfo=UTC)
EPOCH_NS = 1_782_028_800_250_000_000  # date -u -d 2026-06-21T08:00:00.25 +%s%N
VELOCITY, YAW_RATE, SCALE = np.array([8.0, 3.0, 0.1]), 0.4, 1.0006
MOUNTS = {
    "top": ("lidar", [1.2, 0.0, 1.9], Rotation.from_euler("ZYX", [0.3, 0.1, -0.05])),
    "front": ("camera", [1.5, 0.2, 1.7], Rotation.from_matrix(OPTICAL)),
    "gnss": ("gnss", [0.0, 0.0, 1.6], Rotation.identity()),
}
TIMES = {"top": np.arange(0, 5 * 10**9, 10**8), "front": np.arange(3, 5 * 10**9, 333_333_333)}


@pytest.fixture
def dataset(tmp_path):
    """The metadata files of a drive at constant velocity and yaw rate."""
    paths = Paths(tmp_path / "drive")
    manifest = {
        "schema": 1,
        "scene": {"path": "scene"},
        "frame": Frame.at(24.9, 60.2).to_json(),
        "start_time": START.isoformat(),
    }
    manifest |= {"export_crs": "EPSG:32635", "frames": 50, "frames_done": 50, "recipe": {}}
    manifest |= {"scene": {"name": "", "path": "gone"}, "rig": "mine", "attribution": "nobody"}
    write_json(paths.manifest, manifest)
    sensors = {}
    for name, (kind, translation, rotation) in MOUNTS.items():
        mount = np.eye(4)
        mount[:3, :3], mount[:3, 3] = rotation.as_matrix(), translation
        sensors[name] = {"kind": kind, "vehicle_from_sensor": mount.tolist()}
        sensors[name] |= {"rate_hz": 10.0, "time_offset_ns": 0}
    sensors["front"] |= {
        "K": np.eye(3).tolist(),
        "width": 4,
        "height": 3,
        "model": "pinhole",
        "distortion": [],
    }
    write_json(paths.calibration, {"sensors": sensors})
    trajectory = driven(VELOCITY, yaw_rate=YAW_RATE, start=(50.0, -20.0, 3.0), scale=SCALE)
    write_trajectory(paths.trajectory, trajectory)
    for name, times in TIMES.items():
        write_columns(paths.timestamps(name), {"frame": np.arange(len(times)), "time_ns": times})
    write_columns(paths.measurements("gnss"), {"time_ns": [0, 2 * 10**9], "satellites": [7, 8]})
    return open_dataset(paths.root)


def read_tum(path):
    """Nanoseconds since 1970, positions and rotations of a TUM file."""
    rows = [line.split(" ") for line in path.read_text().splitlines()]
    assert {len(row) for row in rows} == {8}
    seconds, rest = zip(*(row[0].split(".") for row in rows), strict=True)
    time_ns = np.array(seconds, np.int64) * 10**9 + np.array(rest, np.int64)
    values = np.array([row[1:] for row in rows], float)
    return time_ns, values[:, :3], Rotation.from_quat(values[:, 3:])


def expected_pose(name, time_ns):
    """True metres and rotation of a sensor of the drive, by its equations."""
    s = time_ns * 1e-9
    vehicle = Rotation.from_rotvec(YAW_RATE * s[:, None] * [0.0, 0.0, 1.0])
    start = np.array([50.0, -20.0, 3.0]) / [SCALE, SCALE, 1.0]
    position = start + s[:, None] * VELOCITY
    if name == "vehicle":
        return position, vehicle
    _, translation, rotation = MOUNTS[name]
    return position + vehicle.apply(translation), vehicle * rotation


def test_hints_can_be_pasted_where_folders_have_spaces(dataset, tmp_path):
    summary = EXPORTERS["tum"].export(dataset, tmp_path / "two words")
    assert str(tmp_path / "two words" / "vehicle.tum") in shlex.split(summary.hint)


def test_tum_trajectories_are_the_true_poses_of_vehicle_and_sensors(dataset, tmp_path):
    summary = EXPORTERS["tum"].export(dataset, tmp_path / "tum")
    times = {"gnss": np.array([0, 2 * 10**9]), **TIMES, "vehicle": dataset.trajectory().time_ns}
    files = {path.stem: path for path in (tmp_path / "tum").rglob("*.tum")}
    assert set(files) == set(times)
    assert summary.counts == {"trajectories": 4, "poses": sum(map(len, times.values()))}
    for name, path in files.items():
        time_ns, position, rotation = read_tum(path)
        np.testing.assert_array_equal(time_ns, EPOCH_NS + times[name])
        place, turn = expected_pose(name, times[name])
        np.testing.assert_allclose(position, place, rtol=0, atol=1e-9, err_msg=name)
        assert (turn.inv() * rotation).magnitude().max() < 1e-9, name
        kitti = np.loadtxt(path.with_suffix(".kitti")).reshape(-1, 3, 4)
        np.testing.assert_allclose(kitti[0], np.eye(3, 4), atol=1e-9)
        np.testing.assert_allclose(
            kitti[:, :, 3], turn[0].inv().apply(place - place[0]), rtol=0, atol=1e-8, err_msg=name
        )
        assert ((turn[0].inv() * turn).inv() * Rotation.from_matrix(kitti[:, :, :3])).magnitude().max() < 1e-9


def test_oxts_values_are_the_true_motion_of_the_inertial_unit(dataset):
    """30 values as in KITTI's data format, from the equations of the drive; read as pykitti does."""
    time_ns = np.arange(0, 4 * 10**9, 10**8)
    stream = Stream("top", dataset.sensors()["top"], np.arange(40), time_ns, ("",) * 40)
    values = oxts_columns(KittiDrive(dataset, stream, {}))
    assert len(values) == 30
    assert {len(column) for column in values.values()} == {40}
    arm = np.array(MOUNTS["gnss"][1])
    place, turn = expected_pose("vehicle", time_ns)
    place, turning = place + turn.apply(arm), np.array([0, 0, YAW_RATE])
    x, y = dataset.frame.from_geographic(values["lon"], values["lat"])
    np.testing.assert_allclose(np.column_stack([x, y]) / SCALE, place[:, :2], atol=1e-5)
    np.testing.assert_allclose(values["alt"], place[:, 2], atol=1e-9)
    convergence = dataset.frame.convergence(values["lon"], values["lat"])
    to_true = Rotation.from_euler("z", -convergence[:, None])
    found = Rotation.from_euler("ZYX", np.column_stack([values[name] for name in ("yaw", "pitch", "roll")]))
    assert ((to_true * turn).inv() * found).magnitude().max() < 1e-9
    velocity = to_true.apply(VELOCITY + np.cross(turning, turn.apply(arm)))
    np.testing.assert_allclose(np.column_stack([values[k] for k in ("ve", "vn", "vu")]), velocity, atol=1e-4)
    level = Rotation.from_euler("z", -values["yaw"][:, None])
    np.testing.assert_allclose(
        np.column_stack([values[k] for k in ("vf", "vl", "vu")]), level.apply(velocity), atol=1e-4
    )
    np.testing.assert_allclose(values["wu"][2:-2], YAW_RATE, atol=1e-3)
    np.testing.assert_allclose(values["wz"], values["wu"], atol=1e-9)
    np.testing.assert_allclose(values["au"][2:-2], 9.81907, atol=2e-3)  # normal gravity at 60.2 N
    assert set(values["numsats"]) == {7, 8}
    write_columns(dataset.paths.measurements("gnss"), {"time_ns": [], "satellites": []})
    assert not oxts_columns(KittiDrive(dataset, stream, {}))["numsats"].any()
    write_columns(dataset.paths.measurements("gnss"), {"time_ns": [0], "satellites": ["many"]})
    with pytest.raises(DatasetError, match=r"gnss\.csv: damaged"):
        oxts_columns(KittiDrive(dataset, stream, {}))


def test_truncation_is_the_share_of_the_projection_outside_the_image():
    camera, sides = np.array([[100.0, 0, 50, 0], [0, 100, 50, 0], [0, 0, 1, 0]]), np.array([100.0, 100.0])
    cube = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    plate = cube * [1, 1, 0]  # 25 pixels wide at 8 m
    cases = [((0, 0, 8), 0.0), ((4, 0, 8), 0.5), ((4, 4, 8), 0.75), ((9, 0, 8), 1.0), ((0, 0, -8), 1.0)]
    for place, share in cases:
        assert truncation(plate + place, camera, sides=sides) == pytest.approx(share, abs=1e-9)
    assert 0.9 < truncation(cube + np.array([0.0, 0.5, 0.0]), camera, sides=sides) < 1  # around the camera


def _write_cloud(dataset, frame, **columns):
    """A cloud of five points of the scanner, but for some columns."""
    whole = {
        "time_ns": np.uint32,
        "ring": np.uint16,
        "column": np.uint32,
        "label": np.uint16,
        "instance": np.int32,
    }
    names = FORMATS["pcd"].columns[:-1]
    table = {name: np.arange(5).astype(whole.get(name, np.float32)) for name in names}
    path = FORMATS["pcd"].path(dataset.path / "top", frame)
    path.parent.mkdir(exist_ok=True)
    FORMATS["pcd"].write(path, table | {name: np.array(v, table[name].dtype) for name, v in columns.items()})


@pytest.mark.parametrize("name", ["kitti", "kitti-360", "nuscenes"])
def test_damaged_clouds_and_boxes_are_refused_by_name(dataset, tmp_path, name):
    row, out, boxes = EXPORTERS[name], tmp_path / "out", dataset.paths.sensor_boxes("top")
    for columns in (
        {"label": [1, 2, 3, 4, 999]},
        {"x": [0, 1, np.nan, 3, 4]},
        {"intensity": [0, 1e30, 3, 4, 5]},
    ):
        _write_cloud(dataset, 0, **columns)
        with pytest.raises(DatasetError, match=r"000000\.pcd: damaged"):
            row.export(dataset, out)
    _write_cloud(dataset, 0)
    _write_cloud(dataset, 99)
    with pytest.raises(DatasetError, match=r"timestamps\.csv: has no time of frame 99"):
        row.export(dataset, out)
    FORMATS["pcd"].path(dataset.path / "top", 99).unlink()
    good = dict.fromkeys((*COLUMNS, "points", "visibility"), "0") | {
        "class": "car",
        "kind": "suv",
        "moving": "True",
    }
    for column, value in (("class", "cart"), ("x", "nan"), ("points", ""), ("moving", "yes"), ("id", "1.5")):
        write_columns(boxes, {key: [text] for key, text in (good | {column: value}).items()})
        with pytest.raises(DatasetError, match=r"boxes\.csv: damaged"):
            row.export(dataset, out)
    boxes.unlink()
    write_json(dataset.paths.manifest, {k: v for k, v in dataset.manifest.items() if k != "attribution"})
    if name == "nuscenes":
        with pytest.raises(DatasetError, match=r"dataset\.json: damaged"):
            row.export(open_dataset(dataset.path), out)
    assert {path.name for path in tmp_path.iterdir()} == {"drive"}


def test_a_scene_path_that_is_no_text_is_refused(dataset):
    write_json(dataset.paths.manifest, dataset.manifest | {"scene": {"name": "", "path": 0}})
    with pytest.raises(DatasetError, match=r"dataset\.json: damaged"):
        open_dataset(dataset.path)


def test_a_camera_without_intrinsics_is_refused(dataset, tmp_path):
    _write_cloud(dataset, 0)
    document = json.loads(dataset.paths.calibration.read_text())
    document["sensors"]["front"]["K"] = [[1, 2]]
    write_json(dataset.paths.calibration, document)
    for name in ("coco", "kitti", "kitti-360", "kitti-raw", "nuscenes"):
        with pytest.raises(DatasetError, match=r"calibration\.json: damaged"):
            EXPORTERS[name].export(dataset, tmp_path / name)


def test_an_export_is_replaced_only_on_request_and_nothing_else_is(dataset, tmp_path):
    row = EXPORTERS["tum"]
    row.export(dataset, tmp_path / "tum")
    with pytest.raises(InputError, match="`overwrite`"):
        row.export(dataset, tmp_path / "tum")
    row.export(dataset, tmp_path / "tum", overwrite=True)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("done")
    with pytest.raises(FolderError, match=r"holds no vehicle\.tum"):
        row.export(dataset, tmp_path / "mine", overwrite=True)
    assert (tmp_path / "mine" / "thesis.txt").read_text() == "done"


def test_a_replaced_export_keeps_and_names_the_files_of_others(dataset, tmp_path, caplog):
    row, out = EXPORTERS["tum"], tmp_path / "tum"
    row.export(dataset, out)
    fresh = {path: path.read_bytes() for end in ("tum", "kitti") for path in out.rglob(f"*.{end}")}
    ours = [out / "provenance.json", out / CHECKSUMS]
    mine = [out / "thesis.txt", out / "sensors" / "top.tum.bak", out / "notes" / "a.md"]
    for path in mine:
        path.parent.mkdir(exist_ok=True)
        path.write_text(path.name)
    (out / "sensors" / "gone.tum").write_text("of an earlier rig")
    (out / "sensors" / "top.tum").write_text("damaged")
    row.export(dataset, out, overwrite=True)
    assert {path for path in out.rglob("*") if path.is_file()} == {*fresh, *mine, *ours}
    assert {path: path.read_bytes() for path in fresh} == fresh
    assert [path.read_text() for path in mine] == [path.name for path in mine]
    assert all(f"{path}: kept" in caplog.text for path in mine)
    assert {path.name for path in tmp_path.iterdir()} == {"drive", "tum"}


def test_a_failed_export_leaves_no_files(dataset, tmp_path):
    dataset.paths.timestamps("front").unlink()
    with pytest.raises(DatasetError, match="was the drive finished"):
        EXPORTERS["tum"].export(dataset, tmp_path / "tum")
    assert [path.name for path in tmp_path.iterdir()] == ["drive"]
