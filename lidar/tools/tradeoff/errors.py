"""Differences between two simulations of the same pulses or pixels, with intervals; rows of comparisons."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from geoscene.drawing.report import metres
from geoscene.support.columns import Columns
from geoscene.typing import Float

RESAMPLES = 200
"""Bootstrap samples of an interval."""

Kind = Literal["scanner", "camera"]

TAILS: dict[Kind, str] = {"scanner": "range_99.9_m", "camera": "rgb_rms"}
"""The figure of an error by which settings of a kind of sensor are ranked."""

LOST = 0.001
"""Share of missed and extra returns beyond which a setting does not keep any error at 99.9 %."""


@dataclass(frozen=True, slots=True)
class PulseReturns(Columns):
    """Returns of some pulses of a frame.

    key   : (n,) int64, ascending: 256 times the row of the pulse plus the rank of the return in it
    range : (n,) metres
    klass : (n,) uint8
    xyz   : (n, 3) scene metres
    """

    key: NDArray[np.int64]
    range: Float
    klass: NDArray[np.uint8]
    xyz: Float

    def equals(self, other: PulseReturns) -> bool:
        """Whether keys and points are the same."""
        return np.array_equal(self.key, other.key) and np.array_equal(self.xyz, other.xyz)


@dataclass(frozen=True, slots=True)
class ErrorEstimate:
    """A figure with a 95 % interval."""

    value: float
    low: float
    high: float

    def to_json(self) -> dict[str, float | None]:
        """The figures; None for those that are not finite."""
        figures = {"value": self.value, "low": self.low, "high": self.high}
        return {name: float(f"{v:.6g}") if np.isfinite(v) else None for name, v in figures.items()}

    @classmethod
    def from_json(cls, figures: Mapping[str, float]) -> ErrorEstimate:
        """The figures of `to_json`, all finite; raises KeyError, TypeError or ValueError for others."""
        return cls(float(figures["value"]), float(figures["low"]), float(figures["high"]))

    def to_text(self, size: Callable[[float], str] = metres) -> str:
        """The value with its interval, each as text by ``size``."""
        return f"{size(self.value)} ({size(self.low)} to {size(self.high)})"

    def __add__(self, other: ErrorEstimate) -> ErrorEstimate:
        """The sum, with the ends of both."""
        return ErrorEstimate(self.value + other.value, self.low + other.low, self.high + other.high)


@dataclass(frozen=True, slots=True)
class FrameDifferences:
    """Differences of one frame from the reference.

    range, position : (m,) metres, absolute, of returns that both have: of ranges, and of points in the world
    there, back     : metres from each point to the nearest one of the reference, and from each of its points
    missed, extra, changed : numbers of returns that only the reference has, or only this, and of other class
    returns         : of the reference
    """

    range: Float
    position: Float
    there: Float
    back: Float
    missed: int
    extra: int
    changed: int
    returns: int


def frame_error(found: PulseReturns, exact: PulseReturns) -> FrameDifferences:
    """Differences between the returns of the same pulses."""
    _, a, b = np.intersect1d(found.key, exact.key, assume_unique=True, return_indices=True)
    position = np.linalg.norm(found.xyz[a] - exact.xyz[b], axis=1)
    there, back = cloud_distances(found.xyz, exact.xyz)
    return FrameDifferences(
        np.abs(found.range[a] - exact.range[b]),
        position,
        there,
        back,
        missed=len(exact) - len(b),
        extra=len(found) - len(a),
        changed=int(np.count_nonzero(found.klass[a] != exact.klass[b])),
        returns=len(exact),
    )


def cloud_distances(found: Float, exact: Float) -> tuple[Float, Float]:
    """Distances of the points of either cloud to the nearest of the other; empty if one has no points."""
    if not len(found) or not len(exact):
        return np.empty(0), np.empty(0)
    from scipy.spatial import cKDTree  # noqa: PLC0415  (0.2 s)

    return cKDTree(exact).query(found)[0], cKDTree(found).query(exact)[0]


def rms(values: Float) -> float:
    """Root mean square; 0 without values."""
    return float(np.sqrt(np.mean(values**2))) if len(values) else 0.0


def percentile(values: Float, share: float) -> float:
    """The value that a share of all values does not exceed; 0 without values."""
    return float(np.quantile(values, share, method="higher")) if len(values) else 0.0


Statistic = Callable[[Sequence[Any]], float]
"""A figure of the differences of frames: of `FrameDifferences`, or of `ImageError`."""


def _of_all(name: str, figure: Callable[[Float], float]) -> Statistic:
    return lambda frames: figure(np.concatenate([getattr(f, name) for f in frames]))


def _share(name: str, *, of: str = "returns") -> Statistic:
    return lambda frames: sum(getattr(f, name) for f in frames) / max(1, sum(getattr(f, of) for f in frames))


def _chamfer(frames: Sequence[FrameDifferences]) -> float:
    there, back = (np.concatenate([getattr(f, side) for f in frames]) for side in ("there", "back"))
    return float(np.mean(there) + np.mean(back)) / 2 if len(there) else 0.0


def _hausdorff(share: float) -> Statistic:
    def distance(frames: Sequence[FrameDifferences]) -> float:
        sides = (np.concatenate([getattr(f, side) for f in frames]) for side in ("there", "back"))
        return max(percentile(side, share) for side in sides)

    return distance


STATISTICS: dict[str, Statistic] = {
    "range_rms_m": _of_all("range", rms),
    "range_99_m": _of_all("range", lambda v: percentile(v, 0.99)),
    "range_99.9_m": _of_all("range", lambda v: percentile(v, 0.999)),
    "range_max_m": _of_all("range", lambda v: percentile(v, 1.0)),
    "missed": _share("missed"),
    "extra": _share("extra"),
    "class_changes": _share("changed"),
    "position_rms_m": _of_all("position", rms),
    "position_99.9_m": _of_all("position", lambda v: percentile(v, 0.999)),
    "chamfer_m": _chamfer,
    "hausdorff_99.9_m": _hausdorff(0.999),
    "hausdorff_m": _hausdorff(1.0),
}
"""Figures of an error, over all sampled frames. Shares are of the reference's returns."""


