"""How many points a file holds, without reading them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from lidar.errors import FormatError

_ROW = {"kitti": 16, "nuscenes": 20}
_HEAD = 4096


def points_in(path: Path, kind: str) -> int:
    """Number of points of a file of one of `lidar.dataset.record.FORMATS`.

    Raises FormatError for a file without a readable header.
    """
    try:
        if kind in _ROW:
            return path.stat().st_size // _ROW[kind]
        return _COUNTERS[kind](path)
    except (OSError, ValueError, IndexError) as error:
        raise FormatError(f"{path}: its number of points cannot be read ({error})") from error


def _named(path: Path, start: bytes) -> int:
    """The last word of the header line that begins so."""
    with path.open("rb") as file:
        head = file.read(_HEAD)
    return int(next(line for line in head.splitlines() if line.startswith(start)).split()[-1])


def _las(path: Path) -> int:
    """The number of point records at byte 247 of LAS 1.4 (R15, table 3)."""
    with path.open("rb") as file:
        file.seek(247)
        return int.from_bytes(file.read(8), "little")


def _csv(path: Path) -> int:
    return path.read_bytes().count(b"\n") - 1


_COUNTERS: dict[str, Callable[[Path], int]] = {
    "pcd": lambda path: _named(path, b"POINTS"),
    "ply": lambda path: _named(path, b"element vertex"),
    "csv": _csv,
    "las": _las,
    "laz": _las,
}
