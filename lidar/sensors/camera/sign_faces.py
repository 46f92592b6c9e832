"""Faces of signs, signals and number plates, drawn from words: shapes, symbols and text of our own."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from geoscene.support.splitmix import uniform_at
from geoscene.typing import Float
from lidar.sensors.camera.shade import linear_table, srgb_bytes

SIDE = 1.5
"""Side in metres of the square that a face is drawn on, about the centre of its plate."""

PLATE = 0.52, 0.11
"""Width and height of a number plate in metres."""

_PIXELS, _FINER = 256, 2
_WHITE, _BLACK, _RED, _BLUE = (238, 238, 232), (24, 24, 24), (176, 24, 32), (24, 78, 150)
_YELLOW, _GREEN, _GREY = (240, 196, 30), (22, 104, 66), (150, 152, 155)
_LETTERS, _DIGITS = "ABCDEFGHJKLMNPRSTUVWXYZ", "0123456789"

Rgb = tuple[int, int, int]


class _Canvas:
    """A square picture in metres about its centre, x to the right, y up."""

    def __init__(self, fill: Rgb, *, side: float = SIDE) -> None:
        self.scale = _PIXELS * _FINER / side
        self.image = Image.new("RGB", (_PIXELS * _FINER,) * 2, fill)
        self.draw = ImageDraw.Draw(self.image)

    def at(self, x: float, y: float) -> tuple[float, float]:
        middle = self.image.width / 2
        return middle + x * self.scale, middle - y * self.scale

    def disc(self, radius: float, fill: Rgb, *, x: float = 0.0, y: float = 0.0) -> None:
        self.draw.ellipse([self.at(x - radius, y + radius), self.at(x + radius, y - radius)], fill=fill)

    def shape(self, points: list[tuple[float, float]], fill: Rgb) -> None:
        self.draw.polygon([self.at(*point) for point in points], fill=fill)

    def bar(self, low: tuple[float, float], high: tuple[float, float], fill: Rgb) -> None:
        self.shape([low, (high[0], low[1]), high, (low[0], high[1])], fill)

    def line(self, points: list[tuple[float, float]], width: float, fill: Rgb) -> None:
        self.draw.line(
            [self.at(*point) for point in points], fill=fill, width=round(width * self.scale), joint="curve"
        )

    def arrow(self, points: list[tuple[float, float]], width: float, fill: Rgb) -> None:
        """A line with a head at its end."""
        (x0, y0), (x1, y1) = points[-2:]
        length = math.hypot(x1 - x0, y1 - y0)
        dx, dy = (x1 - x0) / length, (y1 - y0) / length
        self.line([*points[:-1], (x1 - width * dx, y1 - width * dy)], width, fill)
        tip, wide = (x1 + width * dx, y1 + width * dy), 1.5 * width
        base = x1 - 1.2 * width * dx, y1 - 1.2 * width * dy
        self.shape(
            [tip, (base[0] - wide * dy, base[1] + wide * dx), (base[0] + wide * dy, base[1] - wide * dx)],
            fill,
        )

    def text(self, words: str, *, within: tuple[float, float], fill: Rgb, y: float = 0.0) -> None:
        """Words in one line, as large as they fit into a width and height."""
        height = within[1] * self.scale
        font = ImageFont.load_default(size=1.35 * height)
        width = self.draw.textlength(words, font=font)
        if width > within[0] * self.scale:
            font = ImageFont.load_default(size=1.35 * height * within[0] * self.scale / width)
        self.draw.text(self.at(0.0, y), words, font=font, fill=fill, anchor="mm")

    def pixels(self) -> NDArray[np.uint8]:
        return np.asarray(self.image.reduce(_FINER))


def _ngon(corners: int, radius: float, turn: float = 0.0) -> list[tuple[float, float]]:
    angles = [turn + 2 * math.pi * k / corners for k in range(corners)]
    return [(radius * math.sin(a), radius * math.cos(a)) for a in angles]


def _rim(canvas: _Canvas, fill: Rgb = _WHITE) -> None:
    """A prohibition: a red ring on a disc of 0.6 m."""
    canvas.disc(0.245, fill)


def _person(canvas: _Canvas, fill: Rgb, *, x: float = 0.0, y: float = 0.0, size: float = 1.0) -> None:
    canvas.disc(0.035 * size, fill, x=x, y=y + 0.15 * size)
    canvas.line([(x, y + 0.11 * size), (x, y - 0.02 * size)], 0.06 * size, fill)
    for side in (-1, 1):
        canvas.line([(x, y - 0.02 * size), (x + side * 0.06 * size, y - 0.16 * size)], 0.03 * size, fill)
        canvas.line([(x, y + 0.08 * size), (x + side * 0.08 * size, y)], 0.025 * size, fill)


def _bicycle(canvas: _Canvas, fill: Rgb, ground: Rgb, *, y: float = 0.0, size: float = 1.0) -> None:
    for x in (-0.1, 0.1):
        canvas.disc(0.075 * size, fill, x=x * size, y=y - 0.05 * size)
        canvas.disc(0.055 * size, ground, x=x * size, y=y - 0.05 * size)
    frame = [(-0.1, -0.05), (-0.03, 0.06), (0.06, 0.06), (0.0, -0.05), (-0.1, -0.05)]
    canvas.line([(a * size, y + b * size) for a, b in frame], 0.018 * size, fill)
    fork = [(0.1, -0.05), (0.06, 0.1), (0.1, 0.11)]
    canvas.line([(a * size, y + b * size) for a, b in fork], 0.018 * size, fill)


def _stop(canvas: _Canvas, _: str) -> None:
    canvas.shape(_ngon(8, 0.385, math.pi / 8), _RED)
    canvas.text("STOP", within=(0.58, 0.2), fill=_WHITE)


def _hazard(canvas: _Canvas, _: str) -> None:
    canvas.shape(_ngon(3, 0.52), _WHITE)
    canvas.bar((-0.035, 0.0), (0.035, 0.26), _BLACK)
    canvas.disc(0.045, _BLACK, y=-0.09)


def _limit(canvas: _Canvas, words: str) -> None:
    _rim(canvas)
    if words:
        canvas.text(words, within=(0.36, 0.2), fill=_BLACK)


def _zone(canvas: _Canvas, words: str) -> None:
    canvas.disc(0.21, _RED, y=0.05)
    canvas.disc(0.165, _WHITE, y=0.05)
    canvas.text(words, within=(0.25, 0.15), fill=_BLACK, y=0.05)
    canvas.text("ZONE", within=(0.4, 0.08), fill=_BLACK, y=-0.23)


def _no_overtaking(canvas: _Canvas, _: str) -> None:
    _rim(canvas)
    for x, fill in ((-0.09, _RED), (0.09, _BLACK)):
        canvas.bar((x - 0.065, -0.06), (x + 0.065, 0.02), fill)
        canvas.bar((x - 0.045, 0.02), (x + 0.045, 0.08), fill)


def _no_parking(canvas: _Canvas, _: str) -> None:
    canvas.disc(0.245, _BLUE)
    canvas.line([(-0.18, 0.18), (0.18, -0.18)], 0.055, _RED)


def _no_stopping(canvas: _Canvas, _: str) -> None:
    canvas.disc(0.245, _BLUE)
    for sign in (-1, 1):
        canvas.line([(-0.18, sign * 0.18), (0.18, -sign * 0.18)], 0.055, _RED)


def _priority(canvas: _Canvas, _: str) -> None:
    canvas.shape(_ngon(4, 0.36), _BLACK)
    canvas.shape(_ngon(4, 0.34), _WHITE)
    canvas.shape(_ngon(4, 0.24), _YELLOW)


_COURSES = {
    "straight": [(0.0, -0.18), (0.0, 0.17)],
    "left": [(0.17, -0.02), (-0.16, -0.02)],
    "right": [(-0.17, -0.02), (0.16, -0.02)],
    "turn_left": [(0.1, -0.18), (0.1, 0.04), (-0.13, 0.04)],
    "turn_right": [(-0.1, -0.18), (-0.1, 0.04), (0.13, 0.04)],
    "keep_left": [(0.12, 0.12), (-0.12, -0.12)],
    "keep_right": [(-0.12, 0.12), (0.12, -0.12)],
}


def _ahead(canvas: _Canvas, words: str) -> None:
    canvas.disc(0.29, _BLUE)
    if words == "roundabout":
        for k in range(3):
            turns = [2 * math.pi * (k + share) / 3 for share in (0.0, 0.25, 0.5, 0.62)]
            canvas.arrow([(0.15 * math.sin(-a), 0.15 * math.cos(a)) for a in turns], 0.04, _WHITE)
    elif words in _COURSES:
        canvas.arrow(_COURSES[words], 0.06, _WHITE)


def _path(canvas: _Canvas, words: str) -> None:
    canvas.disc(0.29, _BLUE)
    if words == "bicycle":
        _bicycle(canvas, _WHITE, _BLUE, size=1.4)
    elif words == "foot":
        _person(canvas, _WHITE, size=1.3)
    else:
        _person(canvas, _WHITE, y=0.11, size=0.8)
        _bicycle(canvas, _WHITE, _BLUE, y=-0.12)
        canvas.bar((-0.25, -0.008), (0.25, 0.008), _WHITE)


def _crossing(canvas: _Canvas, _: str) -> None:
    canvas.shape(_ngon(3, 0.3), _WHITE)
    _person(canvas, _BLACK, y=-0.01, size=0.8)


def _living(canvas: _Canvas, _: str) -> None:
    canvas.shape([(0.02, -0.05), (0.02, 0.1), (0.12, 0.2), (0.22, 0.1), (0.22, -0.05)], _WHITE)
    _person(canvas, _WHITE, x=-0.14, y=0.02)
    canvas.bar((-0.24, -0.2), (0.24, -0.18), _WHITE)


def _words(canvas: _Canvas, words: str, *, fill: Rgb = _BLACK) -> None:
    canvas.bar((-0.28, -0.28), (0.28, 0.28), canvas.image.getpixel((2, 2)))  # type: ignore[arg-type]
    lines = words.upper().split()
    step = 0.5 / max(len(lines), 1)
    for k, line in enumerate(lines):
        height = min(0.55 * step, 0.16)
        canvas.text(line, within=(0.52, height), fill=fill, y=(0.5 * (len(lines) - 1) - k) * step)


def _bus(canvas: _Canvas, _: str) -> None:
    canvas.bar((-0.2, -0.12), (0.2, 0.14), _WHITE)
    canvas.bar((-0.17, 0.0), (0.17, 0.1), _BLUE)
    for x in (-0.12, 0.12):
        canvas.disc(0.045, _WHITE, x=x, y=-0.13)


def _signal(canvas: _Canvas, _: str) -> None:
    """Three lenses, none of them lit; lit ones shine, see `lidar.sensors.camera.light`."""
    for k, fill in enumerate(((92, 20, 20), (104, 76, 18), (16, 76, 48))):
        canvas.disc(0.1, fill, y=0.283 * (1 - k))


_FACES: dict[str, tuple[Rgb, Callable[[_Canvas, str], None]]] = {
    "stop": (_WHITE, _stop), "hazard": (_RED, _hazard), "limit": (_RED, _limit), "zone": (_WHITE, _zone),
    "give_way": (_RED, lambda canvas, _: canvas.shape(_ngon(3, 0.52, math.pi), _WHITE)),
    "no_entry": (_RED, lambda canvas, _: canvas.bar((-0.22, -0.055), (0.22, 0.055), _WHITE)),
    "no_vehicles": (_RED, lambda canvas, _: _rim(canvas)), "no_overtaking": (_RED, _no_overtaking),
    "no_parking": (_RED, _no_parking), "no_stopping": (_RED, _no_stopping), "priority": (_WHITE, _priority),
    "one_way": (_BLUE, lambda canvas, _: canvas.arrow([(0.0, -0.2), (0.0, 0.18)], 0.08, _WHITE)),
    "ahead": (_WHITE, _ahead), "path": (_WHITE, _path), "crossing": (_BLUE, _crossing),
    "living_street": (_BLUE, _living), "bus_stop": (_BLUE, _bus), "city": (_YELLOW, _words),
    "parking": (_BLUE, lambda canvas, words: canvas.text(words, within=(0.46, 0.36), fill=_WHITE)),
    "street": (_BLUE, functools.partial(_words, fill=_WHITE)), "words": (_WHITE, _words),
    "signal": (_BLACK, _signal), "plain": (_WHITE, lambda *_: None),
}  # fmt: skip
"""Colour of the plate, and what is drawn on it, by the first word of a face."""

OF_SHAPE = {
    "sign_stop": "stop", "sign_give_way": "give_way", "sign_triangle": "hazard", "sign_round": "limit",
    "sign_rectangle": "plain",
}  # fmt: skip
"""Faces of plates of which the map says no more than their form."""


def known() -> frozenset[str]:
    """The first words of faces that are drawn."""
    return frozenset(_FACES)


@functools.lru_cache(maxsize=1024)
def face_levels(face: str) -> tuple[NDArray[np.float32], ...]:
    """Linear light 0..1 (n, n, 3) of a face, rows from the top, at full size and halved down to one pixel.

    face : a word that says what is drawn, then what is written on it: ``limit 50``, ``street Hauptstrasse``.
           Unknown words are a plain plate.
    """
    name, _, words = face.partition(" ")
    fill, drawing = _FACES.get(name, _FACES["plain"])
    canvas = _Canvas(fill)
    drawing(canvas, "P" if name == "parking" else words)
    return _levels(canvas.pixels())


@functools.lru_cache(maxsize=1024)
def plate_levels(feature: int) -> tuple[NDArray[np.float32], ...]:
    """The same of the number plate of a vehicle, 0.52 m wide; what it reads is a hash of the feature."""
    chance = uniform_at(np.array([feature]), np.zeros(1, np.int64), count=7)[:, 0].tolist()
    text = "".join(_LETTERS[int(c * len(_LETTERS))] for c in chance[:3])
    text += " " + "".join(_DIGITS[int(c * len(_DIGITS))] for c in chance[3:])
    canvas = _Canvas(_BLACK, side=PLATE[0])
    canvas.bar((-0.255, -0.05), (0.255, 0.05), _WHITE)
    canvas.text(text, within=(0.45, 0.07), fill=_BLACK)
    return _levels(canvas.pixels())


def _levels(pixels: NDArray[np.uint8]) -> tuple[NDArray[np.float32], ...]:
    level = linear_table()[pixels].astype(np.float32)
    levels = [level]
    while len(level) > 1:
        level = level.reshape(len(level) // 2, 2, len(level) // 2, 2, 3).mean(axis=(1, 3))
        levels.append(level)
    return tuple(levels)


def sample(
    levels: tuple[NDArray[np.float32], ...], place: Float, *, width: Float, side: float = SIDE
) -> NDArray[np.uint8]:
    """SRGB (n, 3) at places (n, 2) in metres right of and above the centre of a face, over some widths (n,).

    Filtered by the level whose pixels are about as wide (mipmaps), interpolated between four of them.
    """
    level = np.log2(np.maximum(width * _PIXELS / side, 1.0)).round().astype(int).clip(max=len(levels) - 1)
    out = np.empty((len(place), 3))
    for k in np.unique(level).tolist():
        rows = np.flatnonzero(level == k)
        n = len(levels[k])
        x = np.clip((place[rows, 0] / side + 0.5) * n - 0.5, 0, n - 1)
        y = np.clip((0.5 - place[rows, 1] / side) * n - 0.5, 0, n - 1)
        i, j = np.minimum(y.astype(int), max(n - 2, 0)), np.minimum(x.astype(int), max(n - 2, 0))
        v, u = (y - i)[:, None], (x - j)[:, None]
        below, right = np.minimum(i + 1, n - 1), np.minimum(j + 1, n - 1)
        low = levels[k][i, j] * (1 - u) + levels[k][i, right] * u
        high = levels[k][below, j] * (1 - u) + levels[k][below, right] * u
        out[rows] = low * (1 - v) + high * v
    return srgb_bytes(out)
