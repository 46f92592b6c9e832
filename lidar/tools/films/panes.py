"""Parts of a film's picture: the sweep around the vehicle, the growing map, the cameras' images."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image, ImageDraw, ImageFont

from geoscene.classes import Class, class_codes
from geoscene.typing import Bools, Float
from lidar.dataset.formats.table import Table, placed_returns
from lidar.dataset.ground_truth import read_boxes, read_truth
from lidar.dataset.layout import Dataset, reading_file
from lidar.dataset.recorded import Images, Stream, cloud_points
from lidar.errors import InputError
from lidar.geometry.attitude import matrix_from_quat
from lidar.geometry.poses import Trajectory
from lidar.motion.vehicle import Vehicle
from lidar.options.look import FilmOptions
from lidar.sensors.physics.origin import Origin
from lidar.tools.maps.colors import distinct, ramp
from lidar.tools.maps.picture import (
    BACKGROUND,
    PictureView,
    cloud_picture,
    depth_picture,
    range_rings,
    vehicle_outline,
)

Pixels = NDArray[np.uint8]

TEXT = (226, 229, 236)
"""Colour of texts."""

_GROUND = (10, 11, 15, 170)
"""Colour behind texts, with its opacity."""

_LINE = 16
"""Pixels between the lines of a legend."""

_VIEWS = {"chase": PictureView(90.0, 20.0, 62.0), "top": PictureView(90.0, 90.0, 2.0)}
"""In the vehicle frame: x, forward, is up in the picture."""

_SAMPLES = 3
_NAMED = 9
"""Classes that a legend names, at most."""

_LEAST = 25.0
"""Metres that a film shows around the vehicle at least."""

_LIGHTEST = 0.4
"""Luma, from 0 to 1, that edges of boxes have at least."""

_BOX_STEP = 0.04
"""Metres between the points that edges of boxes are drawn by."""

_MARKS, _EGO, _TRACK = (84, 90, 104), (255, 255, 255), (255, 96, 64)
_STEPS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000)


class Pane(Protocol):
    """A part of the picture; times must be requested in ascending order."""

    def draw(self, row: int) -> Pixels:
        """The image (h, w, 3) of a row of the film."""


class Sweeps:
    """Returns of some scanners at the frames of the first one, with their colours.

    streams : of each scanner; of the first, each frame is a row

    Raises InputError for colours by origin in a dataset without stages.
    """

    def __init__(
        self, dataset: Dataset, streams: Sequence[Stream], *, trajectory: Trajectory, options: FilmOptions
    ) -> None:
        self.dataset, self.trajectory = dataset, trajectory
        self.time_ns = streams[0].time_ns
        self._streams, self._color = streams, options.color
        if options.color == "origin" and self._truth(streams[0], 0) is None:
            raise InputError(f"`color` origin: no stage acted in {dataset.path}; choose another")
        some = np.unique(np.linspace(0, len(self.time_ns) - 1, _SAMPLES).astype(int)).tolist()
        tables = [self._cloud(streams[0], row) for row in some]
        self.samples: Float = np.concatenate(  # of surfaces: snow is near, and not what a film shows
            [
                self.in_vehicle(row, placed[table["label"] != Class.NOISE])
                for row, (table, placed) in zip(some, tables, strict=True)
            ]
        )
        if not len(self.samples):
            self.samples = np.zeros((1, 3))
        self._heights = np.percentile(self.samples[:, 2], (2, 97)).tolist()
        self._period = float(np.median(np.diff(streams[0].time_ns))) if len(self.time_ns) > 1 else 1e8
        self.key = self._key(np.concatenate([table["label"] for table, _ in tables]))

    def returns(self, row: int) -> tuple[Float, Pixels, Bools]:
        """Returns (n, 3) in the scene, their colours, and which are of road users that move."""
        parts = []
        for k, stream in enumerate(self._streams):
            after = np.searchsorted(stream.time_ns, self.time_ns[row], side="right")
            mine = row if k == 0 else int(after) - 1
            if mine < 0:
                continue
            table, placed = self._cloud(stream, mine)
            parts.append(
                (
                    placed,
                    self._colors(stream, mine, table=table, placed=placed),
                    self._moving(stream, mine, table=table),
                )
            )
        points, colors, moving = zip(*parts, strict=True)
        return np.concatenate(points), np.concatenate(colors), np.concatenate(moving)

    def in_vehicle(self, row: int, points: ArrayLike) -> Float:
        """Points (n, 3) of the scene in the vehicle's frame at a row."""
        return self.trajectory.at(self.time_ns[row : row + 1]).seen(np.asarray(points, float).reshape(-1, 3))

    def boxes(self, row: int) -> Iterator[tuple[Float, tuple[int, int, int]]]:
        """Points (n, 3) in the scene along the edges of the boxes with returns, and their colours."""
        stream = self._streams[0]
        path = self.dataset.frame_file(self.dataset.paths.frame_boxes(stream.name, int(stream.frames[row])))
        if not path.exists():
            return
        names = ("x", "y", "z", "qx", "qy", "qz", "qw", "length", "width", "height", "points")
        scale = float(self.trajectory.at(self.time_ns[row : row + 1]).scale[0, 0])
        for box in read_boxes(path, names):
            if box["points"]:
                edges = _edges(np.array([box[k] for k in ("length", "width", "height")]))
                turn = matrix_from_quat(tuple(box[k] for k in ("qx", "qy", "qz", "qw")))
                middle = np.array([box[k] for k in "xyz"])
                color = _bright(class_codes().color[Class[str(box["class"]).upper()]])
                yield middle + (edges @ turn.T) * (scale, scale, 1.0), color

    def _cloud(self, stream: Stream, row: int) -> tuple[Table, Float]:
        """A cloud and its returns (n, 3) in the scene."""
        table = cloud_points(self.dataset.frame_file(stream.files[row]))
        placed, _ = placed_returns(
            table, self.trajectory, start_ns=int(stream.time_ns[row]), vehicle_from_sensor=stream.mount.matrix
        )
        return table, placed

    def _truth(self, stream: Stream, row: int, *, count: int | None = None) -> NDArray[np.uint8] | None:
        path = self.dataset.frame_file(self.dataset.paths.truth(stream.name, int(stream.frames[row])))
        truth = read_truth(path, count=count)
        return None if truth is None else truth["origin"]

    def _colors(self, stream: Stream, row: int, *, table: Table, placed: Float) -> Pixels:
        if self._color == "class":
            return class_codes().color[table["label"]]
        if self._color == "intensity":
            return ramp(table["intensity"], 0, high=100)
        if self._color == "time":
            return ramp(table["time_ns"], 0, high=self._period)
        if self._color == "origin":
            origin = self._truth(stream, row, count=len(placed))
            return distinct(np.zeros(len(placed), int) if origin is None else origin)
        pose = self.trajectory.at(stream.time_ns[row : row + 1])
        return ramp(placed[:, 2] - pose.position[0, 2], self._heights[0], high=self._heights[1])

    def _moving(self, stream: Stream, row: int, *, table: Table) -> Bools:
        path = self.dataset.frame_file(self.dataset.paths.frame_boxes(stream.name, int(stream.frames[row])))
        if not path.exists():
            return np.zeros(len(table["label"]), bool)
        movers = [box["instance"] for box in read_boxes(path, ("instance", "moving")) if box["moving"]]
        return np.isin(table["instance"], movers)

    def _key(self, label: NDArray[np.integer]) -> list[tuple[str, ArrayLike]]:
        """Names and colours of the legend."""
        if self._color == "class":
            codes, counts = np.unique(label, return_counts=True)
            named = codes[np.argsort(-counts, kind="stable")][:_NAMED].tolist()
            return [(Class(k).name.lower().replace("_", " "), class_codes().color[k]) for k in named]
        if self._color == "origin":
            return [(one.name.lower(), distinct(int(one))) for one in Origin]
        low, high, unit = {
            "height": (*self._heights, "m"),
            "intensity": (0.0, 100.0, ""),
            "time": (0.0, self._period / 1e6, "ms"),
        }[self._color]
        values = np.linspace(high, low, 5)
        return [
            (f"{self._color} {value:.0f} {unit}".strip(), ramp(value, low, high=high))
            for value in values.tolist()
        ]


