"""The text of things with parameters, ``NAME:key=value,key=value``, and the same as tables of TOML files."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from geoscene.support.untrusted import read_toml
from lidar.errors import InputError

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
    for part in filter(None, map(str.strip, text.split(","))):
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
    if not items:
        raise InputError(f"{text!r}: {_FORM}")
    return items


def _known(name: str, names: Collection[str]) -> str:
    """A name as it is known, if it is known in lower case."""
    return name.lower() if name.lower() in names else name


def _put(item: Item, key: str, *, value: str, text: str) -> None:
    """Add a parameter to an item."""
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
        document = read_toml(path.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read as TOML ({error})") from None
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
