"""Result of a figure, and tools that figures share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import Class
from geoscene.drawing.canvas import Canvas
from geoscene.typing import Float, Ints

WIDE = (1180, 300)
"""Pixels of a panel of the width of a page."""

_MOST = 2000
"""Intervals of a line that is thinned."""


@dataclass(frozen=True, slots=True)
class Drawn:
    """A figure, with a note and its numbers.

    note    : its figures in one line
    numbers : the same by name
    """

    canvas: Canvas
    note: str
    numbers: dict[str, Any]


def plain(value: float) -> str:
    """The text of a value on an axis."""
    return f"{value:g}"


def whole(value: float) -> str:
    """The text of a whole number on an axis; others have none."""
    return f"{value:g}" if value == round(value) else ""


def format_count(value: float) -> str:
    """The text of a count on an axis."""
    return f"{value:,.0f}" if value >= 1 else f"{value:g}"


def class_name(code: int) -> str:
    """The name of a class in words."""
    return Class(code).name.lower().replace("_", " ")


def thin(x: NDArray[np.floating], y: NDArray[np.floating]) -> list[tuple[float, float]]:
    """Points (n,) of a line; of a long one the lowest and highest of each of 2000 parts, in order."""
    if len(x) > 4 * _MOST:
        edges = np.linspace(0, len(x), _MOST + 1).astype(np.int64)
        rows: list[int] = []
        for first, end in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
            part = y[first:end]
            if not np.isfinite(part).all():
                rows.append(first + int(np.argmin(np.isfinite(part))))
            if np.isfinite(part).any():
                rows += [first + int(np.nanargmin(part)), first + int(np.nanargmax(part))]
        kept = np.unique(np.array(rows, np.int64))
        x, y = x[kept], y[kept]
    return list(zip(x.tolist(), y.tolist(), strict=True))


def outline(edges: Float, counts: Float) -> list[tuple[float, float]]:
    """The outline of a histogram."""
    return list(zip(np.repeat(edges, 2)[1:-1].tolist(), np.repeat(counts, 2).tolist(), strict=True))


def most_frequent(counts: Ints, *, most: int) -> list[int]:
    """Rows of ``counts`` (n,) that are not 0, the largest first, at most ``most``."""
    ranked = np.argsort(-counts, kind="stable")
    return [int(k) for k in ranked[:most] if counts[k] > 0]
