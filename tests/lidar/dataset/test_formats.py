"""Point-cloud formats: round trips within their precision, and agreement with other readers."""

import io
import subprocess
import sys
from dataclasses import replace
from datetime import UTC, datetime

import laspy
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from pypcd4 import Encoding, PointCloud
from pyproj import CRS

from geoscene.classes import Class
from lidar.dataset.formats import (
    FORMATS,
    LABELS,
    MAPS,
    las,
    pcd,
    pcd_ascii,
    ply,
    read_cloud,
    read_table,
    text,
)
from lidar.dataset.formats.las import LasInfo, open_las, read_chunks
from lidar.dataset.formats.table import PointLabels, cloud_table, table_cloud
from lidar.errors import FormatError, InputError
from lidar.geometry.time_scales import gps_seconds

INFO = LasInfo(CRS.from_epsg(32618), (383_000.0, 4_082_000.0, 0.0), datetime(2026, 6, 1, 10, tzinfo=UTC))
CSV = {"x": 5.1e-5, "range": 5.1e-5, "true_range": 5.1e-5, "velocity": 5.1e-5, "intensity": 5.1e-3}
LAS = {"x": 5.1e-4, "intensity": 0.002, "gps_time": 1e-6}
E57 = {"x": 1e-5, "gps_time": 1e-6}
STEPS = {
    "csv": {**CSV, "incidence": 5.1e-6},
    "las": LAS,
    "laz": LAS,
    "e57": E57,
    "kitti": {"intensity": 2e-5},
}
"""Largest error of a column by format; 0 for others."""


@pytest.mark.parametrize(("name", "highest"), [("kitti", 1), ("nuscenes", 255)])
@pytest.mark.parametrize("value", [-0.01, 1.01])
def test_intensities_that_the_layout_does_not_have_are_told_with_their_row(tmp_path, name, highest, value):
    points = np.zeros((4, {"kitti": 4, "nuscenes": 5}[name]), "<f4")
    points[2, 3] = value * highest
    points.tofile(tmp_path / "a.bin")
    with pytest.raises(FormatError, match=rf"a\.bin: row 2 has .*, outside of 0 to {highest}, as have 1 "):
        FORMATS[name].read(tmp_path / "a.bin")


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
        "true_range": (np.linalg.norm(xyz, axis=1) * 1.001).astype(np.float32),
        "echo": np.ones(n, np.uint8),
        "echoes": rng.integers(1, 4, n).astype(np.uint8),
        "velocity": rng.normal(size=n).astype(np.float32),
    }


def write(form, path, cloud):
    """Write a table as a drive would; returns it in the format's frame."""
    if form.frame == "sensor":
        form.write(path, cloud)
        return cloud
    placed = {k: cloud[k].astype(float) + o for k, o in zip("xyz", INFO.offset, strict=True)}
    placed["gps_time"] = gps_seconds(INFO.created, cloud["time_ns"])
    form.write(path, cloud | placed, info=INFO)
    return cloud | placed


@pytest.fixture(params=FORMATS)
def form(request):
    return FORMATS[request.param]


@pytest.mark.parametrize("n", [0, 1, 1000])
def test_a_cloud_round_trips_within_the_precision_of_the_format(tmp_path, form, n):
    path = tmp_path / f"a{form.suffix}"
    written = write(form, path, table(n))
    back = read_table(path)
    assert set(form.columns) <= set(back)
    if form.frame == "sensor":
        assert list(back) == [name for name in written if name in form.columns]
    for name in form.columns:
        tolerance = STEPS.get(form.name, {}).get({"y": "x", "z": "x"}.get(name, name), 0.0)
        assert back[name].shape == written[name].shape
        away = np.abs(back[name].astype(float) - written[name].astype(float))
        assert away.max(initial=0) <= tolerance, name
    assert form.count(path) == n


def test_the_same_cloud_is_the_same_bytes(tmp_path, form):
    paths = [tmp_path / f"{k}{form.suffix}" for k in "ab"]
    for path in paths:
        write(form, path, table(100))
    assert paths[0].read_bytes() == paths[1].read_bytes()


