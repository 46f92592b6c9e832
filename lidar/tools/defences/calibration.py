"""Suspicions of genuine data: thresholds at stated false alarms, fusion by how unusual suspicions are."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from geoscene.errors import reason_of
from geoscene.support.untrusted import read_toml
from geoscene.typing import Float
from lidar.errors import InputError
from lidar.tools.defences.defence import Verdict
from lidar.tools.defences.scores import BINS, FALSE_ALARMS, SuspicionCounts, bins_of, threshold_at
from lidar.tools.detection import RULES, Detector

_BUILT_IN = {"rules": Path(__file__).with_name("calibration.toml")}
"""Calibrations that come with the program, by detector."""

TAILS = (0.5, 0.2, 0.1, 0.05, 0.02, 0.01, 0.005, 0.002, 0.001, 0.0005, 0.0002, 0.0001)
"""Shares of genuine returns, objects or frames at whose suspicions a calibration is stored."""

_STEP = 1e-9
"""Of suspicion, after one that many samples have."""

_CALIBRATE = "make its own on datasets without attacks by `calibrate`, and give the file as `calibration`"

_FEWEST = 3
"""Genuine samples above the last stored suspicion."""

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


@dataclass(frozen=True, slots=True)
class Tail:
    """Suspicions above which given shares of genuine samples are.

    count     : genuine samples that it is made of
    share     : (k,) falling
    suspicion : (k,) rising
    """

    count: int
    share: Float
    suspicion: Float

    def of(self, suspicion: Float) -> Float:
        """Share (n,) of genuine samples that are at least as suspicious; at least 1 / (count + 1).

        Between stored suspicions, and from the last one to suspicion 1, its logarithm is linear. Of one that
        is stored several times, as many samples have it, the share is that stored before; of 0 it is 1.
        """
        least = 1 / (self.count + 1)
        x, y = [0.0], [1.0]
        for value in np.unique(self.suspicion):
            same = np.flatnonzero(self.suspicion == value)
            if len(same) > 1 and value > 0:
                x.append(value)
                y.append(self.share[same[0] - 1] if same[0] else 1.0)
            x.append(value + (_STEP if len(same) > 1 or value == 0 else 0.0))
            y.append(self.share[same[-1]])
        x.append(max(1.0, x[-1] + _STEP))
        y.append(min(least, y[-1] / 2))
        share: Float = np.exp(np.interp(suspicion, x, np.log(np.maximum(y, least))))
        return share


@dataclass(frozen=True, slots=True)
class Joint:
    """Suspicions that several defences have of the same genuine samples: the most suspicious ones.

    count     : genuine samples that they are chosen of
    defences  : (k,) names
    suspicion : (m, k)
    """

    count: int
    defences: tuple[str, ...]
    suspicion: Float


@dataclass(frozen=True, slots=True)
class Calibration:
    """Tails by defence and level of `lidar.tools.defences.scores.LEVELS`, and what defences have in common.

    joint    : by level
    note     : of which data
    detector : identity of the one that gave the boxes
    """

    tails: Mapping[tuple[str, str], Tail]
    note: str = ""
    joint: Mapping[str, Joint] = field(default_factory=dict)
    detector: str = RULES.identity

    def check(self, detector: Detector) -> None:
        """Raise InputError if the boxes of the calibration are of another detector."""
        if detector.identity != self.detector:
            raise InputError(
                f"`calibration`: its thresholds are of detector {self.detector}, and `detector` is"
                f" {detector.name} ({detector.identity}); {_CALIBRATE}"
            )

    def tail(self, defence: str, level: str) -> Tail:
        """A tail; raises InputError if the defence is not calibrated at that level."""
        if (defence, level) not in self.tails:
            raise InputError(
                f"defence {defence}: the calibration has no suspicions of {level}; calibrate again"
            )
        return self.tails[defence, level]

    def shares(self, defences: Sequence[str], suspicion: Iterable[Float], *, level: str) -> Float:
        """Shares (k, n) of genuine samples that are at least as suspicious to each of k defences.

        Raises InputError as `tail` does.
        """
        columns = zip(defences, suspicion, strict=True)
        return np.stack([self.tail(name, level).of(column) for name, column in columns])

    def threshold(self, defence: str, level: str) -> float:
        """Suspicion above which is the share `FALSE_ALARMS` of genuine samples."""
        tail = self.tail(defence, level)
        at = np.flatnonzero(tail.share <= FALSE_ALARMS[level] * (1 + 1e-9))
        return float(tail.suspicion[at[0]]) if len(at) else 1.0


def tail_of(samples: SuspicionCounts) -> Tail:
    """The tail of genuine samples; shares that too few samples support are left out."""
    count = int(samples.genuine.sum())
    shares = [share for share in TAILS if share * count >= _FEWEST]
    return Tail(count, np.array(shares), np.array([threshold_at(samples, share) for share in shares]))


def read_calibration(path: Path | None = None, *, detector: Detector = RULES) -> Calibration:
    """The calibration of a TOML file, or the one of a detector that comes with the program.

    Raises InputError for a file that is none, or if none comes with the program for a detector.
    """
    file = path or _BUILT_IN.get(detector.name)
    if file is None:
        raise InputError(f"`detector` {detector.name}: no thresholds come with it; {_CALIBRATE}")
    found = _read(file)
    found.check(detector)
    return found


def _read(file: Path) -> Calibration:
    tails: dict[tuple[str, str], Tail] = {}
    try:
        document = read_toml(file.read_text("utf-8-sig"))
        for defence, levels in document["defence"].items():
            for level, row in levels.items():
                tails[defence, level] = _tail(row)
        joint = {level: _joint(row) for level, row in document.get("joint", {}).items()}
        detector = str(document.get("detector", RULES.identity))
        return Calibration(tails, str(document["note"]), joint, detector)
    except FileNotFoundError:
        raise InputError(f"{file}: is missing; lidar defend --calibrate makes one") from None
    except KeyError as error:
        raise InputError(f"{file}: is no calibration of defences ({error.args[0]} is missing)") from None
    except (OSError, ValueError, TypeError, AttributeError, ArithmeticError) as error:
        raise InputError(f"{file}: is no calibration of defences ({reason_of(error)})") from None


def _tail(row: Mapping[str, Any]) -> Tail:
    """A tail of a file; raises ValueError, KeyError or TypeError if it is none."""
    share, suspicion = np.array(row["share"], float), np.array(row["suspicion"], float)
    falls, rises = (np.diff(share) < 0).all(), (np.diff(suspicion) >= 0).all()
    if share.shape != suspicion.shape or not (falls and rises and np.isfinite(share).all()):
        raise ValueError("shares must fall and suspicions rise")
    return Tail(int(row["count"]), share, suspicion)


def _joint(row: Mapping[str, Any]) -> Joint:
    """Joint suspicions of a file; raises ValueError, KeyError or TypeError if they are none."""
    defences = tuple(map(str, row["defences"]))
    return Joint(int(row["count"]), defences, np.array(row["suspicion"], float).reshape(-1, len(defences)))


def calibration_text(calibration: Calibration) -> str:
    """A calibration as `read_calibration` reads it."""
    lines = [f'note = "{calibration.note}"', f'detector = "{calibration.detector}"']
    for (defence, level), tail in sorted(calibration.tails.items()):
        lines += [
            "",
            f"[defence.{defence}.{level}]",
            f"count = {tail.count}",
            f"share = [{', '.join(f'{v:g}' for v in tail.share)}]",
            f"suspicion = [{', '.join(f'{v:g}' for v in tail.suspicion)}]",
        ]
    for level, joint in sorted(calibration.joint.items()):
        lines += [
            "",
            f"[joint.{level}]",
            f"count = {joint.count}",
            f"defences = {list(joint.defences)}",
            "suspicion = [",
            *(f"  [{', '.join(f'{v:g}' for v in row)}]," for row in joint.suspicion),
            "]",
        ]
    return "\n".join(lines) + "\n"


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
    frames: Iterable[Mapping[str, Float]], calibration: Calibration, *, level: str, rng: np.random.Generator
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