@dataclass(frozen=True, slots=True)
class ImageError:
    """Differences of pixels of one frame of a camera from the reference.

    levels  : (256,) int64, numbers of red, green and blue values by their absolute difference
    depth   : (m,) metres, absolute, of pixels with a depth in both
    missing : number of pixels with a depth in one of both only
    changed : number of pixels of another class
    pixels  : number of pixels compared
    """

    levels: NDArray[np.int64]
    depth: Float
    missing: int
    changed: int
    pixels: int


def _rgb(figure: Callable[[NDArray[np.int64]], float]) -> Statistic:
    return lambda frames: figure(np.sum([f.levels for f in frames], axis=0))


def _level(share: float) -> Callable[[NDArray[np.int64]], float]:
    """The difference that a share of all values does not exceed."""
    return lambda counts: float(np.searchsorted(np.cumsum(counts), share * counts.sum()))


def _rms_of_counts(counts: NDArray[np.int64]) -> float:
    return float(np.sqrt((counts * np.arange(256.0) ** 2).sum() / max(1, counts.sum())))


IMAGE_STATISTICS: dict[str, Statistic] = {
    "rgb_rms": _rgb(_rms_of_counts),
    "rgb_99.9": _rgb(_level(0.999)),
    "rgb_max": _rgb(_level(1.0)),
    "depth_rms_m": _of_all("depth", rms),
    "depth_99.9_m": _of_all("depth", lambda v: percentile(v, 0.999)),
    "depth_max_m": _of_all("depth", lambda v: percentile(v, 1.0)),
    "depth_missing": _share("missing", of="pixels"),
    "class_changes": _share("changed", of="pixels"),
}
"""Figures of an error of images, over all sampled frames: levels of 255, metres, shares of the pixels."""

E = TypeVar("E")


def estimates(
    frames: Sequence[Any], *, seed: int, statistics: Mapping[str, Statistic]
) -> dict[str, ErrorEstimate]:
    """All figures of an error, with intervals by resampling frames; none without frames."""
    return resample(
        frames, seed=seed, figures=lambda of: {name: figure(of) for name, figure in statistics.items()}
    )


def resample(
    frames: Sequence[E], *, seed: int, figures: Callable[[Sequence[E]], Mapping[str, float]]
) -> dict[str, ErrorEstimate]:
    """Figures of frames with 95 % intervals by resampling these; not those that are NaN.

    None without frames.
    """
    if not frames:
        return {}
    picks = np.random.default_rng(seed).integers(0, len(frames), (RESAMPLES, len(frames)))
    return with_intervals(figures(frames), [figures([frames[k] for k in pick]) for pick in picks])


def with_intervals(
    figures: Mapping[str, float], resampled: Sequence[Mapping[str, float]]
) -> dict[str, ErrorEstimate]:
    """Figures with the 95 % intervals of those of resampled data; not those that are NaN."""
    found = {}
    for name, value in figures.items():
        if not np.isnan(value):
            low, high = np.nanpercentile([one[name] for one in resampled], [2.5, 97.5])
            found[name] = ErrorEstimate(value, float(low), float(high))
    return found


def median(values: Sequence[float], *, seed: int) -> ErrorEstimate:
    """The median of repetitions with the 95 % interval by resampling them."""
    data = np.asarray(values, float)
    picks = np.random.default_rng(seed).integers(0, len(data), (RESAMPLES, len(data)))
    low, high = np.percentile(np.median(data[picks], axis=1), [2.5, 97.5])
    return ErrorEstimate(float(np.median(data)), float(low), float(high))


@dataclass(frozen=True, slots=True)
class VariantRow:
    """A measured variant.

    error  : combined: only this setting differs from what the user asked for; see `STATISTICS` and
             `IMAGE_STATISTICS`
    alone  : only this setting differs from the reference; empty for the user's own settings and combinations
    cost   : CPU seconds (``cpu_s``) and bytes (``bytes``) per simulated second, peak memory
             (``memory_bytes``)
    note   : that changes have no effect on the sample, or change the model
    choice : whether it can be recommended: each change has an effect, and the world stays the same
    """

    label: str
    error: dict[str, ErrorEstimate]
    alone: dict[str, ErrorEstimate]
    cost: dict[str, ErrorEstimate]
    note: str = ""
    choice: bool = True


@dataclass(frozen=True, slots=True)
class SensorComparison:
    """The rows of a sensor.

    sensor    : name on the rig, with its preset or size
    reference : what errors are measured against, in words
    residual  : difference between the reference and one with another number of rays: its own uncertainty
    rows      : the user's own settings come first
    samples   : number of pulses or pixels compared
    frames    : number of frames that they are from
    """

    sensor: str
    reference: str
    residual: dict[str, ErrorEstimate]
    rows: tuple[VariantRow, ...]
    samples: int
    frames: int
    kind: Kind = "scanner"

    @property
    def tail(self) -> str:
        """The figure of an error by which the rows are ranked."""
        return TAILS[self.kind]

    @property
    def uncertainty(self) -> float:
        """Metres or levels (see `tail`) by which the reference may be off."""
        return self.residual[self.tail].value
