"""Values of options that Python code gives: taken in the forms that people write, and refused in one line."""

from __future__ import annotations

import math
import os
import types
from collections.abc import Callable, Collection, Hashable, Iterable, Mapping
from dataclasses import fields
from functools import lru_cache
from numbers import Integral, Real
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Union, cast, get_args, get_origin, get_type_hints

from geoscene.support.registry import unknown_name

Reader = Callable[[Any], Any]
"""Returns the value of an option for what is given; raises ValueError, which says what may be given."""


def take_values(
    options: Any, *, error: type[Exception], readers: Mapping[str, Reader] = MappingProxyType({})
) -> None:
    """Give the fields of a frozen dataclass of options values of their types, from values of similar types.

    Whole numbers may be given for numbers, texts and paths for one another, and a text or a list for several
    texts: ``"pcd,laz"``, ``["pcd", "laz"]``.

    error   : is raised for others; it names the option, its value and what is allowed
    readers : of fields, instead of their types
    """
    for name, (kind, split) in _kinds(cast("Hashable", type(options))).items():
        value = getattr(options, name)
        reader = readers.get(name)
        try:
            taken = reader(value) if reader else _value(value, kind, split=split)
        except error:
            raise
        except (TypeError, ValueError) as cause:
            raise error(f"`{name}` {brief(value)}: {cause}") from None
        if taken is not value:
            object.__setattr__(options, name, taken)


def expect(value: object, kind: type[Any], *, name: str, error: type[Exception]) -> None:
    """Raise an error, which names the parameter, unless a value is of a class."""
    if not isinstance(value, kind):
        raise error(f"`{name}` {brief(value)}: give a {kind.__name__}")


def parts_of(text: str) -> tuple[str, ...]:
    """Parts of a text that are separated by commas; raises ValueError for an empty one."""
    parts = tuple(map(str.strip, text.split(",")))
    if not all(parts):
        raise ValueError("has an empty part; separate parts by single commas")
    return parts


def words_of(text: str) -> tuple[str, ...]:
    """Words of a text that are separated by commas, in lower case; raises ValueError for an empty one."""
    return tuple(map(str.lower, parts_of(text)))


def check_words(options: object, *, error: type[Exception], **known: Collection[str]) -> None:
    """Raise an error if an option, or a word of it, is not among the known words by its name.

    error : is raised; None is valid, and so is an empty text among the words, which messages do not list
    """
    for name, words in known.items():
        value = getattr(options, name)
        for word in (value,) if isinstance(value, str) else value or ():
            if word not in words:
                raise error(unknown_name(f"`{name}`", word, known=[one for one in words if one]))


def listed(value: object) -> tuple[Any, ...]:
    """The items of a value of Python code that is no text and no dictionary; raises ValueError for others."""
    if isinstance(value, Iterable) and not isinstance(value, str | bytes | Mapping):
        return tuple(value)
    raise ValueError("give a list")


def brief(value: object) -> str:
    """A value of Python code as a short text for messages."""
    text = " ".join(repr(value).split())
    return text if len(text) <= 60 else f"{text[:57]}..."


@lru_cache(maxsize=64)
def _kinds(kind: Any) -> dict[str, tuple[Any, bool]]:
    """Types of the fields of a class by name, and whether a text is several words separated by commas."""
    from geoscene.support.console import WORDS  # noqa: PLC0415 - it imports what imports this

    hints = get_type_hints(kind, include_extras=True)
    found = {}
    for field in fields(kind):
        hint = hints[field.name]
        extras = get_args(hint)[1:] if get_origin(hint) is Annotated else ()
        found[field.name] = get_args(hint)[0] if extras else hint, any(extra is WORDS for extra in extras)
    return found


def _value(value: Any, kind: Any, *, split: bool) -> Any:
    """A value of a type, from one of a similar type; raises ValueError for others."""
    if kind is Any:
        return value
    if get_origin(kind) in (Union, types.UnionType):
        kinds = get_args(kind)
        if Any in kinds or (value is None and type(None) in kinds):
            return value
        (kind,) = (one for one in kinds if one is not type(None))
    if get_origin(kind) is tuple:
        return _several(value, get_args(kind), split=split)
    return _SINGLE[kind](value)


def _several(value: Any, kinds: tuple[Any, ...], *, split: bool) -> tuple[Any, ...]:
    endless = kinds[-1] is Ellipsis
    if isinstance(value, str | os.PathLike):
        if kinds[0] not in (str, Path):
            raise ValueError("give a list of numbers, not a text")
        text = os.fspath(value)
        value = [text] if not split else words_of(text) if text.strip() else ()
    found = listed(value)
    if not endless and len(found) != len(kinds):
        raise ValueError(f"give {len(kinds)} values")
    taken = tuple(_value(one, kinds[0] if endless else kinds[k], split=False) for k, one in enumerate(found))
    if split:
        taken = tuple(word.lower() for word in taken)
    return taken


def _whole(value: Any) -> int:
    if type(value) is not bool and isinstance(value, Integral):
        return int(value)
    raise ValueError("give a whole number")


def _number(value: Any) -> float:
    if type(value) is bool or not isinstance(value, Real):
        raise ValueError("give a number")
    if not math.isfinite(value):
        raise ValueError("give a finite number")
    return float(value)


def _switch(value: Any) -> bool:
    if isinstance(value, bool) or type(value).__name__ in ("bool", "bool_"):  # of NumPy
        return bool(value)
    raise ValueError("give True or False")


def _text(value: Any) -> str:
    if isinstance(value, str | os.PathLike):
        return str(os.fspath(value))
    raise ValueError("give a text")


def _path(value: Any) -> Path:
    if isinstance(value, str | os.PathLike):
        return Path(value)
    raise ValueError("give a path")


_SINGLE: dict[Any, Reader] = {int: _whole, float: _number, bool: _switch, str: _text, Path: _path}
