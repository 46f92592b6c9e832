"""Groups, converters and checks that options of several commands share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from cyclopts import Group, Parameter, Token

from geoscene.support import option_values
from geoscene.support.option_values import listed
from lidar.errors import InputError
from lidar.parameters import split_pairs, value_text

OUTPUT = Group("Output", sort_key=3)


check_words = partial(option_values.check_words, error=InputError)
"""Raise InputError if an option, or a word of it, is not among the known words by its name."""


def check_whole(options: object, **bounds: tuple[int, int]) -> None:
    """Raise InputError if an option is not within its bounds, both allowed."""
    for name, (low, high) in bounds.items():
        if not low <= getattr(options, name) <= high:
            raise InputError(f"`{name}` {getattr(options, name)}: give {low} to {high}")


def check_positive(options: object, **units: str) -> None:
    """Raise InputError if an option that is given is not positive; ``units`` follow "number"."""
    for name, unit in units.items():
        value = getattr(options, name)
        if value is not None and not value > 0:
            raise InputError(f"`{name}` {value:g}: give a positive number{unit}")


def check_seed(seed: int) -> None:
    """Raise InputError for a seed that random number generators do not take."""
    if not 0 <= seed < 1 << 63:
        raise InputError(f"`seed` {seed}: give a non-negative integer")


def lower(_: object, tokens: Sequence[Token]) -> str:
    """Converter of options that take a word in upper or lower case."""
    return tokens[0].value.lower()


def _texts(_: object, tokens: Sequence[Token]) -> tuple[str, ...]:
    return tuple(token.value for token in tokens)


NAMED = Parameter(converter=_texts, n_tokens=1, metavar="NAME,...")
"""Parameter of an option that takes names with parameters, ``NAME:KEY=VALUE,KEY=VALUE``, as texts."""


def _settings(_: object, tokens: Sequence[Token]) -> tuple[tuple[str, str], ...]:
    return tuple(pair for token in tokens for pair in split_pairs(token.value))


SETTINGS = Parameter(name="--set", converter=_settings, n_tokens=1, metavar="NAME=VALUE")
"""Parameter of an option that takes settings of a method or a fidelity level."""


def taken_settings(value: Any) -> tuple[tuple[str, str], ...]:
    """Settings of Python code: NAME=VALUE, a dictionary, or pairs."""
    if isinstance(value, str):
        return tuple(split_pairs(value))
    found: list[tuple[str, str]] = []
    for pair in value.items() if isinstance(value, Mapping) else listed(value):
        if isinstance(pair, str):
            found += split_pairs(pair)
            continue
        if not isinstance(pair, tuple | list) or len(pair) != 2:
            raise ValueError("give NAME=VALUE, or a dictionary")
        found.append((str(pair[0]), value_text(pair[1])))
    return tuple(found)