def test_a_file_is_read_as_the_cloud_that_was_written(tmp_path, form):
    cloud = table_cloud(table(300), start_ns=7)
    path = tmp_path / f"a{form.suffix}"
    written = write(form, path, cloud_table(cloud))
    if form.frame == "world":
        with pytest.raises(InputError, match="read_table"):
            read_cloud(path)
        return
    back = read_cloud(path, start_ns=7)
    assert back.start_ns == 7
    assert len(back) == 300
    for name, column in cloud_table(back).items():
        if name in form.columns:
            tolerance = STEPS.get(form.name, {}).get({"y": "x", "z": "x"}.get(name, name), 0.0)
            np.testing.assert_allclose(column, written[name], rtol=1e-7, atol=tolerance, err_msg=name)
    if "range" not in form.columns:
        np.testing.assert_allclose(back.range, cloud.range, rtol=1e-5)
        assert (back.klass == 0).all()
        assert (back.feature == -1).all()


def test_a_format_can_be_named(tmp_path):
    FORMATS["kitti"].write(tmp_path / "a.dat", table(5))
    assert len(read_table(tmp_path / "a.dat", "kitti")["x"]) == 5
    with pytest.raises(InputError, match="no point-cloud format"):
        read_table(tmp_path / "a.dat")
    with pytest.raises(InputError, match="known are pcd"):
        read_table(tmp_path / "a.dat", "xyz")


def test_formats_are_listed_without_importing_them():
    code = "import sys; from lidar.dataset.formats import FORMATS; assert 'numpy' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_no_two_formats_share_a_suffix_or_a_folder():
    rows = [*FORMATS.values(), *LABELS.values()]
    for key in (lambda row: row.suffix, lambda row: row.folder or row.name):
        assert len({key(row) for row in rows}) == len(rows)


@pytest.mark.parametrize("name", LABELS)
def test_label_files_have_a_row_per_point(tmp_path, name):
    row = LABELS[name]
    klass = np.array([Class.CAR, Class.ROAD, Class.CAR])
    row.write(tmp_path / "a", PointLabels(klass, np.array([4, 0, 5]), np.array([True, False, False])))
    codes = np.fromfile(tmp_path / "a", {"semantickitti": "<u4", "nuscenes": "u1"}[name])
    assert (
        codes.tolist() == {"semantickitti": [252 | 4 << 16, 40, 10 | 5 << 16], "nuscenes": [17, 24, 17]}[name]
    )


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


@settings(deadline=None, max_examples=50)
@given(st.lists(st.floats(width=32, allow_nan=False), min_size=1, max_size=30))
def test_ascii_pcd_keeps_every_float(tmp_path_factory, values):
    path = tmp_path_factory.mktemp("pcd") / "a.ascii.pcd"
    column = np.array(values, np.float32)
    pcd_ascii.write(path, {"x": column, "range": column.astype(np.float64) / 3})
    back = read_table(path)
    np.testing.assert_array_equal(back["x"], column)
    np.testing.assert_array_equal(back["range"], column.astype(np.float64) / 3)


@pytest.mark.parametrize("module", [pcd, pcd_ascii])
def test_pypcd4_reads_our_pcd(tmp_path, module):
    cloud = table(500)
    module.write(tmp_path / "a.pcd", cloud)
    other = PointCloud.from_path(tmp_path / "a.pcd")
    assert other.fields == tuple("t" if name == "time_ns" else name for name in cloud)
    for name, column in cloud.items():
        np.testing.assert_array_equal(other.pc_data["t" if name == "time_ns" else name], column)


@pytest.mark.parametrize("encoding", [Encoding.ASCII, Encoding.BINARY])
def test_pcd_files_of_other_programs_are_read_with_any_suffix(tmp_path, encoding):
    points = np.array([[1.5, -2.25, 3.0], [0.1, -100.0, 1e6]], np.float32)
    PointCloud.from_xyz_points(points).save(tmp_path / "a.pcd", encoding=encoding)
    back = read_table(tmp_path / "a.pcd")
    np.testing.assert_array_equal(np.column_stack([back[k] for k in "xyz"]), points)


HEAD = (
    "VERSION 0.7\nFIELDS x y\nSIZE 4 4\nTYPE F F\nCOUNT {count}\nWIDTH 2\nHEIGHT 1\nPOINTS 2\nDATA {data}\n"
)


