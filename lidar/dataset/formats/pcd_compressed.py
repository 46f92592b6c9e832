"""PCD 0.7 as PCL's binary_compressed: a column after another, compressed by LZF."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from geoscene.support.files import write_atomically
from lidar.dataset.formats.lzf import compress
from lidar.dataset.formats.pcd import count, pcd_header, read
from lidar.dataset.formats.table import Table, rows
from lidar.errors import FormatError

__all__ = ["count", "read", "write"]

_MOST = 2**32 - 1
"""Bytes of points, before and after compression; the format states them in 32 bits."""


def write(path: Path, table: Table) -> None:
    """Write a table as compressed PCD.

    Raises FormatError for more than 4 GiB of points.
    """
    columns = [column.astype(column.dtype.newbyteorder("<")).tobytes() for column in table.values()]
    data = np.frombuffer(b"".join(columns), np.uint8)
    packed = compress(data)
    if max(len(data), len(packed)) > _MOST:
        raise FormatError(f"{path}: {len(data)} bytes of points; compressed PCD holds at most {_MOST}")
    sizes = np.array([len(packed), len(data)], "<u4")
    header = pcd_header(table, rows(table), data="binary_compressed")
    write_atomically(path, header, sizes, packed)
