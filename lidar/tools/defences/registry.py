"""Registry of defences; reads them from text."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields, replace
from difflib import get_close_matches
from importlib import import_module
from typing import Any, cast

from lidar.errors import InputError
from lidar.signal.stage import parameter_rows
from lidar.tools.defences.defence import Defence

_DEFENCES = {
    "occlusion": "occlusion.Occlusion",
    "shadow": "shadow.Shadow",
    "temporal": "temporal.Temporal",
    "void": "void.Void",
    "azimuth": "azimuth.Azimuth",
    "overlay": "overlay.Overlay",
    "map": "map.Map",
    "navigation": "navigation.NavigationDefence",
    "physics": "physics.Physics",
    "statistical": "statistical.StatisticalDefence",
    "timing": "timing.Timing",
    "watermark": "watermark.WatermarkDefence",
}
"""Module within this folder and class, by name."""


@dataclass(frozen=True, slots=True)
class NamedDefence:
    """A defence that is switched on; ``named`` by the user, not one of all."""

    name: str
    defence: Defence
    named: bool = True

    def to_json(self) -> dict[str, Any]:
        """Its name and parameters."""
        return {"name": self.name, **asdict(self.defence)}


def defence_names() -> list[str]:
    """Names of all defences."""
    return list(_DEFENCES)


def defence_class(name: str) -> type[Defence]:
    """The class of a defence; raises InputError if the name is unknown."""
    if name not in _DEFENCES:
        near = get_close_matches(name, _DEFENCES, 1)
        hint = f"; is {near[0]} meant?" if near else ""
        raise InputError(f"defence {name!r} is unknown{hint} (known are {', '.join(_DEFENCES)})")
    module, kind = _DEFENCES[name].split(".")
    return cast("type[Defence]", getattr(import_module(f"lidar.tools.defences.{module}"), kind))


def read_defences(texts: Iterable[str]) -> tuple[NamedDefence, ...]:
    """Defences from texts ``NAME`` or ``NAME:KEY=VALUE:KEY=VALUE``; ``all`` for those that the data allow.

    Raises InputError for a defence or parameter that is unknown or given twice, or a value out of its bounds.
    """
    found: dict[str, NamedDefence] = {}
    for text in texts:
        for named in map(_read, defence_names() if text == "all" else [text]):
            if named.name in found:
                raise InputError(f"defence {named.name}: given twice")
            found[named.name] = replace(named, named=text != "all")
    if not found:
        raise InputError(f"`defence`: give one or more of {', '.join(_DEFENCES)}, or all")
    return tuple(found.values())


def _read(text: str) -> NamedDefence:
    name, *pairs = (part.strip() for part in text.split(":"))
    kind = defence_class(name)
    known: dict[str, Any] = {f.name: type(f.default) for f in fields(kind)}
    values: dict[str, Any] = {}
    for pair in pairs:
        key, equals, value = (part.strip() for part in pair.partition("="))
        if not equals:
            raise InputError(f"defence {text}: give NAME:KEY=VALUE:KEY=VALUE")
        if key not in known:
            raise InputError(f"defence {name}: no parameter {key!r} (known are {', '.join(known) or 'none'})")
        if key in values:
            raise InputError(f"defence {name}: {key} is given twice")
        try:
            values[key] = known[key](value)
        except ValueError:
            values[key] = value
    try:
        return NamedDefence(name, kind(**values))
    except InputError as error:
        raise InputError(f"defence {name}: {error}") from None


def defence_rows() -> list[dict[str, Any]]:
    """Name, meaning, needs, earlier frames and parameters of every defence."""
    rows = []
    for name in _DEFENCES:
        kind = defence_class(name)
        rows.append(
            {
                "name": name,
                "meaning": (kind.__doc__ or "").partition("\n")[0],
                "needs": sorted(kind.needs),
                "history": kind.history,
                "parameters": parameter_rows(kind),
            }
        )
    return rows
