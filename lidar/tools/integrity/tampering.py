"""Tampered places by a cloud's watermark: returns that were added or moved, and gaps of removed ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoscene.support.graphs import components
from geoscene.typing import Float, Ints
from lidar.tools.integrity.digests import SECTORS, block_of
from lidar.tools.integrity.watermark import CHAINED, Decoded, WatermarkCells, WatermarkKey, earlier

NOISE = 0.001
"""Default standard deviation in metres of noise since the watermark was embedded, such as of rounding."""

_FINEST = 2e-4
"""Metres of noise that is always allowed for: float32 and text with 4 decimals."""

_OFF = 5.0
"""Standard deviations from the lattice from which a coordinate counts as wrong."""

_LINK = 1.0
"""Metres between returns of the same place."""

_TURN, _DEPTH = 1.0, 3.0
"""Degrees and metres of range between returns of neighbouring beams of the same place."""

_FEWEST = 3
"""Returns of a place; fewer are left to the blocks' counts."""

_NEIGHBOURS = 6
"""Returns, with itself, that decide together whether one is genuine where noise is strong."""

_ABSENT = 0.4
"""Share of wrong bits from which a cloud has no watermark; without one it is a half."""

_WIDEST = 170.0
"""Degrees of a gap that is filled with the directions of removed returns."""

_NEAREST = 8
"""Nearest points, with itself, to which each one is linked first; they join almost all cells."""

_AT_ONCE = 1_000_000
"""Pairs of points whose distances are computed at once; two cells with more get a tree."""


@dataclass(frozen=True)
class BlockTest:
    """Which blocks of a frame have more wrong bits than noise explains.

    block  : (b,) number, see `block_of`
    bits   : (b,) bits in it
    wrong  : (b,) wrong ones, or of coordinates off the lattice
    least  : (b,) wrong bits from which a block is tampered with
    chance : (b,) probability that noise alone makes as many: the block's false-alarm rate
    """

    block: Ints
    bits: Ints
    wrong: Ints
    least: Ints
    chance: Float

    @property
    def tampered(self) -> Ints:
        """The blocks (k,) with at least as many wrong bits."""
        return self.block[self.wrong >= self.least]


def block_test(block: Ints, wrong: NDArray[np.bool_], *, error_rate: float, false_alarms: float) -> BlockTest:
    """The test of a frame's blocks.

    block        : (n,) of each return
    wrong        : (n, k) bits that count as wrong, k of each return
    error_rate   : share of bits that noise makes wrong
    false_alarms : blocks a frame that may be reported without tampering, on average at most
    """
    numbers, row = np.unique(block, return_inverse=True)
    bits = wrong.shape[1] * np.bincount(row, minlength=len(numbers))
    count = np.bincount(row, weights=wrong.sum(axis=1), minlength=len(numbers)).astype(np.int64)
    least, chance = _thresholds(bits, error_rate=error_rate, chance=false_alarms / max(len(numbers), 1))
    return BlockTest(numbers, bits, count, least, chance)


def _thresholds(bits: Ints, *, error_rate: float, chance: float) -> tuple[Ints, Float]:
    """Least number of wrong bits that noise exceeds with at most a probability, and that probability."""
    from scipy.special import bdtrc  # noqa: PLC0415  (0.2 s)

    sizes, row = np.unique(bits, return_inverse=True)
    least, found = np.zeros(len(sizes), np.int64), np.ones(len(sizes))
    pending = np.ones(len(sizes), bool)
    k = 0
    while pending.any():
        k += 1
        tail = np.where(k <= sizes, bdtrc(k - 1, np.maximum(sizes, k), error_rate), 0.0)
        done = pending & (tail <= chance)
        least[done], found[done] = k, tail[done]
        pending &= ~done
    return least[row], found[row]


