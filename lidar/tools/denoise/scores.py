"""Scores of a filter: how many returns of the weather it removes, and how many of surfaces."""

from __future__ import annotations

from dataclasses import dataclass
from math import isnan, nan
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class FilterTally:
    """Counts of returns by true origin and by the filter's decision.

    frames, returns, removed : numbers
    weather      : returns of the weather; -1 if the truth is unknown
    weather_removed : those of them that are removed
    """

    frames: int = 0
    returns: int = 0
    removed: int = 0
    weather: int = 0
    weather_removed: int = 0

    def with_frame(self, kept: NDArray[np.bool_], weather: NDArray[np.bool_] | None) -> FilterTally:
        """With one more frame; its truth (n,) may be unknown, for then that of all is."""
        frames, returns = self.frames + 1, self.returns + len(kept)
        removed = self.removed + int(np.count_nonzero(~kept))
        if weather is None or self.weather < 0:
            return FilterTally(frames, returns, removed, -1)
        both = self.weather_removed + int(np.count_nonzero(~kept & weather))
        return FilterTally(frames, returns, removed, self.weather + int(np.count_nonzero(weather)), both)

    @property
    def precision(self) -> float:
        """Share of weather among removed returns; nan without any, or without ground truth."""
        return self.weather_removed / self.removed if self.removed and self.weather >= 0 else nan

    @property
    def recall(self) -> float:
        """Share of the weather that is removed; nan without weather or truth."""
        return self.weather_removed / self.weather if self.weather > 0 else nan

    @property
    def f1(self) -> float:
        """Harmonic mean of precision and recall."""
        return 2 * self.weather_removed / (self.removed + self.weather) if self.weather > 0 else nan

    @property
    def lost(self) -> float:
        """Share of the other returns that is removed too; nan if the truth is unknown."""
        others = self.returns - self.weather
        return (self.removed - self.weather_removed) / others if others and self.weather >= 0 else nan

    def to_json(self) -> dict[str, Any]:
        """Numbers and scores; unknown ones are null."""
        scores = {name: getattr(self, name) for name in ("precision", "recall", "f1", "lost")}
        counts = {"frames": self.frames, "returns": self.returns, "removed": self.removed}
        if self.weather >= 0:
            counts |= {"weather": self.weather, "weather_removed": self.weather_removed}
        return counts | {name: None if isnan(x) else round(x, 6) for name, x in scores.items()}
