"""Images of a drive's frames, whole or some blocks of their pixels, as settings render them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from geoscene.support.columns import Columns
from geoscene.typing import Float, Ints
from lidar.geometry.poses import Trajectory
from lidar.sensors.camera.render import CameraImage, render
from lidar.sensors.camera.settings import CameraSettings
from lidar.sensors.camera.signal_lamps import Lamps
from lidar.sensors.rig.camera_model import exposure_times
from lidar.sensors.rig.devices import Camera
from lidar.sensors.rig.specs import CameraSpec
from lidar.tools.tradeoff.errors import ImageError
from lidar.world.world import World

BLOCK = 4
"""Pixels along each side of the blocks that are compared: one of the lowest resolution."""

_STEPS = (0.7548776662466927, 0.5698402909980532)
"""Steps along columns and rows of the R2 sequence of low discrepancy: powers of the plastic number."""


@dataclass(frozen=True, slots=True)
class Shot:
    """A frame of a camera.

    sun   : (3,) direction towards the sun, scene axes
    lamps : signal heads that are lit
    """

    camera: Camera
    frame: int
    trajectory: Trajectory
    sun: Float
    lamps: Lamps | None = None


@dataclass(frozen=True, slots=True)
class Pixels(Columns):
    """Blocks of a frame: rgb (n, b, b, 3) uint8, depth (n, b, b) metres, klass (n, b, b) uint8."""

    rgb: NDArray[np.uint8]
    depth: NDArray[np.float32]
    klass: NDArray[np.uint8]

    def equals(self, other: Pixels) -> bool:
        """Whether all pixels are the same."""
        return all(
            np.array_equal(getattr(self, name), getattr(other, name)) for name in ("rgb", "depth", "klass")
        )

    def enlarged(self, factor: int) -> Pixels:
        """Each pixel repeated ``factor`` times along both sides."""
        return Pixels(
            self.rgb.repeat(factor, axis=1).repeat(factor, axis=2),
            self.depth.repeat(factor, axis=1).repeat(factor, axis=2),
            self.klass.repeat(factor, axis=1).repeat(factor, axis=2),
        )


def coarse(camera: CameraSpec, resolution: int) -> CameraSpec:
    """The same camera with one pixel for each square of ``resolution`` pixels' side."""
    return replace(
        camera,
        width=camera.width // resolution,
        height=camera.height // resolution,
        fx=camera.fx / resolution,
        fy=camera.fy / resolution,
        cx=(camera.cx + 0.5) / resolution - 0.5,
        cy=(camera.cy + 0.5) / resolution - 0.5,
        row_ns=camera.row_ns * resolution,
    )


def image(shot: Shot, *, world: World, settings: CameraSettings, resolution: int = 1) -> CameraImage:
    """The whole frame."""
    return _render(shot, coarse(shot.camera.spec, resolution), world=world, settings=settings)


def blocks_of_frame(camera: CameraSpec, count: int, *, frame: int, seed: int) -> Ints:
    """Columns and rows (n, 2) of the top left pixels of at most ``count`` blocks, spread evenly over a frame.

    No square twice as wide as their mean distance is without one: rare effects are met in their share.
    """
    across, down = camera.width // BLOCK, camera.height // BLOCK
    row, column = np.divmod(np.arange(across * down), across)
    start = np.random.default_rng([seed, frame]).random()
    order = np.argsort((start + column * _STEPS[0] + row * _STEPS[1]) % 1.0, kind="stable")
    chosen = np.sort(order[:count])
    return (BLOCK * np.column_stack([column[chosen], row[chosen]])).astype(np.int64)


def pixels(
    shot: Shot, blocks: Ints, *, world: World, settings: CameraSettings, resolution: int = 1
) -> Pixels:
    """Blocks of a frame, of its coarse camera: ``BLOCK / resolution`` pixels wide."""
    spec, size = coarse(shot.camera.spec, resolution), BLOCK // resolution
    # Whether a pixel is at an edge depends on its neighbours.
    beside = int(settings.edge_rays > settings.supersample)
    rgb, depth, klass = [], [], []
    for left, top in (blocks // resolution).tolist():
        x, y = max(left - beside, 0), max(top - beside, 0)
        width = min(left + size + beside, spec.width) - x
        height = min(top + size + beside, spec.height) - y
        window = replace(spec, width=width, height=height, cx=spec.cx - x, cy=spec.cy - y)
        frame = _render(shot, window, world=world, settings=settings, top=y)
        own = np.s_[top - y : top - y + size, left - x : left - x + size]
        rgb.append(np.zeros((size, size, 3), np.uint8) if frame.rgb is None else frame.rgb[own])
        depth.append(frame.depth[own])
        klass.append(frame.klass[own])
    return Pixels(np.stack(rgb), np.stack(depth), np.stack(klass))


def _render(
    shot: Shot, spec: CameraSpec, *, world: World, settings: CameraSettings, top: int = 0
) -> CameraImage:
    """A frame of a camera, or of the part of it that begins at its row ``top``."""
    start = shot.camera.frame_start_ns(shot.frame)
    times = exposure_times(spec, start + top * spec.row_ns, samples=settings.moments(spec))
    mount = spec.mount
    return render(
        spec,
        shot.trajectory.at(times).mounted(mount.translation, mount.rotation),
        world=world,
        sun=shot.sun,
        lamps=shot.lamps,
        times=np.clip((times - start) / shot.camera.period_ns, 0.0, 1.0),
        options=settings.options(spec),
    )


def image_error(found: Pixels, exact: Pixels) -> ImageError:
    """Differences between the same pixels."""
    levels = np.abs(found.rgb.astype(np.int16) - exact.rgb.astype(np.int16)).ravel()
    here, there = np.isfinite(found.depth), np.isfinite(exact.depth)
    both = here & there
    depth = found.depth[both].astype(np.float64) - exact.depth[both]
    return ImageError(
        np.bincount(levels, minlength=256),
        np.abs(depth),
        missing=int(np.count_nonzero(here != there)),
        changed=int(np.count_nonzero(found.klass != exact.klass)),
        pixels=both.size,
    )
