"""Illustrations: point clouds from above or obliquely, depth and class images, legends."""

# mypy: disallow-untyped-decorators=False
from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image, ImageDraw, ImageFont

from geoscene.classes import Class, class_codes
from geoscene.support.compiled import njit
from geoscene.typing import Float
from lidar.errors import InputError
from lidar.geometry.attitude import Mount
from lidar.geometry.poses import Poses
from lidar.sensors.rig.camera_model import project
from lidar.sensors.rig.specs import CameraSpec
from lidar.tools.maps.colors import ramp

if TYPE_CHECKING:
    from lidar.motion.vehicle import Vehicle

Pixels = NDArray[np.uint8]

BACKGROUND = (16, 18, 24)
"""Background colour of pictures of point clouds, sRGB."""


@dataclass(frozen=True)
class PictureView:
    """Viewing direction of a picture; the distance follows from the visible bounds.

    azimuth_deg   : horizontal viewing direction, clockwise from the y axis (north)
    elevation_deg : downward angle of the viewing direction
    fov_deg       : horizontal field of view; a narrow one is close to an orthographic projection
    """

    azimuth_deg: float
    elevation_deg: float
    fov_deg: float = 32.0


VIEWS = {
    "top": PictureView(0.0, 90.0, 2.0),
    "oblique": PictureView(25.0, 33.0),
    "low": PictureView(25.0, 16.0, 45.0),
}
"""Views by name; ``top`` is a map with north up."""


def view_named(view: str | PictureView) -> PictureView:
    """A view by its name, or the view itself; raises InputError for an unknown name."""
    if isinstance(view, PictureView):
        return view
    if view not in VIEWS:
        raise InputError(f"view {view!r} is not known: {', '.join(VIEWS)}")
    return VIEWS[view]


def camera_around(corners: Float, view: PictureView, *, size: tuple[int, int]) -> tuple[CameraSpec, Poses]:
    """Nearest camera with all corners (n, 3) in view."""
    width, height = size
    a, e = math.radians(view.azimuth_deg), math.radians(view.elevation_deg)
    forward = np.array([math.sin(a) * math.cos(e), math.cos(a) * math.cos(e), -math.sin(e)])
    right = np.array([math.cos(a), -math.sin(a), 0.0])
    axes = np.stack([right, np.cross(forward, right), forward], axis=1)
    f = width / 2 / math.tan(math.radians(view.fov_deg) / 2)
    half = 0.98 * np.array([width, height]) / 2 / f
    # A corner at (x, z) is in view from (s, -d) if |x - s| <= half * (z + d): the least d that leaves room
    # for an s, in width and in height, and the middle of that room.
    x, z = (corners @ axes)[:, :2] / half, (corners @ axes)[:, 2:]
    distance = float(((x - z).max(axis=0) - (x + z).min(axis=0)).max()) / 2
    aside = half * ((x - z).max(axis=0) + (x + z).min(axis=0)) / 2
    position = axes @ [*aside, -distance]
    camera = CameraSpec(
        "picture", Mount(), width, height, f, f, (width - 1) / 2, (height - 1) / 2, near=0.5, far=np.inf
    )
    return camera, Poses(position[None], axes[None], np.ones((1, 3)))


def cloud_picture(
    points: ArrayLike,
    colors: ArrayLike,
    *,
    view: str | PictureView = "oblique",
    size: tuple[int, int] = (1600, 1000),
    bounds: ArrayLike | None = None,
    point: float = 0.12,
    depth: bool = True,
) -> Pixels:
    """A picture (h, w, 3) of a point cloud.

    points : (n, 3) metres, z up
    colors : (n, 3) uint8
    bounds : (2, 3) lower and upper corner to show; by default 0.5th to 99.5th percentile of the points
    point  : size of a point in metres; at least a pixel
    depth  : darken pixels behind depth edges (eye-dome lighting)

    Raises InputError for a cloud without points, or an unknown view.
    """
    xyz, rgb = np.asarray(points, float), np.ascontiguousarray(colors, np.uint8)
    if not len(xyz):
        raise InputError("a picture of a point cloud needs points")
    box = np.percentile(xyz, [0.5, 99.5], axis=0) if bounds is None else np.asarray(bounds, float)
    box[1] = np.maximum(box[1], box[0] + 1e-3)
    corners = np.array([[x, y, z] for x in box[:, 0] for y in box[:, 1] for z in box[:, 2]])
    camera, pose = camera_around(corners, view_named(view), size=size)
    pixels, z = project(camera, (xyz - pose.position) @ pose.rotation[0])
    width, height = size
    image = np.empty((height, width, 3), np.uint8)
    image[:] = BACKGROUND
    nearest = np.full((height, width), np.inf)
    _splat(pixels, z, rgb, 0.5 * point * camera.fx, image, nearest)
    return _shade_edges(image, nearest) if depth else image


