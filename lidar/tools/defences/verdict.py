"""Verdict of a defence on a frame: suspicion of returns, objects and the frame."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from geoscene.support.columns import Columns
from geoscene.typing import Float
from lidar.errors import LidarError

FEW = 20
"""Suspicious returns that make a frame suspicious: as many as a published attack needs for a phantom car."""


@dataclass(frozen=True, slots=True)
class Gaps(Columns):
    """Places where returns seem to be missing, in the sensor frame.

    xy        : (k, 2) metres, centre
    radius    : (k,) metres
    suspicion : (k,) 0 to 1
    """

    xy: Float
    radius: Float
    suspicion: Float


def no_gaps() -> Gaps:
    """Gaps without any place."""
    return Gaps(np.empty((0, 2)), np.empty(0), np.empty(0))


@dataclass(frozen=True, slots=True)
class Verdict:
    """Suspicion from 0 (as expected) to 1; it orders returns, objects and frames, and is no probability.

    returns : (n,) of each return; None if the defence cannot tell returns apart
    objects : (m,) of each box of the detector; None if it does not judge boxes
    frame   : of the frame as a whole
    gaps    : where returns seem to be missing
    """

    returns: Float | None
    objects: Float | None
    frame: float
    gaps: Gaps = field(default_factory=no_gaps)

    def __post_init__(self) -> None:
        """Check that suspicions are within 0 to 1."""
        for name in ("returns", "objects"):
            column = getattr(self, name)
            if column is not None and not ((column >= 0) & (column <= 1)).all():
                raise LidarError(f"a defence gives {name} a suspicion that is not within 0 to 1")
        if not 0 <= self.frame <= 1:
            raise LidarError(f"a defence gives a frame the suspicion {self.frame:g}")


def greatest(column: Float, *, count: int = 1) -> float:
    """The ``count``-th greatest suspicion; 0 if there are fewer."""
    if len(column) < count:
        return 0.0
    return float(np.partition(column, len(column) - count)[len(column) - count])


def of_objects(n: int, members: tuple[NDArray[np.intp], ...], *, objects: Float) -> Verdict:
    """The verdict of a defence that judges boxes alone.

    Each of the n returns has the suspicion of the most suspicious box that it is in, and the frame the
    greatest of all boxes.
    """
    returns = np.zeros(n)
    for rows, suspicion in zip(members, objects, strict=True):
        returns[rows] = np.maximum(returns[rows], suspicion)
    return Verdict(returns, objects, greatest(objects))
