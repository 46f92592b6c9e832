"""Watermark of point clouds by quantisation index modulation (Changalvala and Malik 2019), keyed.

Each coordinate carries one bit: the parity of its index in a lattice of half the step. The lattice's offset
(dither), its exact step and the bit come from a keyed pseudo-random function of sensor, frame, ring, column
and echo, and the bit also of the three returns before it in the ring, so that neither other positions, nor a
shift by multiples of the step, nor a copy from another frame or beam, nor a gap of removed returns fits.
"""

from __future__ import annotations

import hashlib
import hmac
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from geoscene.typing import Float
from lidar.errors import InputError

STEP = 0.05
"""Default distance in metres of lattice points of the same bit (Changalvala and Malik 2019)."""

SPREAD = 0.04
"""Largest share by which the step of a coordinate is longer or shorter than the mean one."""

CHAINED = 3
"""Returns before one in its ring that its bits depend on; a gap passes unseen one time in 8^3."""

_CELL = np.dtype([("dither", "<u2", 3), ("stretch", "<u2", 3), ("own", "u1"), ("of_later", "u1", CHAINED)])
"""What the pseudo-random function gives for an echo of a pulse."""

_MOST_COLUMNS = 1 << 22
"""Columns of a frame at most; more are a damaged or forged file."""


@dataclass(frozen=True)
class WatermarkCells:
    """Which pulses the returns of a frame belong to.

    sensor, frame : name and number
    ring, column, echo : (n,) as of `lidar.sensors.laser.cloud.Cloud`
    """

    sensor: str
    frame: int
    ring: NDArray[np.integer]
    column: NDArray[np.integer]
    echo: NDArray[np.integer]

    def where(self, keep: NDArray[np.bool_]) -> WatermarkCells:
        """The returns of a mask (n,)."""
        return replace(self, ring=self.ring[keep], column=self.column[keep], echo=self.echo[keep])

    def order(self) -> NDArray[np.intp]:
        """Rows (n,) sorted by ring, column and echo."""
        return np.lexsort((self.echo, self.column, self.ring))


@dataclass(frozen=True)
class Decoded:
    """Decoded watermark of the returns of a frame.

    wrong : (n, 3) bool, bits of x, y, z that are not those of the key
    off   : (n, 3) metres from the nearest lattice point, of either bit
    """

    wrong: NDArray[np.bool_]
    off: Float


@dataclass(frozen=True)
class WatermarkKey:
    """A key and the distance in metres of lattice points of the same bit.

    Raises InputError for a step that is not positive.
    """

    key: bytes
    step: float = STEP

    def __post_init__(self) -> None:
        """Validate the step."""
        if not 1e-4 <= self.step <= 1:
            raise InputError(f"`step` {self.step:g}: give 0.0001 to 1 metre")

    def embedded(self, xyz: NDArray[np.floating], cells: WatermarkCells) -> Float:
        """Coordinates (n, 3) with the watermark, each at most half its step off."""
        dither, half, bits = self._expected(cells)
        index = bits + 2 * np.rint(((xyz - dither) / half - bits) / 2)
        marked: Float = dither + half * index
        return marked

    def decoded(self, xyz: NDArray[np.floating], cells: WatermarkCells) -> Decoded:
        """Bits and lattice distances of coordinates (n, 3) in the sensor frame."""
        dither, half, bits = self._expected(cells)
        index = np.rint((xyz - dither) / half)
        return Decoded(index % 2 != bits, xyz - dither - half * index)

    def error_rate(self, sigma: float, *, within: float = np.inf) -> float:
        """Share of bits that Gaussian noise with a standard deviation in metres makes wrong.

        within : a bit also counts as wrong where its coordinate is farther from the lattice, metres
        """
        middles = (np.arange(64) + 0.5) / 32 - 1
        return float(
            np.mean([bit_error_rate(s, sigma, within=within) for s in self.step * (1 + SPREAD * middles)])
        )

    def _expected(self, cells: WatermarkCells) -> tuple[Float, Float, NDArray[np.uint8]]:
        """Dither, half the step (n, 3) in metres and bits (n, 3) of returns."""
        order = cells.order()
        values = self._cells(cells)[order]
        ring = cells.ring[order]
        bits = values["own"]
        for back in range(CHAINED):
            bits = bits ^ values["of_later"][earlier(ring, back + 1), back]
        row = np.argsort(order)
        half = self.step / 2 * (1 + SPREAD * (values["stretch"][row] / 32767.5 - 1))
        dither: Float = values["dither"][row] / 32768 * half
        return dither, half, ((bits[row, None] >> np.arange(3)) & 1).astype(np.uint8)

    def _cells(self, cells: WatermarkCells) -> NDArray[np.void]:
        """The pseudo-random function (n,) of each return."""
        frame_key = hmac.digest(self.key, f"watermark/{cells.sensor}/{cells.frame}".encode(), "sha256")
        out = np.zeros(len(cells.ring), _CELL)
        column = cells.column.astype(np.int64)
        if len(column) and not 0 <= column.min() <= column.max() < _MOST_COLUMNS:
            raise InputError(f"{cells.sensor} {cells.frame:06d}: columns that no scanner has")
        lane = cells.ring.astype(np.int64) << 8 | cells.echo.astype(np.int64)
        order = np.argsort(lane, kind="stable")
        first = np.flatnonzero(np.diff(lane[order], prepend=-1))
        for rows in np.split(order, first[1:]):
            if len(rows):
                stream = hashlib.shake_256(frame_key + int(lane[rows[0]]).to_bytes(4, "little"))
                size = (int(column[rows].max()) + 1) * _CELL.itemsize
                out[rows] = np.frombuffer(stream.digest(size), _CELL)[column[rows]]
        return out


def earlier(ring: NDArray[np.integer], back: int) -> NDArray[np.intp]:
    """Row (n,) of the return ``back`` places before each in its ring, round the turn; rings are sorted."""
    first = np.flatnonzero(np.diff(ring.astype(np.int64), prepend=-1))
    count = np.diff(np.append(first, len(ring)))
    start, size = np.repeat(first, count), np.repeat(count, count)
    row: NDArray[np.intp] = start + (np.arange(len(ring)) - start - back) % size
    return row


def bit_error_rate(step: float, sigma: float, *, within: float = np.inf) -> float:
    """Share of wrong bits after Gaussian noise with a standard deviation in metres, of one exact step.

    Sum over the lattice of the probability that noise carries a coordinate near no point of its own bit.

    within : metres from such a point that count as near; half way to the next one of the other bit by default
    """
    from scipy.special import ndtr  # noqa: PLC0415  (0.2 s)

    if sigma <= 0:
        return 0.0
    reach = min(within, step / 4)
    k = np.arange(int(12 * sigma / step) + 2)
    return float(2 * (ndtr(-(reach + k * step) / sigma) - ndtr(-(step - reach + k * step) / sigma)).sum())
