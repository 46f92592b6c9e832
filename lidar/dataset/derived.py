"""Directories that are made from recorded data: apart from it, and written whole or not at all."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from lidar.dataset.layout import Paths, remove_dataset
from lidar.errors import DatasetError, InputError


def check_target(out: Path, *, source: Path, overwrite: bool) -> None:
    """Check that ``out`` can be made from ``source``.

    Raises InputError for a directory within the source or around it, and DatasetError for one that is not
    empty, without ``overwrite``.
    """
    here, there = source.resolve(), out.resolve()
    if here == there or here in there.parents or there in here.parents:
        raise InputError(f"{out}: give a directory outside of {source}")
    if out.exists() and (not out.is_dir() or any(out.iterdir())) and not overwrite:
        raise DatasetError(f"{out}: is not empty; set `overwrite`, or give another directory")


@contextmanager
def complete_folder(out: Path) -> Iterator[Path]:
    """Yield a temporary folder whose files become those of ``out`` unless the block raises.

    They replace a former dataset there; other files stay.
    """
    place = out.resolve()
    part = place.with_name(f"{place.name}.{os.getpid()}.part")
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir(parents=True)
    try:
        yield part
        if Paths(out).manifest.exists():
            remove_dataset(out)
        if not place.exists() or not any(place.iterdir()):
            part.replace(place)
            return
        manifest = Paths(part).manifest
        files = [path for path in part.rglob("*") if path.is_file() and path != manifest]
        for path in (*files, *([manifest] if manifest.exists() else [])):
            target = place / path.relative_to(part)
            target.parent.mkdir(parents=True, exist_ok=True)
            path.replace(target)
    finally:
        shutil.rmtree(part, ignore_errors=True)


def copy_dataset(source: Path, out: Path, *, leave_out: set[Path]) -> None:
    """Copy a directory but for its checksums and some files, named as in ``out``."""
    left = leave_out | {Paths(out).checksums}

    def skip(folder: str, names: list[str]) -> list[str]:
        place = out / Path(folder).relative_to(source)
        return [name for name in names if place / name in left]

    shutil.copytree(source, out, ignore=skip, dirs_exist_ok=True)
