"""Digests, by which bytes, files, values and sources are recognised as unchanged."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from functools import cache
from importlib import resources
from importlib.resources.abc import Traversable
from operator import itemgetter
from pathlib import Path

_LENGTH = 20  # hexadecimal digits


def digest(data: bytes) -> str:
    """Digest of bytes: the first 20 hexadecimal digits of their SHA-256."""
    return short(hashlib.sha256(data))


def short(sha256: hashlib._Hash) -> str:
    """Digest of the bytes that a SHA-256 has been fed."""
    return sha256.hexdigest()[:_LENGTH]


def file_digest(path: Path) -> str:
    """Digest of a file's bytes; empty if the file cannot be read."""
    try:
        return file_sha256(path).hex()[:_LENGTH]
    except OSError:
        return ""


def file_sha256(path: Path) -> bytes:
    """SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").digest()


def value_digest(value: object) -> str:
    """Digest of a value as JSON with sorted keys; what JSON does not know counts by its text."""
    return digest(json.dumps(value, sort_keys=True, default=str).encode())


def recipe_digest(data: bytes) -> str:
    """Digest of bytes as recipes of drives state them: 12 hexadecimal digits of BLAKE2b."""
    return hashlib.blake2b(data, digest_size=6).hexdigest()


@cache
def sources_digest(package: str) -> str:
    """Digest of the Python sources and TOML tables of a package, such as ``geoscene``, by name."""
    found = hashlib.sha256()
    for name, file in sorted(_sources(resources.files(package), ""), key=itemgetter(0)):
        data = file.read_bytes()
        found.update(f"{name}\n{len(data)}\n".encode() + data)
    return short(found)


def _sources(folder: Traversable, prefix: str) -> Iterator[tuple[str, Traversable]]:
    for entry in folder.iterdir():
        if entry.is_dir():
            yield from _sources(entry, f"{prefix}{entry.name}/")
        elif entry.name.endswith((".py", ".toml")):
            yield prefix + entry.name, entry
