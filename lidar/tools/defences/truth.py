"""Ground truth that verdicts are scored against; defences never see it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geoscene.support.untrusted import read_arrays
from geoscene.typing import Float
from lidar.dataset.layout import Dataset, reading_file
from lidar.errors import DatasetError
from lidar.sensors.physics.origin import Origin
from lidar.signal.registry import ATTACKS, acts_on

FORGED = (Origin.INJECTED, Origin.REPLAYED, Origin.MOVED)
"""Origins of returns that an attack adds or moves."""

FORGED_SHARE = 0.5
"""Share of a box's returns from which on attacked ones make it a forged object."""


@dataclass(frozen=True, slots=True)
class FrameTruth:
    """Ground truth of the attacks on a frame.

    returns     : (n,) bool, returns that an attack gave
    removed_xyz : (k, 3) metres, sensor frame: genuine returns that are missing
    """

    returns: NDArray[np.bool_]
    removed_xyz: Float

    @property
    def attacked(self) -> bool:
        """Whether the frame differs from what the sensor measured."""
        return bool(self.returns.any()) or len(self.removed_xyz) > 0

    def objects(self, members: Sequence[NDArray[np.intp]]) -> NDArray[np.bool_]:
        """Whether each box (m,), of which the rows of its returns are given, is forged."""
        return np.array(
            [len(rows) > 0 and self.returns[rows].mean() >= FORGED_SHARE for rows in members], bool
        )


def attack_truth(dataset: Dataset, sensor: str, *, frame: int, count: int, seconds: float) -> FrameTruth:
    """As `frame_truth`; returns that are missing count only while an attack on the sensor's returns goes on.

    Weather, lost packets and dirt take returns, too, and are no attacks.

    seconds : of the frame's start since the drive's start
    """
    truth = frame_truth(dataset, sensor, frame=frame, count=count)
    recipe = dataset.manifest["recipe"]
    with reading_file(dataset.paths.manifest):
        stages = [table for key in ("stages", "applied_stages") for table in recipe.get(key, ())]
        goes_on = any(
            table["name"] in ATTACKS
            and acts_on(table, sensor, kind="lidar")
            and table["start"] <= seconds < table["stop"]
            for table in stages
        )
    return truth if goes_on else replace(truth, removed_xyz=truth.removed_xyz[:0])


def frame_truth(dataset: Dataset, sensor: str, *, frame: int, count: int) -> FrameTruth:
    """The truth of a frame with ``count`` returns; without a truth file nothing was changed.

    Returns that weather hid are not counted as missing.

    Raises DatasetError for a truth file that is damaged or of another cloud.
    """
    path = dataset.paths.truth(sensor, frame)
    if not path.exists():
        return FrameTruth(np.zeros(count, bool), np.empty((0, 3)))
    origin, hidden, removed, xyz = _read(path)
    if len(origin) != count:
        raise DatasetError(f"{path}: is of {len(origin)} returns, the cloud has {count}")
    by_weather = hidden[(origin == Origin.WEATHER) & (hidden >= 0)]
    missing = ~np.isin(removed, by_weather)
    return FrameTruth(np.isin(origin, FORGED), xyz[missing])


def _read(path: Path) -> tuple[NDArray[np.uint8], NDArray[np.int32], NDArray[np.int32], Float]:
    with reading_file(path):
        file = read_arrays(path)
        xyz = file["removed_xyz"].astype(np.float64).reshape(-1, 3)
        return file["origin"], file["hidden"], file["removed"], xyz
