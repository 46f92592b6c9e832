"""Verdicts of several defences as one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from geoscene.typing import Float
from lidar.defences.calibration import Calibration
from lidar.defences.scores import FALSE_ALARMS
from lidar.defences.verdict import Verdict

FUSIONS = ("max", "fisher")
"""Rules: the most unusual suspicion counts (Bonferroni's bound), or all do (Fisher 1932)."""

FUSED = "fused"
"""Name of the fused verdict."""

_DECADES = 6.0
"""Powers of ten of the share of genuine samples that suspicions 0 to 1 stand for."""


def fused(verdicts: Mapping[str, Verdict], calibration: Calibration, *, rule: str) -> Verdict:
    """The verdict of several defences.

    Each suspicion becomes the share p of genuine samples that are at least as suspicious. ``max`` takes k
    times the least of k shares; ``fisher`` the tail of -2 sum ln p, of 2 k degrees of freedom, which assumes
    that the defences err independently. The suspicion is -log10(p) / 6.

    Raises InputError if a defence is not calibrated.
    """
    returns, objects = (
        _fused(
            [(n, c) for n, v in verdicts.items() if (c := getattr(v, level)) is not None],
            calibration,
            level=level,
            rule=rule,
        )
        for level in ("returns", "objects")
    )
    frames = _fused(
        [(name, np.array([v.frame])) for name, v in verdicts.items()], calibration, level="frames", rule=rule
    )
    assert frames is not None  # noqa: S101
    return Verdict(returns, objects, float(frames[0]))


def _fused(
    columns: Sequence[tuple[str, Float]], calibration: Calibration, *, level: str, rule: str
) -> Float | None:
    if not columns:
        return None
    shares = np.stack([calibration.tail(name, level).of(column) for name, column in columns])
    if rule == "fisher":
        from scipy.special import gammaincc  # noqa: PLC0415  (0.2 s)

        share = gammaincc(len(shares), -np.log(shares).sum(axis=0))
    else:
        share = np.minimum(len(shares) * shares.min(axis=0), 1.0)
    suspicion: Float = np.clip(-np.log10(np.maximum(share, 1e-300)) / _DECADES, 0.0, 1.0)
    return suspicion


def fused_threshold(level: str) -> float:
    """Suspicion of a fused verdict that a share `FALSE_ALARMS` of genuine samples has, if the rule holds."""
    return float(-np.log10(FALSE_ALARMS[level]) / _DECADES)
