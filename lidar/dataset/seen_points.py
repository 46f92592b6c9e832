"""Points of clouds in camera images: where a camera saw each, and what hid it."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.support.columns import Columns
from geoscene.typing import Bools, Float, Ints
from lidar.dataset.formats.table import Table, placed_returns
from lidar.dataset.ground_truth import COLUMNS, read_boxes
from lidar.dataset.layout import Dataset, reading_file
from lidar.dataset.png import counts_to_depth, read_png
from lidar.dataset.recorded import Stream, color_images
from lidar.geometry.poses import Trajectory
from lidar.sensors.rig.camera_model import exposure_times, project
from lidar.sensors.rig.specs import CameraSpec

_ROLLS = 5
"""Iterations for the row in which a rolling shutter sees a point."""
_NEAR = 0.1
"""Metres by which a point may be behind the surface that a pixel shows, and a share of its distance."""
_SHARE = 0.01
_FLAT = 0.02
"""Share by which inverse depths of neighbouring pixels on a plane may differ from a line."""
_OWN = (0.3, 0.05)
"""The same for surfaces that are known by the points of the cloud alone."""
_CELL = 2.0
"""Side of the cells in which the nearest point hides others, over the mean distance of points, pixels."""


@dataclass(frozen=True, slots=True)
class SceneReturns(Columns):
    """Returns of a scanner in the scene.

    place    : (n, 3) scene metres, at their times
    time_ns  : (n,) since the drive's start
    velocity : (n, 3) scene metres per second, of the road users that they are on
    """

    place: Float
    time_ns: Ints
    velocity: Float

    def at(self, time_ns: Ints) -> Float:
        """Positions (n, 3) of the surfaces of the returns at other times (n,); road users move straight."""
        moved: Float = self.place + self.velocity * ((time_ns - self.time_ns) * 1e-9)[:, None]
        return moved


@dataclass(frozen=True, slots=True)
class Sight:
    """Visible points of a point cloud in an image.

    pixel : (n, 2) columns and rows; NaN for points that the camera does not image
    depth : (n,) metres, as in depth images
    seen  : (n,) whether the point is in the image and nothing is before it
    """

    pixel: Float
    depth: Float
    seen: Bools

    @property
    def cell(self) -> tuple[Ints, Ints]:
        """Rows and columns of the pixels of the points that are seen."""
        u, v = np.rint(self.pixel[self.seen]).astype(np.int64).T
        return v, u


@dataclass(frozen=True)
class ImageView:
    """A camera with colour images of a dataset.

    images : its stream
    """

    dataset: Dataset
    camera: CameraSpec
    images: Stream

    @functools.cached_property
    def trajectory(self) -> Trajectory:
        """The vehicle's poses."""
        return self.dataset.trajectory()

    def nearest(self, time_ns: int) -> int:
        """Row of the image whose middle is nearest to a time."""
        middle = self.images.time_ns + self.camera.row_ns * self.camera.height // 2
        return int(np.abs(middle - time_ns).argmin())

    def color(self, row: int) -> NDArray[np.uint8]:
        """The image (h, w, 3) of a row."""
        path = self.dataset.frame_file(self.images.files[row])
        with reading_file(path):
            image = read_png(path)
            if image.shape != (self.camera.height, self.camera.width, 3):
                raise ValueError("another size than the camera's")
        return image.astype(np.uint8)

    def depth(self, row: int) -> NDArray[np.float32] | None:
        """The depth image (h, w) of a row in metres, infinite without a surface; None if not recorded."""
        frame = int(self.images.frames[row])
        path = self.dataset.frame_file(self.dataset.paths.image(self.camera.name, frame, kind="depth"))
        if not path.exists():
            return None
        with reading_file(path):
            counts = read_png(path)
            if counts.shape != (self.camera.height, self.camera.width) or counts.dtype != np.uint16:
                raise ValueError("no depth image of the camera")
        return counts_to_depth(counts.astype(np.uint16))

    def sight(self, returns: SceneReturns, row: int) -> Sight:
        """Projection of returns into an image, each at the time of the row of pixels that shows it.

        A return is hidden if the depth image shows a nearer surface there; without depth images, if another
        return of the cloud about there is nearer.
        """
        spec = self.camera
        times = exposure_times(spec, int(self.images.time_ns[row]), samples=1)
        poses = self.trajectory.at(times).mounted(spec.mount.translation, spec.mount.rotation)
        line = np.full(len(returns.place), len(times) // 2)
        for _ in range(_ROLLS if len(times) > 1 else 1):
            there = poses.take(line)
            local = there.seen(returns.at(times[line]))
            pixel, depth = project(spec, local)
            line = np.clip(np.rint(np.nan_to_num(pixel[:, 1])), 0, len(times) - 1).astype(np.int64)
        if spec.model == "fisheye":
            depth = np.linalg.norm(local, axis=1)
        u, v = pixel.T
        with np.errstate(invalid="ignore"):
            inside = (u > -0.5) & (v > -0.5) & (u < spec.width - 0.5) & (v < spec.height - 0.5)
        inside &= (depth >= spec.near) & (depth <= spec.far)
        seen = inside.copy()
        recorded = self.depth(row)
        rows = np.flatnonzero(inside)
        if recorded is not None:
            seen[rows] = _before(recorded, pixel[rows], depth=depth[rows])
        else:
            seen[rows] = _nearest_of_all(pixel[rows], depth[rows], size=(spec.width, spec.height))
        return Sight(pixel, depth, seen)


def _before(image: NDArray[np.float32], pixel: Float, *, depth: Float) -> Bools:
    """Whether points lie on the surface that a depth image (h, w) shows at their pixels, or before it.

    Across a plane the inverse depth is linear in the pixels: where it is, the surface falls off by half of
    its step to the next pixel within one.
    """
    height, width = image.shape
    u, v = np.rint(pixel).astype(np.int64).T
    inverse = np.where(np.isfinite(image), 1 / np.maximum(image.astype(float), _NEAR), 0.0)
    here, fall = inverse[v, u], np.zeros(len(u))
    for du, dv in ((1, 0), (0, 1)):
        before, after = (
            inverse[np.clip(v + s * dv, 0, height - 1), np.clip(u + s * du, 0, width - 1)] for s in (-1, 1)
        )
        plane = np.abs(before + after - 2 * here) <= _FLAT * here
        with np.errstate(invalid="ignore", divide="ignore"):
            fall += np.where(plane & (here > 0), np.abs(after - before) / (4 * here**2), 0.0)
    surface = np.divide(1.0, here, out=np.full(len(here), -np.inf), where=here > 0)
    known: Bools = depth <= surface + _NEAR + _SHARE * np.maximum(surface, 0) + fall
    return known


def _nearest_of_all(pixel: Float, depth: Float, *, size: tuple[int, int]) -> Bools:
    """Whether points are as near as the nearest one about their pixels."""
    if not len(pixel):
        return np.zeros(0, bool)
    side = max(_CELL * np.sqrt(size[0] * size[1] / len(pixel)), 1.0)
    wide = int(size[0] / side) + 1
    u, v = ((pixel + 0.5) / side).astype(np.int64).T
    cell = v * wide + u
    nearest = np.full(int(cell.max()) + 1, np.inf)
    np.minimum.at(nearest, cell, depth)
    near: Bools = depth <= nearest[cell] * (1 + _OWN[1]) + _OWN[0]
    return near


def views_of(dataset: Dataset) -> list[ImageView]:
    """The cameras of a dataset that have colour images."""
    streams = ((spec, color_images(dataset, spec.name)) for spec in dataset.rig().cameras)
    return [ImageView(dataset, spec, stream) for spec, stream in streams if stream is not None]


def returns_of(
    table: Table, trajectory: Trajectory, *, start_ns: int, mount: Float, motions: Mapping[int, Float]
) -> SceneReturns:
    """The returns of a recorded cloud in the scene.

    start_ns : of the frame
    mount    : (4, 4) vehicle_from_sensor
    motions  : velocities (3,) of road users by instance, see `motions_of`
    """
    placed, time_ns = placed_returns(table, trajectory, start_ns=start_ns, vehicle_from_sensor=mount)
    velocity = np.zeros((len(placed), 3))
    for instance, speed in motions.items():
        velocity[table["instance"] == instance] = speed
    return SceneReturns(placed, time_ns, velocity)


def motions_of(dataset: Dataset, name: str) -> dict[int, dict[int, Float]]:
    """Velocities (3,) of road users in scene metres per second, by frame of a scanner and instance."""
    path = dataset.paths.sensor_boxes(name)
    found: dict[int, dict[int, Float]] = {}
    if not path.exists():
        return found
    scale = float(dataset.trajectory().scale[0])
    box: dict[str, Any]
    for box in read_boxes(path, COLUMNS):
        if box["moving"]:
            speed = np.array([box["vx"], box["vy"], box["vz"]]) * [scale, scale, 1.0]
            found.setdefault(box["frame"], {})[box["instance"]] = speed
    return found
