"""PLY, binary little-endian, with 16-bit columns as 32 bits: some readers drop 16-bit properties."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import numpy as np

from geoscene.errors import reason_of
from geoscene.support.files import write_atomically
from lidar.dataset.formats.las import LasInfo
from lidar.dataset.formats.table import Table, counted_file, number_in_header, records, rows
from lidar.errors import FormatError

_TYPES = {
    "float32": "float",
    "float64": "double",
    "uint8": "uchar",
    "int32": "int",
    "uint32": "uint",
    "int8": "char",
    "int16": "short",
    "uint16": "ushort",
}
_COUNT_WIDTH = 12


def ply_table(table: Table) -> Table:
    """The columns as stored: ``t`` in seconds (double) for ``time_ns``, 32 bits for 16."""
    out: Table = {}
    for name, column in table.items():
        if name == "time_ns":
            out["t"] = column.astype(np.float64) * 1e-9
        elif column.dtype == np.uint16:
            out[name] = column.astype(np.uint32)
        else:
            out[name] = column
    return out


def ply_header(table: Table, count: int, *, comments: tuple[str, ...] = ()) -> bytes:
    """The header for ``count`` vertices of a PLY table; its length does not depend on the count."""
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {c}" for c in comments)]
    lines += [f"element vertex {count:0{_COUNT_WIDTH}d}"]
    lines += [f"property {_TYPES[column.dtype.name]} {name}" for name, column in table.items()]
    return ("\n".join([*lines, "end_header"]) + "\n").encode("ascii")


def write(path: Path, table: Table, *, comments: tuple[str, ...] = ()) -> None:
    """Write a table as PLY."""
    out = ply_table(table)
    write_atomically(path, ply_header(out, rows(out), comments=comments), records(out))


def read(path: Path) -> Table:
    """The table of a PLY file of vertices; ``t`` comes back as ``time_ns``.

    Raises FormatError for anything that is not binary little-endian with scalar vertex properties.
    """
    raw = path.read_bytes()
    head, marker, body = raw.partition(b"end_header\n")
    lines = head.decode("ascii", "replace").splitlines()
    if not marker or lines[:2] != ["ply", "format binary_little_endian 1.0"]:
        raise FormatError(f"{path}: not a binary little-endian PLY file")
    kinds = {v: k for k, v in _TYPES.items()}
    words = [line.split() for line in lines]
    try:
        count = _vertices(words)
        fields = [(w[2], np.dtype(kinds[w[1]]).newbyteorder("<")) for w in words if w[0] == "property"]
        data = np.frombuffer(body, np.dtype(fields), count)
    except (StopIteration, KeyError, ValueError, IndexError) as error:
        raise FormatError(f"{path}: damaged PLY header or data ({reason_of(error)})") from error
    table = {name: data[name] for name, _ in fields}
    if "t" in table:
        nanoseconds = np.rint(table["t"] * 1e9).astype(np.int64)
        table = {("time_ns" if n == "t" else n): (nanoseconds if n == "t" else c) for n, c in table.items()}
    for name in ("ring", "label"):
        if name in table:
            table[name] = table[name].astype(np.uint16)
    return table


def _vertices(words: list[list[str]]) -> int:
    """The number of vertices that the words of a header state; raises ValueError or StopIteration without."""
    number = next(int(w[2]) for w in words if w[:2] == ["element", "vertex"])
    if number < 0:
        raise ValueError(f"{number} vertices")
    return number


def count(path: Path) -> int:
    """Number of points of a file."""
    return number_in_header(path, b"element vertex")


def open_map(
    path: Path,
    info: LasInfo,
    *,
    columns: tuple[str, ...],  # noqa: ARG001 - any columns will do
) -> AbstractContextManager[Callable[[Table], None]]:
    """Yield a function that appends tables to a map in double precision; a comment names its CRS."""
    comments = (f"crs {info.crs.name}",)
    return counted_file(path, ply_table, header=lambda t, n: ply_header(t, n, comments=comments))
