"""Values of tags as mappers write them: lists and words, and remarks on those that cannot be used."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import TypeVar

from geoscene.sources.data import Tags

T = TypeVar("T")

Remarks = list[tuple[str, str]]
"""Reasons and details of problems of a way's tags, in the words of `geoscene.support.problems.Problem`."""


def remark_unreadable(remarks: Remarks, key: str, *, text: str, why: str = "") -> None:
    """Remark that a tag is not used as it cannot be read."""
    remarks.append(("unreadable-tag", f"{key}={text}" + (f": {why}" if why else "")))


def remark_several(remarks: Remarks, key: str, *, text: str, taken: str) -> None:
    """Remark that of the values of a tag one is used."""
    remarks.append(("several-values", f"{key}={text}: {taken} is taken"))


def read_word(tags: Tags, key: str, *, known: Mapping[str, T], remarks: Remarks) -> T | None:
    """The meaning of the first known value of a tag; None without the tag or a known value."""
    text = tags.get(key)
    if text is None:
        return None
    values = [value.strip() for value in text.lower().split(";")]
    found = next((value for value in values if value in known), None)
    if found is None:
        remark_unreadable(remarks, key, text=text)
        return None
    if len(values) > 1:
        remark_several(remarks, key, text=text, taken=found)
    return known[found]


def most_important(text: str, order: Collection[str]) -> str:
    """The value of a list separated by semicolons that comes first in ``order``, or "" if none is in it."""
    values = {value.strip() for value in text.split(";")}
    return next((name for name in order if name in values), "")
