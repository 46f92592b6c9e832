"""Small pictures from above, and cards of a picture and a table, as notebooks show them."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Iterable

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray
from PIL import Image, ImageDraw, ImageFont

from geoscene.typing import Float

Color = tuple[int, int, int]
Bounds = tuple[float, float, float, float]

DARK, PAPER = (16, 18, 24), (244, 243, 239)
"""Backgrounds of point clouds and of maps, sRGB."""

_SIDE = 480
"""Pixels along the longer side of a picture."""
_FINER = 2
"""Pixels that are drawn for one of the picture, along each side."""
_MARK = (255, 255, 255)


class PreviewPlan:
    """A picture of a part of the plane, north up.

    bounds : xmin, ymin, xmax, ymax of what is shown, metres
    ground : background colour
    """

    def __init__(self, bounds: Bounds, ground: Color) -> None:
        xmin, ymin, xmax, ymax = bounds
        wide, high = max(xmax - xmin, 1e-3), max(ymax - ymin, 1e-3)
        self._scale = _SIDE * _FINER / max(wide, high)
        self._corner = np.array([xmin, ymax])
        size = max(round(wide * self._scale), 2 * _FINER), max(round(high * self._scale), 2 * _FINER)
        self._wide = wide
        self._image = Image.new("RGB", size, ground)
        self._pen = ImageDraw.Draw(self._image)

    def polygons(self, shapes: Iterable[shapely.Geometry], fill: Color, *, edge: Color | None = None) -> None:
        """Fill polygons; other geometries are left out."""
        for part in shapely.get_parts(np.asarray(list(shapes), object)):
            if part.geom_type != "Polygon" or part.is_empty:
                continue
            rings = [self._pixels(shapely.get_coordinates(ring)) for ring in (part.exterior, *part.interiors)]
            # One path to each ring and back: the ways there cancel out, and holes stay open (even-odd rule).
            self._pen.polygon([pixel for ring in rings for pixel in (*ring, rings[0][0])], fill)
            for ring in rings if edge is not None else ():
                self._pen.line(ring, edge)

    def line(self, xy: ArrayLike, color: Color, *, width: int = 2) -> None:
        """Draw a line through points (n, 2), ``width`` pixels wide, and a dot at its start."""
        path = self._pixels(np.asarray(xy, float))
        if len(path) > 1:
            self._pen.line(path, color, width=width * _FINER, joint="curve")
        (x, y), r = path[0], 2.5 * width * _FINER
        self._pen.ellipse((x - r, y - r, x + r, y + r), fill=color, outline=_MARK, width=_FINER)

    def points(self, xyz: ArrayLike, colors: NDArray[np.uint8]) -> None:
        """Draw points (n, 3) in colours (n, 3): the higher over the lower ones."""
        place = np.asarray(xyz, float)
        order = np.argsort(place[:, 2], kind="stable")
        pixels = np.asarray(self._image).copy()
        column, row = np.floor(self._transformed(place[order, :2])).astype(np.int64).T
        for down in range(_FINER):
            for right in range(_FINER):
                u, v = column + right, row + down
                seen = (u >= 0) & (v >= 0) & (u < pixels.shape[1]) & (v < pixels.shape[0])
                pixels[v[seen], u[seen]] = colors[order][seen]
        self._image = Image.fromarray(pixels)
        self._pen = ImageDraw.Draw(self._image)

    def png(self) -> bytes:
        """The picture with a scale bar as a PNG file."""
        size = self._image.width // _FINER, self._image.height // _FINER
        image = self._image.resize(size, Image.Resampling.LANCZOS)
        steps = [base * 10**power for power in range(6) for base in (1, 2, 5)]
        length = next((s for s in reversed(steps) if s <= 0.3 * self._wide), None)
        if length is not None and size[1] > 60:
            pen, font = ImageDraw.Draw(image), ImageFont.load_default(size=13)
            across, y = length * self._scale / _FINER, size[1] - 10
            for color, width in (((0, 0, 0), 4), (_MARK, 2)):
                pen.line((10, y, 10 + across, y), fill=color, width=width)
            text = f"{length} m" if length < 1000 else f"{length // 1000} km"
            pen.text((10, y - 6), text, _MARK, font, anchor="ls", stroke_width=2, stroke_fill=(0, 0, 0))
        out = io.BytesIO()
        image.save(out, "PNG")
        return out.getvalue()

    def _transformed(self, xy: Float) -> Float:
        pixels: Float = (xy - self._corner) * [self._scale, -self._scale]
        return pixels

    def _pixels(self, xy: Float) -> list[tuple[float, float]]:
        return [(x, y) for x, y in self._transformed(xy).tolist()]


def around(xy: Float, *, margin: float = 0.0) -> Bounds:
    """Bounds of points (n, 2), of which the outermost hundredth may be left out, and a margin in metres."""
    low, high = np.percentile(xy, [0.5, 99.5], axis=0)
    return (low[0] - margin, low[1] - margin, high[0] + margin, high[1] + margin)


def card(title: str, rows: Iterable[tuple[str, object]], *, picture: bytes | None = None) -> str:
    """HTML of a picture (PNG) and, beside it, a table of names and values."""
    cells = "".join(
        f'<tr><th style="text-align:left;padding-right:1em">{html.escape(name)}</th>'
        f'<td style="text-align:left">{html.escape(str(value))}</td></tr>'
        for name, value in rows
    )
    shown = ""
    if picture is not None:
        data = base64.b64encode(picture).decode()
        shown = f'<img alt="{html.escape(title)}" src="data:image/png;base64,{data}" style="max-width:100%">'
    return (
        '<div style="display:flex;flex-wrap:wrap;gap:1em;align-items:flex-start">'
        f"{shown}<div><b>{html.escape(title)}</b><table>{cells}</table></div></div>"
    )
