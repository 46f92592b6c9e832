"""PCD 0.7 as ASCII, for text tools and for readers that take no binary PCD."""

from __future__ import annotations

from pathlib import Path

from geoscene.support.files import write_atomically
from lidar.dataset.formats.pcd import count, pcd_header, read
from lidar.dataset.formats.table import Table, rows

__all__ = ["count", "read", "write"]


def write(path: Path, table: Table) -> None:
    """Write a table as ASCII PCD, floats in the shortest text that reads back the same."""
    columns = [column.astype(str).tolist() for column in table.values()]
    lines = [" ".join(row) + "\n" for row in zip(*columns, strict=True)]
    header = pcd_header(table, rows(table), data="ascii")
    write_atomically(path, header + "".join(lines).encode("ascii"))
