"""Verdicts of several defences as one."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from geoscene.typing import Float
from lidar.tools.defences.calibration import Calibration, Joint
from lidar.tools.defences.scores import BINS, FALSE_ALARMS, bins_of
from lidar.tools.defences.verdict import Verdict

FUSIONS = ("harmonic", "max", "fisher")
"""Rules: the harmonic mean of the shares (Wilson 2019), the least (Bonferroni), or all (Fisher 1932)."""

FUSED = "fused"
"""Name of the fused verdict."""

_DECADES = 6.0
"""Powers of ten of the share of genuine samples that suspicions 0 to 1 stand for."""

_KEPT = 12
"""Samples that a calibration keeps, over those that may have an alarm: enough for fewer defences, too."""

_DRAWN = 150
"""Returns of a frame that are drawn for them."""


def fuse_verdicts(verdicts: Mapping[str, Verdict], calibration: Calibration, *, rule: str) -> Verdict:
    """The verdict of several defences.

    Each suspicion becomes the share p of genuine samples that are at least as suspicious. ``harmonic`` takes
    the harmonic mean of k shares; ``max`` k times the least of them; ``fisher`` the tail of -2 sum ln p, of
    2 k degrees of freedom, which assumes that the defences err independently. The suspicion is -log10(p) / 6.

    Raises InputError if a defence is not calibrated.
    """
    returns, objects = (
        _fuse(
            {n: c for n, v in verdicts.items() if (c := getattr(v, level)) is not None},
            calibration,
            level=level,
            rule=rule,
        )
        for level in ("returns", "objects")
    )
    frame = {name: np.array([v.frame]) for name, v in verdicts.items()}
    frames = _fuse(frame, calibration, level="frames", rule=rule)
    assert frames is not None  # noqa: S101
    return Verdict(returns, objects, float(frames[0]))


def _fuse(columns: Mapping[str, Float], calibration: Calibration, *, level: str, rule: str) -> Float | None:
    if not columns:
        return None
    shares = np.stack([calibration.tail(name, level).of(column) for name, column in columns.items()])
    return _suspicion(_combine(shares, rule=rule))


def _combine(shares: Float, *, rule: str) -> Float:
    """One share (n,) of k shares (k, n)."""
    if rule == "fisher":
        from scipy.special import gammaincc  # noqa: PLC0415  (0.2 s)

        tail: Float = gammaincc(len(shares), -np.log(shares).sum(axis=0))
        return tail
    if rule == "max":
        least: Float = np.minimum(len(shares) * shares.min(axis=0), 1.0)
        return least
    mean: Float = len(shares) / (1 / shares).sum(axis=0)
    return mean


def _suspicion(share: Float) -> Float:
    suspicion: Float = np.clip(-np.log10(np.maximum(share, 1e-300)) / _DECADES, 0.0, 1.0)
    return suspicion


def fused_threshold(calibration: Calibration, defences: Sequence[str], *, level: str, rule: str) -> float:
    """Suspicion of a fused verdict of defences that a share `FALSE_ALARMS` of genuine samples has.

    For ``harmonic`` it is that of the calibration's samples, if they have suspicions of all defences;
    otherwise the one that the rule has by theory.
    """
    names = [name for name in defences if (name, level) in calibration.tails]
    joint = calibration.joint.get(level)
    if rule != "harmonic" or joint is None or not set(names) <= set(joint.defences):
        return float(-np.log10(FALSE_ALARMS[level]) / _DECADES)
    known = [joint.defences.index(name) for name in names]
    every, some = (
        sum(1 / calibration.tail(joint.defences[k], level).of(joint.suspicion[:, k]) for k in rows)
        for rows in (range(len(joint.defences)), known)
    )
    allowed = int(FALSE_ALARMS[level] * joint.count)
    # Samples that are not stored have at most the least evidence of those that are, whatever is left out.
    bound = float(np.min(every)) if joint.count > len(joint.suspicion) else float(len(names))
    worst = np.sort(some)[::-1]
    evidence = max(float(worst[allowed]) if allowed < len(worst) else bound, bound)
    return float(_suspicion(np.array([len(names) / evidence]))[0])


def joint_of(
    frames: Iterable[Mapping[str, Float]],
    calibration: Calibration,
    *,
    level: str,
    rng: np.random.Generator,
) -> Joint:
    """The genuine samples with most evidence against them: the sum of 1 / p over all defences.

    frames : suspicions (n,) by defence; of returns `_DRAWN` of a frame are drawn
    """
    drawn = []
    for row in frames:
        names = tuple(row)
        whole = np.stack([bins_of(column) for column in row.values()], axis=1)
        if level == "returns" and len(whole) > _DRAWN:
            whole = rng.choice(whole, _DRAWN, replace=False)
        drawn.append(whole)
    suspicion = np.concatenate(drawn) / BINS
    shares = (
        calibration.tail(name, level).of(column) for name, column in zip(names, suspicion.T, strict=True)
    )
    order = np.argsort(-sum(1 / share for share in shares), kind="stable")
    return Joint(
        len(suspicion), names, suspicion[order[: _KEPT * max(int(FALSE_ALARMS[level] * len(suspicion)), 1)]]
    )
