"""Rendered pictures of scenes, from above or obliquely."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from lidar.errors import InputError
from lidar.sensors.camera.render import render
from lidar.sensors.camera.settings import CameraSettings
from lidar.tools.maps.picture import PictureView, Pixels, camera_around, view_named
from lidar.world.world import World

AFTERNOON = (-0.52, -0.37, 0.77)
"""Direction towards a sun in the south-west, 50° above the horizon."""


def scene_picture(
    world: World,
    *,
    view: str | PictureView = "oblique",
    size: tuple[int, int] = (1600, 1000),
    bounds: tuple[float, float, float, float] | None = None,
    sun: ArrayLike = AFTERNOON,
    settings: CameraSettings = CameraSettings(supersample=2, haze=np.inf),  # noqa: B008 - frozen
) -> Pixels:
    """A rendered picture (h, w, 3) of a scene.

    view   : name in `VIEWS`, or a `PictureView`
    size   : width and height in pixels
    bounds : (xmin, ymin, xmax, ymax) to show, scene metres; the whole world by default
    sun    : (3,) direction towards the sun

    Raises InputError for an unknown view.
    """
    area = bounds or world.region or world.scene.bounds
    low, high = _heights(world, area)
    corners = np.array([[x, y, z] for x in area[0::2] for y in area[1::2] for z in (low, high)])
    camera, pose = camera_around(corners, view_named(view), size=size)
    picture = render(camera, pose, world=world, sun=sun, settings=settings).rgb
    if picture is None:
        raise InputError("the camera of a picture records colour")
    return picture


def _heights(world: World, area: tuple[float, float, float, float]) -> tuple[float, float]:
    """Lowest and 98th percentile height of the surfaces in an area, sampled on a grid of vertical rays."""
    x, y = np.meshgrid(np.linspace(area[0], area[2], 96), np.linspace(area[1], area[3], 96))
    top = 1e4
    origins = np.stack([x.ravel(), y.ravel(), np.full(x.size, top)], axis=1)
    hits = world.caster.cast(origins, np.broadcast_to([0.0, 0.0, -1.0], origins.shape))
    z = top - hits.range[np.isfinite(hits.range)]
    if not len(z):
        raise InputError(f"the scene has no surfaces within {area}")
    return float(z.min()), float(np.percentile(z, 98))
