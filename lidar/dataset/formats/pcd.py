"""PCD 0.7 as PCL, Open3D and ROS tools read it: written as binary, read as binary and ASCII."""

from __future__ import annotations

import io
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import numpy as np

from geoscene.errors import reason_of
from geoscene.support.files import write_atomically
from lidar.dataset.formats.las import LasInfo
from lidar.dataset.formats.table import Table, counted_file, number_in_header, records, rows
from lidar.errors import FormatError

_KIND = {"f": "F", "i": "I", "u": "U"}
_NAMES = {"time_ns": "t"}  # the field name that odometry programs look for; nanoseconds, unsigned
_COLUMNS = {"t": "time_ns"}


def pcd_header(table: Table, points: int, *, data: str = "binary", comment: str = "") -> bytes:
    """The header of a PCD file with the columns of a table.

    points  : number of points in the file
    data    : encoding of the points: ``binary`` or ``ascii``
    comment : a line after the format's own comment line
    """
    fields = [column.dtype for column in table.values()]
    lines = [
        "# .PCD v0.7 - Point Cloud Data file format",
        *([f"# {comment}"] if comment else []),
        "VERSION 0.7",
        "FIELDS " + " ".join(_NAMES.get(name, name) for name in table),
        "SIZE " + " ".join(str(f.itemsize) for f in fields),
        "TYPE " + " ".join(_KIND[f.kind] for f in fields),
        "COUNT " + " ".join("1" for _ in fields),
        f"WIDTH {points}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {points}",
        f"DATA {data}\n",
    ]
    return "\n".join(lines).encode("ascii")


def write(path: Path, table: Table, *, comment: str = "") -> None:
    """Write a table as binary PCD."""
    write_atomically(path, pcd_header(table, rows(table), comment=comment), records(table))


def read(path: Path) -> Table:
    """The table of a binary or ASCII PCD file; its field ``t`` is the column ``time_ns``.

    Raises FormatError for compressed and damaged files, and for fields of several values.
    """
    head, marker, rest = path.read_bytes().partition(b"\nDATA ")
    encoding, _, body = rest.partition(b"\n")
    entries = {
        words[0]: words[1:]
        for words in (line.split() for line in head.decode("ascii", "replace").splitlines())
        if words and words[0] != "#"
    }
    if not marker or "FIELDS" not in entries:
        raise FormatError(f"{path}: not a PCD file (no FIELDS and DATA lines)")
    if encoding.strip() not in (b"binary", b"ascii"):
        stated = encoding.decode("ascii", "replace").strip()[:40]
        raise FormatError(
            f"{path}: DATA {stated} is not supported; write it again as binary or ascii"
            " (pcl_convert_pcd_ascii_binary)"
        )
    if set(entries.get("COUNT", ["1"])) != {"1"}:
        raise FormatError(f"{path}: has fields of several values (COUNT {' '.join(entries['COUNT'])})")
    try:
        names = [_COLUMNS.get(name, name) for name in entries["FIELDS"]]
        types = [f"<{t.lower()}{s}" for t, s in zip(entries["TYPE"], entries["SIZE"], strict=True)]
        kinds, points = np.dtype(list(zip(names, types, strict=True))), int(entries["POINTS"][0])
        if encoding.strip() == b"binary":
            data = np.frombuffer(body, kinds, points)
        else:
            data = np.loadtxt(io.BytesIO(body), kinds, ndmin=1) if points else np.empty(0, kinds)
    except (KeyError, ValueError, TypeError, IndexError) as error:
        raise FormatError(f"{path}: damaged PCD header or data ({reason_of(error)})") from error
    if len(data) != points:
        raise FormatError(f"{path}: holds {len(data)} points, and its header states {points}")
    return {name: data[name] for name in names}


def count(path: Path) -> int:
    """Number of points of a file."""
    return number_in_header(path, b"POINTS")


def open_map(
    path: Path,
    info: LasInfo,
    *,
    columns: tuple[str, ...],  # noqa: ARG001 - any columns will do
) -> AbstractContextManager[Callable[[Table], None]]:
    """Yield a function that appends tables to a map.

    Readers take float32 coordinates only: they are relative to the offset that the comment line states.
    """
    note = f"add {' '.join(f'{o:.0f}' for o in info.offset)} for {info.crs.name}"
    return counted_file(
        path,
        lambda table: _map_table(table, info.offset),
        header=lambda table, points: pcd_header(table, points, comment=note),
    )


def _map_table(table: Table, offset: tuple[float, float, float]) -> Table:
    """A table of a map with float32 coordinates less the offset, and its colour packed as PCL has it."""
    shifted = {k: (table[k] - s).astype(np.float32) for k, s in zip("xyz", offset, strict=True)}
    red, green, blue = (table[name].astype(np.uint32) for name in ("red", "green", "blue"))
    rest = {k: v for k, v in table.items() if k not in ("x", "y", "z", "red", "green", "blue")}
    return shifted | {"rgb": (red << 16 | green << 8 | blue).view(np.float32)} | rest