@dataclass(frozen=True)
class Place:
    """A bounding box in which returns were added, moved or removed.

    kind    : ``added or moved``, or ``removed``; a moved cluster is both, at its two places
    low, high : (3,) corners of the box in the sensor frame, metres; of removed returns in the directions of
              the gap, at the range of the returns beside it
    returns : number of returns, for a gap that of the pulses in it
    rings   : lowest and highest
    """

    kind: str
    low: tuple[float, float, float]
    high: tuple[float, float, float]
    returns: int
    rings: tuple[int, int]


@dataclass(frozen=True)
class FrameVerdict:
    """Verdict of the watermark on a frame.

    bits, wrong : of all returns
    blocks      : the test of each block
    forged      : (n,) bool, returns that do not bear the watermark, in tampered blocks and beside them
    places      : boxes of those, and of gaps
    suspicion   : (n,) 0 to 1, probability that a return is forged, if half of all were
    """

    bits: int
    wrong: int
    blocks: BlockTest
    forged: NDArray[np.bool_]
    places: tuple[Place, ...]
    suspicion: Float

    @property
    def absent(self) -> bool:
        """Whether the cloud has no watermark of this key, sensor and frame; it has no places then."""
        return self.wrong > _ABSENT * self.bits


def frame_verdict(
    watermark: WatermarkKey,
    xyz: NDArray[np.floating],
    *,
    cells: WatermarkCells,
    noise: float = NOISE,
    false_alarms: float = 0.01,
) -> FrameVerdict:
    """The verdict on a frame.

    xyz          : (n, 3) coordinates in the sensor frame
    noise        : standard deviation in metres that coordinates got since the watermark was embedded
    false_alarms : blocks a frame that may be reported without tampering
    """
    decoded = watermark.decoded(xyz, cells)
    within = _OFF * max(noise, _FINEST)
    rate = watermark.error_rate(max(noise, _FINEST), within=within)
    block, bad = block_of(xyz, cells.ring), decoded.wrong | (np.abs(decoded.off) > within)
    test = block_test(block, bad, error_rate=rate, false_alarms=false_alarms)
    evidence = _evidence(watermark, decoded, noise=noise)
    bits, wrong = decoded.wrong.size, int(decoded.wrong.sum())
    suspicion = 1 / (1 + np.exp(-np.clip(evidence, -50, 50)))
    if wrong > _ABSENT * bits:
        return FrameVerdict(bits, wrong, test, np.ones(len(xyz), bool), (), suspicion)
    near = np.isin(block, _with_neighbours(test.tampered))
    noisy = noise > watermark.step / 40
    forged = _detect_forged(evidence, xyz, among=near, noisy=noisy)
    places = _places("added or moved", xyz[forged], ring=cells.ring[forged])
    if near.any():
        places += _gaps(watermark, xyz[~forged], cells=cells.where(~forged), near=near[~forged], noisy=noisy)
    return FrameVerdict(bits, wrong, test, forged, places, suspicion)


def _evidence(watermark: WatermarkKey, decoded: Decoded, *, noise: float) -> Float:
    """Logarithm (n,) of how much likelier the coordinates of a return are if it is forged than if genuine."""
    half, sigma = watermark.step / 2, max(noise, _FINEST)
    wraps = np.arange(-2, 3)[:, None, None] * half
    density = np.exp(-0.5 * ((decoded.off + wraps) / sigma) ** 2).sum(axis=0) / (np.sqrt(2 * np.pi) * sigma)
    floor = 1e-12
    found: Float = -np.log(np.maximum(density * half, floor)).sum(axis=1)
    return found


def _detect_forged(
    evidence: Float, xyz: NDArray[np.floating], *, among: NDArray[np.bool_], noisy: bool
) -> NDArray[np.bool_]:
    """Returns (n,) that are forged: by their own evidence, or that of most of their neighbours.

    noisy : where noise is strong, the evidence of a return and its neighbours is summed instead
    """
    if not among.any():
        return among
    from scipy.spatial import cKDTree  # noqa: PLC0415  (0.2 s)

    rows = np.flatnonzero(among)
    nearest = cKDTree(xyz[rows]).query(xyz[rows], k=min(_NEIGHBOURS, len(rows)))[1].reshape(len(rows), -1)
    own = evidence[rows]
    out = np.zeros(len(evidence), bool)
    out[rows] = own[nearest].sum(axis=1) > 0 if noisy else (own > 0) | ((own[nearest] > 0).mean(axis=1) > 0.6)
    return out


