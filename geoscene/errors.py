"""Exceptions of geoscene.

Messages name parameters in backquotes (`tile_size`); the command line shows them as flags (--tile-size), see
`geoscene.support.console.with_flags`.
"""

from __future__ import annotations

import importlib
import json
import re
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType


class GeosceneError(Exception):
    """Base class of the exceptions of geoscene; the command line prints one line and exits with code 1."""


class InputError(GeosceneError, ValueError):
    """Invalid input or options; the command line exits with code 2."""


class DamagedFileError(InputError):
    """A point cloud that does not hold what its header states; the command line exits with code 1."""


class SourceNotFoundError(InputError):
    """A file, place or area that does not exist or has no features."""


class NetworkError(GeosceneError, OSError):
    """A map server that cannot be reached or refuses the request."""


class StorageError(GeosceneError):
    """Object storage that cannot be reached, refuses access or lacks a file."""


class NotWrittenError(GeosceneError, OSError):
    """A file that a library could not write, as on a full disk."""


class FrameError(InputError):
    """An unsuitable coordinate reference system, or coordinates outside its area of use."""


class SceneFormatError(InputError):
    """A folder that is not a scene, or one written by another version."""


BUILD_AGAIN = "build the scene again with `overwrite`"
"""What to do about a damaged file of a scene."""

DIFFERS = f"differs from what the build wrote: damaged, edited or of another scene; {BUILD_AGAIN}"
"""Fault of a file of a scene whose digest is not the stated one, and its remedy."""


class MissingExtraError(InputError, ImportError):
    """An optional dependency that is not installed."""


class WorkersLostError(GeosceneError):
    """All worker processes were killed."""


_WORDS = (
    (r"invalid literal for int\(\) with base \d+: (.+)", r"\1 is not a whole number"),
    (r"could not convert string to float: (.+)", r"\1 is not a number"),
    (
        r"could not convert string (.+) to \w+ at row (\d+), column (\d+).*",
        r"\1 in row \2, column \3 is not a number",
    ),
    (r"not enough values to unpack \(expected .*?(\d+), got (\d+)\)", r"\2 values where \1 are needed"),
    (r"too many values to unpack \(expected (\d+).*\)", r"more values than the \1 that are needed"),
    (r"Invalid isoformat string: (.+)", r"\1 is not an ISO 8601 time"),
    (r"cannot convert float \S+ to integer", "a number that is not finite"),
    (r"cannot reshape array .*", "a number of values that does not fit the stated one"),
    (
        r"the number of columns changed from (\d+) to (\d+) at row (\d+).*",
        r"row \3 has \2 columns, the first \1",
    ),
    (r"non-hexadecimal number .*", "digits that are not hexadecimal"),
    (
        r".*NoneType.*|.*'\w+' object.*|.* (subscriptable|iterable).*|.*__\w+__.*|.*not supported between.*",
        "",
    ),
)
"""What messages of Python become in plain words."""


def schema_fault(schema: object, *, reads: int, remedy: str) -> str:
    """Fault of a manifest of another schema version than this program ``reads``, and what to do.

    remedy : for former versions
    """
    newer = isinstance(schema, int) and schema > reads
    what = "a newer version wrote it: upgrade this program" if newer else remedy
    return f"schema version {schema}, this program reads {reads}; {what}"


_FORM = "contents of another form than expected"


def reason_of(error: BaseException) -> str:
    """The reason of an error in reading a file in plain words, without those of Python, on one line."""
    text = " ".join(str(error).split())[:200]
    if isinstance(error, GeosceneError):
        return text
    if isinstance(error, UnicodeDecodeError):
        return f"no UTF-8 text at byte {error.start + 1}"
    if isinstance(error, json.JSONDecodeError):
        ends = error.pos >= len(error.doc.rstrip())
        return "it ends too early" if ends else f"no JSON at line {error.lineno}, column {error.colno}"
    if isinstance(error, OSError):
        return error.strerror or text or "it cannot be read"
    if isinstance(error, KeyError):
        return f"{text[:60]} is missing"
    if isinstance(error, IndexError | EOFError | zlib.error | struct.error):
        return "it ends too early or is damaged"
    if isinstance(error, RecursionError):
        return "it nests too deeply"
    if isinstance(error, AttributeError | TypeError | AssertionError):
        return _FORM
    for pattern, plain in _WORDS:
        if re.fullmatch(pattern, text, re.IGNORECASE):
            text = re.sub(pattern, plain, text, flags=re.IGNORECASE)
            break
    return text or _FORM


@contextmanager
def reading(
    path: object, error: type[Exception], *, remedy: str, known: type[Exception] = GeosceneError
) -> Iterator[None]:
    """Raise what goes wrong in the block, which reads a file, as an ``error`` that names the file.

    remedy : what to do about a missing or damaged file, such as "build the scene again"
    known  : base class of errors that name their cause; they pass, as do those of access and memory
    """
    try:
        yield
    except (known, MemoryError, PermissionError):
        raise
    except IsADirectoryError as cause:
        raise error(f"{path}: is a directory, not a file; {remedy}") from cause
    except FileNotFoundError as cause:
        raise error(f"{path}: is missing; {remedy}") from cause
    except Exception as cause:
        raise error(f"{path}: damaged ({reason_of(cause)}); {remedy}") from cause


def need(module: str, extra: str) -> ModuleType:
    """Import an optional module; raises MissingExtraError, which names the extra, if it is not installed."""
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name and not (module == error.name or module.startswith(error.name + ".")):
            raise
        raise MissingExtraError(
            f"{module} is not installed; it comes with: pip install 'geoscene[{extra}]'"
        ) from None
