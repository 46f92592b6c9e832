"""Objects of the scanner that the camera confirms: outlines against edges, inside against surroundings."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import ConvexHull, QhullError

from geoscene.typing import Float
from lidar.parameters import parameter
from lidar.sensors.rig.camera_model import project
from lidar.tools.defences.defence import Defence, Verdict, Window, of_boxes
from lidar.tools.defences.observation import Observation, Picture, pixels_of

_BLUR = 1.0
"""Pixels, standard deviation of the filter before edges are computed."""
_SAMPLES = 96
"""Places on an outline."""
_LEVELS = 6
"""Levels of each colour channel in histograms."""
_BANDS = 3
"""Bands of rows of an outline in which colours are compared."""
_SHOWN = 0.7
"""Share of an object's returns that must be in the image, where it is neither saturated nor black."""
_SMALLEST = 6.0
"""Pixels, height and width of the smallest outline that is judged."""


@dataclass(frozen=True, slots=True)
class Evidence:
    """Evidence of a camera image for or against an object.

    outline  : (k, 2) pixels, corners
    edges    : mean strength of the edges that run along the outline, 0 to 1
    contrast : difference of the colours inside and on both sides, 0 to 1
    """

    outline: Float
    edges: float
    contrast: float


@dataclass(frozen=True)
class Overlay(Defence):
    """Objects without edges along their outline in the image, or whose inside resembles the surroundings."""

    needs: ClassVar[frozenset[str]] = frozenset({"cameras"})

    slack: float = parameter(
        3.0, "error of calibration and time in the image", unit="pixels", low=0, high=100
    )
    lag: float = parameter(
        0.06, "greatest time between the image and the frame's pulses", unit="s", low=0, high=10
    )
    edge: float = parameter(12.0, "grey levels per pixel of an edge of strength 1/2", low=0.1, high=255)

    def judge(self, window: Window) -> Verdict:
        """Judge the bounding boxes of the last frame that are in view of a camera."""
        frame = window.frame
        objects = [0.0] * len(frame.objects)
        for row in range(len(frame.objects)):
            found = [e for picture in frame.pictures if (e := self.evidence(frame, row, picture=picture))]
            if found:
                objects[row] = min(suspicion_of(one) for one in found)
        return of_boxes(frame, objects)

    def pictures(
        self, frame: Observation, verdict: Verdict, *, threshold: float
    ) -> dict[str, NDArray[np.uint8]]:
        """Each camera's picture with the outlines of objects: green if confirmed, red if rejected."""
        assert verdict.objects is not None  # noqa: S101
        found = {}
        for picture in frame.pictures:
            shown = [
                (evidence, bool(verdict.objects[row] > threshold))
                for row in range(len(frame.objects))
                if (evidence := self.evidence(frame, row, picture=picture))
            ]
            if shown:
                found[f"{picture.camera.name}_{picture.file.stem}"] = _drawn(picture, shown)
        return found

    def evidence(self, frame: Observation, row: int, *, picture: Picture) -> Evidence | None:
        """Evidence of an image for a bounding box; None if it does not show it at its time."""
        body = frame.members[row]
        if len(body) < 4 or np.abs(frame.time_ns[body] - picture.time_ns).min() > 1e9 * self.lag:
            return None
        pixels = project_returns(frame, body, picture=picture)
        with np.errstate(invalid="ignore"):
            within = (pixels >= 0) & (pixels < [picture.camera.width, picture.camera.height])
        shown = within[:, 0] & within[:, 1]
        shown[shown] = _tells(picture, pixels[shown])
        if shown.mean() < _SHOWN:
            return None
        corners = hull_of(pixels[shown])
        if corners is None or np.ptp(corners, axis=0).min() < _SMALLEST:
            return None
        spacing = self._spacing(frame, picture)
        edges = self._edges_along(picture, corners, spacing=spacing)
        return Evidence(corners, edges, contrast_of(picture, corners, margin=spacing))

    def _spacing(self, frame: Observation, picture: Picture) -> Float:
        """Pixels (2,) between pulses, sideways and up: by so much the outline of returns may be too small."""
        fired = frame.firings.direction
        rings = max(int(frame.firings.ring.max()) + 1, 2)
        up = float(np.ptp(np.arcsin(np.clip(fired[:, 2], -1, 1)))) / (rings - 1)
        aside = 2 * np.pi * rings / max(len(fired), rings)
        return np.array([picture.camera.fx * aside, picture.camera.fy * up]) + self.slack

    def _edges_along(self, picture: Picture, corners: Float, *, spacing: Float) -> float:
        """Mean strength of edges along an outline.

        At each place the strongest one counts from a little inside to where the next pulses have no return.
        Its strength is that of the gradient across the outline.
        """
        image = edges_of(picture.file)
        places, normals = outline_samples(corners)
        reach = np.abs(normals) @ spacing
        steps = np.linspace(-self.slack / max(float(reach.max()), 1e-6), 1.0, 9)
        at = places[:, None] + (reach[:, None] * steps)[:, :, None] * normals[:, None]
        rows = np.clip(np.round(at[:, :, 1]).astype(int), 0, image.shape[0] - 1)
        columns = np.clip(np.round(at[:, :, 0]).astype(int), 0, image.shape[1] - 1)
        across = np.abs(np.einsum("skc,sc->sk", image[rows, columns], normals)).max(axis=1)
        return float((across / (across + self.edge)).mean())