class SweepPane:
    """The sweep of each row in the vehicle's frame, from behind or from above, with boxes and a scale."""

    def __init__(self, sweeps: Sweeps, *, view: str, size: tuple[int, int], vehicle: Vehicle | None) -> None:
        self._sweeps, self._view, self._size = sweeps, _VIEWS[view], size
        away = np.hypot(sweeps.samples[:, 0], sweeps.samples[:, 1])
        low, high = np.percentile(sweeps.samples[:, 2], (2, 97))
        half = float(np.clip(np.percentile(away, 85), _LEAST, max(45.0, -2 * low)))
        aspect = size[0] / size[1]
        if view == "top":
            wide, tall = (half * max(aspect, 1.0), half * max(1 / aspect, 1.0))
            self._bounds = np.array([[-tall, -wide, low], [tall, wide, max(high, low + 1)]])
        else:
            self._bounds = np.array(
                [[-0.12 * half, -0.3 * half, low], [1.4 * half, 0.3 * half, low + 0.1 * half]]
            )
        self._step = next((s for s in _STEPS if half / s <= 5), _STEPS[-1])
        rings = np.arange(1, 6) * float(self._step)
        self._marks = [(range_rings(rings.tolist(), height=float(low)), _MARKS)]
        if vehicle is not None:
            shape = vehicle_outline(vehicle.length, vehicle.width, rear=vehicle.rear_overhang)
            self._marks.append((shape, _EGO))

    def draw(self, row: int) -> Pixels:
        """The image (h, w, 3) of a row of the film."""
        points, colors, _ = self._sweeps.returns(row)
        parts = [(self._sweeps.in_vehicle(row, points), colors)]
        for edge, color in self._sweeps.boxes(row):
            parts.append((self._sweeps.in_vehicle(row, edge), _one_color(color, len(edge))))
        parts += [(mark, _one_color(color, len(mark))) for mark, color in self._marks]
        xyz, rgb = (np.concatenate(some) for some in zip(*parts, strict=True))
        image = cloud_picture(xyz, rgb, view=self._view, size=self._size, bounds=self._bounds, point=0.05)
        return written(image, f"circles every {self._step} m", key=self._sweeps.key)


