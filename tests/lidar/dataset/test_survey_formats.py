"""E57 and COPC against their readers: pye57, laspy and copclib."""

from datetime import UTC, datetime

import copclib
import laspy
import numpy as np
import pye57
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pyproj import CRS
from scipy.spatial.transform import Rotation

from lidar.dataset.formats import FORMATS, MAPS, copc, e57, las, read_table
from lidar.dataset.formats.las import LasInfo
from lidar.dataset.formats.table import FrameInfo
from lidar.errors import FormatError
from lidar.geometry.time_scales import gps_seconds

INFO = LasInfo(CRS.from_epsg(32618), (583_000.0, 4_507_000.0, 0.0), datetime(2026, 6, 1, 10, tzinfo=UTC))
COLUMNS = ("x", "y", "z", "intensity", "gps_time", "ring", "label", "instance", "source")


def world_table(n, seed=0, spread=60.0):
    """Points around a place in the export CRS, as maps and frames have them."""
    rng = np.random.default_rng(seed)
    xyz = INFO.offset + np.round(rng.normal(size=(n, 3)) * [spread, spread, 3], 3)
    time_ns = np.sort(rng.integers(0, 10**8, n))
    return {
        **dict(zip("xyz", xyz.T, strict=True)),
        "intensity": rng.uniform(0, 255, n).astype(np.float32),
        "gps_time": gps_seconds(INFO.created, time_ns),
        "ring": rng.integers(0, 128, n).astype(np.uint16),
        "label": rng.choice([1, 2, 10], n).astype(np.uint16),
        "instance": rng.integers(-1, 2**31 - 1, n).astype(np.int32),
        "source": np.full(n, 3, np.uint16),
        **{name: rng.integers(0, 256, n).astype(np.uint8) for name in ("red", "green", "blue")},
    }


def write_map(name, path, tables):
    with MAPS[name].open_map(path, info=INFO, columns=(*COLUMNS, "red", "green", "blue")) as append:
        for table in tables:
            append(table)
    return path


def in_order(points, columns):
    """Rows of columns, sorted, so that order does not matter."""
    rows = np.column_stack([np.asarray(points[name], np.float64) for name in columns])
    return rows[np.lexsort(rows.T)]


def test_pye57_finds_the_points_of_a_frame_where_las_has_them(tmp_path):
    frame = world_table(3000) | {"column": np.arange(3000, dtype=np.uint32)}
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("zyx", (130, 4, -2), degrees=True).as_matrix()
    pose[:3, 3] = np.add(INFO.offset, (12.5, -31.25, 2.0))
    las.write(tmp_path / "a.las", frame, info=INFO)
    e57.write(tmp_path / "a.e57", frame, info=INFO, frame=FrameInfo("top", 7, 3 * 10**8, pose))
    file = pye57.E57(str(tmp_path / "a.e57"))
    header = file.get_header(0)
    np.testing.assert_allclose(header.rotation_matrix, pose[:3, :3], atol=1e-12)
    np.testing.assert_allclose(header.translation, pose[:3, 3])
    scan = file.read_scan(0, intensity=True, colors=True, row_column=True, ignore_missing_fields=True)
    placed = np.column_stack([scan[f"cartesian{axis}"] for axis in "XYZ"])
    survey = laspy.read(tmp_path / "a.las")
    assert np.abs(placed - np.asarray(survey.xyz)).max() < 5e-4 + 2e-5
    np.testing.assert_array_equal(scan["rowIndex"], frame["ring"])
    np.testing.assert_array_equal(scan["columnIndex"], frame["column"])
    np.testing.assert_array_equal(scan["intensity"], frame["intensity"])
    local = file.read_scan_raw(0, ignore_unsupported_fields=True)
    seen = np.column_stack([local[f"cartesian{axis}"] for axis in "XYZ"])
    assert np.abs((placed - pose[:3, 3]) @ pose[:3, :3] - seen).max() < 1e-6
    assert header.node["name"].value() == "top 000007"
    begin = header.node["acquisitionStart"]["dateTimeValue"].value()  # GPS seconds since 1980
    utc = (INFO.created - datetime(1980, 1, 6, tzinfo=UTC)).total_seconds()
    assert begin == pytest.approx(utc + 18 + 0.3, abs=1e-5)
    assert CRS.from_wkt(file.root["coordinateMetadata"].value()).to_epsg() == 32618
    for axis, low, high in zip("xyz", seen.min(axis=0), seen.max(axis=0), strict=True):
        bounds = header.node["cartesianBounds"]
        assert bounds[f"{axis}Minimum"].value() == pytest.approx(low, abs=1e-5)
        assert bounds[f"{axis}Maximum"].value() == pytest.approx(high, abs=1e-5)