@pytest.mark.parametrize(
    ("data", "count", "body", "says"),
    [
        ("binary_compressed", "1 1", "", "binary_compressed is not supported; write it again"),
        ("ascii", "1 3", "", "several values"),
        ("ascii", "1 1", "1 2\n", "1 points, and its header states 2"),
        ("ascii", "1 1", "1 2\n3 four\n", "damaged"),
        ("binary", "1 1", "1234", "damaged"),
    ],
)
def test_unreadable_pcd_is_refused_in_one_line(tmp_path, data, count, body, says):
    (tmp_path / "a.pcd").write_text(HEAD.format(data=data, count=count) + body)
    with pytest.raises(FormatError, match=says) as error:
        read_table(tmp_path / "a.pcd")
    assert "\n" not in str(error.value)


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
    assert file.header.parse_crs().to_epsg() == 32618


def test_an_uncompressed_file_written_in_parts_equals_that_of_laspy(tmp_path):
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


def test_a_point_outside_the_las_integer_range_is_refused(tmp_path):
    far = table(3) | {"x": np.array([0.0, 1.0, 3e6])}
    with pytest.raises(FormatError, match="too far"):
        las.write(tmp_path / "a.las", far, info=replace(INFO, offset=(0.0, 0.0, 0.0)))
    assert list(tmp_path.iterdir()) == []


def test_a_failed_writer_leaves_nothing(tmp_path):
    with (
        pytest.raises(KeyError),
        open_las(tmp_path / "a.laz", INFO, columns=("x", "y", "z", "label")) as append,
    ):
        append({"x": np.zeros(1)})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("content", [b"", b"hello\nworld\n", b"\x00\xff" * 51])