def _tells(picture: Picture, pixels: Float) -> NDArray[np.bool_]:
    """Whether pixels (n, 2) within a picture are neither saturated nor black, as by a lamp or a loss."""
    column, row = pixels.astype(int).T
    rgb = picture.rgb()[row, column]
    found: NDArray[np.bool_] = ~((rgb == 255).all(axis=1) | (rgb == 0).all(axis=1))
    return found


def suspicion_of(evidence: Evidence) -> float:
    """Suspicion of an object whose pixels in an image have neither edges nor contrast."""
    return (1 - evidence.edges) * (1 - evidence.contrast)


def project_returns(frame: Observation, rows: NDArray[np.intp], *, picture: Picture) -> Float:
    """Pixels (n, 2) of returns in a picture, from where the vehicle was when it was taken; NaN behind it."""
    camera = picture.camera
    pose = frame.trajectory.at([picture.time_ns]).mounted(camera.mount.translation, camera.mount.rotation)
    local = ((frame.scene_xyz[rows] - pose.position) / pose.scale) @ pose.rotation[0]
    with np.errstate(invalid="ignore"):
        pixels, _ = project(camera, local)
    return pixels


def hull_of(pixels: Float) -> Float | None:
    """Corners (k, 2) of the convex hull of pixels, clockwise; None if the pixels are collinear."""
    try:
        hull = ConvexHull(pixels)
    except (QhullError, ValueError):
        return None
    corners: Float = pixels[hull.vertices]
    return corners


def outline_samples(corners: Float) -> tuple[Float, Float]:
    """Places (s, 2) evenly along a convex outline, and the normals (s, 2) outwards."""
    side, length, normal = _sides(corners)
    along = (np.arange(_SAMPLES) + 0.5) / _SAMPLES * length.sum()
    ends = np.cumsum(length)
    row = np.minimum(np.searchsorted(ends, along), len(corners) - 1)
    part = (along - (ends[row] - length[row])) / np.maximum(length[row], 1e-9)
    return corners[row] + part[:, None] * side[row], normal[row]


def _sides(corners: Float) -> tuple[Float, Float, Float]:
    """Sides (k, 2) of a convex outline, their lengths (k,), and normals (k, 2) outwards."""
    side = np.roll(corners, -1, axis=0) - corners
    length = np.linalg.norm(side, axis=1)
    normal = np.column_stack([side[:, 1], -side[:, 0]]) / np.maximum(length, 1e-9)[:, None]
    normal[np.einsum("ij,ij->i", normal, corners - corners.mean(axis=0)) < 0] *= -1
    return side, length, normal