class MapPane:
    """The map of all sweeps so far from above, with the vehicle's path, without moving road users."""

    def __init__(self, sweeps: Sweeps, *, size: tuple[int, int], legend: bool) -> None:
        self._sweeps, self._size = sweeps, size
        self._key = sweeps.key if legend else []
        path = sweeps.trajectory.at(sweeps.time_ns).position[:, :2]
        margin = float(np.clip(np.percentile(np.hypot(*sweeps.samples[:, :2].T), 80), 15.0, 1e4))
        low, high = path.min(axis=0) - margin, path.max(axis=0) + margin
        self._scale = float((np.array(size) / (high - low)).min())  # pixels per scene metre
        self._corner = (low + high) / 2 + np.array([-0.5, 0.5]) * np.array(size) / self._scale
        self._image: Pixels = np.full((size[1], size[0], 3), BACKGROUND, np.uint8)
        self._top = np.full(size[0] * size[1], -np.inf)
        self._path: list[tuple[float, float]] = []
        across = size[0] / self._scale
        self._step = max((s for s in _STEPS if s <= 0.3 * across), default=_STEPS[0])

    def draw(self, row: int) -> Pixels:
        """The image (h, w, 3) of a row of the film, with the sweeps of all rows drawn before."""
        points, colors, moving = self._sweeps.returns(row)
        pixel = np.floor(self._pixels(points)).astype(np.int64)
        width, height = self._size
        shown = ((pixel >= 0) & (pixel < (width, height))).all(axis=1) & ~moving
        cell, z, rgb = pixel[shown, 1] * width + pixel[shown, 0], points[shown, 2], colors[shown]
        np.maximum.at(self._top, cell, z)
        highest = z == self._top[cell]
        self._image.reshape(-1, 3)[cell[highest]] = rgb[highest]
        pose = self._sweeps.trajectory.at(self._sweeps.time_ns[row : row + 1])
        self._path.append(_pair(self._pixels(pose.position)[0]))
        picture = Image.fromarray(self._image)
        pen = ImageDraw.Draw(picture)
        if len(self._path) > 1:
            pen.line(self._path, fill=_TRACK, width=2)
        ahead, aside = pose.rotation[0, :2, 0] * (1, -1), pose.rotation[0, :2, 1] * (1, -1)
        here = np.array(self._path[-1])
        corners = (here + 11 * ahead, here - 6 * ahead + 6 * aside, here - 6 * ahead - 6 * aside)
        pen.polygon([_pair(corner) for corner in corners], fill=_EGO, outline=_TRACK)
        long = self._step * self._scale
        pen.line([(12, height - 12), (12 + long, height - 12)], fill=TEXT, width=3)
        pen.text((12, height - 18), f"{self._step} m", fill=TEXT, font=_font(14), anchor="ls")
        return written(np.asarray(picture), "map, north up", key=self._key)

    def _pixels(self, points: Float) -> Float:
        """Pixels (n, 2) of scene points, x to the right and y down."""
        found: Float = (points[:, :2] - self._corner) * (self._scale, -self._scale)
        return found


