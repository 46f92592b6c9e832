"""Files and folders that appear whole or not at all."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np

from geoscene.errors import InputError


@dataclass(frozen=True, slots=True)
class Summary:
    """What an export wrote.

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


@contextmanager
def whole_file(path: Path) -> Iterator[IO[bytes]]:
    """A binary file to write to, which takes its name when the block ends well."""
    part = path.with_name(f"{path.name}.{os.getpid()}.part")
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        with part.open("w+b") as file:
            yield file
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


@contextmanager
def whole_folder(path: Path, *, mark: str) -> Iterator[Path]:
    """A folder to write to, which takes its name when the block ends well.

    mark : name of the file by which a folder of this kind is known, so that only such a one is replaced

    Raises InputError where the name is taken by anything else.
    """
    if path.exists() and not (path / mark).is_file() and not (path.is_dir() and not any(path.iterdir())):
        raise InputError(f"{path}: exists and holds no {mark}; give another folder")
    part = path.with_name(f"{path.name}.{os.getpid()}.part")
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir(parents=True)
    try:
        yield part
        if path.exists():
            shutil.rmtree(path)
        part.rename(path)
    finally:
        shutil.rmtree(part, ignore_errors=True)


@contextmanager
def spool(near: Path) -> Iterator[IO[bytes]]:
    """A nameless temporary file on the disk of ``near``, for what a format wants at its end."""
    with tempfile.TemporaryFile(dir=near.parent) as file:
        yield file


def append(target: IO[bytes], source: IO[bytes]) -> None:
    """Copy all of a spool to the end of a file."""
    source.seek(0)
    shutil.copyfileobj(source, target, 1 << 20)


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
