"""Every cloud format gives back what was written, to its own step, and strangers' readers agree."""

import io
from dataclasses import replace
from datetime import UTC, datetime

import laspy
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from pypcd4 import PointCloud
from pyproj import CRS

from geoscene.classes import Class
from lidar.dataset.formats import las, pcd, ply, read_table, text
from lidar.dataset.formats.las import LasInfo, gps_seconds, open_las, read_chunks, read_crs
from lidar.errors import FormatError

INFO = LasInfo(CRS.from_epsg(32618), (383_000.0, 4_082_000.0, 0.0), datetime(2026, 6, 1, 10, tzinfo=UTC))


def table(n, seed=0):
    rng = np.random.default_rng(seed)
    xyz = rng.normal(size=(n, 3)).astype(np.float32) * 40
    return {
        "x": xyz[:, 0],
        "y": xyz[:, 1],
        "z": xyz[:, 2],
        "intensity": rng.uniform(0, 255, n).astype(np.float32),
        "time_ns": rng.integers(0, 100_000_000, n).astype(np.uint32),
        "ring": rng.integers(0, 128, n).astype(np.uint16),
        "column": rng.integers(0, 2048, n).astype(np.uint32),
        "range": np.linalg.norm(xyz, axis=1).astype(np.float32),
        "label": rng.choice([int(c) for c in Class], n).astype(np.uint16),
        "instance": rng.integers(-1, 2**31 - 1, n).astype(np.int32),
        "incidence": rng.uniform(0, np.pi / 2, n).astype(np.float32),
        "echo": np.ones(n, np.uint8),
        "echoes": np.ones(n, np.uint8),
    }


FORMATS = {
    ".pcd": (pcd.write, read_table, {}),
    ".ply": (ply.write, read_table, {}),
    ".csv": (
        text.write,
        read_table,
        {"x": 5.1e-5, "range": 5.1e-5, "intensity": 5.1e-3, "incidence": 5.1e-6},
    ),
}


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize("n", [0, 1, 1000])
def test_a_cloud_comes_back_to_the_formats_own_step(tmp_path, suffix, n):
    write, read, step = FORMATS[suffix]
    cloud = table(n)
    write(tmp_path / f"a{suffix}", cloud)
    back = read(tmp_path / f"a{suffix}")
    assert list(back) == list(cloud)
    for name, column in cloud.items():
        tolerance = step.get({"y": "x", "z": "x"}.get(name, name), 0.0)
        assert back[name].shape == column.shape
        assert np.abs(back[name].astype(float) - column.astype(float)).max(initial=0) <= tolerance, name


@pytest.mark.parametrize("suffix", FORMATS)
def test_the_same_cloud_is_the_same_bytes(tmp_path, suffix):
    write = FORMATS[suffix][0]
    write(tmp_path / f"a{suffix}", table(100))
    write(tmp_path / f"b{suffix}", table(100))
    assert (tmp_path / f"a{suffix}").read_bytes() == (tmp_path / f"b{suffix}").read_bytes()


@settings(deadline=None, max_examples=50)
@given(
    st.lists(st.floats(-1e9, 1e9), min_size=1, max_size=20),
    st.lists(st.integers(-(2**62), 2**62), min_size=1),
)
def test_csv_writes_numbers_as_python_does(tmp_path_factory, metres, integers):
    path = tmp_path_factory.mktemp("csv") / "a.csv"
    n = min(len(metres), len(integers))
    text.write(path, {"x": np.array(metres[:n]), "instance": np.array(integers[:n], np.int64)})
    for line, x, k in zip(path.read_text().splitlines()[1:], metres, integers, strict=False):
        ten_thousandths = int(np.rint(np.float64(x) * 1e4))
        sign = "-" if ten_thousandths < 0 else ""
        whole, rest = divmod(abs(ten_thousandths), 10_000)
        assert line == f"{sign}{whole}.{rest:04d},{k}"


def test_pypcd4_reads_our_pcd(tmp_path):
    cloud = table(500)
    pcd.write(tmp_path / "a.pcd", cloud, comment="x")
    other = PointCloud.from_path(tmp_path / "a.pcd")
    assert other.fields == tuple("t" if name == "time_ns" else name for name in cloud)
    for name, column in cloud.items():
        np.testing.assert_array_equal(other.pc_data["t" if name == "time_ns" else name], column)