class CameraPane:
    """The latest image of each camera at each time, in a grid with names."""

    def __init__(
        self,
        dataset: Dataset,
        cameras: Sequence[Images],
        *,
        time_ns: NDArray[np.int64],
        size: tuple[int, int],
        columns: int,
    ) -> None:
        self._dataset, self._cameras, self._time_ns = dataset, cameras, time_ns
        self._size, self._columns = size, columns

    def draw(self, row: int) -> Pixels:
        """The image (h, w, 3) of a row of the film."""
        width, height = self._size
        picture = Image.new("RGB", self._size, BACKGROUND)
        rows = -(-len(self._cameras) // self._columns)
        cell = width // self._columns, height // rows
        for k, images in enumerate(self._cameras):
            stream, kind = images.stream, images.kind
            latest = int(np.searchsorted(stream.time_ns, self._time_ns[row], side="right")) - 1
            corner = (k % self._columns) * cell[0], (k // self._columns) * cell[1]
            place = corner
            if latest >= 0:
                image = Image.fromarray(self._image(stream, kind, row=latest))
                share = min((cell[0] - 2) / image.width, (cell[1] - 2) / image.height)
                shape = max(round(image.width * share), 1), max(round(image.height * share), 1)
                place = corner[0] + (cell[0] - shape[0]) // 2, corner[1] + (cell[1] - shape[1]) // 2
                picture.paste(image.resize(shape, Image.Resampling.LANCZOS), place)
            name = stream.name if kind == "rgb" else f"{stream.name}, {kind}"
            label(picture, name, place=(place[0] + 8, place[1] + 6))
        return np.asarray(picture)

    def _image(self, stream: Stream, kind: str, *, row: int) -> Pixels:
        path = self._dataset.frame_file(stream.files[row])
        with reading_file(path), Image.open(path) as image:
            if kind == "rgb":
                return np.asarray(image.convert("RGB"))
            counts = float(stream.sensor["depth_counts_per_metre"])
            return depth_picture(np.asarray(image) / counts)


def written(image: Pixels, words: str, *, key: Sequence[tuple[str, ArrayLike]] = ()) -> Pixels:
    """The image with words in its lower right corner, and as much of a legend as has room on its left."""
    picture = Image.fromarray(image)
    font = _font(14)
    shown = key[: int(0.6 * picture.height / _LINE)]
    pen = ImageDraw.Draw(picture, "RGBA")
    if shown:
        wide = max(_font(12).getlength(name) for name, _ in shown) + 34
        pen.rectangle((6, 6, 6 + wide, 12 + _LINE * len(shown)), fill=_GROUND)
    for k, (name, color) in enumerate(shown):
        top = 9 + _LINE * k
        pen.rectangle((12, top + 2, 26, top + _LINE - 3), fill=tuple(np.asarray(color).tolist()))
        pen.text((32, top + _LINE / 2), name, fill=TEXT, font=_font(12), anchor="lm")
    label(picture, words, place=(picture.width - 10 - font.getlength(words), picture.height - 24))
    return np.asarray(picture)


def label(picture: Image.Image, words: str, *, place: tuple[float, float]) -> None:
    """Write words into a picture, on a dark ground."""
    pen, font = ImageDraw.Draw(picture, "RGBA"), _font(14)
    left, top, right, bottom = pen.textbbox(place, words, font=font)
    pen.rectangle((left - 4, top - 3, right + 4, bottom + 3), fill=_GROUND)
    pen.text(place, words, fill=TEXT, font=font)


def _font(size: int) -> ImageFont.FreeTypeFont:
    font = ImageFont.load_default(size=size)
    assert isinstance(font, ImageFont.FreeTypeFont)  # noqa: S101
    return font


def _bright(color: NDArray[np.uint8]) -> tuple[int, int, int]:
    """A colour, lightened for contrast on the dark background."""
    light = float(color @ np.array([0.299, 0.587, 0.114])) / 255
    share = min(max((_LIGHTEST - light) / (1 - light), 0.0), 1.0) if light < 1 else 0.0
    red, green, blue = np.rint(color + share * (255.0 - color)).astype(int).tolist()
    return red, green, blue


def _pair(values: Float) -> tuple[float, float]:
    return float(values[0]), float(values[1])


def _one_color(color: tuple[int, int, int], count: int) -> Pixels:
    return np.tile(np.array(color, np.uint8), (count, 1))


def _edges(sides: Float) -> Float:
    """Points (n, 3) along the twelve edges of a box about its centre, and from there to the front."""
    parts = []
    for axis in range(3):
        share = np.linspace(-0.5, 0.5, max(2, math.ceil(sides[axis] / _BOX_STEP)))
        for one in (-0.5, 0.5):
            for other in (-0.5, 0.5):
                line = np.empty((len(share), 3))
                line[:, axis], line[:, axis - 2], line[:, axis - 1] = share, one, other
                parts.append(line)
    front = np.linspace(0.0, 0.5, max(2, math.ceil(sides[0] / _BOX_STEP)))
    parts.append(np.column_stack([front, np.zeros((len(front), 2))]))
    return np.concatenate(parts) * sides
