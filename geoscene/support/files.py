"""Atomic writes of files and folders: a path never holds a partly written result."""

from __future__ import annotations

import errno
import importlib
import json
import logging
import os
import re
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from geoscene.errors import InputError, NotWrittenError

if TYPE_CHECKING:
    from numpy.typing import NDArray

log = logging.getLogger(__name__)

fcntl = None if sys.platform == "win32" else importlib.import_module("fcntl")


@contextmanager
def atomic_path(path: Path, *, keep_suffix: bool = False) -> Iterator[Path]:
    """Yield a temporary path in the same folder; the file written there is renamed to ``path`` afterwards.

    If the block raises, the temporary file is deleted and ``path`` is left unchanged. If the block writes
    no file, an existing ``path`` is deleted. An OSError without a file name (disk full) gets ``path``.

    keep_suffix : give the temporary file the suffix of ``path``, for libraries that choose the format by it,
                  instead of ``.part``
    """
    middle = f".{os.getpid()}.part"
    part = path.with_name(f"{path.stem}{middle}{path.suffix}" if keep_suffix else f"{path.name}{middle}")
    path.parent.mkdir(parents=True, exist_ok=True)
    part.unlink(missing_ok=True)
    try:
        with naming(path):
            yield part
        if part.exists():
            part.replace(path)
        else:
            path.unlink(missing_ok=True)
    finally:
        part.unlink(missing_ok=True)


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Give an OSError of the block that names no file, such as of a full disk, the name of ``path``."""
    try:
        yield
    except OSError as error:
        if error.filename is None and error.errno is not None:
            error.filename = str(path)
        raise


def not_written(path: Path, cause: Exception) -> NotWrittenError:
    """The error of a file that a library could not write."""
    text = " ".join(str(cause).split())[:120]
    return NotWrittenError(f"{path}: cannot be written ({text}); is the disk full?")


@contextmanager
def atomic_file(path: Path) -> Iterator[IO[bytes]]:
    """Yield a binary file, open for writing and reading, that becomes ``path`` unless the block raises."""
    with atomic_path(path) as part, part.open("w+b") as file:
        yield file


@contextmanager
def atomic_folder(path: Path, *, mark: str, names: str) -> Iterator[Path]:
    """Yield a temporary folder that replaces ``path`` unless the block raises, as `replaced_folder` does.

    mark  : name of a file that marks folders of this kind
    names : regular expression of the paths, relative to the folder, of the files in folders of this kind

    Raises InputError if ``path`` exists and is neither empty nor a folder with the mark.
    """
    if path.exists() and not (path / mark).is_file() and not (path.is_dir() and not any(path.iterdir())):
        raise InputError(f"{path}: exists and holds no {mark}; give another folder")
    own = re.compile(names)
    with replaced_folder(path, own=lambda _: lambda name: own.fullmatch(name) is not None) as part:
        yield part


@contextmanager
def replaced_folder(path: Path, *, own: Callable[[Path], Callable[[str], bool]]) -> Iterator[Path]:
    """Yield a temporary folder that replaces ``path`` unless the block raises.

    Files of the replaced folder that are not of its kind are kept, with a warning for each. A replacement
    that was killed is completed or undone by the next one.

    own : from a folder, which paths relative to it, with slashes, are of its kind

    Raises InputError for a file, for the current directory, which cannot be replaced, a folder around it or
    the root of a disk, and if another process writes the folder.
    """
    place, here = path.resolve(), Path.cwd()
    if place.exists() and not place.is_dir():
        raise InputError(f"{path}: is a file; give a directory")
    if place.is_mount() or place in (here, *here.parents):
        kind = "the root of a disk" if place.is_mount() else "the current directory or holds it"
        raise InputError(f"{path}: is {kind} and cannot be replaced; give a directory in it")
    part, old = (place.with_name(f"{place.name}.{end}.part") for end in ("new", "old"))
    with exclusive(place):
        if old.exists() and not place.exists():
            old.rename(place)
        elif old.exists():
            _keep_foreign(old, path, own=own(old))
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir()
        try:
            with naming(path):
                yield part
            if place.exists():
                place.rename(old)
            part.rename(place)
            if old.exists():
                _keep_foreign(old, path, own=own(old))
        finally:
            if old.exists() and not place.exists():
                old.rename(place)
            shutil.rmtree(part, ignore_errors=True)


def _keep_foreign(old: Path, path: Path, *, own: Callable[[str], bool]) -> None:
    """Move files and links that are not ``own`` from a replaced folder to the new one; delete the rest."""
    for entry in sorted(entry for entry in old.rglob("*") if entry.is_symlink() or not entry.is_dir()):
        name = entry.relative_to(old)
        target = path / name
        if own(name.as_posix()) or target.exists() or target.is_symlink():
            continue
        target.parent.mkdir(parents=True, exist_ok=True)
        entry.rename(target)
        log.warning("%s: kept, though it is not of what was written", target)
    shutil.rmtree(old)


@contextmanager
def exclusive(path: Path) -> Iterator[None]:
    """Hold the right to write a path against other processes; ``<path>.lock`` exists meanwhile.

    Temporary files beside it of processes that were killed are deleted.

    Raises InputError if another process holds it. It ends with its process, however that ends.
    """
    lock = path.with_name(f"{path.name}.lock")
    lock.parent.mkdir(parents=True, exist_ok=True)
    with lock.open("ab") as file:
        if (
            not _try_lock(file)
            or not lock.exists()
            or not os.path.samestat(lock.stat(), os.fstat(file.fileno()))
        ):
            raise InputError(f"{path}: another process is writing it; wait for it, or give another path")
        try:
            delete_leftovers(path.parent, stem=path.stem, below=False)
            yield
        finally:
            lock.unlink(missing_ok=True)


@contextmanager
def temporary_folder(path: Path, what: str) -> Iterator[Path]:
    """Yield a folder beside ``path`` that is deleted afterwards; ``what`` is part of its name.

    If the process is killed, the next one that writes ``path`` deletes it, see `exclusive`.
    """
    folder = path.with_name(f"{path.name}.{what}.{os.getpid()}.part")
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def delete_leftovers(folder: Path, *, stem: str = "", below: bool = True) -> None:
    """Delete temporary files and folders, as of `atomic_path`, of processes that have ended.

    stem  : with which, and a dot, their names begin; by default all
    below : also those in folders of the folder
    """
    for place, folders, files in os.walk(folder):
        for name in [*folders, *files]:
            found = _TEMPORARY.fullmatch(name)
            if found is None or (stem and not name.startswith(f"{stem}.")) or _runs(int(found[1])):
                continue
            entry = Path(place, name)
            if entry.is_dir() and not entry.is_symlink():
                shutil.rmtree(entry)
                folders.remove(name)
            else:
                entry.unlink(missing_ok=True)
        if not below:
            break


_TEMPORARY = re.compile(r".+\.(\d+)\.part(?:\.[.\w]+)?")
"""Names of temporary files with the number of the process."""


def _runs(process: int) -> bool:
    """Whether a process with a number runs; True where that is not known."""
    if sys.platform == "win32":
        return True
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        pass
    return True


def _try_lock(file: IO[bytes]) -> bool:
    """Lock a file; whether that succeeded. Systems without such locks count as success."""
    if fcntl is None:
        return True
    try:
        fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        return error.errno not in (errno.EACCES, errno.EAGAIN)
    return True


def copy_file(source: Path, path: Path) -> None:
    """Copy a file to a path, whose folders are made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(source, path)


