"""Parquet: a file per frame; to programs that read folders of Parquet, those of a dataset are one table.

Beside the columns of a cloud, a file has ``sensor``, ``frame`` and ``start_ns``, the frame's start in
nanoseconds of the drive. It keeps the types of columns.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from geoscene.errors import need
from geoscene.support.files import atomic_path
from lidar.dataset.formats.table import NO_FRAME, FrameInfo, Table, rows
from lidar.errors import FormatError

_OF_FRAME = ("sensor", "frame", "start_ns")


def _pyarrow(module: str = "pyarrow") -> Any:
    return need(module, "gis")


def write(path: Path, table: Table, *, frame: FrameInfo = NO_FRAME) -> None:
    """Write a table as Parquet: Zstandard, floats split by bytes, integers by dictionaries."""
    pa, parquet = _pyarrow(), _pyarrow("pyarrow.parquet")
    n = rows(table)
    columns = {
        "sensor": pa.repeat(pa.scalar(frame.sensor), n),
        "frame": np.full(n, frame.frame, np.int32),
        "start_ns": np.full(n, frame.start_ns, np.int64),
        **table,
    }
    split = [name for name, column in table.items() if column.dtype.kind == "f"]
    with atomic_path(path) as part:
        parquet.write_table(
            pa.table(columns),
            part,
            compression="zstd",
            use_dictionary=[name for name in columns if name not in split],
            use_byte_stream_split=split,
        )


def read(path: Path) -> Table:
    """The table of a Parquet file of one frame, without the columns that are those of the frame.

    Raises FormatError for a file that is damaged, lacks x, y and z, or has columns that are no numbers.
    """
    pa, parquet = _pyarrow(), _pyarrow("pyarrow.parquet")
    data = pa.py_buffer(path.read_bytes())
    try:
        with parquet.ParquetFile(pa.BufferReader(data)) as file:
            names = [name for name in file.schema_arrow.names if name not in _OF_FRAME]
            found = file.read(names)
        table = {name: found[name].to_numpy() for name in names}
    except (ValueError, KeyError, OSError, NotImplementedError) as error:
        raise FormatError(f"{path}: not a readable Parquet file ({_line(error)})") from error
    if lacks := [axis for axis in "xyz" if axis not in table]:
        raise FormatError(f"{path}: has no column {', '.join(lacks)}")
    if texts := [name for name, column in table.items() if column.dtype.kind not in "iuf"]:
        raise FormatError(f"{path}: columns {', '.join(texts)} are no numbers")
    return table


def count(path: Path) -> int:
    """Number of points of a file."""
    return int(_pyarrow("pyarrow.parquet").read_metadata(path).num_rows)


def _line(error: Exception) -> str:
    return " ".join(str(error).split())[:200]
