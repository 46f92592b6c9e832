"""Figures as text with units: lengths, shares, differences of colours, sizes."""

from __future__ import annotations


def metres(value: float) -> str:
    """A length with a unit that fits it."""
    for unit, size in (("m", 1.0), ("cm", 0.01), ("mm", 0.001), ("µm", 1e-6), ("nm", 1e-9)):
        if abs(value) >= size:
            return f"{value / size:.3g} {unit}"
    return "0" if value == 0 else "below 1 nm"


def share(value: float) -> str:
    """A share in percent, with its sign if negative."""
    digits = 3 if abs(value) >= 0.995 else 2
    return "0" if value == 0 else f"{100 * value:.{digits}g} %"


def levels(value: float) -> str:
    """A difference of colours, in levels of 255."""
    text = f"{value:.3g}"
    return f"{text} level{'' if text == '1' else 's'}"


def size(value: float) -> str:
    """Bytes in decimal units."""
    for unit, one in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if abs(value) >= one:
            return f"{value / one:.3g} {unit}"
    return f"{value:.0f} B"
