"""Exceptions of geoscene.

Messages name parameters in backquotes (`tile_size`); the command line shows them as flags (--tile-size), see
`geoscene.support.console.with_flags`.
"""

from __future__ import annotations

import importlib
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
        text = " ".join(str(cause).split())[:200]
        raise error(f"{path}: damaged ({type(cause).__name__}: {text}); {remedy}") from cause


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
