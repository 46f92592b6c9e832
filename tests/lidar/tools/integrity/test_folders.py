"""Signed folders of KITTI and nuScenes, and watermarks in clouds of the world frame."""

import shutil

import numpy as np
import pytest
from helpers.programs import run_program
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from lidar.dataset.checksums import CHECKSUMS
from lidar.dataset.formats import FORMATS
from lidar.dataset.formats.las import LasInfo
from lidar.dataset.layout import open_dataset
from lidar.errors import DatasetError, FormatError, InputError
from lidar.options import ApplyOptions, DriveOptions
from lidar.signal.registry import read_stages
from lidar.simulation.drive import drive
from lidar.tools.apply import apply_stages
from lidar.tools.integrity.directions import LEAST, cells_by_direction, is_marked, with_mark
from lidar.tools.integrity.keys import Hmac
from lidar.tools.integrity.marked_clouds import coarseness
from lidar.tools.integrity.tampering import frame_verdict
from lidar.tools.integrity.watermark import WatermarkKey
from lidar.tools.sign import sign_dataset
from lidar.tools.verify import verify_dataset

MARK = WatermarkKey(b"0123456789abcdef")
HMAC = Hmac(b"fedcba9876543210")


@pytest.fixture(scope="module")
def driven(scene, tmp_path_factory):
    out = tmp_path_factory.mktemp("driven") / "a"
    formats = ("pcd", "las", "kitti", "nuscenes")
    options = DriveOptions(
        rig="vlp16", duration=0.3, seed=3, formats=formats, labels=("semantickitti",), workers=1
    )
    drive(scene, out, options=options)
    return out


@pytest.fixture(scope="module")
def kitti(driven, tmp_path_factory):
    """A sequence with clouds, labels and poses; nuScenes names files by microseconds."""
    folder = tmp_path_factory.mktemp("kitti") / "00"
    top = next(path.parent for path in driven.glob("*/velodyne"))
    for name in ("velodyne", "labels"):
        shutil.copytree(top / name, folder / name)
    shutil.copyfile(top / "poses.txt", folder / "poses.txt")
    (folder / "samples" / "LIDAR_TOP").mkdir(parents=True)
    for k, path in enumerate(sorted((top / "nuscenes").iterdir())):
        name = f"n015-2018__LIDAR_TOP__{1531281440199888 + 50000 * k}.pcd.bin"
        shutil.copyfile(path, folder / "samples" / "LIDAR_TOP" / name)
    return folder


@pytest.fixture(scope="module")
def signed(kitti, tmp_path_factory):
    out = tmp_path_factory.mktemp("signed") / "00"
    sign_dataset(kitti, out, watermark=MARK, signer=HMAC)
    return out


@pytest.fixture
def copy(signed, tmp_path):
    shutil.copytree(signed, tmp_path / "00")
    return tmp_path / "00"


def found(folder):
    return {f.place: f.to_text() for f in verify_dataset(folder, signer=HMAC).chain.findings}


POINTS = npst.arrays(
    np.float32, st.tuples(st.integers(1, 60), st.just(3)), elements=st.floats(-250, 250, width=32)
)


@given(POINTS, st.integers(0, 5))
def test_marks_in_ranges_survive_single_precision(xyz, frame):
    """Whatever the points: on edges of cells, doubled, near the sensor, straight up."""
    marked = with_mark(MARK, xyz, sensor="velodyne", frame=frame)
    assert marked.dtype == np.float32
    kept = is_marked(xyz)
    assert np.array_equal(kept, is_marked(marked))
    assert np.array_equal(marked[~kept], xyz[~kept])
    decoded = MARK.decoded(marked[kept], cells_by_direction(marked[kept], sensor="velodyne", frame=frame))
    assert not decoded.wrong.any()
    assert np.abs(decoded.off).max(initial=0) < 1e-4
    moved = np.linalg.norm(marked.astype(float) - xyz, axis=1)
    far = np.linalg.norm(xyz.astype(float), axis=1) > 2 * LEAST
    assert moved[far].max(initial=0) <= 0.52 * MARK.step + 2e-3
    other = cells_by_direction(marked[kept], sensor="velodyne", frame=frame + 1)
    if kept.sum() > 40 and len(np.unique(xyz[kept], axis=0)) > 40:
        assert MARK.decoded(marked[kept], other).wrong.mean() > 0.1


