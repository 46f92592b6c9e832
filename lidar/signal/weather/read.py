"""Weather from texts such as ``rain=10mm/h`` and from TOML files, as stages."""

from __future__ import annotations

import re
from collections.abc import Mapping
from math import isfinite
from typing import Any

from geoscene.support.registry import unknown_name
from lidar.errors import InputError
from lidar.grammar import Item, read_items
from lidar.parameters import read_values
from lidar.signal.registry import STAGES, NamedStage, number_stages
from lidar.signal.weather.setting import KINDS, MODELS

_UNITS = {
    "mm/h": {"mm/h": 1.0, "cm/h": 10.0},
    "m": {"m": 1.0, "km": 1000.0},
    "mm": {"mm": 1.0, "cm": 10.0},
    "": {},
}
_OF_FILES = ("from", "to", "centre", "interpolation")
_CENTRE = {"longitude", "latitude", "radius"}
_AMOUNT = re.compile(r"\s*([-+]?[\d.]+(?:[eE][-+]?\d+)?)\s*(\S*)\s*")


def read_weather(text: str) -> tuple[NamedStage, ...]:
    """Stages of weather from a text such as ``rain=10mm/h``, ``fog=50m,medium=radiation`` or ``FILE.toml``.

    A text names one or more kinds, separated by commas, each followed by its parameters; ``rain=10mm/h`` is
    short for ``rain:amount=10mm/h``. A file has a table ``[[weather]]`` for each setting, with ``kind``,
    ``amount``, optionally ``from`` and ``to`` (seconds), ``polygon`` ([[lon, lat], ...]) or ``centre``
    ([lon, lat]) and ``radius`` (metres), ``interpolation`` (``step`` or ``linear``, which goes to
    ``amount_to``), and the other parameters of `WeatherSetting`.

    Raises InputError for what cannot be read.
    """
    found = []
    for item in read_items([text], KINDS, table="weather", key="kind", main="amount"):
        where = item.source or f"weather {text!r}: "
        try:
            found.append(_stage(item, _flat(item.values) if item.source else item.values))
        except InputError as error:
            raise InputError(f"{where}{error}") from None
    return number_stages(found)


def _flat(table: Mapping[str, Any]) -> dict[str, Any]:
    """The values of a table of a file, by the parameters of `WeatherSetting`."""
    row = {{"from": "start", "to": "end"}.get(key, key): value for key, value in table.items()}
    if "centre" in row:
        centre = row.pop("centre")
        if not _is_pair(centre) or "radius" not in row:
            raise InputError("centre is [longitude, latitude] in degrees, with a radius in metres")
        row["longitude"], row["latitude"] = centre
    if isinstance(row.get("polygon"), list):
        if not all(_is_pair(corner) for corner in row["polygon"]):
            raise InputError("polygon is [[longitude, latitude], ...] in degrees")
        row["polygon"] = ", ".join(f"{lon!r} {lat!r}" for lon, lat in row["polygon"])
    way = row.pop("interpolation", "linear" if "amount_to" in row else "step")
    if way not in ("step", "linear") or (way == "linear") != ("amount_to" in row):
        raise InputError("interpolation is step, or linear with amount_to")
    return row


def _is_pair(value: Any) -> bool:
    return (
        isinstance(value, list)
        and len(value) == 2
        and all(isinstance(x, int | float) and isfinite(x) for x in value)
    )


def _stage(item: Item, given: Mapping[str, Any]) -> NamedStage:
    """The stage of a kind of weather and the parameters that are given for it."""
    if item.name not in KINDS:
        raise InputError(unknown_name("kind", item.name, known=KINDS))
    if missing := _CENTRE - given.keys() if _CENTRE & given.keys() else ():
        raise InputError(f"a centre needs longitude, latitude and radius; {min(missing)} is missing")
    if "kind" in given:
        raise InputError("kind is given twice")
    kind, model = KINDS[item.name], str(given.get("model", "physical"))
    if model not in MODELS:
        raise InputError(unknown_name("model", model, known=MODELS))
    if "amount" not in given and kind.default is None:
        raise InputError(f"{item.name} needs an amount ({kind.meaning}, {kind.unit})")
    values = {"kind": item.name, "amount": kind.default, **given}
    for name in ("amount", "amount_to"):
        if isinstance(values.get(name), str):
            values[name] = _amount(values[name], item.name)
    name = "weather" if model == "physical" else "weather_model"
    stage = STAGES[name]
    return NamedStage(name, stage(**read_values(stage, values, also=_OF_FILES if item.source else ())))


def _amount(text: str, kind: str) -> float:
    """An amount in the unit of its kind, from a number with or without a unit."""
    unit = KINDS[kind].unit
    found = _AMOUNT.fullmatch(text)
    factors = {"": 1.0, **_UNITS[unit]}
    if not found or found[2] not in factors:
        raise InputError(
            f"amount {text!r} of {kind} is not a number in {' or '.join(_UNITS[unit]) or 'no unit'}"
        )
    try:
        return float(found[1]) * factors[found[2]]
    except ValueError:
        raise InputError(f"amount {text!r} of {kind} is not a number") from None
