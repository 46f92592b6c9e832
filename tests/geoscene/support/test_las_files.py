"""Damaged LAS, LAZ and COPC files: one clear error each, and never the end of the process."""

import subprocess
import sys

import laspy
import numpy as np
import pytest

from geoscene.clouds.read import open_cloud
from geoscene.errors import DamagedFileError
from geoscene.support.las_files import open_las

READ_MUTATED = """
import sys
from pathlib import Path
import numpy as np
from geoscene.errors import DamagedFileError
from geoscene.support.las_files import open_las
whole, path = Path(sys.argv[1]).read_bytes(), Path(sys.argv[2])
refused = 0
for seed in range(60):
    rng = np.random.default_rng(seed)
    size = int(rng.integers(4, 400))
    near = (0, 700), (len(whole) - 300, len(whole)), (0, len(whole))
    low, high = near[seed % 3]
    at = int(rng.integers(low, max(high - size, low + 1)))
    block = rng.bytes(size) if seed % 2 else whole[at // 2 : at // 2 + size]
    damaged = whole[:at] + block + whole[at + (size if seed % 4 else 0) :]
    path.write_bytes(damaged if seed % 5 else damaged[: int(rng.integers(1, len(whole)))])
    try:
        with open_las(path) as reader:
            for points in reader.chunk_iterator(10_000):
                len(points.x)
    except DamagedFileError as error:
        assert path.name in str(error) and "\\n" not in str(error)
        refused += 1
print(refused)
"""


def write_las(path, *, point_format, count=1000, extra=False):
    header = laspy.LasHeader(version="1.4" if point_format > 5 else "1.2", point_format=point_format)
    header.scales = np.full(3, 0.001)
    if extra:
        header.add_extra_dims([laspy.ExtraBytesParams("ring", "u2")])
    las, rng = laspy.LasData(header), np.random.default_rng(1)
    las.x, las.y, las.z = (np.cumsum(rng.normal(0, 0.1, count)) for _ in "xyz")
    las.return_number[:] = las.number_of_returns[:] = 1
    las.write(path)


@pytest.mark.parametrize(
    ("point_format", "extra"), [(1, False), (3, True), (6, False), (7, True), (8, False)]
)
def test_a_damaged_file_is_refused_and_does_not_end_the_process(tmp_path, point_format, extra):
    write_las(tmp_path / "a.laz", point_format=point_format, extra=extra)
    command = [sys.executable, "-c", READ_MUTATED, tmp_path / "a.laz", tmp_path / "b.laz"]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    assert int(run.stdout) > 20


def test_a_chunk_table_of_more_chunks_than_memory_is_refused(tmp_path):
    path = tmp_path / "a.laz"
    write_las(path, point_format=7)
    whole = path.read_bytes()
    start = int.from_bytes(whole[96:100], "little")
    at = int.from_bytes(whole[start : start + 8], "little") + 4
    path.write_bytes(whole[:at] + b"\xff\xff\xff\xf1" + whole[at + 4 :])
    with pytest.raises(DamagedFileError, match=r"a\.laz: damaged .*chunk table states more"):
        open_cloud(path, crs="EPSG:32618")


@pytest.mark.parametrize("suffix", ["las", "laz"])
@pytest.mark.parametrize("point_format", [1, 6])
def test_a_header_with_half_the_points_is_refused(tmp_path, suffix, point_format):
    path = tmp_path / f"a.{suffix}"
    write_las(path, point_format=point_format)
    head = bytearray(path.read_bytes())
    places = [(107, 4)] if point_format < 6 else [(247, 8)]
    for at, size in places:
        head[at : at + size] = (500).to_bytes(size, "little")
    path.write_bytes(head)
    with pytest.raises(DamagedFileError, match="its header states 500 points, and"), open_las(path):
        pass
    number_by_return = 111 if point_format < 6 else 255  # also if the numbers by return agree
    head[number_by_return : number_by_return + 4] = (500).to_bytes(4, "little")
    path.write_bytes(head)
    held = "it holds more" if (suffix, point_format) == ("laz", 1) else ".*1000"  # its chunks state no number
    with pytest.raises(DamagedFileError, match=f"its header states 500 points, and {held}"), open_las(path):
        pass


@pytest.mark.parametrize("count", [1, 2, 1000, 50_000, 50_001])
def test_equal_points_which_need_parts_of_a_bit_each_are_read(tmp_path, count):
    header = laspy.LasHeader(version="1.2", point_format=1)
    las = laspy.LasData(header)
    las.x = las.y = las.z = np.zeros(count)
    las.return_number[:] = las.number_of_returns[:] = 1
    las.write(tmp_path / "a.laz")
    with open_las(tmp_path / "a.laz") as reader:
        assert len(reader.read()) == count


def test_a_file_of_several_chunks_is_read_whole(tmp_path):
    write_las(tmp_path / "a.laz", point_format=6, count=120_000)
    with open_las(tmp_path / "a.laz") as reader:
        assert sum(len(points) for points in reader.chunk_iterator(50_000)) == 120_000
