"""Directories made from recorded data: outside of it, and written atomically."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

from geoscene.errors import NotWrittenError
from geoscene.support.files import replaced_folder
from lidar.dataset.layout import Paths, own_files
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


def complete_folder(out: Path) -> AbstractContextManager[Path]:
    """Yield a temporary folder that replaces ``out`` unless the block raises.

    Files there that are not of a dataset stay, with a warning for each.
    """
    return replaced_folder(out, own=own_files)


def copy_dataset(source: Path, out: Path, *, leave_out: set[Path]) -> None:
    """Copy a directory but for its checksums and some files, named as in ``out``."""
    left = leave_out | {Paths(out).checksums}

    def skip(folder: str, names: list[str]) -> list[str]:
        place = out / Path(folder).relative_to(source)
        return [name for name in names if place / name in left]

    copy_folder(source, out, ignore=skip)


def copy_folder(
    source: Path, out: Path, *, ignore: Callable[[str, list[str]], list[str]] | None = None
) -> None:
    """Copy a directory, except the names that ``ignore`` returns for each folder.

    Raises NotWrittenError, which names the first file that could not be copied.
    """
    try:
        shutil.copytree(source, out, ignore=ignore, dirs_exist_ok=True)
    except shutil.Error as error:
        first, _, why = error.args[0][0]
        raise NotWrittenError(f"{first}: cannot be copied ({str(why).partition(': ')[0]})") from error
