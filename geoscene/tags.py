"""Parses values of OpenStreetMap tags: numbers, lengths, directions, colours."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

_NUMBER = r"[+-]?(?:\d+(?:[.,]\d+)*|[.,]\d+)"
_ABOUT = re.compile(r"^(?:~|≈|ca\.?|c\.|approx\.?|about|around)\s*")
_QUOTES = str.maketrans({"’": "'", "‘": "'", "′": "'", "´": "'", "`": "'", "”": '"', "“": '"', "″": '"'})

_METRES = {
    "": 1.0, "m": 1.0, "meter": 1.0, "meters": 1.0, "metre": 1.0, "metres": 1.0, "mtr": 1.0, "м": 1.0,
    "km": 1000.0, "dm": 0.1, "cm": 0.01, "mm": 0.001,
    "'": 0.3048, "ft": 0.3048, "foot": 0.3048, "feet": 0.3048,
    '"': 0.0254, "in": 0.0254, "inch": 0.0254, "inches": 0.0254,
    "yd": 0.9144, "yard": 0.9144, "yards": 0.9144,
    "mi": 1609.344, "mile": 1609.344, "miles": 1609.344, "nmi": 1852.0,
}  # fmt: skip
"""Metres per unit; the international foot, inch, yard and mile are exact."""

_LENGTH = re.compile(rf"^({_NUMBER})\s*([^\s\d.]*)\.?$")
_FEET_INCHES = re.compile(rf"^({_NUMBER})\s*(?:'|ft\.?|feet|foot)\s*({_NUMBER})\s*(?:\"|in\.?|inch|inches)?$")
_PLAIN = re.compile(rf"^({_NUMBER})$")

_COMPASS = (
    "n", "nne", "ne", "ene", "e", "ese", "se", "sse",
    "s", "ssw", "sw", "wsw", "w", "wnw", "nw", "nnw",
)  # fmt: skip
_POINTS = {"north": "n", "east": "e", "south": "s", "west": "w"}


def first_value(text: str) -> str:
    """The first of a list of values separated by semicolons that is not blank, in lower case, else ""."""
    values = (value.strip() for value in text.translate(_QUOTES).replace("''", '"').lower().split(";"))
    return next(filter(None, values), "")


def _first_quantity(text: str) -> str:
    """The first of a list of values, in lower case, without words for "about"."""
    return _ABOUT.sub("", first_value(text))


def _float(digits: str) -> float | None:
    """A number with a decimal point or comma; if it has both, the last one is the decimal mark."""
    dot, comma = digits.rfind("."), digits.rfind(",")
    if dot >= 0 and comma >= 0:
        group, mark = (",", ".") if dot > comma else (".", ",")
        digits = digits.replace(group, "").replace(mark, ".")
    else:
        digits = digits.replace(",", ".")
    try:
        value = float(digits)
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def parse_number(text: str | None) -> float | None:
    """A plain number ("3", "2.5", "2,5", the first of "3;4"), or None."""
    if text is None:
        return None
    match = _PLAIN.match(_first_quantity(text))
    return _float(match[1]) if match else None


def parse_length(text: str | None) -> float | None:
    """A length in metres, or None if the value is not a length.

    The unit is metres unless given ("48.5 m", "1.2 km", "574'", "5 ft 6 in", 12'6"). Accepts decimal commas
    ("9,5"), typographic quotes for feet and inches, a sign, and "~10" or "ca. 10". Of a list ("5;6") the
    first value counts.
    """
    if text is None:
        return None
    value = _first_quantity(text)
    if match := _FEET_INCHES.match(value):
        feet, inches = _float(match[1]), _float(match[2])
        if feet is None or inches is None or inches < 0:
            return None
        return math.copysign(abs(feet) * 12 + inches, feet) * 0.0254
    match = _LENGTH.match(value)
    if not match or match[2] not in _METRES:
        return None
    number = _float(match[1])
    return None if number is None else number * _METRES[match[2]]


def parse_direction(text: str | None) -> float | None:
    """Degrees clockwise from true north in [0, 360) of "135", "135°", "SE", "NNE", "north-west", or None."""
    if text is None:
        return None
    value = _first_quantity(text).removesuffix("°").strip()
    if match := _PLAIN.match(value):
        degrees = _float(match[1])
        return None if degrees is None else degrees % 360.0 % 360.0  # -1e-20 % 360 is 360
    for word, letter in _POINTS.items():
        value = value.replace(word, letter)
    value = re.sub(r"[\s_-]", "", value)
    return _COMPASS.index(value) * 22.5 if value in _COMPASS else None


def parse_color(text: str | None) -> tuple[int, int, int] | None:
    """Red, green, blue (sRGB, 0..255) of a tagged colour, or None if it is not a colour.

    CSS names (also "light grey" and "dark_red"), "#rgb", "#rrggbb" (with or without "#") and "rgb(1,2,3)".
    """
    if text is None:
        return None
    from PIL import ImageColor  # noqa: PLC0415 (Pillow is needed for colours only)

    value = re.sub(r"[\s_-]", "", first_value(text))
    if re.fullmatch(r"[0-9a-f]{6}|[0-9a-f]{3}", value):
        value = "#" + value
    try:
        red, green, blue = ImageColor.getrgb(value)[:3]
    except ValueError:
        return None
    if max(red, green, blue) > 255 or min(red, green, blue) < 0:
        return None
    return int(red), int(green), int(blue)


@dataclass(frozen=True, slots=True)
class Quantities:
    """Reads quantities from the tags of one feature.

    refused : tags that were read and could not be used, with the reasons
    """

    tags: Mapping[str, str]
    refused: list[str] = field(default_factory=list)

    def first(
        self, *keys: str, parse: Callable[[str], float | None], low: float = -math.inf, high: float = math.inf
    ) -> float:
        """The first value of the keys that ``parse`` can read and that lies from low to high; NaN if none."""
        for key in keys:
            text = " ".join(self.tags[key].split()) if key in self.tags else ""
            if not text:
                continue
            value = parse(text)
            if value is not None and low <= value <= high:
                return value
            why = "unreadable" if value is None else f"not from {low:g} to {high:g}"
            self.refused.append(f"{key}={text[:40]} is {why}")
        return math.nan
