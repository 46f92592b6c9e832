"""TOML tables read key by key, with messages that name file, line and key."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field
from importlib import resources
from math import isfinite
from pathlib import Path
from typing import Any

from geoscene.errors import reason_of
from geoscene.support.registry import hint, nearest, unknown_name
from geoscene.support.untrusted import read_toml
from lidar.errors import RigError

_HEADER = re.compile(r"^\s*\[(\[?)\s*([A-Za-z0-9_.\-\"' ]+?)\s*\]\]?\s*(?:#.*)?$")
_KEY = re.compile(r"^\s*([A-Za-z0-9_.\-\"']+)\s*=")


def _lines(text: str) -> dict[tuple[str, ...], int]:
    """Line number of every header and key; the third ``[[a]]`` has the key ('a', '2')."""
    found: dict[tuple[str, ...], int] = {}
    counts: dict[str, int] = {}
    section: tuple[str, ...] = ()
    for number, line in enumerate(text.splitlines(), 1):
        if header := _HEADER.match(line):
            name = header[2].replace('"', "").replace("'", "")
            section = tuple(part.strip() for part in name.split("."))
            if header[1]:
                counts[name] = counts.get(name, -1) + 1
                section = (*section, str(counts[name]))
            found.setdefault(section, number)
        elif key := _KEY.match(line):
            found.setdefault((*section, *key[1].replace('"', "").replace("'", "").split(".")), number)
    return found


@dataclass(slots=True)
class Table:
    """One table of a TOML file. `close` raises an error for keys that were never read."""

    path: str
    data: dict[str, Any]
    place: tuple[str, ...] = ()
    lines: dict[tuple[str, ...], int] = field(default_factory=dict)
    read: list[str] = field(default_factory=list)

    def error(self, key: str, message: str) -> RigError:
        """A RigError with the file and line of a key."""
        spot = (*self.place, *key.split(".")) if key else self.place
        line = next((self.lines[spot[:k]] for k in range(len(spot), 0, -1) if spot[:k] in self.lines), None)
        where = f"{self.path}, line {line}" if line else self.path
        name = ".".join(part for part in spot if not part.isdigit())
        return RigError(f"{where}: {name}: {message}" if name else f"{where}: {message}")

    def _take(self, key: str, default: Any) -> Any:
        self.read.append(key)
        if key in self.data:
            return self.data[key]
        if default is ...:
            near = nearest(key, self.data)
            question = f"; is {near} a misspelling of it?" if near else ""
            raise self.error(key, f"this key is missing{question}")
        return default

    def number(
        self,
        key: str,
        default: Any = ...,
        *,
        low: float = -1e18,
        high: float = 1e18,
        above: float | None = None,
    ) -> float:
        """A finite number within [low, high] and greater than ``above``."""
        value = self._take(key, default)
        if isinstance(value, bool) or not isinstance(value, int | float) or not isfinite(value):
            raise self.error(key, f"{value!r} is not a number")
        if above is not None and value <= above:
            raise self.error(key, f"{value} is not over {above:g}")
        if not low <= value <= high:
            bound = f"under {low:g}" if value < low else f"over {high:g}"
            raise self.error(key, f"{value} is {bound}")
        return float(value)

    def integer(self, key: str, default: Any = ..., *, low: int = -(2**62), high: int = 2**62) -> int:
        """An integer within [low, high]."""
        value = self._take(key, default)
        if isinstance(value, bool) or not isinstance(value, int):
            raise self.error(key, f"{value!r} is not a whole number")
        if not low <= value <= high:
            raise self.error(key, f"{value} is not within {low} to {high}")
        return value

    def text(self, key: str, default: Any = ..., *, among: Iterable[str] = ()) -> str:
        """A string; one of ``among`` unless that is empty."""
        value = self._take(key, default)
        if not isinstance(value, str):
            raise self.error(key, f"{value!r} is not a string")
        if (known := tuple(among)) and value not in known:
            raise self.error(key, unknown_name("value", value, known=known))
        return value

    def texts(self, key: str, default: Any = ..., *, among: Iterable[str] = ()) -> tuple[str, ...]:
        """A list of strings, each one of ``among`` unless that is empty."""
        value, known = self._take(key, default), tuple(among)
        if not isinstance(value, list | tuple) or not all(isinstance(v, str) for v in value):
            raise self.error(key, f"{value!r} is not a list of strings")
        if known and (strange := [v for v in value if v not in known]):
            raise self.error(key, unknown_name("value", strange[0], known=known))
        return tuple(value)

    def flag(self, key: str, default: Any = ...) -> bool:
        """A boolean."""
        value = self._take(key, default)
        if not isinstance(value, bool):
            raise self.error(key, f"{value!r} is not true or false")
        return value

    def numbers(
        self,
        key: str,
        default: Any = ...,
        *,
        count: int | Sequence[int] = 0,
        spread: bool = False,
        within: float = 1e18,
    ) -> tuple[float, ...]:
        """Numbers within ±``within``, ``count`` of them (0: any count); ``spread`` repeats a single one."""
        value = self._take(key, default)
        lengths = (count,) if isinstance(count, int) else tuple(count)
        if spread and isinstance(value, int | float) and not isinstance(value, bool):
            value = [value] * lengths[0]
        if not isinstance(value, list | tuple) or not value:
            raise self.error(key, f"{value!r} is not a list of numbers")
        for k, v in enumerate(value):
            if isinstance(v, bool) or not isinstance(v, int | float) or not isfinite(v):
                raise self.error(key, f"entry {k + 1}, {v!r}, is not a number")
            if abs(v) > within:
                raise self.error(key, f"entry {k + 1}, {v:g}, is not within ±{within:g}")
        if lengths != (0,) and len(value) not in lengths:
            wanted = " or ".join(str(n) for n in lengths)
            raise self.error(key, f"{len(value)} numbers where {wanted} are needed")
        return tuple(float(v) for v in value)

    def has(self, key: str) -> bool:
        """Whether the key is given."""
        return key in self.data

    def table(self, key: str, default: Any = ...) -> Table:
        """A nested table."""
        value = self._take(key, default)
        if not isinstance(value, dict):
            raise self.error(key, f"{value!r} is not a table")
        return Table(self.path, value, (*self.place, key), self.lines)

    def tables(self, key: str) -> list[Table]:
        """A list of nested tables; empty if the key is missing."""
        value = self._take(key, [])
        if not isinstance(value, list) or not all(isinstance(v, dict) for v in value):
            raise self.error(key, f"write it as [[{key}]]")
        return [Table(self.path, v, (*self.place, key, str(k)), self.lines) for k, v in enumerate(value)]

    def close(self) -> None:
        """Raise RigError for keys that were never read."""
        for key in self.data:
            if key not in self.read:
                raise self.error(key, unknown_name("key", key, known=dict.fromkeys(self.read)))


def read_table(path: Path | Any, *, name: str = "") -> Table:
    """The root table of a TOML file (a Path, or a resource of a package).

    Raises RigError if the file is missing or is not TOML.
    """
    shown = name or str(path)
    try:
        text = path.read_text("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise RigError(f"{shown}: cannot be read ({reason_of(error)})") from error
    try:
        data = read_toml(text)
    except tomllib.TOMLDecodeError as error:
        raise RigError(f"{shown}: not valid TOML: {reason_of(error)}") from error
    return Table(shown, data, (), _lines(text))


def built_in_names(package: str, folder: str) -> list[str]:
    """Names of the TOML files in a folder of a package."""
    files = (resources.files(package) / folder).iterdir()
    return sorted(f.name.removesuffix(".toml") for f in files if f.name.endswith(".toml"))


def unknown_built_in(what: str, name: str, *, names: Collection[str]) -> str:
    """The message for a name that is neither built in nor that of a TOML file."""
    return (
        f"{what} {name!r} is not known{hint(name, names)} ({', '.join(names)}, or the path of a .toml file)"
    )


def read_named_table(name: str | Path, *, what: str, package: str, folder: str) -> Table:
    """The root table of a TOML file, or of a built-in one by its name.

    what : of what it is, for messages

    Raises RigError as `read_table`, and for a name that is neither.
    """
    names = built_in_names(package, folder)
    known = ", ".join(names)
    if str(name).endswith(".toml"):
        if not Path(name).is_file():
            raise RigError(f"{name}: no such {what} file; built-in ones are {known}")
        return read_table(Path(name))
    if str(name) not in names:
        raise RigError(unknown_built_in(what, str(name), names=names))
    return read_table(resources.files(package) / folder / f"{name}.toml", name=f"{folder}/{name}.toml")
