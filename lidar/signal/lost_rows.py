"""Rows of camera images that are lost in transmission."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lidar.parameters import parameter
from lidar.sensors.camera.render import CameraImage
from lidar.signal.situation import Situation
from lidar.signal.stage import Stage


@dataclass(frozen=True)
class LostRows(Stage):
    """Bands of image rows are lost on the link from the camera and stay black."""

    loss: float = parameter(0.01, "probability that a band is lost", low=0, high=1)
    rows: int = parameter(8, "image rows a band", low=1, high=100_000)

    def image(self, frame: CameraImage, *, at: Situation, rng: np.random.Generator) -> CameraImage:
        """The frame with its lost bands black; depth and labels stay."""
        del at
        rgb = frame.rgb
        assert rgb is not None  # noqa: S101
        bands = -(-len(rgb) // self.rows)
        lost = np.repeat(rng.random(bands) < self.loss, self.rows)[: len(rgb)]
        return replace(frame, rgb=np.where(lost[:, None, None], np.uint8(0), rgb))
