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
    def judge(
        self, frames: Sequence[Observation], *, scene: World | None, rng: np.random.Generator
    ) -> Verdict:
        """The verdict on the last of consecutive frames of a scanner.

        frames : at most ``history`` earlier ones, oldest first, and the one to judge
        scene  : what the map says is around, without road users; None unless ``needs`` has it
        rng    : random numbers of this defence and frame
        """

    def pictures(
        self, frame: Observation, verdict: Verdict, *, threshold: float
    ) -> dict[str, NDArray[np.uint8]]:
        """Pictures (h, w, 3) by name that show a verdict; none by default.

        threshold : suspicion of objects above which there is an alarm
        """
        del frame, verdict, threshold
        return {}
