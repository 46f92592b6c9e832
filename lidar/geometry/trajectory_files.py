"""Trajectories: ``trajectory.csv`` of a dataset, whose manifest holds the frame, and text files of TUM.

TUM's (Sturm et al. 2012) are for evo and other programs that compare trajectories. A line is ``timestamp tx
ty tz qx qy qz qw``: POSIX seconds (UTC), position in metres, and the rotation of the axes of the position
from those of the body. Lines that begin with # are comments.
"""

from __future__ import annotations

from decimal import Decimal
from pathlib import Path
from typing import TextIO

import numpy as np
from numpy.typing import NDArray

from geoscene.errors import reason_of
from geoscene.support.columns import write_columns
from geoscene.support.files import write_atomically
from geoscene.typing import Float
from lidar.errors import DatasetError, FormatError, InputError
from lidar.geometry.poses import Trajectory

MANIFEST = "dataset.json"
"""Name of a dataset's manifest; its key ``frame`` is the frame of the trajectory beside it."""

_LARGEST = 1e15  # nanoseconds of eleven days
_TRAJECTORY = ("time_ns", "x", "y", "z", "qx", "qy", "qz", "qw", "vx", "vy", "vz", "scale")


def write_trajectory(path: Path, trajectory: Trajectory) -> None:
    """Write a trajectory as CSV; `read_trajectory` returns exactly the same numbers."""
    t = trajectory
    columns = [t.time_ns, *t.position.T, *t.quat_xyzw.T, *t.velocity.T, t.scale]
    write_columns(path, dict(zip(_TRAJECTORY, columns, strict=True)))


def read_trajectory(path: Path) -> Trajectory:
    """The trajectory that `write_trajectory` wrote.

    Raises DatasetError if the file is missing or damaged.
    """
    try:
        with path.open(encoding="utf-8-sig") as lines:
            return _parse(path, lines)
    except DatasetError:
        raise
    except (OSError, ValueError, InputError) as error:
        raise DatasetError(f"{path}: not a readable trajectory ({reason_of(error)})") from error


def _parse(path: Path, lines: TextIO) -> Trajectory:
    """The trajectory in a file; raises DatasetError for other columns and rows that hold no pose."""
    names = next(lines, "").rstrip("\n")
    if tuple(names.split(",")) != _TRAJECTORY:
        raise DatasetError(f"{path}: columns {names}; expected {','.join(_TRAJECTORY)}")
    rows = [*lines]
    if not rows:
        raise DatasetError(f"{path}: no rows")
    values = np.loadtxt(rows, delimiter=",", ndmin=2)
    if values.shape != (len(rows), len(_TRAJECTORY)):
        raise DatasetError(f"{path}: rows and columns disagree")
    time, quat, scale = values[:, 0], values[:, 4:8], values[:, 11]
    with np.errstate(over="ignore", invalid="ignore"):
        unit = np.abs(np.linalg.norm(quat, axis=1) - 1) < 1e-3
        sound = (np.abs(values) < _LARGEST).all(axis=1) & unit & (scale > 0)
    if not sound.all():
        raise DatasetError(f"{path}: line {sound.argmin() + 2} holds no pose")
    if len(late := np.flatnonzero(np.diff(time) <= 0)):
        raise DatasetError(f"{path}: line {late[0] + 3} is not later than the line before")
    return Trajectory(
        time.astype(np.int64), values[:, 1:4].copy(), quat.copy(), values[:, 8:11].copy(), scale.copy()
    )


_LATEST_S = 2**32
"""Seconds since 1970 before which times are."""


def write_tum(path: Path, time_ns: NDArray[np.int64], *, position: Float, quat_xyzw: Float) -> None:
    """Write positions (n, 3) and rotations (n, 4) at times (n,) in nanoseconds since 1970."""
    seconds, rest = np.divmod(time_ns, 10**9)
    rows = zip(seconds.tolist(), rest.tolist(), np.hstack([position, quat_xyzw]).tolist(), strict=True)
    lines = [f"{s}.{ns:09d} {' '.join(map(str, row))}\n" for s, ns, row in rows]
    write_atomically(path, "".join(lines).encode("ascii"))


def read_tum(path: Path) -> tuple[NDArray[np.int64], Float, Float]:
    """Times (n,) in nanoseconds since 1970, positions (n, 3) and rotations (n, 4) xyzw of a file.

    Raises InputError for a file that does not exist, and FormatError for one without two poses at rising
    times.
    """
    try:
        lines = path.read_text("utf-8-sig").splitlines()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); give a TUM trajectory") from None
    except UnicodeDecodeError:
        raise FormatError(f"{path}: not text; a TUM trajectory is") from None
    times, rows = [], []
    for number, line in enumerate(lines, 1):
        if not (words := line.split()) or words[0].startswith("#"):
            continue
        try:
            seconds = Decimal(words[0])
            # Before it is a whole number, which may have a million digits.
            times.append(int(seconds * 10**9) if abs(seconds) < _LATEST_S else _LATEST_S * 10**9)
            rows.append([float(word) for word in words[1:]])
        except (ArithmeticError, ValueError):
            raise FormatError(f"{path}, line {number}: not numbers") from None
        if len(rows[-1]) != 7:
            raise FormatError(
                f"{path}, line {number}: {len(words)} numbers; a pose has 8: timestamp tx ty tz qx qy qz qw"
            )
    poses = np.array(rows, float).reshape(-1, 7)
    if len(times) < 2:
        raise FormatError(f"{path}: {len(times)} poses; a trajectory has two or more")
    if max(map(abs, times)) >= _LATEST_S * 10**9:
        raise FormatError(f"{path}: times that are no POSIX seconds")
    time_ns = np.array(times, np.int64)
    if (np.diff(time_ns) <= 0).any():
        raise FormatError(f"{path}: its times do not increase")
    if not (np.isfinite(poses).all() and (np.abs(np.linalg.norm(poses[:, 3:], axis=1) - 1) < 1e-3).all()):
        raise FormatError(
            f"{path}: holds rotations that are no unit quaternions, or numbers that are not finite"
        )
    return time_ns, poses[:, :3], poses[:, 3:]
