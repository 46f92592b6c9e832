"""Pictures of lines, areas, texts and images, as PNG and as SVG with the same marks."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

Color = tuple[int, int, int]
Place = tuple[float, float]
Box = tuple[float, float, float, float]

INK: Color = (30, 32, 38)
_WHITE: Color = (255, 255, 255)
_FINER = 2
"""Marks of a PNG are drawn with this many pixels a pixel along each axis, so that lines are smooth."""


@dataclass(frozen=True, slots=True)
class _Line:
    points: Sequence[Place]
    color: Color
    width: float
    name: str


@dataclass(frozen=True, slots=True)
class _Area:
    points: Sequence[Place]
    color: Color
    opacity: float
    name: str


@dataclass(frozen=True, slots=True)
class _Dot:
    place: Place
    radius: float
    color: Color
    hollow: bool
    name: str


@dataclass(frozen=True, slots=True)
class _Picture:
    pixels: NDArray[np.uint8]
    box: Box
    name: str


@dataclass(frozen=True, slots=True)
class _Text:
    place: Place
    words: str
    size: int
    color: Color
    anchor: str


class Canvas:
    """A white picture to draw on, in pixels from its upper left corner; later marks cover earlier ones.

    Texts are above all other marks. The ``name`` of a mark is its ``data-name`` in an SVG.
    """

    def __init__(self, width: int, height: int) -> None:
        self.width, self.height = width, height
        self._marks: list[_Line | _Area | _Dot | _Picture] = []
        self._texts: list[_Text] = []

    def line(self, points: Sequence[Place], color: Color, *, width: float = 1.0, name: str = "") -> None:
        """Draw a line through points."""
        if len(points) > 1:
            self._marks.append(_Line(points, color, width, name))

    def area(self, points: Sequence[Place], color: Color, *, opacity: float = 1.0, name: str = "") -> None:
        """Fill a polygon."""
        if len(points) > 2:
            self._marks.append(_Area(points, color, opacity, name))

    def rectangle(self, box: Box, color: Color) -> None:
        """Fill a rectangle (left, top, right, bottom)."""
        left, top, right, bottom = box
        self.area([(left, top), (right, top), (right, bottom), (left, bottom)], color)

    def dot(self, place: Place, color: Color, *, radius: float, hollow: bool = False, name: str = "") -> None:
        """Draw a dot, or a circle that is white inside."""
        self._marks.append(_Dot(place, radius, color, hollow, name))

    def image(self, pixels: NDArray[np.uint8], box: Box, *, name: str = "") -> None:
        """Draw an image (h, w, 3) over a box (left, top, right, bottom), its pixels as rectangles."""
        self._marks.append(_Picture(pixels, box, name))

    def text(
        self, place: Place, words: str, *, size: int = 14, anchor: str = "la", color: Color = INK
    ) -> None:
        """Write a line of text; the anchor is Pillow's: l, m, r and a, t, m, s."""
        self._texts.append(_Text(place, words, size, color, anchor))

    def png(self) -> bytes:
        """The picture as PNG."""
        size = (self.width * _FINER, self.height * _FINER)
        fine = Image.new("RGB", size, _WHITE)
        for mark in self._marks:
            _draw(mark, fine)
        picture = fine.reduce(_FINER)
        pen = ImageDraw.Draw(picture)
        for text in self._texts:
            font = ImageFont.load_default(size=text.size)
            pen.text(text.place, drawable(text.words), fill=text.color, font=font, anchor=text.anchor)
        file = io.BytesIO()
        picture.save(file, "PNG")
        return file.getvalue()

    def svg(self) -> bytes:
        """The picture as SVG 1.1, which names no other file."""
        marks = "\n".join(map(_svg, [*self._marks, *self._texts]))
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{self.width}" height="{self.height}"'
            f' viewBox="0 0 {self.width} {self.height}" font-family="Helvetica,Arial,sans-serif">\n'
            f'<rect width="100%" height="100%" fill="#fff"/>\n{marks}\n</svg>\n'
        ).encode()

    def encoded(self, suffix: str) -> bytes:
        """The picture as a file with the suffix ``.png`` or ``.svg``."""
        return {".png": self.png, ".svg": self.svg}[suffix]()


