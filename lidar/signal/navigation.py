"""Stages on the measurements of receivers and inertial units, and the truth about their changes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from lidar.errors import LidarError
from lidar.sensors.navigation.gnss import gnss_columns
from lidar.sensors.navigation.imu import imu_columns
from lidar.sensors.navigation.measurements import Fixes, Inertial
from lidar.signal.registry import Stages
from lidar.signal.situation import Situation
from lidar.signal.stage import FixesStage, SamplesStage


def altered_fixes(fixes: Fixes, stages: Stages, *, at: Situation) -> Fixes:
    """The fixes of a receiver after the stages on them; ground truth stays."""
    found = fixes
    for named in stages.at("fixes", at.sensor):
        rng = named.rng(stages.seed, at.sensor, frame=at.frame)
        before, found = found, cast("FixesStage", named.stage).fixes(found, at=at, rng=rng)
        if len(found) != len(fixes):
            raise LidarError(f"stage {named.name} returned {len(found)} of {len(fixes)} fixes")
        if at.effects is not None:
            at.effects.add(named.label, {"fixes changed": fixes_truth(found, before)["changed"].sum()})
    truth = {name: getattr(fixes, name) for name in ("error", "true_lonlath", "true_velocity")}
    return replace(found, **truth)


def altered_samples(samples: Inertial, stages: Stages, *, at: Situation) -> Inertial:
    """The samples of an inertial unit after the stages on them; ground truth stays."""
    found = samples
    for named in stages.at("samples", at.sensor):
        rng = named.rng(stages.seed, at.sensor, frame=at.frame)
        before, found = found, cast("SamplesStage", named.stage).samples(found, at=at, rng=rng)
        if len(found) != len(samples):
            raise LidarError(f"stage {named.label} returned {len(found)} of {len(samples)} samples")
        if at.effects is not None:
            at.effects.add(named.label, {"samples changed": samples_truth(found, before)["changed"].sum()})
    return replace(found, true_gyro=samples.true_gyro, true_accel=samples.true_accel)


def fixes_truth(
    fixes: Fixes, original: Fixes, *, past: Mapping[str, NDArray[Any]] | None = None
) -> dict[str, NDArray[Any]]:
    """Columns of the truth file of a receiver, see `_truth`.

    past : columns of the truth file of ``original``, if stages changed that already
    """
    return _truth(gnss_columns(fixes), gnss_columns(original) | dict(past or {}))


def samples_truth(
    samples: Inertial, original: Inertial, *, past: Mapping[str, NDArray[Any]] | None = None
) -> dict[str, NDArray[Any]]:
    """Columns of the truth file of an inertial unit, as of `fixes_truth`."""
    return _truth(imu_columns(samples), imu_columns(original) | dict(past or {}))


def _truth(altered: dict[str, NDArray[Any]], original: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """``changed`` (n,), 1 where a measurement differs, and the measurements as without stages."""
    before = {name: column for name, column in original.items() if not name.startswith("true_")}
    changed = np.zeros(len(before["time_ns"]), bool)
    for name, column in before.items():
        missing = np.isnan(altered[name]) & np.isnan(column)  # no fix, before and after
        changed |= (altered[name] != column) & ~missing
    return {"changed": changed.astype(np.int8), **before}