def _with_neighbours(blocks: Ints) -> Ints:
    """Blocks and those beside them: a ring below and above, a sector to the left and right."""
    ring, sector = np.divmod(blocks, SECTORS)
    around = [(ring + up) * SECTORS + (sector + left) % SECTORS for up in (-1, 0, 1) for left in (-1, 0, 1)]
    return np.unique(np.concatenate(around))


def _gaps(
    watermark: WatermarkKey,
    xyz: NDArray[np.floating],
    *,
    cells: WatermarkCells,
    near: NDArray[np.bool_],
    noisy: bool,
) -> tuple[Place, ...]:
    """Places of removed returns: after a gap, the next returns do not fit those before them."""
    if not len(xyz):
        return ()
    order = cells.order()
    ring, column, points = cells.ring[order], cells.column[order].astype(np.int64), xyz[order]
    broken = watermark.decoded(xyz, cells).wrong.sum(axis=1)[order]
    before = earlier(ring, 1)
    after = np.empty_like(before)
    after[before] = np.arange(len(before))
    following = broken + broken[after] + broken[after[after]]
    begins = (broken >= 1) & (following >= (2 if noisy else 1)) & near[order]
    begins &= ~(begins[before] | begins[before[before]])  # those after the first are of the same gap
    missing = np.maximum((column - column[before]) % (int(column.max()) + 1) - 1, 0)  # 0 of the same pulse
    row = np.flatnonzero(begins)
    for _ in range(CHAINED - 1):  # one time in eight the first return after a gap fits by chance
        row = np.unique(np.where(missing[row] == 0, before[row], row))
    fill, gap = _between(points[before[row]], points[row], count=missing[row])
    return _places("removed", fill, ring=ring[row[gap]])


def _between(first: NDArray[np.floating], last: NDArray[np.floating], *, count: Ints) -> tuple[Float, Ints]:
    """Points (n, 3) in equal steps of direction and range between k pairs of points, and the pair of each.

    count : (k,) points of each pair; none of pairs that are far apart
    """
    ends = np.stack([first, last]).astype(np.float64)
    away = np.linalg.norm(ends, axis=2)
    unit = ends / np.maximum(away[..., None], 1e-9)
    angle = np.arccos(np.clip((unit[0] * unit[1]).sum(axis=1), -1, 1))
    count = np.where((angle <= np.radians(_WIDEST)) & (angle >= 1e-9), count, 0)
    gap = np.repeat(np.arange(len(count)), count)
    number = np.arange(len(gap)) - np.repeat(np.cumsum(count) - count, count)
    share = ((number + 1) / (count[gap] + 1))[:, None]
    turn, (begin, end) = angle[gap, None], unit[:, gap]
    turned = (np.sin((1 - share) * turn) * begin + np.sin(share * turn) * end) / np.sin(turn)
    filled: Float = turned * ((1 - share) * away[0, gap, None] + share * away[1, gap, None])
    return filled, gap


def _places(kind: str, xyz: NDArray[np.floating], *, ring: NDArray[np.integer]) -> tuple[Place, ...]:
    """Boxes of clusters of linked points; the largest first."""
    if not len(xyz):
        return ()
    cluster = _clusters(xyz, ring)
    order = np.argsort(cluster, kind="stable")
    count = np.bincount(cluster)
    first = np.cumsum(count) - count
    points, rings = xyz[order].astype(np.float64), ring[order]
    low, high, lowest, highest = (
        least.reduceat(column, first) for column in (points, rings) for least in (np.minimum, np.maximum)
    )
    large = np.flatnonzero(count >= _FEWEST)
    return tuple(
        Place(
            kind,
            tuple(low[k].tolist()),
            tuple(high[k].tolist()),
            int(count[k]),
            (int(lowest[k]), int(highest[k])),
        )
        for k in large[np.argsort(-count[large], kind="stable")].tolist()
    )