def test_a_folder_as_it_was_signed_is_intact(kitti, signed):
    report = verify_dataset(signed, watermark=MARK, signer=HMAC)
    assert report.intact
    assert (report.watermark.clouds, report.watermark.wrong) == (6, 0)
    assert report.chain.frames == 9
    before, after = (np.fromfile(k / "velodyne/000001.bin", "<f4").reshape(-1, 4) for k in (kitti, signed))
    assert np.array_equal(before[:, 3], after[:, 3])
    moved = np.linalg.norm(after[:, :3] - before[:, :3], axis=1)
    assert 0.01 < np.sqrt((moved**2).mean()) < 0.017  # D / sqrt(12) is 14 mm
    direction = [k[:, :3] / np.linalg.norm(k[:, :3], axis=1, keepdims=True) for k in (before, after)]
    assert np.abs(direction[0] - direction[1]).max() < 5e-6
    labels = "labels/000001.label"
    assert (signed / labels).read_bytes() == (kitti / labels).read_bytes()


@settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_any_flipped_byte_is_named(copy, data):
    places = [path for path in copy.rglob("*") if path.is_file() and path.stat().st_size]
    path = data.draw(st.sampled_from(sorted(p for p in places if not {"integrity", CHECKSUMS} & {*p.parts})))
    before = path.read_bytes()
    at = data.draw(st.integers(0, len(before) - 1))
    after = bytearray(before)
    after[at] ^= data.draw(st.integers(1, 255))
    path.write_bytes(after)
    names = set(found(copy))
    path.write_bytes(before)
    assert names == {path.relative_to(copy).as_posix()}


def test_missing_added_and_exchanged_files_are_named(copy):
    clouds = copy / "velodyne"
    first, third = (clouds / "000000.bin").read_bytes(), (clouds / "000002.bin").read_bytes()
    (clouds / "000000.bin").write_bytes(third)
    (clouds / "000002.bin").write_bytes(first)
    (clouds / "000007.bin").write_bytes(first)
    (copy / "labels" / "000001.label").unlink()
    (copy / "calib.txt").write_text("P0:")
    (copy / "poses.txt").unlink()
    sample = sorted((copy / "samples" / "LIDAR_TOP").iterdir())[1]
    sample.unlink()
    place = sample.relative_to(copy).as_posix()
    assert found(copy) == {
        "velodyne/000000.bin": "velodyne/000000.bin: replaced (holds frame 2)",
        "velodyne/000002.bin": "velodyne/000002.bin: replaced (holds frame 0)",
        "velodyne/000007.bin": "velodyne/000007.bin: added",
        "labels/000001.label": "labels/000001.label: missing",
        "calib.txt": "calib.txt: added",
        "poses.txt": "poses.txt: missing",
        place: f"{place}: missing",
    }
    absent = {one.file for one in verify_dataset(copy, watermark=MARK).watermark.frames if one.absent}
    assert absent == {"velodyne/000000.bin", "velodyne/000002.bin", "velodyne/000007.bin"}


def test_attacks_on_signed_clouds_are_found_and_their_truth_is_kept(signed, tmp_path):
    attack = read_stages(["move:bearing=0,distance=8,long=8,wide=8,high=6,ahead=1.3"]).stages
    shutil.copytree(signed / "velodyne", tmp_path / "in" / "velodyne")
    apply_stages(tmp_path / "in", tmp_path / "out", options=ApplyOptions(attack, sensor="vlp16"))
    for frame in verify_dataset(tmp_path / "out", watermark=MARK).watermark.frames:
        path = tmp_path / "out" / "truth" / "velodyne" / f"{frame.frame:06d}.npz"
        with np.load(path) as truth:
            moved = truth["origin"] == 5
        assert frame.forged > 0.8 * moved.sum() > 20
        assert not frame.absent
        table = FORMATS["kitti"].read(tmp_path / "out" / frame.file)
        middle = np.median(np.column_stack([table[axis] for axis in "xyz"])[moved], axis=0)
        boxes = [place for place in frame.places if place.kind == "added or moved"]
        low, high = np.array(boxes[0].low) - 1, np.array(boxes[0].high) + 1
        assert ((low < middle) & (middle < high)).all()