def test_identifiers_of_e57_follow_from_the_content(tmp_path):
    def identifiers(name, table, number):
        e57.write(tmp_path / name, table, info=INFO, frame=FrameInfo("top", number))
        file = pye57.E57(str(tmp_path / name))
        return file.root["guid"].value(), file.data3d[0]["guid"].value()

    first = identifiers("a.e57", world_table(50), 0)
    assert identifiers("b.e57", world_table(50), 0) == first
    assert not set(first) & set(identifiers("c.e57", world_table(50), 1))
    assert not set(first) & set(identifiers("d.e57", world_table(50, seed=1), 0))


def test_e57_of_others_is_read_scan_by_scan_with_poses_and_without_invalid_points(tmp_path):
    path = tmp_path / "a.e57"
    rng = np.random.default_rng(1)
    scans = [{f"cartesian{axis}": rng.normal(size=20) for axis in "XYZ"} for _ in range(2)]
    scans[1]["cartesianInvalidState"] = np.arange(20, dtype=np.int8) % 2
    file = pye57.E57(str(path), mode="w")
    for k, scan in enumerate(scans):
        turn = Rotation.from_euler("z", 90 * k, degrees=True).as_quat()
        file.write_scan_raw(scan, rotation=np.roll(turn, 1), translation=np.array([100.0 * k, 0, 5]))
    file.close()
    found = read_table(path)
    first, second = (np.column_stack([s[f"cartesian{a}"] for a in "XYZ"]) for s in scans)
    second = second[::2] @ np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    second += (100, 0, 5)
    expected = np.vstack([np.add(first, (0, 0, 5)), second])
    np.testing.assert_allclose(np.column_stack([found[axis] for axis in "xyz"]), expected, atol=1e-6)
    assert FORMATS["e57"].count(path) == 40


def test_a_changed_byte_of_e57_is_found(tmp_path):
    path = tmp_path / "a.e57"
    e57.write(path, world_table(500), info=INFO)
    whole = path.read_bytes()
    for at in np.random.default_rng(0).integers(48, len(whole), 10):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 16]) + whole[at + 1 :])
        with pytest.raises(FormatError, match=r"a\.e57: not a readable E57"):
            e57.read(path)


@pytest.mark.parametrize("name", ["e57", "copc"])
def test_a_map_written_in_parts_holds_the_points_of_that_in_las(tmp_path, name):
    tables = [world_table(n, seed=n) for n in (55_000, 1, 0, 5_000)]
    known = read_table(write_map("las", tmp_path / "a.las", tables))
    found = read_table(write_map(name, tmp_path / f"a{MAPS[name].suffix}", tables))
    columns = (*COLUMNS, *(("red", "green", "blue") if name == "e57" else ()))
    for axis in "xyz":
        np.testing.assert_allclose(np.sort(found[axis]), np.sort(known[axis]), atol=1e-6)
    rest = [column for column in columns if column not in ("x", "y", "z", "intensity", "gps_time")]
    if name == "e57":  # 8 bits; LAS has 16
        found |= {color: found[color].astype(np.uint16) * 257 for color in ("red", "green", "blue")}
    np.testing.assert_array_equal(in_order(found, rest), in_order(known, rest))
    assert np.abs(np.sort(found["intensity"]) - np.sort(known["intensity"])).max() < 0.002
    assert MAPS[name].count(tmp_path / f"a{MAPS[name].suffix}") == 60_001


@pytest.fixture(scope="module")
def town(tmp_path_factory):
    """A COPC map and the same as LAS, of streets that are denser near the middle."""
    folder = tmp_path_factory.mktemp("copc")
    tables = [world_table(60_000, seed=k, spread=20.0 * 4**k) for k in range(3)]
    return write_map("copc", folder / "a.copc.laz", tables), write_map("las", folder / "a.las", tables)


def nodes_of(path):
    with laspy.CopcReader.open(path) as file:
        entries = file.root_page.entries
        return file.copc_info, file.header, {key: node.point_count for key, node in entries.items()}


@pytest.mark.full
def test_laspy_and_copclib_read_all_points_of_a_copc_map(town):
    cloud, plain = laspy.read(town[0]), laspy.read(town[1])
    names = [name for name in plain.point_format.dimension_names if name != "scan_angle"]
    np.testing.assert_array_equal(in_order(cloud, names), in_order(plain, names))
    assert cloud.header.parse_crs().to_epsg() == 32618
    np.testing.assert_array_equal(cloud.header.mins, plain.header.mins)
    np.testing.assert_array_equal(cloud.header.maxs, plain.header.maxs)
    np.testing.assert_array_equal(
        cloud.header.number_of_points_by_return, plain.header.number_of_points_by_return
    )
    reader = copclib.FileReader(str(town[0]))
    assert len(reader.GetAllPoints()) == len(plain) == sum(nodes_of(town[0])[2].values())
    assert reader.ValidateSpatialBounds(verbose=False)


