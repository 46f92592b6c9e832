"""Faces of traffic signs from tags: human-readable names and national sign codes."""

from __future__ import annotations

import functools
import re
import tomllib
from importlib import resources

from geoscene.sources.data import Tags

_ROUND = frozenset(
    {"limit", "no_entry", "no_vehicles", "no_overtaking", "no_parking", "no_stopping", "ahead", "path"}
)
_FORMS = {
    "stop": "sign_stop",
    "give_way": "sign_give_way",
    "hazard": "sign_triangle",
    **dict.fromkeys(_ROUND, "sign_round"),
}
_LONGEST = 40
"""Characters that are kept of what is written on a sign."""

_CODE = re.compile(r"(?P<code>[A-Za-z]{0,3}-?\d[\w.]*(?:-\d+)?[a-z]?)(?:\[(?P<words>[^\]]*)\])?")


@functools.cache
def sign_codes() -> dict[str, dict[str, str]]:
    """Faces by code, by country (``names`` for values without one)."""
    table = resources.files("geoscene") / "signs.toml"
    return tomllib.loads(table.read_text(encoding="utf-8-sig"))


def sign_face(tags: Tags) -> str:
    """Face of a node's sign, a keyword and perhaps text: ``limit 50``; empty if it is not mapped.

    The first of several signs on a post counts. Numbers come from brackets (``FI:361[40]``), from the code
    itself (``DE:274-30``) or from ``maxspeed``; names of places and streets from brackets or ``name``.
    """
    value = re.split(r"[;,](?![^\[]*\])", tags.get("traffic_sign", ""))[0].strip()
    country, colon, rest = value.partition(":")
    if not colon:
        name, _, words = value.partition("[")
        return _fill(sign_codes()["names"].get(name.lower(), ""), words.rstrip("]"), tags=tags)
    found = _CODE.match(rest.strip())
    codes = sign_codes().get(country.upper())
    if not found or not codes:
        return ""
    code, words = found["code"], found["words"] or ""
    if code in codes:
        return _fill(codes[code], words, tags=tags)
    stem, _, number = code.rpartition("-")
    return _fill(codes.get(stem, ""), words or number, tags=tags)


def sign_shape(face: str) -> str:
    """The shape of the plate of a face, of `geoscene.objects.shapes.shapes`."""
    return _FORMS.get(face.partition(" ")[0], "sign_rectangle")


def select_direction(tags: Tags) -> Tags:
    """Tags with ``traffic_sign`` for the direction that ``traffic_sign:forward`` or ``:backward`` states."""
    stated = [way for way in ("forward", "backward") if tags.get(f"traffic_sign:{way}", "no") != "no"]
    if "traffic_sign" in tags or len(stated) != 1:
        return tags
    way = stated[0]
    speed = tags.get(f"maxspeed:{way}")
    return {
        **tags,
        "traffic_sign": tags[f"traffic_sign:{way}"],
        "traffic_sign:direction": way,
        **({"maxspeed": speed} if speed else {}),
    }


def _fill(face: str, words: str, *, tags: Tags) -> str:
    """A face with its words, or those of other tags, in place of ``{}``."""
    if "{}" not in face:
        return face
    kind = face.partition(" ")[0]
    if not words and kind in {"city", "street"}:
        words = tags.get("name", "")
    elif not words:
        words = tags.get("maxspeed", "")
    if kind not in {"city", "street"}:
        number = re.search(r"\d+(?:\.\d+)?", words)
        if number is None:
            return kind if kind == "limit" else ""
        words = number[0]
    return face.replace("{}", " ".join(words.split())[:_LONGEST]).strip()