@functools.lru_cache(maxsize=4)
def edges_of(file: Path) -> NDArray[np.float32]:
    """Gradient (h, w, 2) of the brightness, grey levels per pixel, of the channel in which it is greatest."""
    rgb = ndimage.gaussian_filter(pixels_of(file).astype(np.float32), (_BLUR, _BLUR, 0))
    x, y = np.gradient(rgb, axis=1), np.gradient(rgb, axis=0)
    best = np.argmax(x * x + y * y, axis=2)[..., None]
    gradient: NDArray[np.float32] = np.concatenate(
        [np.take_along_axis(x, best, 2), np.take_along_axis(y, best, 2)], axis=2
    )
    return gradient


def contrast_of(picture: Picture, corners: Float, *, margin: Float) -> float:
    """Hellinger distance of the colours inside an outline and on both sides of it, 0 to 1.

    Mean over bands of rows, as colours change from the ground to the sky without any object.
    """
    rgb = picture.rgb()
    height, width = rgb.shape[:2]
    size = np.ptp(corners, axis=0)
    beside = np.array([max(0.5 * size[0], 6) + margin[0], 0.0])
    low = np.maximum(np.floor(corners.min(axis=0) - beside), 0).astype(int)
    high = np.minimum(np.ceil(corners.max(axis=0) + beside), [width - 1, height - 1]).astype(int)
    x, y = (
        part.ravel() for part in np.meshgrid(np.arange(low[0], high[0] + 1), np.arange(low[1], high[1] + 1))
    )
    away = _outside(np.column_stack([x, y]), corners, scale=margin)
    colors = rgb[y, x].astype(np.int64) * _LEVELS // 256
    code = (colors[:, 0] * _LEVELS + colors[:, 1]) * _LEVELS + colors[:, 2]
    band = (y - low[1]) * _BANDS // max(high[1] - low[1] + 1, 1)
    found = []
    for k in range(_BANDS):
        inside = (away <= 0) & (band == k)
        sides = [
            (away > 1) & (band == k) & side for side in (x < corners[:, 0].min(), x > corners[:, 0].max())
        ]
        away_from = [_hellinger(code[inside], code[side]) for side in sides if side.sum() >= 12]
        if inside.sum() >= 12 and away_from:
            found.append(min(away_from))
    return float(np.mean(found)) if found else 0.0


def _hellinger(one: NDArray[np.int64], other: NDArray[np.int64]) -> float:
    """Hellinger distance of two histograms of codes."""
    parts = [np.bincount(code, minlength=_LEVELS**3) / len(code) for code in (one, other)]
    return float(np.sqrt(max(1 - np.sqrt(parts[0] * parts[1]).sum(), 0.0)))


def _outside(pixels: NDArray[np.int64], corners: Float, *, scale: Float) -> Float:
    """Distance (n,) of pixels outside a convex outline, in units of a scale by axis; negative inside."""
    normal = _sides(corners)[2]
    over = np.einsum("nkj,kj->nk", pixels[:, None] - corners[None], normal)
    found: Float = (over / (np.abs(normal) @ scale)).max(axis=1)
    return found


def _drawn(picture: Picture, found: Sequence[tuple[Evidence, bool]]) -> NDArray[np.uint8]:
    """A picture with the outlines of objects and whether they are rejected."""
    from PIL import Image, ImageDraw  # noqa: PLC0415

    image = Image.fromarray(picture.rgb())
    draw = ImageDraw.Draw(image)
    for evidence, rejected in found:
        corners = [(float(x), float(y)) for x, y in evidence.outline]
        color = (255, 40, 40) if rejected else (40, 255, 40)
        draw.line([*corners, corners[0]], fill=color, width=2)
        left, top = evidence.outline.min(axis=0)
        draw.text(
            (left, top - 12), f"edges {evidence.edges:.2f}, contrast {evidence.contrast:.2f}", fill=color
        )
    return np.asarray(image)
