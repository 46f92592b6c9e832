"""NPZ and Parquet against the readers of others."""

import io
import sys
import zipfile

import numpy as np
import pyarrow.dataset
import pyarrow.parquet
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from geoscene.errors import MissingExtraError
from lidar.dataset.formats import FORMATS, npz, parquet, read_table
from lidar.dataset.formats.table import FrameInfo
from lidar.errors import FormatError, InputError
from lidar.settings import RecordingSettings


def table(n=400, seed=0):
    rng = np.random.default_rng(seed)
    return {
        **{axis: rng.normal(size=n).astype(np.float32) for axis in "xyz"},
        "time_ns": np.sort(rng.integers(0, 10**8, n)).astype(np.uint32),
        "ring": np.tile(np.arange(16, dtype=np.uint16), n // 16 + 1)[:n],
        "instance": rng.integers(-1, 9, n).astype(np.int32),
    }


def test_numpy_reads_our_npz_without_pickles(tmp_path):
    cloud = table()
    npz.write(tmp_path / "a.npz", cloud)
    with np.load(tmp_path / "a.npz", allow_pickle=False) as file:
        assert file.files == list(cloud)
        for name, column in cloud.items():
            assert file[name].dtype == column.dtype
            np.testing.assert_array_equal(file[name], column)


@pytest.mark.parametrize(
    ("arrays", "says"),
    [
        ({"x": np.zeros(3)}, "has no array y, z"),
        ({"x": np.zeros(3), "y": np.zeros(3), "z": np.zeros(2)}, "differ in length"),
        ({"x": np.zeros((3, 2)), "y": np.zeros(3), "z": np.zeros(3)}, "no column of numbers"),
        ({k: np.array([None] * 3) for k in "xyz"}, "holds objects, not numbers"),
    ],
)
def test_npz_of_other_arrays_is_refused(tmp_path, arrays, says):
    np.savez(tmp_path / "a.npz", **arrays)
    with pytest.raises(FormatError, match=says):
        read_table(tmp_path / "a.npz")


def test_npz_that_states_more_numbers_than_it_holds_is_refused(tmp_path):
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(head, {"shape": (10**15,), "fortran_order": False, "descr": "<f8"})
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as file:
        file.writestr("x.npy", head.getvalue())
    with pytest.raises(FormatError, match="does not hold"):
        read_table(tmp_path / "a.npz")


def test_parquet_files_of_a_drive_are_one_table(tmp_path):
    clouds = {("top", 0): table(seed=0), ("top", 1): table(seed=1), ("front", 0): table(seed=2)}
    for (sensor, frame), cloud in clouds.items():
        path = FORMATS["parquet"].path(tmp_path / sensor, frame)
        FORMATS["parquet"].write(path, cloud, frame=FrameInfo(sensor, frame, frame * 10**8))
    whole = pyarrow.dataset.dataset(tmp_path, format="parquet").to_table()
    assert whole.num_rows == 1200
    for (sensor, frame), cloud in clouds.items():
        of_sensor = pyarrow.dataset.field("sensor") == sensor
        part = whole.filter(of_sensor & (pyarrow.dataset.field("frame") == frame))
        assert set(part["start_ns"].to_pylist()) == {frame * 10**8}
        for name, column in cloud.items():
            assert part[name].to_numpy().dtype == column.dtype
            np.testing.assert_array_equal(part[name].to_numpy(), column)
        assert list(read_table(FORMATS["parquet"].path(tmp_path / sensor, frame))) == list(cloud)


def test_parquet_of_other_tables_is_refused(tmp_path):
    path = tmp_path / "a.parquet"
    pyarrow.parquet.write_table(pyarrow.table({"x": [1.0], "y": [2.0]}), path)
    with pytest.raises(FormatError, match="has no column z"):
        parquet.read(path)
    pyarrow.parquet.write_table(pyarrow.table({"x": [1.0], "y": [2.0], "z": ["high"]}), path)
    with pytest.raises(FormatError, match="columns z are no numbers"):
        parquet.read(path)


@pytest.mark.parametrize("name", ["npz", "parquet"])
@settings(deadline=None, max_examples=40)
@given(seed=st.integers(0, 2**32))
def test_changed_bytes_are_read_or_refused_in_one_line(tmp_path_factory, name, seed):
    form, rng = FORMATS[name], np.random.default_rng(seed)
    path = tmp_path_factory.mktemp("damaged") / f"a{form.suffix}"
    form.write(path, table(50))
    data = bytearray(path.read_bytes())
    for at in rng.integers(0, len(data), rng.integers(1, 6)):
        data[at] = rng.integers(256)
    path.write_bytes(data[: rng.integers(len(data))] if seed % 3 == 0 else data)
    for function in (form.read, form.count):
        said = ""
        try:
            function(path)
        except FormatError as error:
            said = str(error)
        assert "\n" not in said


@pytest.mark.parametrize(("name", "extra"), [("parquet", "gis"), ("e57", "e57")])
def test_a_drive_names_the_extra_that_its_format_needs_before_it_starts(monkeypatch, name, extra):
    monkeypatch.setitem(sys.modules, FORMATS[name].extra.split()[0], None)
    with pytest.raises(MissingExtraError, match=rf"geoscene\[{extra}\]"):
        RecordingSettings(formats=("pcd", name))


def test_a_removed_format_names_its_successors():
    with pytest.raises(InputError, match="pcd-compressed: no longer written; use pcd"):
        RecordingSettings(formats=("pcd-compressed",))
