"""The journal of a dataset: which frames are finished, with digests of their files."""

from __future__ import annotations

import csv
import hashlib
import threading
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from geoscene.files import write_columns

_HEADER = ("sensor", "frame", "points", "digest")

Entry = tuple[int, str]
"""Number of points of a frame (0 for images), and the digest of its files."""


def digest_of_files(paths: Iterable[Path]) -> str:
    """Digest of the contents of files in order; empty if one of them cannot be read."""
    digest = hashlib.sha256()
    try:
        for path in paths:
            data = path.read_bytes()
            digest.update(len(data).to_bytes(8))
            digest.update(data)
    except OSError:
        return ""
    return digest.hexdigest()[:20]


def read_journal(path: Path) -> dict[tuple[str, int], Entry]:
    """Finished frames by sensor and number; lines that are damaged or cut off are left out."""
    found: dict[tuple[str, int], Entry] = {}
    if not path.is_file():
        return found
    for row in csv.reader(path.read_text("utf-8", "replace").splitlines()):
        if len(row) == len(_HEADER) and row[1].isdecimal() and row[2].isdecimal():
            found[row[0], int(row[1])] = int(row[2]), row[3]
    return found


def write_journal(path: Path, entries: Mapping[tuple[str, int], Entry]) -> None:
    """Write finished frames in order of sensor and number."""
    rows = [(*key, *entries[key]) for key in sorted(entries)]
    columns = zip(*rows, strict=True) if rows else [()] * len(_HEADER)
    write_columns(path, dict(zip(_HEADER, map(np.array, columns), strict=True)))


class Journal:
    """The frames that are finished; several threads may add to it.

    entries : by sensor and frame, those of earlier runs among them
    """

    def __init__(self, path: Path, entries: Mapping[tuple[str, int], Entry]) -> None:
        self.path, self.entries, self._lock = path, dict(entries), threading.Lock()
        write_journal(path, self.entries)

    def add(self, sensor: str, frame: int, *, points: int, digest: str) -> None:
        """Add a frame whose files are written."""
        with self._lock:
            self.entries[sensor, frame] = points, digest
            with self.path.open("a", encoding="utf-8") as file:
                file.write(f"{sensor},{frame},{points},{digest}\n")

    def close(self) -> None:
        """Write the file anew, in order."""
        write_journal(self.path, self.entries)
