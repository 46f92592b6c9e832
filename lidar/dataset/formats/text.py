"""CSV with a header line and a fixed number of decimals per column."""

from __future__ import annotations

import logging
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.errors import reason_of
from geoscene.support.compiled import njit
from geoscene.support.files import write_atomically
from lidar.dataset.formats.table import Table, rows
from lidar.errors import FormatError

log = logging.getLogger(__name__)

_METRES = ("x", "y", "z", "range", "true_range", "velocity")
_DECIMALS = dict.fromkeys(_METRES, 4) | {"intensity": 2, "incidence": 5}
_TYPES: dict[str, Any] = {
    "intensity": np.float32,
    "time_ns": np.int64,
    "ring": np.uint16,
    "column": np.uint32,
    "label": np.uint16,
    "instance": np.int32,
    **dict.fromkeys(("echo", "echoes", "red", "green", "blue"), np.uint8),
}


@njit(cache=True, nogil=True)
def _format(values: NDArray[np.int64], decimals: NDArray[np.int64], out: NDArray[np.uint8]) -> int:
    """Write fixed-point rows as text into ``out``, 22 bytes per value; return the number of bytes."""
    digits = np.empty(24, np.uint8)
    at = 0
    for i in range(values.shape[0]):
        for j in range(values.shape[1]):
            value = values[i, j]
            if value < 0:
                out[at] = 45
                at += 1
                value = -value
            n = 0
            while value > 0 or n <= decimals[j]:  # at least one digit before the point
                digits[n] = 48 + value % 10
                value //= 10
                n += 1
            for k in range(n - 1, -1, -1):
                out[at] = digits[k]
                at += 1
                if k == decimals[j] and k > 0:
                    out[at] = 46
                    at += 1
            out[at] = 44 if j < values.shape[1] - 1 else 10
            at += 1
    return at


def write(path: Path, table: Table) -> None:
    """Write a table as CSV: metres with 4 decimals, integers as they are."""
    decimals = np.array([_DECIMALS.get(name, 0) for name in table], np.int64)
    values = np.empty((rows(table), len(table)), np.int64)
    for j, (column, places) in enumerate(zip(table.values(), decimals, strict=True)):
        values[:, j] = np.rint(column.astype(np.float64) * 10.0**places) if places else column
    out = np.empty(values.size * 22 + 1, np.uint8)
    text = out[: _format(values, decimals, out)]
    write_atomically(path, (",".join(table) + "\n").encode("ascii"), text)


def read(path: Path) -> Table:
    """The table of a CSV file with a header line.

    Raises FormatError if the columns cannot be read as numbers.
    """
    header, _, body = path.read_text(encoding="ascii", errors="replace").partition("\n")
    if body and not body.endswith("\n"):
        log.warning("%s: does not end with a line break: its last number may be cut", path)
    names = header.strip().split(",")
    if "x" not in names:
        raise FormatError(f"{path}: its first line does not name a column x")
    try:
        values = np.loadtxt(StringIO(body), delimiter=",", ndmin=2) if body else np.empty((0, len(names)))
    except ValueError as error:
        raise FormatError(f"{path}: not a table of numbers ({reason_of(error)})") from error
    if values.shape[1] != len(names):
        raise FormatError(f"{path}: {values.shape[1]} numbers a line under {len(names)} names")
    return {name: values[:, j].astype(_TYPES.get(name, np.float64)) for j, name in enumerate(names)}


def count(path: Path) -> int:
    """Number of points of a file."""
    return sum(1 for line in path.read_bytes().splitlines() if line) - 1
