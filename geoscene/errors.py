"""Exceptions of geoscene.

Messages name parameters in backquotes (`tile_size`); the command line shows them as flags (--tile-size), see
`geoscene.console.with_flags`.
"""

from __future__ import annotations

import importlib
from types import ModuleType


class GeosceneError(Exception):
    """Base class of the exceptions of geoscene; the command line prints one line and exits with code 1."""


class InputError(GeosceneError, ValueError):
    """Invalid input or options; the command line exits with code 2."""


class SourceNotFoundError(InputError):
    """A file, place or area that does not exist or has no features."""


class NetworkError(GeosceneError, OSError):
    """A map server that cannot be reached or refuses the request."""


class FrameError(InputError):
    """An unsuitable coordinate reference system, or coordinates outside its area of use."""


class SceneFormatError(InputError):
    """A folder that is not a scene, or one written by another version."""


class SolidError(GeosceneError):
    """A solid that is not closed, oriented and of positive volume."""


class MissingExtraError(InputError, ImportError):
    """An optional dependency that is not installed."""


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