def test_signed_drives_in_weather_can_be_attacked(driven, tmp_path):
    fog = read_stages(["false_weather:share=0.2"]).stages
    apply_stages(driven, tmp_path / "foggy", options=ApplyOptions(fog))
    sign_dataset(tmp_path / "foggy", tmp_path / "signed", watermark=MARK, signer=HMAC)
    assert verify_dataset(tmp_path / "signed", watermark=MARK, signer=HMAC).intact
    attack = read_stages(["delete:bearing=0,distance=8,long=8,wide=8,high=6"]).stages
    apply_stages(tmp_path / "signed", tmp_path / "attacked", options=ApplyOptions(attack))
    report = verify_dataset(tmp_path / "attacked", watermark=MARK, signer=HMAC)
    assert {f.what for f in report.chain.findings} == {"changed"}
    for frame in report.watermark.frames:
        with np.load(tmp_path / "attacked" / frame.sensor / "truth" / f"{frame.frame:06d}.npz") as truth:
            assert len(truth["removed"]) > 0
            assert {0, 3} <= set(truth["origin"].tolist())
    assert report.watermark.frames


def test_watermarks_are_read_from_world_coordinates(driven, tmp_path):
    sign_dataset(driven, tmp_path / "a", watermark=MARK)
    dataset = open_dataset(tmp_path / "a")
    (name,) = dataset.sensors("lidar")
    for path in (tmp_path / "a").glob(f"{name}/pcd/*"):
        path.unlink()
    report = verify_dataset(tmp_path / "a", watermark=MARK).watermark
    assert {f.what for f in report.findings} == {"missing"}
    assert (report.clouds, report.wrong, report.tampered) == (3, 0, 0)
    path = tmp_path / "a" / name / "las" / "000001.las"
    table = FORMATS["las"].read(path)
    near = np.flatnonzero(np.asarray(table["range"]) < 12)
    table["z"][near] += 0.4
    info = LasInfo(dataset.crs, (np.round(table["x"][0]), np.round(table["y"][0]), 0.0), dataset.start)
    FORMATS["las"].write(path, table, info=info)
    (frame,) = verify_dataset(tmp_path / "a", watermark=MARK).watermark.frames
    assert frame.file.endswith("las/000001.las")
    assert frame.forged == pytest.approx(len(near), rel=0.1)
    for axis in "xyz":
        table[axis] = np.round(table[axis] / 0.05) * 0.05
    FORMATS["las"].write(path, table, info=info)
    with pytest.raises(InputError, match=r"are multiples of 0\.05 m; a watermark with a step"):
        verify_dataset(tmp_path / "a", watermark=MARK)


@given(st.sampled_from([1.0, 0.5, 0.1, 0.05, 0.02, 0.01, 0.005]), st.integers(0, 99))
def test_rounded_coordinates_are_noticed(step, seed):
    exact = np.random.default_rng(seed).uniform(-100, 100, (200, 3))
    assert coarseness(exact) == 0
    assert coarseness((np.round(exact / step) * step).astype(np.float32)) == pytest.approx(step)


def test_shifts_of_a_whole_cloud_are_found():
    rng = np.random.default_rng(5)
    xyz = rng.normal(0, 15, (5000, 3)).astype(np.float32)
    marked = with_mark(MARK, xyz, sensor="velodyne", frame=3)
    shifted = marked + np.float32([0.3, 0, 0])
    cells = cells_by_direction(shifted, sensor="velodyne", frame=3)
    assert frame_verdict(MARK, shifted, cells=cells).absent


def test_what_cannot_be_signed_is_refused_with_nothing_written(kitti, signed, tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(DatasetError, match=r"no dataset\.json, no velodyne"):
        sign_dataset(tmp_path / "empty", None, signer=HMAC)
    with pytest.raises(DatasetError, match="has a watermark already"):
        sign_dataset(signed, tmp_path / "out", watermark=MARK)
    with pytest.raises(DatasetError, match="is not signed"):
        verify_dataset(kitti, signer=HMAC)
    odd = tmp_path / "odd" / "velodyne"
    odd.mkdir(parents=True)
    shutil.copyfile(kitti / "velodyne" / "000000.bin", odd / "first.bin")
    with pytest.raises(DatasetError, match=r"first\.bin: its name has no frame number"):
        sign_dataset(tmp_path / "odd", tmp_path / "out", watermark=MARK)
    np.full(8, np.nan, "<f4").tofile(odd / "000000.bin")
    (odd / "first.bin").unlink()
    with pytest.raises(FormatError, match="row 0 has a number that is not finite"):
        sign_dataset(tmp_path / "odd", tmp_path / "out", watermark=MARK)
    (odd / "000000.bin").write_bytes(b"123")
    (tmp_path / "key").write_text("00112233445566778899aabbccddeeff")
    words = ("lidar", "sign", tmp_path / "odd", "--watermark", tmp_path / "key", "-o", tmp_path / "out")
    done = run_program(*words)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["empty", "key", "odd"]