@njit(cache=True, nogil=True, error_model="numpy")
def _splat(
    pixels: Float, depth: Float, colors: Pixels, half_size: float, image: Pixels, nearest: Float
) -> None:
    """Draw points as squares with a depth buffer; ``half_size`` is half a side in pixels at distance 1."""
    height, width = nearest.shape
    for i in range(len(depth)):
        z = depth[i]
        if not (z > 0.0 and abs(pixels[i, 0]) < 1e6 and abs(pixels[i, 1]) < 1e6):
            continue
        half = min(max(half_size / z, 0.8), 12.0)
        u0, u1 = math.ceil(pixels[i, 0] - half), math.ceil(pixels[i, 0] + half)
        v0, v1 = math.ceil(pixels[i, 1] - half), math.ceil(pixels[i, 1] + half)
        for v in range(max(v0, 0), min(v1, height)):
            for u in range(max(u0, 0), min(u1, width)):
                if z < nearest[v, u]:
                    nearest[v, u] = z
                    for c in range(3):
                        image[v, u, c] = colors[i, c]


def _shade_edges(image: Pixels, nearest: Float) -> Pixels:
    """The image with eye-dome lighting (Boucheny 2009): pixels behind their neighbours are darker."""
    height, width = nearest.shape
    far = np.isinf(nearest)
    span = np.where(far, np.nan, np.log(np.where(far, 1.0, nearest)))
    if far.all():
        return image
    span = np.where(far, np.nanmax(span) + 1.0, span)
    behind = np.zeros_like(span)
    reach = max(1, round(height / 700))
    around = np.pad(span, reach, mode="edge")
    for dv in (-reach, 0, reach):
        for du in (-reach, 0, reach):
            other = around[reach + dv : reach + dv + height, reach + du : reach + du + width]
            behind += np.maximum(span - other, 0.0)
    # Depth steps are relative to the depth range, so that a map gets the same edges as a street view.
    spread = max(float(np.percentile(span[~far], 99) - np.percentile(span[~far], 1)), 1e-6)
    light = np.where(far, 1.0, np.exp(-0.9 * np.minimum(behind / spread, 2.0)))
    return np.rint(image * light[..., None]).astype(np.uint8)


def class_colors(klass: NDArray[np.uint8]) -> Pixels:
    """Colours (..., 3) of class codes (...), as in `geoscene.classes`."""
    return class_codes().color[klass]


def depth_picture(depth: NDArray[np.floating], *, near: float = 2.0, far: float = 120.0) -> Pixels:
    """Colours (h, w, 3) of depths (h, w) in metres, logarithmic: bright near, dark far, grey if none."""
    seen = np.isfinite(depth) & (depth > 0)
    picture = ramp(-np.log(np.where(seen, depth, far)), -math.log(far), high=-math.log(near))
    picture[~seen] = (40, 40, 44)
    return picture


def with_legend(image: Pixels, klass: NDArray[np.uint8]) -> Pixels:
    """The image with a legend of the classes that occur in ``klass`` (any shape), most frequent first."""
    codes, counts = np.unique(klass[klass != Class.SKY], return_counts=True)
    ranked = codes[np.argsort(-counts, kind="stable")]
    names = [Class(code).name.lower().replace("_", " ") for code in ranked]
    return with_key(
        image, [(name, class_codes().color[code]) for name, code in zip(names, ranked, strict=True)]
    )


