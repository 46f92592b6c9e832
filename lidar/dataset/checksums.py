"""Checksums of all files of a folder, in one file that ``sha256sum -c`` reads, too.

A line for each file, in order of paths, is its SHA-256 and its path as coreutils write them. The last line is
a comment with the SHA-256 of the lines above: the digest of the folder, by which data made from it name it.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from geoscene.support.digests import file_sha256
from geoscene.support.files import write_atomically
from geoscene.support.progress import Progress, silent

CHECKSUMS = "checksums.sha256"
"""Name of the file."""

_LINE = re.compile(rb"(\\?)([0-9a-f]{64})  ([^\n]+)\n")
_END = b"# sha256 of the lines above: "
_ESCAPES = {b"\\": rb"\\", b"\n": rb"\n", b"\r": rb"\r"}
_MEANT = {escaped: byte for byte, escaped in _ESCAPES.items()}


@dataclass(frozen=True, slots=True)
class Difference:
    """A file that is not as its checksum says.

    what   : changed, missing, added, or cannot be read
    name   : path relative to the folder
    detail : more about it; may be empty
    """

    what: str
    name: str
    detail: str = ""


@dataclass(frozen=True, slots=True)
class Checksums:
    """Contents of a file of checksums.

    sha256 : by path relative to the folder
    digest : of the folder, hexadecimal
    intact : whether the file itself is as it was written
    """

    sha256: dict[str, bytes]
    digest: str
    intact: bool


def files_in(folder: Path) -> Iterator[str]:
    """Paths of all files and links in a folder, relative to it with slashes, but `CHECKSUMS`; in no order."""
    open_folders = [""]
    while open_folders:
        place = open_folders.pop()
        with os.scandir(folder / place) as entries:
            for entry in entries:
                name = f"{place}{entry.name}"
                if entry.is_dir(follow_symlinks=False):
                    open_folders.append(f"{name}/")
                elif name != CHECKSUMS:
                    yield name


def write_checksums(
    folder: Path,
    *,
    known: Mapping[str, bytes] | None = None,
    own: Callable[[str], bool] = lambda _: True,
) -> str:
    """Write the checksums of the files of a folder; return the folder's digest.

    known : SHA-256 of files that need not be read
    own   : which paths are listed; by default all
    """
    data = _to_bytes(_digests(folder, known or {}, own=own))
    write_atomically(folder / CHECKSUMS, data)
    return _digest_of(data)


def add_to_checksums(folder: Path, *, below: str, known: Mapping[str, bytes]) -> None:
    """State the files anew that are below a path of the folder; others keep their checksums, right or wrong.

    A folder without checksums stays without.

    known : SHA-256 of files that are not written yet
    """
    path = folder / CHECKSUMS
    if not path.is_file():
        return
    start = f"{below}/"
    found = {name: sha for name, sha in read_checksums(path).sha256.items() if not name.startswith(start)}
    fresh = {start + name: file_sha256(folder / below / name) for name in files_in(folder / below)}
    write_atomically(path, _to_bytes({**found, **fresh, **known}))


def read_checksums(path: Path) -> Checksums:
    """Read a file of checksums; damaged lines are left out."""
    data = path.read_bytes()
    found = {}
    for line in data.splitlines(keepends=True):
        if parts := _LINE.fullmatch(line):
            name = re.sub(rb"\\[\\nr]", lambda m: _MEANT[m[0]], parts[3]) if parts[1] else parts[3]
            found[os.fsdecode(name)] = bytes.fromhex(parts[2].decode())
    digest = _digest_of(data)
    return Checksums(found, digest, intact=data == _to_bytes(found))


def folder_digest(folder: Path) -> str:
    """Digest of a folder as its checksums state it, or would if it had them; hexadecimal."""
    path = folder / CHECKSUMS
    if path.is_file():
        return read_checksums(path).digest
    return _digest_of(_to_bytes(_digests(folder, {})))


def differences(folder: Path, stated: Checksums, *, progress: Progress = silent) -> Iterator[Difference]:
    """Files of a folder that are not as its checksums state, in order of paths."""
    if not stated.intact:
        yield Difference("changed", CHECKSUMS, "the list of checksums itself")
    present = set(files_in(folder))
    names = sorted(present | stated.sha256.keys())
    for done, name in enumerate(names):
        progress("verify", done, total=len(names))
        if name not in present:
            yield Difference("missing", name)
            continue
        if name not in stated.sha256:
            yield Difference("added", name)
            continue
        path = folder / name
        try:
            same = path.is_file() and file_sha256(path) == stated.sha256[name]
        except OSError as error:
            yield Difference("cannot be read", name, error.strerror or type(error).__name__)
            continue
        if not same:
            yield Difference("changed", name)
    progress("verify", len(names), total=len(names))


def _digests(
    folder: Path, known: Mapping[str, bytes], *, own: Callable[[str], bool] = lambda _: True
) -> dict[str, bytes]:
    """SHA-256 of files of a folder."""
    names = filter(own, files_in(folder))
    return {name: known.get(name) or file_sha256(folder / name) for name in names}


def _to_bytes(sha256: Mapping[str, bytes]) -> bytes:
    lines = b"".join(_line(os.fsencode(name), sha256[name]) for name in sorted(sha256))
    return lines + _END + hashlib.sha256(lines).hexdigest().encode() + b"\n"


def _line(name: bytes, sha256: bytes) -> bytes:
    escaped = re.sub(rb"[\\\n\r]", lambda m: _ESCAPES[m[0]], name)
    mark = b"\\" if escaped != name else b""
    return mark + sha256.hex().encode() + b"  " + escaped + b"\n"


def _digest_of(data: bytes) -> str:
    """Digest of the lines of a file of checksums but the last."""
    lines, _, _ = data.rpartition(_END)
    return hashlib.sha256(lines).hexdigest()
