"""Colours for points: by class, height, intensity or sensor, and of the camera images nearest in time."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geoscene.typing import Bools, Float
from lidar.dataset.formats.table import Table
from lidar.dataset.layout import Dataset
from lidar.dataset.seen_points import motions_of, returns_of, views_of
from lidar.errors import DatasetError

# Ten anchors of viridis (Smith and van der Walt, released as CC0), evenly spaced.
_VIRIDIS = np.array(
    [
        (68, 1, 84), (72, 40, 120), (62, 74, 137), (49, 104, 142), (38, 130, 142),
        (31, 158, 137), (53, 183, 121), (109, 205, 89), (180, 222, 44), (253, 231, 37),
    ],
    float,
)  # fmt: skip

# The palette of Okabe and Ito: eight colours that colour-blind people can tell apart.
_DISTINCT = np.array(
    [
        (230, 159, 0), (86, 180, 233), (0, 158, 115), (240, 228, 66),
        (0, 114, 178), (213, 94, 0), (204, 121, 167), (0, 0, 0),
    ],
    np.uint8,
)  # fmt: skip
_AFTER_NS = (0, -500_000_000, 500_000_000, -1_000_000_000, 1_000_000_000, 2_000_000_000, -2_000_000_000)
"""Times, from a sweep's middle, of the images in which returns are sought, in order."""

_IMAGES = 16
"""Images that are kept in memory."""


def ramp(values: ArrayLike, low: float, *, high: float) -> NDArray[np.uint8]:
    """Colours (..., 3) of values between ``low`` (violet) and ``high`` (yellow); clipped outside."""
    share = np.clip((np.asarray(values, float) - low) / max(high - low, 1e-12), 0.0, 1.0)
    at = share * (len(_VIRIDIS) - 1)
    steps = np.arange(len(_VIRIDIS))
    channels = [np.interp(at, steps, _VIRIDIS[:, k]) for k in range(3)]
    rgb: NDArray[np.uint8] = np.rint(np.stack(channels, axis=-1)).astype(np.uint8)
    return rgb


def distinct(index: ArrayLike) -> NDArray[np.uint8]:
    """Colours (..., 3) of small integers; they repeat after eight."""
    rgb: NDArray[np.uint8] = _DISTINCT[np.asarray(index) % len(_DISTINCT)]
    return rgb


class ImageColors:
    """Colours of the returns of a drive.

    Raises DatasetError for a drive without colour images.
    """

    def __init__(self, dataset: Dataset) -> None:
        self._views = views_of(dataset)
        if not self._views:
            raise DatasetError(
                f"{dataset.path}: no colour images, which `color` image takes; drive with a rig of cameras"
            )
        self._dataset, self._trajectory = dataset, dataset.trajectory()
        self._motions: dict[str, dict[int, dict[int, Float]]] = {}
        self._image = lru_cache(_IMAGES)(lambda view, row: self._views[view].color(row))

    def of(
        self, table: Table, name: str, *, frame: int, start_ns: int, mount: Float
    ) -> tuple[NDArray[np.uint8], Bools]:
        """Colours (n, 3) of the returns of a cloud in the sensor frame, and whether a camera saw each.

        name, frame : of the scanner's cloud
        start_ns    : of the frame
        mount       : (4, 4) vehicle_from_sensor

        Returns on moving road users take the nearest image only.
        """
        if name not in self._motions:
            self._motions[name] = motions_of(self._dataset, name)
        motions = self._motions[name].get(frame, {})
        returns = returns_of(table, self._trajectory, start_ns=start_ns, mount=mount, motions=motions)
        color = np.zeros((len(returns.place), 3), np.uint8)
        known = np.zeros(len(color), bool)
        moving = (returns.velocity != 0).any(axis=1)
        middle = int(returns.time_ns.mean()) if len(color) else start_ns
        tried: set[tuple[int, int]] = set()
        for after in _AFTER_NS:
            for number, view in enumerate(self._views):
                row = view.nearest(middle + after)
                missing = np.flatnonzero(~known & ~(moving & (after != 0)))
                if (number, row) in tried or not len(missing):
                    continue
                tried.add((number, row))
                sight = view.sight(returns.take(missing), row)
                seen = missing[sight.seen]
                color[seen] = self._image(number, row)[sight.cell]
                known[seen] = True
        return color, known
