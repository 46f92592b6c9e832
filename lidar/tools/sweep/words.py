"""Values of a TOML file as words of a command line."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from cyclopts import CycloptsError

from geoscene.errors import GeosceneError
from lidar.errors import InputError, LidarError
from lidar.grammar import item_of, item_text, value_text

_REPEATED = ("set", "stage", "weather", "attack")
"""Options of which each value is given by a flag of its own."""

_JOINED = ("format", "labels", "only")
"""Options whose values are separated by commas."""


@contextmanager
def naming(path: Path, what: str) -> Iterator[None]:
    """Raise errors of the block as InputErrors that name the file and what in it has the error."""
    try:
        yield
    except (CycloptsError, LidarError, GeosceneError, OSError) as error:
        raise InputError(f"{path}: {what}: {str(error).rstrip('.')}") from error


def text_of(value: Any) -> str:
    """A value of the grid as one text; a table with a name as ``NAME:KEY=VALUE,KEY=VALUE``."""
    if isinstance(value, dict):
        return item_text(item_of(value))
    return " ".join(map(text_of, value)) if isinstance(value, list) else value_text(value)


def words_of(key: str, value: Any) -> list[str]:
    """An option and its value as on the command line."""
    flag = f"--{key.replace('_', '-')}"
    if isinstance(value, bool) and key != "traffic":
        return [flag] * value
    if not isinstance(value, list):
        return [flag, text_of(value)] if value != "" else []
    if key in _REPEATED:
        return [word for item in value for word in (flag, text_of(item))]
    if key in _JOINED:
        return [flag, ",".join(map(str, value))] if value else []
    return [flag, *map(str, value)]
