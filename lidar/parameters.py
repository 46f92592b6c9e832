"""Parameters of stages, defences, filters and settings: type, unit, bounds and meaning, declared once.

They are read from texts ``NAME:key=value,key=value``, and from tables of TOML files.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import Field, dataclass, field, fields
from math import inf, isfinite
from pathlib import Path
from typing import Any, TypeVar

from geoscene.errors import reason_of
from geoscene.support.registry import Registry, hint, unknown_name
from geoscene.support.untrusted import read_toml
from lidar.errors import InputError

P = TypeVar("P")
T = TypeVar("T", bool, int, float, str)

_ENDLESS = ("unlimited", "never")
"""Words for infinity in texts, besides inf."""
_SWITCH = {"on": True, "yes": True, "true": True, "1": True}
_SWITCH |= {"off": False, "no": False, "false": False, "0": False}


def parameter(
    default: T,
    meaning: str,
    *,
    unit: str = "",
    low: float = -inf,
    high: float = inf,
    endless: str = "",
    among: tuple[str, ...] = (),
) -> T:
    """A field of a dataclass whose value users choose; its type is that of its default.

    meaning   : one line
    unit      : of a number; empty for counts, shares and factors
    low, high : bounds of a number, both allowed
    endless   : word for infinity, such as never or unlimited; infinity is not allowed if empty
    among     : allowed words of a text; any if empty
    """
    declared = {"meaning": meaning, "unit": unit, "low": low, "high": high}
    return field(default=default, metadata=declared | {"endless": endless, "among": among})


def parameters_of(kind: type[Any]) -> list[Field[Any]]:
    """The fields of a class that `parameter` made."""
    return [f for f in fields(kind) if "meaning" in f.metadata]


def parameter_rows(kind: type[Any]) -> list[dict[str, Any]]:
    """Name, default, bounds or words, unit and meaning of each parameter of a class."""
    return [
        {
            "name": f.name,
            "default": shown_value(f, f.default),
            **{end: f.metadata[end] for end in ("low", "high") if isfinite(f.metadata[end])},
            **{key: f.metadata[key] for key in ("among", "unit") if f.metadata[key]},
            "meaning": f.metadata["meaning"],
        }
        for f in parameters_of(kind)
    ]


def shown_value(declared: Field[Any], value: Any) -> Any:
    """The value of a parameter for listings: infinity as its word."""
    return declared.metadata["endless"] if value == inf else value


def describe(row: Mapping[str, Any]) -> str:
    """The meaning of a parameter in a row of `parameter_rows`, with its words if there are any."""
    among = row.get("among")
    return f"{row['meaning']} ({', '.join(among)})" if among else str(row["meaning"])


COLUMNS = ("default", "from", "to", "unit", "meaning")
"""Columns of `parameter_cells` after the name."""


def parameter_cells(rows: Iterable[Mapping[str, Any]]) -> list[list[str]]:
    """Lines of a table of parameters, by rows of `parameter_rows`: name and `COLUMNS`."""
    return [
        [
            row["name"],
            value_text(row["default"]),
            *(f"{row[end]:g}" if end in row else "" for end in ("low", "high")),
            row.get("unit", ""),
            describe(row),
        ]
        for row in rows
    ]


def check_parameters(values: Any, *more: str) -> None:
    """Raise InputError if a parameter of a dataclass is not of its type or not within its bounds.

    more : further faults; empty ones are none. All faults are in one message
    """
    faults = [fault_of(f, getattr(values, f.name)) for f in parameters_of(type(values))]
    if found := [fault for fault in (*faults, *more) if fault]:
        raise InputError("; ".join(found))


@dataclass(frozen=True)
class Parameters:
    """Base of dataclasses whose fields are made by `parameter`.

    Raises InputError for a parameter that is not of its default's type or not within its bounds.
    """

    def __post_init__(self) -> None:
        """Validate the parameters, all faults in one message."""
        check_parameters(self)


def fault_of(declared: Field[Any], value: Any) -> str:
    """The fault of the value of a parameter, with what is allowed; empty for a valid one."""
    name, bounds = declared.name, declared.metadata
    kind: type = type(declared.default)
    if kind is bool:
        return "" if type(value) is bool else f"{name} = {value!r} is not on or off"
    if kind is str:
        return _text_fault(name, value, among=bounds["among"])
    is_number = isinstance(value, int if kind is int else int | float) and not isinstance(value, bool)
    if not is_number:
        return f"{name} = {value!r} is not {'a whole number' if kind is int else 'a number'}{_within(bounds)}"
    if (isfinite(value) and bounds["low"] <= value <= bounds["high"]) or (bounds["endless"] and value == inf):
        return ""
    return f"{name} = {value:g} is not{_within(bounds) or ' a finite number'}"


def _text_fault(name: str, value: Any, *, among: tuple[str, ...]) -> str:
    if not isinstance(value, str):
        return f"{name} = {value!r} is not a text"
    if not among or value in among:
        return ""
    return f"{name} = {value!r} is none of {', '.join(among)}{hint(value, among)}"


def _within(bounds: Mapping[str, Any]) -> str:
    """The bounds of a number in words, after a space; empty without any."""
    low, high, unit = bounds["low"], bounds["high"], f" {bounds['unit']}" if bounds["unit"] else ""
    if isfinite(high):
        return f" within {low:g} to {high:g}{unit}"
    if isfinite(low):
        more = f", or {bounds['endless']}" if bounds["endless"] else " and finite"
        return f" at least {low:g}{unit}{more}"
    return ""


def read_values(kind: type[Any], given: Mapping[str, Any], *, also: Collection[str] = ()) -> dict[str, Any]:
    """Values of parameters of a class from texts, or from values of the parameters' types.

    also : further known names, for messages

    Raises InputError for an unknown name. A text that is no value of the parameter's type is returned as it
    is; `check_parameters` refuses it.
    """
    known = {f.name: type(f.default) for f in parameters_of(kind)}
    for name in given:
        if name not in known:
            raise InputError(unknown_name("parameter", name, known=[*known, *also]))
    metres = {f.name for f in parameters_of(kind) if f.metadata["unit"] == "m"}
    return {
        name: _value(_in_metres(value) if name in metres else value, known[name])
        if isinstance(value, str)
        else value
        for name, value in given.items()
    }


def build(registry: Registry[type[P]], item: Item, *, also: Collection[str] = ()) -> P:
    """The object of an item's name in a registry of classes, with the item's values.

    also : further names of values, which were taken before; for messages

    Raises InputError for an unknown name or parameter, and for a value that its class refuses.
    """
    if item.name not in registry:
        raise InputError(item.source + unknown_name(registry.what, item.name, known=registry))
    kind = registry[item.name]
    try:
        return kind(**read_values(kind, item.values, also=also))
    except InputError as error:
        raise InputError(f"{item.source}{registry.what} {item.name}: {error}") from None


_LENGTH = re.compile(r"([\d.]+) ?(mm|cm|m)")
_EXPONENTS = {"mm": "e-3", "cm": "e-2", "m": ""}


def _in_metres(text: str) -> str:
    """A length such as 5mm, 1cm or 0.5 m as a number of metres; another text as it is."""
    found = _LENGTH.fullmatch(text)
    return found[1] + _EXPONENTS[found[2]] if found else text


def _value(text: str, kind: type) -> Any:
    """A text as a value of a type; the text itself if it is none."""
    if kind is bool:
        return _SWITCH.get(text.lower(), text)
    if kind is float and text.lower() in _ENDLESS:
        return inf
    try:
        return kind(text)
    except ValueError:
        return text


_FORM = "give NAME:KEY=VALUE,KEY=VALUE"
_BY_COLONS = re.compile(r":\s*(\w+)\s*=")


@dataclass(slots=True)
class Item:
    """A name with parameters, as read from text or TOML.

    name   : as in its registry, in lower case if it is known so
    values : by parameter; texts on the command line, values of any type in TOML files
    source : file and table that it was read from; empty for a text
    """

    name: str
    values: dict[str, Any] = field(default_factory=dict)
    source: str = ""


def split_items(text: str, names: Collection[str], *, main: str = "", default: str = "") -> list[Item]:
    """The items of a text ``NAME:key=value,key=value,NAME,...``.

    A value may have commas, such as a place: a part without ``=`` that is no known name belongs to the value
    before it.

    names   : known ones; others are items where no value could be meant
    main    : parameter that ``NAME=value`` gives, for known names; none if empty
    default : name of a text that begins with ``key=value``; such a text is refused if empty

    Raises InputError for a text of another form, and parameters that are given twice.
    """
    items: list[Item] = []
    key = ""
    parts = list(map(str.strip, text.split(",")))
    if not all(parts):
        raise InputError(f"{text!r}: has an empty part; {_FORM}")
    for part in parts:
        left, equals, value = (word.strip() for word in part.partition("="))
        head, colon, parameter = (word.strip() for word in left.rpartition(":"))
        if equals and colon:
            items.append(Item(_known(head, names)))
            key = parameter
        elif equals and main and (not items or _known(left, names) in names):
            items.append(Item(_known(left, names)))
            key = main
        elif equals and not items and not default:
            raise InputError(f"{text}: {_FORM}")
        elif equals:
            items = items or [Item(default)]
            key = left
        elif _known(part, names) in names or not (items and key):
            if colon:
                raise InputError(f"{text}: {_FORM}")
            items.append(Item(_known(part, names)))
            key = ""
            continue
        else:
            items[-1].values[key] += f",{part}"
            continue
        _put(items[-1], key, value=value, text=text)
    return items


def _known(name: str, names: Collection[str]) -> str:
    """A name as it is known, if it is known in lower case."""
    return name.lower() if name.lower() in names else name


def _put(item: Item, key: str, *, value: str, text: str) -> None:
    if not key or not value:
        raise InputError(f"{text}: {key or value} has no {'value' if key else 'key'}; {_FORM}")
    if key in item.values:
        raise InputError(f"{text}: {key} is given twice")
    if _BY_COLONS.search(value):
        commas = _BY_COLONS.sub(r",\1=", value)
        raise InputError(f"{text}: separate parameters by commas, as in {item.name}:{key}={commas}")
    item.values[key] = value


def split_pairs(text: str) -> list[tuple[str, str]]:
    """Names and values of a text ``NAME=VALUE,NAME=VALUE``.

    Raises InputError for a text of another form, and names that are given twice.
    """
    items = split_items(text, (), default="settings")
    if [item.name for item in items] != ["settings"]:
        raise InputError(f"{text}: give NAME=VALUE, such as rays=7")
    return list(items[0].values.items())


def read_items(
    texts: Iterable[str], names: Collection[str], *, table: str, key: str = "name", main: str = ""
) -> Iterator[Item]:
    """The items of texts as `split_items` reads them, and of files ``FILE.toml`` with tables ``[[table]]``.

    key : of a table, that has the item's name; its other keys are parameters

    Raises InputError as `split_items` does, and for a file that cannot be read or holds something else.
    """
    for text in texts:
        if not text.endswith(".toml"):
            yield from split_items(text, names, main=main)
            continue
        for number, row in enumerate(_file_tables(Path(text), table), 1):
            yield item_of(row, key=key, source=f"{text}: [[{table}]] {number}: ")


def item_of(table: Mapping[str, Any], *, key: str = "name", source: str = "") -> Item:
    """The item of a table; raises InputError if the key with its name is missing."""
    values = dict(table)
    name = values.pop(key, None)
    if not isinstance(name, str) or not name:
        raise InputError(f"{source}{key} is missing")
    return Item(name, values, source)


def _file_tables(path: Path, table: str) -> list[Mapping[str, Any]]:
    try:
        document = read_toml(path.read_text("utf-8-sig"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read as TOML ({reason_of(error)})") from None
    rows = document.pop(table, None)
    if document or not rows or not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise InputError(f"{path}: give tables [[{table}]] with a name and parameters, and nothing else")
    return rows


def item_text(item: Item) -> str:
    """The text of an item, as `split_items` reads it."""
    values = ",".join(f"{key}={value_text(value)}" for key, value in item.values.items())
    return f"{item.name}:{values}" if values else item.name


def value_text(value: object) -> str:
    """The text of a parameter's value: on or off, a number with all its digits, or words."""
    if isinstance(value, bool):
        return "on" if value else "off"
    if isinstance(value, float) and float(f"{value:g}") == value:
        return f"{value:g}"
    return str(value)
