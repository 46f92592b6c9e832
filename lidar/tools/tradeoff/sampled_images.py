"""Errors of cameras in sampled frames against the reference."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from math import inf, nan

import numpy as np

from lidar.dataset.png import counts_to_depth, depth_to_counts
from lidar.options import PERCENTS
from lidar.sensors.camera.settings import CameraSettings
from lidar.sensors.rig.devices import Camera
from lidar.tools.tradeoff.errors import IMAGE_STATISTICS, ImageError, percentile
from lidar.tools.tradeoff.images import Pixels, blocks_of_frame, image_error, pixels
from lidar.tools.tradeoff.simulate import EXACT, FAST, Bench
from lidar.tools.tradeoff.variants import camera_basis


def image_errors_of(
    bench: Bench, camera: Camera, *, settings: Sequence[CameraSettings], blocks: int
) -> Iterator[list[ImageError]]:
    """Errors of each of some settings, frame by frame of those that a camera has in a bench.

    blocks : of pixels of each frame

    Depths are those of the files, rounded.
    """
    near, exposed = bench.plan.options.recording_settings.world, camera.spec.exposure_ns > 0
    exact = camera_basis(settings[0], exposed=exposed, world=near).exact
    for frame in bench.frames[camera.name]:
        shot = bench.shot(camera, frame)
        chosen = blocks_of_frame(camera.spec, blocks, frame=frame, seed=bench.plan.options.seed)
        whole = bench.world(camera, frame, backend=EXACT, settings=replace(near, origin="near", reach=inf))
        truth = pixels(shot, chosen, world=whole, settings=exact)
        world = bench.world(camera, frame, backend=FAST, settings=near)
        yield [
            image_error(
                _as_written(pixels(shot, chosen, world=world, settings=replace(one, camera_noise=False))),
                truth,
            )
            for one in settings
        ]


def _as_written(found: Pixels) -> Pixels:
    """The pixels with depths as files hold them."""
    return replace(found, depth=counts_to_depth(depth_to_counts(found.depth)))


def image_figures(frames: Sequence[ImageError], *, camera: Camera) -> dict[str, float]:
    """Rms of colours (``rgb_rms``) and metres that depths of shares of the pixels do not exceed.

    Of those images that the camera writes; NaN without a depth.
    """
    kinds, found = camera.spec.images, {}
    if "rgb" in kinds:
        found["rgb_rms"] = IMAGE_STATISTICS["rgb_rms"](frames)
    if "depth" in kinds:
        depth = np.concatenate([f.depth for f in frames])
        found |= {f"depth_{p:g}_m": percentile(depth, p / 100) if len(depth) else nan for p in PERCENTS}
    return found
