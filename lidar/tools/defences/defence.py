"""Base of defences: parameters with bounds, judgement of a frame by it and earlier ones, verdicts."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from geoscene.support.columns import Columns
from geoscene.typing import Float
from lidar.errors import LidarError
from lidar.parameters import Parameters
from lidar.tools.defences.observation import Observation
from lidar.world.world import World

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


_NO_GAPS = Gaps(np.empty((0, 2)), np.empty(0), np.empty(0))


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
    gaps: Gaps = _NO_GAPS

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


def of_boxes(frame: Observation, objects: Sequence[float]) -> Verdict:
    """The verdict of a defence that judges boxes alone, of which the suspicions (m,) are given.

    Each return has the suspicion of the most suspicious box that it is in, and the frame the greatest of all.
    """
    returns, suspicions = np.zeros(len(frame)), np.array(objects)
    for rows, suspicion in zip(frame.members, suspicions, strict=True):
        returns[rows] = np.maximum(returns[rows], suspicion)
    return Verdict(returns, suspicions, greatest(suspicions))


def of_returns(frame: Observation, returns: Float) -> Verdict:
    """The verdict of a defence that judges returns (n,): boxes by their mean, the frame by the worst few."""
    objects = np.array([returns[rows].mean() if len(rows) else 0.0 for rows in frame.members])
    return Verdict(returns, objects, greatest(returns, count=FEW))


@dataclass(frozen=True, slots=True)
class Window:
    """Consecutive frames of a scanner, the last of which a defence judges.

    frames : at most `Defence.history` earlier ones, oldest first, and the one to judge
    scene  : world of the map, without road users; None unless `Defence.needs` has it
    rng    : random numbers of this defence and frame
    """

    frames: Sequence[Observation]
    scene: World | None
    rng: np.random.Generator

    @property
    def frame(self) -> Observation:
        """The frame to judge."""
        return self.frames[-1]


@dataclass(frozen=True)
class Defence(Parameters):
    """Base of all defences; its fields are made by `lidar.parameters.parameter`.

    history : number of earlier frames that it looks at
    needs   : what a dataset must have: ``columns`` (ring, column, time and range of returns), ``cameras``,
              ``scene``, ``navigation``, ``watermark`` or ``firing_jitter`` (random firing times)
    """

    history: ClassVar[int] = 0
    needs: ClassVar[frozenset[str]] = frozenset()

    @property
    def lacks(self) -> str:
        """Description of missing parameters; empty if none is missing."""
        return ""

    @abstractmethod
    def judge(self, window: Window) -> Verdict:
        """The verdict on the last frame of a window."""

    def pictures(
        self, frame: Observation, verdict: Verdict, *, threshold: float
    ) -> dict[str, NDArray[np.uint8]]:
        """Pictures (h, w, 3) by name that show a verdict; none by default.

        threshold : suspicion of objects above which there is an alarm
        """
        del frame, verdict, threshold
        return {}
