"""Base of defences: parameters with bounds, and a method that judges a frame by it and earlier frames."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from lidar.parameters import Parameters
from lidar.tools.defences.observation import Observation
from lidar.tools.defences.verdict import Verdict
from lidar.world.world import World


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
