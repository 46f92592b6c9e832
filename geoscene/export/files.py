"""Summary that all exports return, and small conversions."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np


@dataclass(frozen=True, slots=True)
class Summary:
    """Summary of an export.

    path    : the file, or the folder
    kind    : name of the format
    files   : number of files
    bytes   : of all files together
    objects : objects, features, roads or pixels, whichever the format counts in
    solids  : closed solids among them
    faces   : triangles
    crs     : name of the coordinate reference system of the coordinates in it
    notes   : what a user must know of it, one line each
    """

    path: Path
    kind: str
    files: int
    bytes: int
    objects: int
    solids: int = 0
    faces: int = 0
    crs: str = ""
    notes: tuple[str, ...] = ()

    @classmethod
    def of(cls, path: Path, kind: str, **fields: Any) -> Summary:
        """Summary of an export to a path, with the number and size of its files."""
        return cls(path, kind, *size_of(path), **fields)


def size_of(path: Path) -> tuple[int, int]:
    """Number of files and of bytes at a path."""
    files = [path] if path.is_file() else [p for p in path.rglob("*") if p.is_file()]
    return len(files), sum(p.stat().st_size for p in files)


def plain(value: Any) -> Any:
    """A value of a column as JSON has it; None for NaN, infinity and empty text."""
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or value == "" or (isinstance(value, float) and not np.isfinite(value)):
        return None
    return value


def compact_json(value: Any) -> bytes:
    """A value as JSON without spaces."""
    return json.dumps(value, ensure_ascii=False, separators=(",", ":"), allow_nan=False).encode()