def test_trimesh_reads_our_ply(tmp_path):
    cloud = table(500)
    ply.write(tmp_path / "a.ply", cloud, comments=("EPSG:32618",))
    other = trimesh.load(tmp_path / "a.ply")
    np.testing.assert_array_equal(other.vertices, np.column_stack([cloud[k] for k in "xyz"]).astype(float))


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_laspy_reads_world_coordinates_crs_classes_and_time(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    cloud = table(2000)
    world = cloud | {
        "x": cloud["x"].astype(float) + 383_629.0124,
        "y": cloud["y"].astype(float) + 4_082_944.5213,
        "z": cloud["z"].astype(float),
        "gps_time": gps_seconds(INFO.created, cloud["time_ns"]),
        "source": np.full(2000, 7, np.uint16),
    }
    las.write(path, world, info=INFO)
    file = laspy.read(path)
    assert file.header.version == "1.4"
    assert file.header.parse_crs().to_epsg() == 32618
    assert file.header.global_encoding.wkt
    for axis in "xyz":
        assert np.abs(file[axis] - world[axis]).max() <= 0.0005 + 1e-9
    np.testing.assert_array_equal(file.ring, cloud["ring"])
    np.testing.assert_array_equal(file.instance, cloud["instance"])
    assert (np.asarray(file.classification)[cloud["label"] == Class.BUILDING] == 6).all()
    np.testing.assert_allclose(file.gps_time, world["gps_time"])
    back = list(read_chunks(path, chunk=700))
    assert [len(t["x"]) for t in back] == [700, 700, 600]
    np.testing.assert_array_equal(np.concatenate([t["label"] for t in back]), cloud["label"])
    assert np.abs(np.concatenate([t["intensity"] for t in back]) - cloud["intensity"]).max() < 0.002
    assert read_crs(path).to_epsg() == 32618


def test_an_uncompressed_file_in_parts_is_what_laspy_writes_of_its_points(tmp_path):
    cloud = table(900)
    world = cloud | {"gps_time": cloud["time_ns"] * 1e-9}
    for axis, shift in zip("xyz", INFO.offset, strict=True):
        world[axis] = cloud[axis] + shift
    parts = [{name: column[rows] for name, column in world.items()} for rows in (slice(400), slice(400, 900))]
    with open_las(tmp_path / "a.las", INFO, columns=tuple(world)) as append:
        for part in parts:
            append(part)
    copy = io.BytesIO()
    laspy.read(tmp_path / "a.las").write(copy)
    assert (tmp_path / "a.las").read_bytes() == copy.getvalue()


def test_a_point_beyond_what_las_can_count_is_refused(tmp_path):
    far = table(3) | {"x": np.array([0.0, 1.0, 3e6])}
    with pytest.raises(FormatError, match="too far"):
        las.write(tmp_path / "a.las", far, info=replace(INFO, offset=(0.0, 0.0, 0.0)))
    assert list(tmp_path.iterdir()) == []


def test_gps_time_of_a_known_moment():
    # 2026-06-01 10:00:00 UTC is second 122 418 of GPS week 2421, 18 leap seconds included.
    assert gps_seconds(INFO.created, np.array([0, 500_000_000])).tolist() == [
        2421 * 604800 + 122418 - 1e9,
        464343218.5,
    ]


def test_a_failed_writer_leaves_nothing(tmp_path):
    with (
        pytest.raises(KeyError),
        open_las(tmp_path / "a.laz", INFO, columns=("x", "y", "z", "label")) as append,
    ):
        append({"x": np.zeros(1)})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["pcd", "ply", "csv"])
@pytest.mark.parametrize("content", [b"", b"hello\nworld\n", b"\x00\xff" * 50])
def test_damaged_files_are_named(tmp_path, name, content):
    path = tmp_path / f"bad.{name}"
    path.write_bytes(content)
    with pytest.raises(FormatError, match=f"bad.{name}"):
        read_table(path)


def test_a_truncated_laz_is_named(tmp_path):
    las.write(tmp_path / "a.laz", table(500), info=replace(INFO, offset=(0.0, 0.0, 0.0)))
    whole = (tmp_path / "a.laz").read_bytes()
    (tmp_path / "a.laz").write_bytes(whole[: len(whole) // 3])
    with pytest.raises(FormatError, match=r"a\.laz"):
        read_table(tmp_path / "a.laz")
