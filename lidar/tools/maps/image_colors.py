"""Colours of returns from the camera images of a drive: of the image nearest in time that shows them."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from geoscene.typing import Bools, Float
from lidar.dataset.formats.table import Table
from lidar.dataset.layout import Dataset
from lidar.dataset.seen_points import motions_of, returns_of, views_of
from lidar.errors import DatasetError

_AFTER_NS = (0, -500_000_000, 500_000_000, -1_000_000_000, 1_000_000_000, 2_000_000_000, -2_000_000_000)
"""Times, from a sweep's middle, of the images in which returns are sought, in order."""
_IMAGES = 16
"""Images that are kept in memory."""


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
