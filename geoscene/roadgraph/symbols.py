"""Symbols painted on roads: arrows, bicycles, words, numbers. Drawn by this program, in plan.

Frame of a symbol: u along the lane in the direction of travel from 0, v to the left, metres. Symbols are
drawn out along the lane, so that drivers see them upright. Sizes are close to those of RMS (Germany: arrows
of 5 m in towns) and the MUTCD (bicycles of 1.8 m); proportions are assumed.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np
import shapely
from shapely import affinity

ARROW = 5.0
"""Length of arrows."""

_STEM = 0.15
_HEAD, _HALF = 1.6, 0.3
# Of a turn: its heads' half width along the lane, where it begins beside the stem and ends.
_SIDE, _FROM, _TIP = 0.8, 0.30, 0.95
_STROKE = 0.13
_LETTER, _TALL, _SPACE = 0.5, 1.8, 0.3
_WHEEL, _APART, _STRETCH, _TYRE = 0.24, 0.33, 1.7, 0.09

_Line = Sequence[tuple[float, float]]

# Strokes of letters and digits in a square of side 1, x to the right and y up.
_RIGHT_BOWL: _Line = ((0.7, 0.52), (1, 0.42), (1, 0.1), (0.7, 0), (0.3, 0), (0, 0.1))
_ROUND: _Line = ((0.3, 0), (0.7, 0), (1, 0.1), (1, 0.9), (0.7, 1), (0.3, 1), (0, 0.9), (0, 0.1), (0.3, 0))
_SIX: _Line = (
    (1, 0.9), (0.7, 1), (0.3, 1), (0, 0.9), (0, 0.1), (0.3, 0), (0.7, 0), (1, 0.1), (1, 0.45), (0.7, 0.55),
    (0, 0.55),
)  # fmt: skip
_STROKES: dict[str, tuple[_Line, ...]] = {
    "0": (_ROUND,),
    "1": (((0.2, 0.8), (0.6, 1), (0.6, 0)),),
    "2": (((0, 0.88), (0.3, 1), (0.7, 1), (1, 0.88), (1, 0.6), (0.02, 0.03), (1, 0.03)),),
    "3": (((0, 0.9), (0.3, 1), (0.7, 1), (1, 0.9), (1, 0.62), *_RIGHT_BOWL), ((0.3, 0.52), (0.72, 0.52))),
    "4": (((0.75, 0), (0.75, 1), (0, 0.3), (1, 0.3)),),
    "5": (((0.95, 0.97), (0.05, 0.97), (0.05, 0.55), (0.7, 0.55), *_RIGHT_BOWL[1:]),),
    "6": (_SIX,),
    "7": (((0, 0.97), (0.95, 0.97), (0.35, 0)),),
    "8": (_ROUND, ((0, 0.52), (1, 0.52))),
    "9": (tuple((1 - x, 1 - y) for x, y in _SIX),),
    "B": (
        ((0, 0.03), (0, 0.97), (0.7, 0.97), (1, 0.87), (1, 0.62), (0.7, 0.52), (1, 0.42), (1, 0.13),
         (0.7, 0.03), (-0.1, 0.03)),
        ((0, 0.52), (0.72, 0.52)),
    ),
    "S": (((1, 0.9), (0.7, 1), (0.3, 1), (0, 0.9), (0, 0.62), (0.3, 0.52), *_RIGHT_BOWL),),
    "U": (((0, 1), (0, 0.1), (0.3, 0), (0.7, 0), (1, 0.1), (1, 1)),),
}  # fmt: skip


@functools.cache
def arrow(turns: tuple[str, ...], *, left_hand: bool = False) -> Any:
    """The arrow of a lane, a polygon of `ARROW` length: values of ``turn:lanes``, as in (left, through).

    left_hand : traffic keeps left, and turns back on the right
    """
    merging = [turn for turn in turns if turn.startswith("merge")]
    if merging:
        lean = np.degrees(np.arctan2(0.8, ARROW)) * (1 if merging[0] == "merge_to_left" else -1)
        return affinity.rotate(_straight(ARROW), lean, origin=(ARROW / 2, 0))
    parts = [_straight(ARROW)] if "through" in turns or not turns else []
    # Beside the head of a straight arrow, branches leave the stem lower; those of one side below each other.
    top = 2.5 if parts else ARROW - _SIDE
    reach = 0.0
    for side in (1.0, -1.0):
        own = [turn for turn in turns if _side(turn, left_hand=left_hand) == side]
        own.sort(key=lambda turn: turn == "reverse")
        for turn, level in zip(
            own, np.linspace(top, max(top - 1.5 * len(own) + 1.5, 2.05), len(own)), strict=True
        ):
            branch, joint = _branch(turn, float(level))
            parts.append(affinity.scale(branch, 1.0, side, origin=(0, 0)))
            reach = max(reach, joint)
    return shapely.union_all([*parts, shapely.box(0, -_STEM / 2, reach, _STEM / 2)])


def _side(turn: str, *, left_hand: bool) -> float:
    """1 for turns to the left, -1 to the right, 0 for none."""
    if turn == "reverse":
        return -1.0 if left_hand else 1.0
    return 1.0 if "left" in turn else -1.0 if "right" in turn else 0.0


def _straight(length: float) -> Any:
    neck = length - _HEAD
    half = _STEM / 2
    return shapely.Polygon(
        [(0, -half), (neck, -half), (neck, -_HALF), (length, 0), (neck, _HALF), (neck, half), (0, half)]
    )


def _branch(turn: str, at: float) -> tuple[Any, float]:
    """The part of an arrow that leaves the stem to the left, with its head about u = at; where it leaves."""
    if turn == "reverse":
        back = shapely.LineString([(at - 1.2, 0), (at, 0.1), (at + 0.3, 0.35), (at, 0.6), (at - 0.6, 0.68)])
        head = shapely.Polygon([(at - 0.5, 0.68 - _HALF), (at - 0.5, 0.68 + _HALF), (at - 2.0, 0.68)])
        return shapely.union_all([_stroke(back, _STEM), head]), at - 1.2
    if turn.startswith("slight"):
        bend = shapely.LineString([(at - 1.6, 0), (at - 0.6, 0.12), (at, 0.35)])
        head = shapely.Polygon([(at + 1.0 - 0.15, 0.70), (at - 0.35, 0.57), (at + 0.1, 0.12)])
        return shapely.union_all([_stroke(bend, _STEM), head]), at - 1.6
    back = 0.5 if turn.startswith("sharp") else 0.0
    bend = shapely.LineString([(at - 1.2, 0), (at - 0.45, 0.05), (at, _FROM + 0.02)])
    head = shapely.Polygon([(at - _SIDE, _FROM), (at + _SIDE, _FROM), (at - back, _TIP)])
    return shapely.union_all([_stroke(bend, _STEM), head]), at - 1.2


def _stroke(line: Any, width: float) -> Any:
    return line.buffer(width / 2, cap_style="flat", join_style="mitre", mitre_limit=2.0)


@functools.cache
def word(text: str) -> Any:
    """Letters or digits side by side, about v = 0; of `_STROKES`."""
    parts = []
    for k, letter in enumerate(text):
        left = (len(text) * _LETTER + (len(text) - 1) * _SPACE) / 2 - k * (_LETTER + _SPACE)
        for line in _STROKES[letter]:
            places = [(y * _TALL, left - x * _LETTER) for x, y in line]
            closed = places[0] == places[-1]
            pen = shapely.LinearRing(places) if closed else shapely.LineString(places)
            parts.append(_stroke(pen, _STROKE))
    joined = shapely.union_all(parts)
    return affinity.translate(joined, -joined.bounds[0], 0)


@functools.cache
def bicycle(*, chevrons: bool = False) -> Any:
    """A bicycle 1.2 m wide; with two chevrons ahead, the mark of a lane that is shared with cars."""
    turn = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    parts = []
    for aside in (_APART, -_APART):
        outer, inner = (
            np.column_stack([_STRETCH * (_WHEEL + r * np.cos(turn)), aside + r * np.sin(turn)])
            for r in (_WHEEL, _WHEEL - _TYRE)
        )
        parts.append(shapely.Polygon(outer, [inner]))
    hub, top = _STRETCH * _WHEEL, 1.15
    frame = (
        [(hub, _APART), (top, 0.12), (top, -0.22), (hub, 0.02), (top, 0.12)],
        [(hub, _APART), (hub, 0.02)],
        [(hub, -_APART), (1.5, -0.19), (1.5, -0.36)],
        [(hub, 0.02), (1.32, 0.16)],
        [(1.32, 0.04), (1.32, 0.28)],
    )
    parts.extend(_stroke(shapely.LineString(line), 0.08) for line in frame)
    starts = (2.0, 2.7) if chevrons else ()
    lines = [shapely.LineString([(u, 0.5), (u + 0.45, 0), (u, -0.5)]) for u in starts]
    parts.extend(_stroke(line, 0.12) for line in lines)
    return shapely.simplify(shapely.union_all(parts), 0.004)
