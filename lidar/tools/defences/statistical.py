"""Returns that lie apart from the others (statistical outliers)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from geoscene.typing import Float
from lidar.parameters import parameter
from lidar.tools.defences.defence import Defence, Window
from lidar.tools.defences.verdict import FEW, Verdict, greatest

_BINS = 24
_NEAREST, _FARTHEST = 1.0, 200.0  # metres, of the bins of range


@dataclass(frozen=True)
class StatisticalDefence(Defence):
    """Returns farther from their neighbours than others at their range are (Charron et al. 2018)."""

    neighbours: int = parameter(6, "nearest returns of which the mean distance counts", low=1, high=50)
    half: float = parameter(6.0, "ratio to the median at that range that has suspicion 0.5", low=1, high=100)

    def judge(self, window: Window) -> Verdict:
        """Judge the returns of the last frame."""
        frame = window.frame
        n = len(frame)
        if n <= self.neighbours:
            return Verdict(np.zeros(n), np.zeros(len(frame.objects)), 0.0)
        away, _ = cKDTree(frame.xyz).query(frame.xyz, k=self.neighbours + 1)
        ratio = away[:, 1:].mean(axis=1) / _typical(away[:, 1:].mean(axis=1), frame.distance)
        excess = np.maximum(ratio - 1, 0)
        returns = excess / (excess + self.half - 1 + 1e-9)
        objects = np.array([returns[rows].mean() if len(rows) else 0.0 for rows in frame.members])
        return Verdict(returns, objects, greatest(returns, count=FEW))


def _typical(spacing: Float, distance: Float) -> Float:
    """Median spacing (n,) of returns at about the same range."""
    edges = np.geomspace(_NEAREST, _FARTHEST, _BINS + 1)
    rows = np.clip(np.searchsorted(edges, distance) - 1, 0, _BINS - 1)
    median = np.array(
        [np.median(spacing[rows == k]) if (rows == k).sum() > 20 else np.nan for k in range(_BINS)]
    )
    known = np.flatnonzero(np.isfinite(median))
    if not len(known):
        return np.full(len(spacing), max(float(np.median(spacing)), 1e-3))
    filled: Float = np.interp(np.arange(_BINS), known, median[known])
    return np.maximum(filled[rows], 1e-3)