def test_damaged_files_are_named_in_one_line(tmp_path, form, content):
    path = tmp_path / f"bad{form.suffix}"
    path.write_bytes(content)
    if not content and form.name in ("kitti", "nuscenes"):  # files without a header: empty without points
        assert len(read_table(path)["x"]) == 0
        return
    with pytest.raises(FormatError, match="bad") as error:
        read_table(path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize(("at", "size"), [(94, 2), (96, 4), (100, 4), (247, 8), (235, 12)])
def test_counts_that_a_file_cannot_hold_are_refused(tmp_path, suffix, at, size):
    path = tmp_path / f"a{suffix}"
    las.write(path, table(500), info=replace(INFO, offset=(0.0, 0.0, 0.0)))
    whole = path.read_bytes()
    path.write_bytes(whole[:at] + b"\xf0" * size + whole[at + size :])
    with pytest.raises(FormatError, match=r"damaged LAS or LAZ file \(its header"):
        read_table(path)


def test_a_chunk_table_that_a_file_cannot_hold_is_refused(tmp_path):
    path = tmp_path / "a.laz"
    las.write(path, table(500), info=replace(INFO, offset=(0.0, 0.0, 0.0)))
    whole = path.read_bytes()
    at = int.from_bytes(whole[(start := int.from_bytes(whole[96:100], "little")) : start + 8], "little") + 4
    path.write_bytes(whole[:at] + b"\xf0" * 4 + whole[at + 4 :])
    with pytest.raises(FormatError, match="states more than the file holds"):
        read_table(path)


def test_layers_that_a_chunk_cannot_hold_are_refused(tmp_path):
    path = tmp_path / "a.laz"
    las.write(path, table(500), info=replace(INFO, offset=(0.0, 0.0, 0.0)))
    assert len(read_table(path)["x"]) == 500
    whole = path.read_bytes()
    length, start = int.from_bytes(whole[105:107], "little"), int.from_bytes(whole[96:100], "little")
    sizes = start + 8 + length + 4  # after the place of the chunk table, the first point and their number
    path.write_bytes(whole[:sizes] + b"\xf0" * 4 + whole[sizes + 4 :])
    with pytest.raises(FormatError, match="layers of another length than their chunk"):
        read_table(path)


def test_chunks_of_more_points_than_a_file_can_hold_are_refused(tmp_path):
    """The decompressor allocates memory for all points that a chunk may have."""
    path = tmp_path / "a.laz"
    las.write(path, table(500), info=replace(INFO, offset=(0.0, 0.0, 0.0)))
    whole = path.read_bytes()
    at = whole.index((50_000).to_bytes(4, "little"))
    path.write_bytes(whole[:at] + (1_879_088_695).to_bytes(4, "little") + whole[at + 4 :])
    with pytest.raises(FormatError, match="chunks of 1879088695 points"):
        read_table(path)


def test_a_panic_of_the_decompressor_names_the_file(tmp_path, monkeypatch):
    class PanicException(BaseException):
        """As pyo3 raises it."""

    def fails(path, **_):
        raise PanicException(path)

    las.write(tmp_path / "a.laz", table(500), info=replace(INFO, offset=(0.0, 0.0, 0.0)))
    monkeypatch.setattr(laspy, "open", fails)
    with pytest.raises(FormatError, match=r"a\.laz: damaged LAS or LAZ file \(the decompressor"):
        read_table(tmp_path / "a.laz")


def test_a_truncated_laz_is_named(tmp_path):
    las.write(tmp_path / "a.laz", table(500), info=replace(INFO, offset=(0.0, 0.0, 0.0)))
    whole = (tmp_path / "a.laz").read_bytes()
    (tmp_path / "a.laz").write_bytes(whole[: len(whole) // 3])
    with pytest.raises(FormatError, match=r"a\.laz"):
        read_table(tmp_path / "a.laz")


def test_laz_records_of_another_length_than_is_compressed_are_refused(tmp_path):
    """Memory would be reserved for 50,000 of them."""
    path = tmp_path / "a.laz"
    las.write(path, table(500), info=replace(INFO, offset=(0.0, 0.0, 0.0)))
    whole = path.read_bytes()
    path.write_bytes(whole[:105] + b"\xff\xff" + whole[107:])
    with pytest.raises(FormatError, match="records of 65535 bytes"):
        read_table(path)


@pytest.mark.parametrize("count", ["-1", "-2", "-999999999999"])
@pytest.mark.parametrize("name", ["pcd", "pcd-ascii", "ply"])
def test_fewer_than_no_points_are_refused(name, count, tmp_path):
    form = FORMATS[name]
    path = tmp_path / f"a{form.suffix}"
    form.write(path, {axis: np.zeros(7, np.float32) for axis in "xyz"})
    whole, stated = path.read_bytes(), b"vertex 000000000007" if name == "ply" else b"POINTS 7"
    assert stated in whole
    path.write_bytes(whole.replace(stated, stated.split()[0] + b" " + count.encode()))
    with pytest.raises(FormatError, match="number of points"):
        form.count(path)
    with pytest.raises(FormatError, match=path.name):
        read_table(path)


def test_extended_records_that_a_file_cannot_hold_are_refused(tmp_path):
    path = tmp_path / "a.copc.laz"
    info, points = replace(INFO, offset=(0.0, 0.0, 0.0)), table(500)
    points |= dict.fromkeys(("red", "green", "blue"), np.zeros(500, np.uint8))
    with MAPS["copc"].open_map(path, info=info, columns=tuple(points)) as append:
        append(points)
    assert len(read_table(path)["x"]) == 500
    whole = path.read_bytes()
    at = int.from_bytes(whole[235:243], "little") + 20
    path.write_bytes(whole[:at] + b"\xf0" * 5 + whole[at + 5 :])
    with pytest.raises(FormatError, match="a record is longer than the file"):
        read_table(path)


@pytest.mark.parametrize("end", ["", "\n", "\r\n", "\n\n"])
def test_points_of_a_text_are_counted_however_it_ends(end, tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(f"x,y,z\n1,2,3\n\n4,5,6{end}", newline="")
    assert FORMATS["csv"].count(path) == len(read_table(path)["x"]) == 2


@pytest.mark.parametrize("version", ["1.2", "1.4"])
def test_points_of_las_are_counted_in_the_header_of_its_version(version, tmp_path):
    file = laspy.LasData(laspy.LasHeader(version=version, point_format=1 if version == "1.2" else 6))
    file.x = file.y = file.z = np.zeros(17)
    file.write(tmp_path / "a.las")
    assert FORMATS["las"].count(tmp_path / "a.las") == 17
    (tmp_path / "b.las").write_bytes(b"LASF")
    with pytest.raises(FormatError, match="number of points"):
        FORMATS["las"].count(tmp_path / "b.las")