def with_key(image: Pixels, entries: Sequence[tuple[str, ArrayLike]]) -> Pixels:
    """The image with a legend of names and colours in its lower left corner, scaled to fit."""
    if not entries:
        return image
    line = max(8, min(round(image.shape[0] / 36), int(0.96 * image.shape[0] / (len(entries) + 1.3))))
    font = ImageFont.load_default(size=round(line * 0.72))
    wide = max(font.getlength(name) for name, _ in entries)
    box = (round(wide + 2.6 * line), round((len(entries) + 0.8) * line))
    picture = Image.fromarray(image)
    top = max(image.shape[0] - box[1] - line // 2, 0)
    shade = Image.new("RGB", box, (10, 11, 15))
    region = (line // 2, top)
    under = picture.crop((*region, region[0] + box[0], region[1] + box[1]))
    picture.paste(Image.blend(under, shade, 0.72), region)
    pen = ImageDraw.Draw(picture)
    for k, (name, color) in enumerate(entries):
        y = top + round((k + 0.4) * line)
        x = region[0] + line // 2
        fill = tuple(int(c) for c in np.asarray(color))
        pen.rectangle((x, y + line // 6, x + line, y + line - line // 6), fill=fill)
        pen.text((x + 1.5 * line, y + line / 2), name, fill=(235, 235, 235), font=font, anchor="lm")
    return np.asarray(picture).copy()


def vehicle_outline(length: float, width: float, *, rear: float, step: float = 0.05) -> Float:
    """Points (n, 3) along a vehicle's outline on the ground and a forward arrow, vehicle frame, metres.

    rear : rear overhang, metres
    step : distance of the points, metres
    """
    back, front, side = -rear, length - rear, width / 2
    tip = 0.35 * length
    corners = [(back, -side), (front, -side), (front, side), (back, side), (back, -side)]
    arrow = [(front - tip, side), (front, 0.0), (front - tip, -side)]
    parts = []
    for line in (corners, arrow):
        for a, b in itertools.pairwise(np.array(line)):
            share = np.linspace(0, 1, max(2, math.ceil(float(np.hypot(*(b - a))) / step)))[:, None]
            parts.append(a + share * (b - a))
    xy = np.concatenate(parts)
    return np.column_stack([xy, np.full(len(xy), 0.05)])


def range_rings(radii: Sequence[float], *, height: float = 0.0, step: float = 0.1) -> Float:
    """Points (n, 3) on horizontal circles about the z axis, metres: a scale for pictures of a sweep."""
    parts = []
    for radius in radii:
        turn = np.linspace(0, 2 * np.pi, max(8, round(2 * np.pi * radius / step)), endpoint=False)
        ring = radius * np.stack([np.cos(turn), np.sin(turn)], axis=1)
        parts.append(np.column_stack([ring, np.full(len(turn), height)]))
    return np.concatenate(parts)


def sweep_picture(
    points: ArrayLike,
    colors: ArrayLike,
    *,
    vehicle: Vehicle | None = None,
    half_width: float = 60.0,
    view: str | PictureView = "oblique",
    size: tuple[int, int] = (1600, 1000),
    point: float = 0.15,
) -> Pixels:
    """A picture (h, w, 3) of one sweep with the vehicle's outline and range rings.

    points : (n, 3) metres in the vehicle frame
    colors : (n, 3) uint8
    half_width : metres shown to each side of the vehicle

    Raises InputError for a cloud without points, or an unknown view.
    """
    xyz, rgb = np.asarray(points, float), np.asarray(colors, np.uint8)
    near = np.abs(xyz[:, :2]).max(axis=1, initial=0.0) < half_width
    if not near.any():
        raise InputError("a picture of a point cloud needs points")
    step = next(s for s in (1, 2, 5, 10, 20, 50, 100, 200, 500, 1e4) if half_width / s <= 6)
    low = float(np.percentile(xyz[near, 2], 2))
    marks = [range_rings(np.arange(step, half_width, step).tolist(), height=low)]
    if vehicle is not None:
        marks.append(vehicle_outline(vehicle.length, vehicle.width, rear=vehicle.rear_overhang))
    drawn = np.concatenate([xyz[near], *marks])
    kinds = [(110, 116, 130), (255, 255, 255)]
    marked = [np.tile(np.array(kind, np.uint8), (len(m), 1)) for kind, m in zip(kinds, marks, strict=False)]
    box = np.percentile(xyz[near], [0.5, 99.5], axis=0)
    box[:, :2] = [[-half_width, -half_width], [half_width, half_width]]
    image = cloud_picture(
        drawn, np.concatenate([rgb[near], *marked]), view=view, size=size, point=point, bounds=box
    )
    picture = Image.fromarray(image)
    line = max(12, round(size[1] / 36))
    ImageDraw.Draw(picture).text(
        (size[0] - line, size[1] - line),
        f"circles every {step:g} m",
        fill=(200, 204, 214),
        font=ImageFont.load_default(size=round(line * 0.72)),
        anchor="rs",
    )
    return np.asarray(picture).copy()


def sheet(images: Sequence[Pixels], *, columns: int = 2, gap: int = 8) -> Pixels:
    """Several images in one, row by row, in cells of the size of the largest."""
    if not images:
        raise InputError("a sheet needs images")
    height, width = (max(image.shape[k] for image in images) for k in (0, 1))
    rows = -(-len(images) // columns)
    wide = min(columns, len(images))
    whole = np.full((rows * (height + gap) - gap, wide * (width + gap) - gap, 3), 255, np.uint8)
    for k, image in enumerate(images):
        v, u = (k // columns) * (height + gap), (k % columns) * (width + gap)
        whole[v : v + image.shape[0], u : u + image.shape[1]] = image
    return whole
