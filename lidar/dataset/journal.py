"""The journal of a dataset: which frames are finished, with digests of their files."""

from __future__ import annotations

import csv
import hashlib
import threading
from array import array
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.support.columns import Columns, table_blocks, write_blocks
from geoscene.support.digests import digest
from geoscene.support.files import naming
from geoscene.typing import Ints

_HEADER = ("sensor", "frame", "points", "digest")
_DIGEST = 20
"""Characters of a digest."""
_LARGEST, _DIGITS = 1 << 62, 20


def frame_digest(digests: bytes) -> str:
    """Digest of a frame by the digests of its files; empty without any."""
    return digest(digests) if digests else ""


@dataclass(frozen=True, slots=True)
class FinishedFrames(Columns):
    """Finished frames of a sensor.

    frame  : (n,) int64, rising
    points : (n,) int64, number of points, 0 for images
    digest : (n,) ASCII, of the files
    """

    frame: Ints
    points: Ints
    digest: NDArray[np.bytes_]

    def row(self, frame: int) -> int:
        """Row of a frame; -1 for none."""
        k = int(np.searchsorted(self.frame, frame))
        return k if k < len(self.frame) and self.frame[k] == frame else -1


class Entries:
    """Finished frames of all sensors; memory holds 38 bytes of each."""

    def __init__(self) -> None:
        self._names: list[str] = []
        self._sensor, self._frame, self._points = array("H"), array("q"), array("q")
        self._digest = bytearray()

    def __len__(self) -> int:
        """Number of frames."""
        return sum(len(self.of(name)) for name in self._names)

    @property
    def sensors(self) -> list[str]:
        """Names of the sensors with finished frames, sorted."""
        return sorted(self._names)

    def add(self, sensor: str, frame: int, *, points: int, digest: str) -> None:
        """Add a frame; it replaces an earlier entry of the same frame."""
        if sensor not in self._names:
            self._names.append(sensor)
        self._sensor.append(self._names.index(sensor))
        self._frame.append(frame)
        self._points.append(points)
        self._digest += digest.encode("ascii").ljust(_DIGEST)

    def of(self, sensor: str) -> FinishedFrames:
        """The finished frames of a sensor."""
        number = self._names.index(sensor) if sensor in self._names else -1
        rows = np.flatnonzero(np.array(self._sensor) == number)
        frame = np.array(self._frame)[rows]
        frame, last = np.unique(frame[::-1], return_index=True)
        rows = rows[::-1][last]
        digest = np.frombuffer(bytes(self._digest), f"S{_DIGEST}")[rows]
        return FinishedFrames(frame, np.array(self._points)[rows], np.char.rstrip(digest))


def read_journal(path: Path) -> Entries:
    """Finished frames of a dataset; lines that are damaged or cut off are left out."""
    found = Entries()
    if not path.is_file():
        return found
    with path.open(encoding="utf-8-sig", errors="replace", newline="") as file:
        for row in csv.reader(file):
            if len(row) != len(_HEADER) or not all(n.isdecimal() and len(n) < _DIGITS for n in row[1:3]):
                continue
            sensor, frame, points, digest = row[0], int(row[1]), int(row[2]), row[3]
            if max(frame, points) < _LARGEST and digest.isascii() and len(digest) <= _DIGEST:
                found.add(sensor, frame, points=points, digest=digest)
    return found


def write_journal(path: Path, entries: Entries) -> None:
    """Write finished frames in order of sensor and number."""
    write_blocks(path, _blocks(entries))


def forget_frames(path: Path, sensors: Collection[str]) -> None:
    """Take the finished frames of some sensors out of a journal, so that they are recorded again."""
    old, kept = read_journal(path), Entries()
    for name in old.sensors:
        if name not in sensors:
            table = old.of(name)
            for frame, points, of_files in zip(table.frame, table.points, table.digest, strict=True):
                kept.add(name, int(frame), points=int(points), digest=of_files.decode())
    write_journal(path, kept)


def _blocks(entries: Entries) -> Iterator[dict[str, Any]]:
    for name in entries.sensors or [""]:
        table = entries.of(name)
        for rows in table_blocks(len(table)):
            block = table.take(rows)
            columns = [name] * len(block), block.frame, block.points, block.digest.astype(str)
            yield dict(zip(_HEADER, columns, strict=True))


class Journal:
    """The frames that are finished; several threads may add to it.

    entries : those of earlier runs among them
    """

    def __init__(self, path: Path) -> None:
        self.path, self.entries, self._lock = path, Entries(), threading.Lock()
        self._files: dict[str, bytearray] = {}

    def keep(self, sensor: str, frame: int, *, points: int, digests: bytes) -> None:
        """Keep a frame of an earlier run; before `begin`."""
        self.entries.add(sensor, frame, points=points, digest=frame_digest(digests))
        own = self._files.setdefault(sensor, bytearray())
        at = frame * len(digests)
        own.extend(bytes(max(at + len(digests) - len(own), 0)))
        own[at : at + len(digests)] = digests

    def begin(self) -> None:
        """Write the file with the frames that were kept."""
        write_journal(self.path, self.entries)

    def add(self, sensor: str, frame: int, *, points: int, digests: bytes) -> None:
        """Add a frame whose files are written.

        digests : SHA-256 of the files, one after another; as many of each frame of a sensor
        """
        with self._lock:
            self.keep(sensor, frame, points=points, digests=digests)
            with naming(self.path), self.path.open("a", encoding="utf-8") as file:
                file.write(f"{sensor},{frame},{points},{frame_digest(digests)}\n")

    def file_digests(self, sensor: str, frame: int, *, count: int) -> list[bytes]:
        """SHA-256 of each of the ``count`` files of a finished frame."""
        size = hashlib.sha256().digest_size
        at = frame * count * size
        own = self._files[sensor][at : at + count * size]
        return [bytes(own[k : k + size]) for k in range(0, len(own), size)]

    def close(self) -> None:
        """Write the file anew, in order."""
        write_journal(self.path, self.entries)
