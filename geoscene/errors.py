"""Everything geoscene raises on purpose.

Messages name parameters in backquotes (`tile_size`); the command line shows them as flags (--tile-size), see
`geoscene.console.with_flags`.
"""

from __future__ import annotations

import importlib
from types import ModuleType


class GeosceneError(Exception):
    """Root of what this package raises on purpose; the command line shows it as one line, exit code 1."""


class InputError(GeosceneError, ValueError):
    """The user's input or options cannot be used; the command line exits with code 2."""


class SourceNotFoundError(InputError):
    """A file, place or area that does not exist or holds nothing."""


class NetworkError(GeosceneError, OSError):
    """A map server could not be reached or refused."""


class FrameError(InputError):
    """A coordinate reference system that cannot serve, or coordinates outside its area of use."""


class SceneFormatError(InputError):
    """A folder that is not a scene, or one written by another version."""


class SolidError(GeosceneError):
    """A solid that is not closed, oriented and of positive volume."""


class MissingExtraError(InputError, ImportError):
    """An optional dependency that is not installed."""


def need(module: str, extra: str) -> ModuleType:
    """Import an optional module, or raise `MissingExtraError` that names the extra which brings it."""
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name and not (module == error.name or module.startswith(error.name + ".")):
            raise
        raise MissingExtraError(
            f"{module} is not installed; it comes with: pip install 'geoscene[{extra}]'"
        ) from None