def test_the_record_of_copc_states_cube_spacing_and_times(town):
    info, header, nodes = nodes_of(town[0])
    plain = laspy.read(town[1])
    low, high = info.center - info.halfsize, info.center + info.halfsize
    assert (low <= header.mins + 1e-6).all()
    assert (high >= header.maxs - 1e-6).all()
    assert 2 * info.halfsize == pytest.approx((header.maxs - header.mins).max(), abs=1e-6)
    assert info.spacing == pytest.approx(2 * info.halfsize / 128)
    assert (info.gps_min, info.gps_max) == (plain.gps_time.min(), plain.gps_time.max())
    assert max(key.level for key in nodes) >= 2
    assert all(key.level == 0 or any(other.level == key.level - 1 for other in nodes) for key in nodes)


def test_each_level_of_copc_is_a_sample_with_a_point_a_cell(town):
    info, _, nodes = nodes_of(town[0])
    reader = copclib.FileReader(str(town[0]))
    parents = {(k.level - 1, k.x // 2, k.y // 2, k.z // 2) for k in nodes if k.level}
    for key, count in nodes.items():
        at = (key.level, key.x, key.y, key.z)
        points = reader.GetPoints(copclib.VoxelKey(*at))
        xyz = np.column_stack([points.x, points.y, points.z])
        side = 2 * info.halfsize / 2**key.level
        place = (xyz - (info.center - info.halfsize)) / side - [key.x, key.y, key.z]
        assert len(xyz) == count
        assert place.min() > -1e-6
        assert place.max() < 1 + 1e-6
        if at in parents:
            cells = np.clip(np.floor(place * 128), 0, 127)
            edge = np.abs(place * 128 - np.rint(place * 128)).min(axis=1) < 1e-4  # rounded to either side
            inner = cells[~edge]
            assert len(np.unique(inner, axis=0)) == len(inner)
        else:
            assert count <= 50_000


@settings(deadline=None, max_examples=12)
@given(st.tuples(*[st.floats(-60, 60)] * 3), st.floats(0.5, 80))
def test_a_query_returns_the_points_of_its_box(town, middle, half):
    plain = laspy.read(town[1])
    low, high = (np.round(np.add(INFO.offset, middle) + sign * half, 3) for sign in (-1, 1))
    counts = np.column_stack([plain.X, plain.Y, plain.Z])
    least, most = (np.rint((edge - plain.header.offsets) / plain.header.scales) for edge in (low, high))
    inside = ((counts >= least) & (counts <= most)).all(axis=1)
    with laspy.CopcReader.open(town[0]) as file:
        found = file.query(laspy.copc.Bounds(mins=low, maxs=high))
    names = ("X", "Y", "Z", "gps_time", "instance")
    np.testing.assert_array_equal(in_order(found, names), in_order(plain[inside], names))


@pytest.mark.parametrize(
    "table",
    [
        world_table(0),
        world_table(1),
        {name: np.repeat(column, 60_000) for name, column in world_table(1).items()},
        world_table(60_000) | {"z": np.zeros(60_000), "y": np.full(60_000, INFO.offset[1])},
    ],
    ids=["no point", "one point", "one place", "a line"],
)
def test_copc_of_degenerate_maps_is_read(tmp_path, table):
    path = write_map("copc", tmp_path / "a.copc.laz", [table])
    with laspy.CopcReader.open(path) as file:
        assert file.header.point_count == len(table["x"])
        if len(table["x"]):
            assert len(file.query()) == len(table["x"])
    assert len(read_table(path)["x"]) == len(table["x"])


def test_copc_does_not_depend_on_how_much_is_kept_in_memory(tmp_path, monkeypatch):
    tables = [world_table(40_000, seed=k) for k in range(2)]
    first = write_map("copc", tmp_path / "a.copc.laz", tables).read_bytes()
    monkeypatch.setattr(copc, "_ROOM", 1000)
    monkeypatch.setattr(copc, "_CHUNK", 7000)
    again = write_map("copc", tmp_path / "b.copc.laz", [*tables[:1], world_table(0), *tables[1:]])
    assert again.read_bytes() == first


def test_a_map_that_fails_leaves_nothing(tmp_path):
    for name in ("copc", "e57"):
        with pytest.raises(KeyError):
            write_map(name, tmp_path / f"a{MAPS[name].suffix}", [{"x": np.zeros(3)}])
    far = world_table(3) | {"x": np.full(3, 1e8)}
    with pytest.raises(FormatError, match="too far"):
        write_map("copc", tmp_path / "a.copc.laz", [far])
    assert list(tmp_path.iterdir()) == []