def write_lines(path: Path, lines: Iterable[str]) -> None:
    """Write lines of text as a file, atomically."""
    write_atomically(path, "".join(f"{line}\n" for line in lines).encode())


def write_atomically(path: Path, *data: bytes | NDArray[Any]) -> None:
    """Write bytes and arrays, one after another, as a file, atomically."""
    with atomic_file(path) as file:
        for part in data:
            file.write(part if isinstance(part, (bytes, bytearray)) else part.data)


def write_json(path: Path, document: Mapping[str, Any], *, indent: int = 2) -> None:
    """Write a document as indented UTF-8 JSON."""
    write_atomically(path, json_bytes(document, indent=indent))


def json_bytes(document: Mapping[str, Any], *, indent: int = 2) -> bytes:
    """A document as `write_json` writes it; what of a path is no UTF-8 becomes an escape of JSON."""
    text = json.dumps(document, indent=indent, ensure_ascii=False) + "\n"
    return text.encode("utf-8", "backslashreplace")


@contextmanager
def spool(near: Path) -> Iterator[IO[bytes]]:
    """Yield an unnamed temporary file on the disk of ``near``, for data whose size the header states."""
    with naming(near), tempfile.TemporaryFile(dir=near.parent) as file:
        yield file


def append(target: IO[bytes], source: IO[bytes]) -> None:
    """Append the contents of a `spool` to a file."""
    source.seek(0)
    shutil.copyfileobj(source, target, 1 << 20)
