"""Poses as TUM text files (Sturm et al. 2012), for evo and other programs that compare trajectories.

A line is ``timestamp tx ty tz qx qy qz qw``: POSIX seconds (UTC), position in metres, and the rotation of the
axes of the position from those of the body. Lines that begin with # are comments.
"""

from __future__ import annotations

from decimal import Decimal
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geoscene.support.files import write_atomically
from geoscene.typing import Float
from lidar.errors import FormatError, InputError

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
        lines = path.read_text("utf-8").splitlines()
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