def _clusters(xyz: NDArray[np.floating], ring: NDArray[np.integer]) -> Ints:
    """Cluster (n,) of points: linked are those within `_LINK`, or on neighbouring beams at a like range."""
    n, away = len(xyz), np.linalg.norm(xyz, axis=1)
    level = np.maximum(np.hypot(xyz[:, 0], xyz[:, 1]), 1e-9)
    turn = xyz[:, :2] / level[:, None] / np.radians(_TURN)
    near = linked_clusters(xyz / _LINK, p=2)
    beside = linked_clusters(np.column_stack([turn, 0.9 * ring, away / _DEPTH]), p=np.inf)
    rows, groups = np.arange(n), np.append(n + near, n + near.max() + 1 + beside)
    return components(np.append(rows, rows), groups, count=int(groups.max()) + 1)[:n]


def linked_clusters(points: NDArray[np.floating], *, p: float) -> Ints:
    """Cluster (n,) of each point: those within a distance of 1 are linked, chains of links make a cluster.

    points : (n, d), n > 0
    p      : of the Minkowski norm: 2 for Euclid's distance, infinity for the greatest coordinate's

    A list of all links would grow with the square of the density. Here points fall into cells so small that
    all of a cell are linked; links to nearest points join cells, and where these do not, all distances
    between the points of two cells tell.
    """
    from scipy.spatial import cKDTree  # noqa: PLC0415  (0.2 s)

    points = points.astype(np.float64)
    n, axes = points.shape
    side = (1 - 1e-9) / axes ** (1 / p)
    corner, cell = np.unique(np.floor(points / side), axis=0, return_inverse=True)
    cell = cell.reshape(n)
    away, near = (column.reshape(n, -1) for column in cKDTree(points).query(points, k=min(_NEAREST, n), p=p))
    row, place = np.nonzero(away <= 1)
    cluster = components(cell[row], cell[near[row, place]], count=len(corner))
    beside = cKDTree(corner).query_pairs(np.ceil(1 / side), p=np.inf, output_type="ndarray")
    members = _Members(cell)
    while len(beside := beside[cluster[beside[:, 0]] != cluster[beside[:, 1]]]):
        beside = beside[np.argsort(members.size[beside].prod(axis=1), kind="stable")]
        ends = np.cumsum(members.size[beside].prod(axis=1))
        most = int(np.searchsorted(ends, _AT_ONCE, side="right"))
        if most:
            pair, one, other = members.pairs(beside[:most])
            apart = np.linalg.norm(points[one] - points[other], ord=p, axis=1)
            met = beside[np.unique(pair[apart <= 1])]
        else:
            most = 1
            first, second = (points[members.of(number)] for number in beside[0])
            met = beside[: int(cKDTree(first).query(second, p=p)[0].min() <= 1)]
        cluster = components(*cluster[met].T, count=len(corner))[cluster]
        beside = beside[most:]
    return cluster[cell]


class _Members:
    """The points of each cell.

    size : (m,) points of each
    """

    def __init__(self, cell: Ints) -> None:
        self.size = np.bincount(cell)
        self._rows = np.argsort(cell, kind="stable")
        self._first = np.cumsum(self.size) - self.size

    def of(self, number: int) -> Ints:
        """The points of a cell."""
        return self._rows[self._first[number] :][: self.size[number]]

    def pairs(self, cells: NDArray[np.integer]) -> tuple[Ints, Ints, Ints]:
        """All pairs of points of pairs (k, 2) of cells: row of ``cells``, and both points."""
        counts = self.size[cells].prod(axis=1)
        pair = np.repeat(np.arange(len(cells)), counts)
        number = np.arange(len(pair)) - np.repeat(np.cumsum(counts) - counts, counts)
        one, other = np.divmod(number, self.size[cells[pair, 1]])
        first = self._first[cells[pair]]
        return pair, self._rows[first[:, 0] + one], self._rows[first[:, 1] + other]
