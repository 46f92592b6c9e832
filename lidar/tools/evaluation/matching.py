"""Poses of an estimate and of the truth at the same times, and the estimate moved onto the truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geoscene.typing import Float, Ints
from lidar.dataset.recorded import nearest
from lidar.errors import InputError
from lidar.tools.evaluation.trajectories import Path3D

GAPS_S = {"interpolated": 1.0, "nearest": 0.01}
"""Seconds between poses of the truth that are interpolated, and between matched poses, at most."""


@dataclass(frozen=True, slots=True)
class PosePairs:
    """Poses of an estimate and of the truth at the same times, row by row.

    left_out : poses of the estimate without a counterpart
    """

    estimate: Path3D
    truth: Path3D
    left_out: int

    def __len__(self) -> int:
        return len(self.truth)


@dataclass(frozen=True, slots=True)
class TrajectoryAlignment:
    """Similarity transform from estimate to ground truth: ``scale * rotation @ point + shift``.

    rotation : (3, 3)
    shift    : (3,) metres
    """

    kind: str
    rotation: Float
    shift: Float
    scale: float = 1.0

    def of(self, path: Path3D) -> Path3D:
        """A path moved by it."""
        return path.moved(self.rotation, self.shift, scale=self.scale)


def match_poses(estimate: Path3D, truth: Path3D, *, how: str, gap_s: float | None = None) -> PosePairs:
    """Pair the poses of two paths by time; those of files without times by their number.

    how   : ``interpolated`` takes the truth between its poses at each time of the estimate; ``nearest`` takes
            for each pose of the path with fewer poses the other's nearest in time
    gap_s : see `GAPS_S`

    Raises InputError for paths without common times or of different kinds of time.
    """
    if not estimate.timed and not truth.timed:
        if len(estimate) != len(truth):
            raise InputError(
                f"the estimate has {len(estimate)} poses, the truth {len(truth)}, and neither has times: give"
                " files of equal length, or times"
            )
        return PosePairs(estimate, truth, 0)
    if estimate.timed != truth.timed:
        raise InputError("one trajectory has times and the other none: give both as TUM, or a dataset")
    gap_ns = round(1e9 * (GAPS_S[how] if gap_s is None else gap_s))
    pairs = (_interpolate if how == "interpolated" else _nearest)(estimate, truth, gap_ns=gap_ns)
    if len(pairs) < 2:
        spans = (f"{p.time_ns[0] / 1e9:.3f} to {p.time_ns[-1] / 1e9:.3f}" for p in (estimate, truth))
        raise InputError(
            f"{len(pairs)} poses at common times: those of the estimate are {', of the truth '.join(spans)}"
            " (seconds since 1970)"
        )
    return pairs


def _interpolate(estimate: Path3D, truth: Path3D, *, gap_ns: int) -> PosePairs:
    knots, at = truth.time_ns, estimate.time_ns
    after = np.clip(np.searchsorted(knots, at), 1, len(knots) - 1)
    inside = (at >= knots[0]) & (at <= knots[-1]) & (knots[after] - knots[after - 1] <= gap_ns)
    kept = estimate.where(inside)
    return PosePairs(kept, truth.at(kept.time_ns), int((~inside).sum()))


def _nearest(estimate: Path3D, truth: Path3D, *, gap_ns: int) -> PosePairs:
    fewer, more = (estimate, truth) if len(estimate) <= len(truth) else (truth, estimate)
    row: Ints = nearest(more.time_ns, fewer.time_ns)
    close = np.abs(more.time_ns[row] - fewer.time_ns) <= gap_ns
    first, second = fewer.where(close), more.take(row[close])
    if fewer is estimate:
        return PosePairs(first, second, int((~close).sum()))
    return PosePairs(second, first, len(estimate) - len(second))


def alignment(pairs: PosePairs, kind: str) -> TrajectoryAlignment:
    """The motion that brings an estimate onto the truth.

    none         : as it is
    origin       : first pose onto first pose
    se3, sim3    : least squares of the positions, with scale for sim3 (Umeyama, IEEE PAMI 13, 1991)
    yaw-position : the same with a turn about z alone, for estimates whose roll and pitch are those of gravity

    Raises InputError for positions on a line or in a point, onto which there are several turns.
    """
    estimate, truth = pairs.estimate, pairs.truth
    if kind == "none":
        return TrajectoryAlignment(kind, np.eye(3), np.zeros(3))
    if kind == "origin":
        turn = truth.rotation[0] @ estimate.rotation[0].T
        return TrajectoryAlignment(kind, turn, truth.position[0] - turn @ estimate.position[0])
    here, there = estimate.position.mean(axis=0), truth.position.mean(axis=0)
    x, y = estimate.position - here, truth.position - there
    if kind == "yaw-position":
        yaw = np.arctan2((x[:, 0] * y[:, 1] - x[:, 1] * y[:, 0]).sum(), (x[:, :2] * y[:, :2]).sum())
        c, s = np.cos(yaw), np.sin(yaw)
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        return TrajectoryAlignment(kind, turn, there - turn @ here)
    u, d, v = np.linalg.svd(y.T @ x / len(x))
    if d[1] <= 1e-9 * max(d[0], 1e-12):
        raise InputError(
            f"`align` {kind}: the positions are on a line, onto which there are many turns; give origin or"
            " yaw-position"
        )
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(v))])
    turn = u @ flip @ v
    scale = float(np.trace(np.diag(d) @ flip) / (x**2).sum(axis=1).mean()) if kind == "sim3" else 1.0
    return TrajectoryAlignment(kind, turn, there - scale * turn @ here, scale)
