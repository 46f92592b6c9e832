"""Attacks on cameras: light that blinds them, and patches on pictures or in the world."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from math import inf
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geoscene.errors import reason_of
from geoscene.typing import Float
from lidar.errors import InputError
from lidar.parameters import parameter
from lidar.sensors.camera.render import CameraImage
from lidar.sensors.camera.shade import linear_table, srgb_bytes
from lidar.sensors.rig.camera_model import pixel_rays
from lidar.sensors.rig.specs import CameraSpec
from lidar.signal.attacks.attacker import checked_digest
from lidar.signal.situation import Situation, degrees_of, point_of
from lidar.signal.stage import Stage

_TINTS = {
    "white": (1.0, 1.0, 1.0),
    "red": (1.0, 0.06, 0.02),
    "green": (0.1, 1.0, 0.05),
    "blue": (0.1, 0.2, 1.0),
}
"""Shares of red, green and blue of a lamp or a laser as a camera sees it; of lasers typical values."""

_SQUARES = 8
"""Squares along a side of the patch that is used without a file."""


@dataclass(frozen=True)
class CameraBlind(Stage):
    """A lamp or a laser shines into cameras: saturation around it, and veiling glare.

    Budget: power and direction. Light that is scattered in the lens falls with the square of the angle from
    the lamp (Stiles and Holladay's law of veiling glare).
    """

    power: float = parameter(100.0, "light at its middle over the camera's full scale", low=0, high=1e9)
    core: float = parameter(
        0.5, "angle from it at which the light has fallen to a half", unit="degrees", low=0.01, high=90
    )
    right: float = parameter(
        0.0, "angle to the right of the optical axis", unit="degrees", low=-180, high=180
    )
    up: float = parameter(0.0, "angle above it", unit="degrees", low=-90, high=90)
    tint: str = parameter("white", "colour", among=(*_TINTS,))
    start: float = parameter(0.0, "time since the drive's start from which it shines", unit="s", low=0)
    stop: float = parameter(
        inf, "time since the drive's start until which it shines", unit="s", low=0, endless="never"
    )

    def image(self, frame: CameraImage, *, at: Situation, rng: np.random.Generator) -> CameraImage:
        """The frame with the light added."""
        del rng
        if frame.rgb is None or at.camera is None or not self.start <= at.start_ns / 1e9 < self.stop:
            return frame
        right, up = np.radians(self.right), np.radians(self.up)
        lamp = np.array([np.sin(right) * np.cos(up), -np.sin(up), np.cos(right) * np.cos(up)])
        cosine = np.clip(np.nan_to_num(pixel_rays(at.camera) @ lamp, nan=-1.0), -1, 1)
        angle = np.degrees(np.arccos(cosine)).reshape(frame.rgb.shape[:2])
        glare = self.power * self.core**2 / (angle**2 + self.core**2)
        light = linear_table()[frame.rgb] + glare[:, :, None] * _TINTS[self.tint]
        return replace(frame, rgb=srgb_bytes(light))


@dataclass(frozen=True)
class Patch(Stage):
    """A picture is pasted on images, or hung up in the world, where nearer surfaces hide it.

    Budget: its size. In the world it has a fixed place and faces a direction, or it moves along with the
    camera and faces it.
    """

    file: str = parameter("", "picture (PNG, JPEG); a chequerboard by default")
    digest: str = parameter("", "of the picture's file, which the program fills in; another one is refused")
    on: str = parameter("image", "pasted on the image, or in the world", among=("image", "world"))
    x: float = parameter(0.5, "of its middle: share of the image's width from the left", low=0, high=1)
    y: float = parameter(0.6, "of its middle: share of the image's height from the top", low=0, high=1)
    size: float = parameter(0.2, "share of the image's width that it covers", low=0.001, high=1)
    place: str = parameter(
        "", "in the world: LAT,LON,HEIGHT of its middle above the ground; empty: moves along"
    )
    facing: float = parameter(
        0.0, "of a place: direction, clockwise from north", unit="degrees", low=-360, high=360
    )
    ahead: float = parameter(
        10.0, "without place: distance in front of the camera", unit="m", low=0.2, high=500
    )
    left: float = parameter(0.0, "without place: distance to its left", unit="m", low=-500, high=500)
    up: float = parameter(0.0, "without place: height above it", unit="m", low=-500, high=500)
    wide: float = parameter(1.0, "in the world: its width", unit="m", low=0.01, high=100)
    start: float = parameter(0.0, "time since the drive's start from which it is there", unit="s", low=0)
    stop: float = parameter(
        inf, "time since the drive's start until which it is there", unit="s", low=0, endless="never"
    )

    def __post_init__(self) -> None:
        """Validate the parameters; the picture must be readable."""
        super().__post_init__()
        _picture(self.file)
        object.__setattr__(self, "digest", checked_digest(self.file, known=self.digest))
        if self.place:
            degrees_of(self.place)

    @property
    def image_kinds(self) -> tuple[str, ...]:
        """The depth image, from which occlusion of a patch in the world is computed."""
        return ("depth",) if self.on == "world" else ()

    def image(self, frame: CameraImage, *, at: Situation, rng: np.random.Generator) -> CameraImage:
        """The frame with the patch."""
        del rng
        if frame.rgb is None or at.camera is None or not self.start <= at.start_ns / 1e9 < self.stop:
            return frame
        picture = _picture(self.file)
        high = picture.shape[0] / picture.shape[1]
        if self.on == "image":
            u, v = self._on_image(frame, high=high)
        else:
            u, v = self._in_world(frame, camera=at.camera, at=at, high=high)
        shown = (u >= 0) & (u <= 1) & (v >= 0) & (v <= 1)
        rgb = frame.rgb.copy()
        rgb[shown] = _sample(picture, u=u[shown], v=v[shown])
        return replace(frame, rgb=rgb)

    def _on_image(self, frame: CameraImage, *, high: float) -> tuple[Float, Float]:
        """Coordinates (h, w) from 0 to 1 on the patch, from its left and its top."""
        assert frame.rgb is not None  # noqa: S101
        rows, columns = np.indices(frame.rgb.shape[:2]).astype(float)
        height, width = frame.rgb.shape[:2]
        side = self.size * width
        return (
            (columns + 0.5 - self.x * width) / side + 0.5,
            (rows + 0.5 - self.y * height) / (side * high) + 0.5,
        )

    def _in_world(
        self, frame: CameraImage, *, camera: CameraSpec, at: Situation, high: float
    ) -> tuple[Float, Float]:
        """As `_on_image`, for the pixels' rays in the world; NaN where they miss the plane."""
        middle, right, up = self._plane(at)
        normal = np.cross(right, up)
        rays = pixel_rays(camera)
        slope = rays @ normal
        with np.errstate(divide="ignore", invalid="ignore"):
            away = (middle @ normal) / slope
        met = rays * away[:, None] - middle
        depth = (away if camera.model == "fisheye" else away * rays[:, 2]).reshape(frame.depth.shape)
        visible = (away > 0).reshape(depth.shape) & (slope < 0).reshape(depth.shape) & (depth < frame.depth)
        u = 0.5 + (met @ right).reshape(depth.shape) / self.wide
        v = 0.5 - (met @ up).reshape(depth.shape) / (self.wide * high)
        return np.where(visible, u, np.nan), np.where(visible, v, np.nan)

    def _plane(self, at: Situation) -> tuple[Float, Float, Float]:
        """Centre, right and up vectors (3,) of the patch as a viewer sees it, in the camera frame."""
        if not self.place:
            return np.array([-self.left, -self.up, self.ahead]), np.array([1.0, 0, 0]), np.array([0, -1.0, 0])
        if at.poses is None or at.geo is None:
            raise InputError("`place` needs a dataset with poses; give `ahead`, `left` and `up` instead")
        pose = at.poses(np.array([at.start_ns]))
        turn, facing = pose.rotation[0], np.radians(self.facing)
        middle = (point_of(self.place, geo=at.geo, at=at) - pose.position[0]) / pose.scale[0]
        right = np.array([-np.cos(facing), np.sin(facing), 0.0])  # seen by who looks against the facing
        return middle @ turn, right @ turn, np.array([0.0, 0.0, 1.0]) @ turn


@functools.lru_cache(maxsize=4)
def _picture(file: str) -> NDArray[np.uint8]:
    """Colours (h, w, 3) of a picture; of a chequerboard without a file."""
    if not file:
        squares = np.indices((_SQUARES, _SQUARES)).sum(axis=0) % 2
        return np.repeat((255 * squares)[:, :, None], 3, axis=2).astype(np.uint8)
    from PIL import Image  # noqa: PLC0415

    try:
        with Image.open(Path(file)) as picture:
            return np.asarray(picture.convert("RGB"))
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise InputError(f"file = {file!r} cannot be read as a picture ({reason_of(error)})") from None


def _sample(picture: NDArray[np.uint8], *, u: Float, v: Float) -> NDArray[np.uint8]:
    """Colours (k, 3) of the nearest pixels of a picture at coordinates from 0 to 1."""
    height, width = picture.shape[:2]
    row = np.minimum((v * height).astype(np.int64), height - 1)
    column = np.minimum((u * width).astype(np.int64), width - 1)
    chosen: NDArray[np.uint8] = picture[row, column]
    return chosen