SUFFIXES = (".png", ".svg")
"""Of the files that a canvas makes."""


def drawable(words: str) -> str:
    """Words in letters that Pillow's own font has: it lacks the micro sign."""
    return words.replace("µ", "u")


def _draw(mark: _Line | _Area | _Dot | _Picture, picture: Image.Image) -> None:
    pen = ImageDraw.Draw(picture, "RGBA")
    match mark:
        case _Line():
            width = max(round(mark.width * _FINER), 1)
            pen.line(_fine(mark.points), fill=mark.color, width=width, joint="curve" if width > 3 else None)
        case _Area():
            pen.polygon(_fine(mark.points), fill=(*mark.color, round(255 * mark.opacity)))
        case _Dot():
            (u, v), r = mark.place, mark.radius
            ((left, top), (right, bottom)) = _fine([(u - r, v - r), (u + r, v + r)])
            inside = _WHITE if mark.hollow else mark.color
            pen.ellipse((left, top, right, bottom), fill=inside, outline=mark.color, width=2 * _FINER)
        case _Picture():
            left, top, right, bottom = (round(v * _FINER) for v in mark.box)
            size = (max(right - left, 1), max(bottom - top, 1))
            picture.paste(Image.fromarray(mark.pixels).resize(size, Image.Resampling.NEAREST), (left, top))


def _fine(points: Sequence[Place]) -> list[Place]:
    return [(u * _FINER, v * _FINER) for u, v in points]


def _svg(mark: _Line | _Area | _Dot | _Picture | _Text) -> str:
    match mark:
        case _Line():
            stroke = f'fill="none" stroke="{_hex(mark.color)}" stroke-width="{mark.width:g}"'
            return f'<polyline{_name_of(mark.name)} points="{_pairs(mark.points)}" {stroke}/>'
        case _Area():
            fill = f'fill="{_hex(mark.color)}" fill-opacity="{mark.opacity:g}"'
            return f'<polygon{_name_of(mark.name)} points="{_pairs(mark.points)}" {fill}/>'
        case _Dot():
            u, v = mark.place
            fill = "#fff" if mark.hollow else _hex(mark.color)
            return (
                f'<circle{_name_of(mark.name)} cx="{u:.2f}" cy="{v:.2f}" r="{mark.radius:g}" fill="{fill}"'
                f' stroke="{_hex(mark.color)}" stroke-width="2"/>'
            )
        case _Picture():
            left, top, right, bottom = mark.box
            file = io.BytesIO()
            Image.fromarray(mark.pixels).save(file, "PNG")
            data = base64.b64encode(file.getvalue()).decode()
            return (
                f'<image{_name_of(mark.name)} x="{left:.2f}" y="{top:.2f}" width="{right - left:.2f}"'
                f' height="{bottom - top:.2f}" preserveAspectRatio="none" style="image-rendering:pixelated"'
                f' href="data:image/png;base64,{data}"/>'
            )
        case _Text():
            (u, v), size = mark.place, mark.size
            side = {"l": "start", "m": "middle", "r": "end"}[mark.anchor[0]]
            down = {"a": 0.8, "t": 0.75, "m": 0.36, "s": 0.0}[mark.anchor[1]] * size
            return (
                f'<text x="{u:.2f}" y="{v + down:.2f}" font-size="{size}" text-anchor="{side}"'
                f' fill="{_hex(mark.color)}">{html.escape(mark.words)}</text>'
            )


def _hex(color: Color) -> str:
    return "#" + "".join(f"{c:02x}" for c in color)


def _name_of(name: str) -> str:
    return f' data-name="{html.escape(name)}"' if name else ""


def _pairs(points: Sequence[Place]) -> str:
    return " ".join(f"{u:.2f},{v:.2f}" for u, v in points)
