"""Sweeps as compact bytes for the page: quantised columns against a table of directions, deflated.

A return is stored by its slot (ring and column), its range, and how far its direction and time are from
those of its slot in the table. Scanners that repeat their pattern thus need hardly more than ranges; others
need more bytes, with the same bounds.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.export.kinds import compact_json
from geoscene.typing import Float, Ints
from geoscene.view.assembly import gzip
from lidar.dataset.formats.table import Table

RANGE_STEP = 1 / 256
"""Quantisation step of ranges in metres."""

ANGLE_STEP = 2 * np.pi / 2**19
"""Quantisation step of azimuth and elevation in radians: 12 µrad, of which half is 0.6 mm at 100 m."""

TIME_STEP_NS = 1000
"""Quantisation step of times in nanoseconds."""

TABLE_STEP = 2 * np.pi / 2**31
"""Unit of the table of directions in radians: rounding in it does not add to that in `ANGLE_STEP`."""

MOST_SLOTS = 1 << 22
"""Slots beyond which a table would be larger than what it saves; later slots have no entry."""

COLUMNS = (
    *("ring", "column", "range", "azimuth", "elevation", "time", "intensity", "label", "instance"),
    *("echo", "origin"),
)
"""Columns of a sweep, in the order in which they are stored."""

_DIFFERENCES = ("ring", "column", "range", "instance")
"""Columns of which the differences from row to row are stored."""

_HALF_TURN = 2**18
"""Half a turn in `ANGLE_STEP`."""


@dataclass(frozen=True, slots=True)
class Slots:
    """Direction and time of each slot, one row for each ring and column.

    rings, columns : their numbers
    azimuth, elevation : (k,) int32 in `TABLE_STEP`; 0 for slots without an entry
    time      : (k,) int32 in `TIME_STEP_NS`
    """

    rings: int
    columns: int
    azimuth: NDArray[np.int32]
    elevation: NDArray[np.int32]
    time: NDArray[np.int32]

    def of(self, ring: Ints, column: Ints) -> Ints:
        """Row (n,) of each return; the last, which is empty, for slots beyond the table."""
        row = ring * self.columns + column
        inside = (column < self.columns) & (row < len(self.azimuth) - 1)
        return np.where(inside, row, len(self.azimuth) - 1)


def slots_of(sweeps: Sequence[Table]) -> Slots:
    """The table of the directions in which sweeps found returns; of equal slots, the first sweep's."""
    slots = [(_column(t, "ring"), _column(t, "column")) for t in sweeps]
    columns = 1 + max((int(column.max(initial=0)) for _, column in slots), default=0)
    rings = 1 + max((int(ring.max(initial=0)) for ring, _ in slots), default=0)
    count = min(rings * columns, MOST_SLOTS) + 1
    table = Slots(rings, columns, *(np.zeros(count, np.int32) for _ in range(3)))
    for sweep, (ring, column) in zip(reversed(sweeps), reversed(slots), strict=True):
        row = table.of(ring, column)
        azimuth, elevation, _ = _spherical(sweep)
        table.azimuth[row] = np.rint(azimuth / TABLE_STEP)
        table.elevation[row] = np.rint(elevation / TABLE_STEP)
        table.time[row] = np.rint(_column(sweep, "time_ns") / TIME_STEP_NS)
    for values in (table.azimuth, table.elevation, table.time):
        values[-1] = 0
    return table


def pack_slots(slots: Slots) -> bytes:
    """The table as deflated bytes: the planes of its three columns, see `planes`."""
    packed = [
        planes(_differences(values.astype(np.int64)))
        for values in (slots.azimuth, slots.elevation, slots.time)
    ]
    head = {
        "rings": slots.rings,
        "columns": slots.columns,
        "count": len(slots.time),
        "planes": [n for n, _ in packed],
    }
    return gzip(_join(head, b"".join(data for _, data in packed)))


def pack_sweep(
    sweep: Table, slots: Slots, *, origin: NDArray[np.uint8] | None, head: dict[str, Any]
) -> bytes:
    """A sweep as deflated bytes: JSON with its length before it, then the planes of `COLUMNS`.

    origin : (n,) `lidar.sensors.physics.echoes.Origin` of each return; None if no stage changed the sweep
    head   : further entries of the JSON

    Returns are sorted by ring, column and echo.
    """
    ring, column = _column(sweep, "ring"), _column(sweep, "column")
    echo = _column(sweep, "echo")
    order = np.lexsort([echo, column, ring])
    row = slots.of(ring, column)
    azimuth, elevation, distance = _spherical(sweep)
    palette, instance = np.unique(_column(sweep, "instance", default=-1), return_inverse=True)
    turn = np.rint((azimuth - slots.azimuth[row] * TABLE_STEP) / ANGLE_STEP).astype(np.int64)
    values = {
        "ring": ring,
        "column": column,
        "range": np.rint(distance / RANGE_STEP).astype(np.int64),
        "azimuth": (turn + _HALF_TURN) % (2 * _HALF_TURN) - _HALF_TURN,
        "elevation": np.rint((elevation - slots.elevation[row] * TABLE_STEP) / ANGLE_STEP).astype(np.int64),
        "time": np.rint(_column(sweep, "time_ns") / TIME_STEP_NS).astype(np.int64) - slots.time[row],
        "intensity": np.rint(sweep["intensity"].astype(float)).clip(0, 255).astype(np.int64),
        "label": _column(sweep, "label"),
        "instance": instance.ravel(),
        "echo": echo,
        "origin": np.zeros(len(ring), np.int64) if origin is None else origin.astype(np.int64),
    }
    packed = []
    for name in COLUMNS:
        sorted_values = values[name][order]
        packed.append(planes(_differences(sorted_values) if name in _DIFFERENCES else sorted_values))
    about = {"count": len(ring), "planes": [n for n, _ in packed], "instances": palette.tolist(), **head}
    return gzip(_join(about, b"".join(data for _, data in packed)))


def planes(values: Ints) -> tuple[int, bytes]:
    """Whole numbers (n,) as bytes by rank, the lowest first: as many planes as the largest needs.

    Negative numbers are interleaved with positive ones (0, -1, 1, -2 ...), so that small numbers of either
    sign have empty high planes, which are not stored.
    """
    folded = ((values << 1) ^ (values >> 63)).astype("<u8")
    count = (int(folded.max(initial=0)).bit_length() + 7) // 8
    return count, np.ascontiguousarray(folded.view(np.uint8).reshape(-1, 8)[:, :count].T).tobytes()


def _differences(values: Ints) -> Ints:
    """Differences (n,) from row to row; the first is the first value."""
    found: Ints = np.diff(values, prepend=np.int64(0))
    return found


def _join(head: dict[str, Any], data: bytes) -> bytes:
    text = compact_json(head)
    return struct.pack("<I", len(text)) + text + data


def _spherical(sweep: Table) -> tuple[Float, Float, Float]:
    """Azimuth, elevation and distance (n,) of points from the sensor's origin."""
    x, y, z = (sweep[axis].astype(float) for axis in "xyz")
    flat = np.hypot(x, y)
    return np.arctan2(y, x), np.arctan2(z, flat), np.hypot(flat, z)


def _column(sweep: Table, name: str, *, default: int = 0) -> Ints:
    """A column (n,) of whole numbers."""
    if name not in sweep:
        return np.full(len(sweep["x"]), default, np.int64)
    return sweep[name].astype(np.int64)
