"""Runs stages on frames and measurements, and records the ground truth of their changes."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from geoscene.typing import Float
from lidar.errors import LidarError
from lidar.geometry.random_streams import generator
from lidar.sensors.laser.cloud import Cloud, TracedCloud
from lidar.sensors.laser.scan import Sweep, detect, deviates_of, report
from lidar.sensors.navigation.measurements import Fixes, Inertial
from lidar.sensors.physics.detector import added_noise
from lidar.sensors.physics.echoes import Echoes, TracedEchoes, mix, trace
from lidar.sensors.physics.origin import Origin
from lidar.signal.registry import Stages
from lidar.signal.situation import Situation, row_changes
from lidar.signal.stage import Pulses, pulses_of
from lidar.signal.truth import Altered, fixes_truth, image_truth, samples_truth

if TYPE_CHECKING:
    from lidar.sensors.camera.render import CameraImage

T = TypeVar("T")
Rows = TypeVar("Rows", Fixes, Inertial)

_FALSE_KINDS = 3  # kinds of false echoes, each at most one per pulse


def altered_sweep(sweep: Sweep, stages: Stages, *, at: Situation) -> Altered:
    """The point cloud of a sweep after the stages on its echoes and on the cloud."""
    m = len(sweep.echoes)
    noise = _RepeatedNoise(sweep)
    echoes = trace(sweep.echoes, Origin.SURFACE, source=np.arange(m))
    first = last = detect(sweep, echoes, deviates=noise.first)
    original = report(sweep, first)
    before = stages.at("echoes", at.sensor)
    if before:
        noise_added = added_noise(sweep.sensor, sweep.settings)
        pulses = pulses_of(sweep.sensor, sweep.sent, noise=noise_added)
        echoes = altered_echoes(pulses, echoes, stages=stages, at=at, extinction=sweep.settings.extinction)
        last = detect(sweep, echoes, deviates=noise.again)
    reported, unaltered = cast("TracedEchoes", last.echoes), cast("TracedEchoes", first.echoes)
    cloud = link_truth(report(sweep, last) if before else original, reported, first=unaltered)
    return Altered(altered_cloud(cloud, stages, at=at), original)


def altered_echoes(
    pulses: Pulses, echoes: TracedEchoes, *, stages: Stages, at: Situation, extinction: float = 0.0
) -> TracedEchoes:
    """Echoes after the stages on them, sorted by pulse and range.

    Echoes within the sensor's echo separation are merged in pulses that have added or moved ones.

    extinction : of the air, 1/m one way, beside that of the stages
    """
    in_between = [*(s for s in stages.before if s.sensor in ("", at.sensor)), *stages.at("echoes", at.sensor)]

    def clearness(row: int, distance: float) -> float:
        shares = [one.stage.clearness(pulses, row, distance=distance, at=at) for one in in_between]
        return math.exp(-extinction * distance) * math.prod(shares)

    def fault(found: TracedEchoes) -> str:
        fired = not len(found) or 0 <= found.pulse.min() <= found.pulse.max() < len(pulses)
        return "" if fired else "echoes of pulses that were not fired"

    situation = replace(at, clearness=clearness)
    changes = partial(row_changes, unit="echoes", columns=("range", "apparent"))
    echoes = _altered(
        echoes, stages, seam="echoes", at=situation, changes=changes, pulses=(pulses,), fault=fault
    )
    is_new = (echoes.source < 0) | (echoes.origin == Origin.MOVED)
    return mix(echoes, is_new, pulses=len(pulses), separation=pulses.sensor.echo_separation)


def link_truth(cloud: Cloud, echoes: TracedEchoes, *, first: TracedEchoes) -> TracedCloud:
    """A cloud with the truth of its returns against those of the original cloud.

    echoes : of the returns of ``cloud``
    first  : of the returns of the original cloud
    """
    row = np.full(max(first.source.max(initial=-1), echoes.source.max(initial=-1)) + 2, -1, np.int32)
    row[first.source] = np.arange(len(first))
    source = row[echoes.source]
    lost = _others(source, len(first))
    hidden = np.full(len(cloud), -1, np.int32)
    if len(lost):
        at = np.minimum(np.searchsorted(first.pulse[lost], echoes.pulse), len(lost) - 1)
        hides = (source < 0) & (first.pulse[lost[at]] == echoes.pulse)
        hidden[hides] = lost[at[hides]]
    added: list[Any] = [echoes.origin, source, hidden]
    return TracedCloud(cloud.start_ns, *cloud.columns().values(), *added)


def _others(rows: NDArray[np.integer], count: int) -> NDArray[np.int64]:
    """Rows below ``count`` that are not among the given rows; negative ones are ignored."""
    is_other = np.ones(count, bool)
    is_other[rows[rows >= 0]] = False
    return np.flatnonzero(is_other)


def altered_cloud(cloud: TracedCloud, stages: Stages, *, at: Situation) -> TracedCloud:
    """A cloud after the stages on it."""
    changes = partial(row_changes, unit="returns", columns=("xyz", "intensity"))
    cloud = _altered(cloud, stages, seam="cloud", at=at, changes=changes)
    moved = (cloud.origin == Origin.MOVED) & (cloud.hidden < 0)
    return replace(cloud, hidden=np.where(moved, cloud.source, cloud.hidden))


def altered_image(image: CameraImage, stages: Stages, *, at: Situation) -> CameraImage:
    """An image with colours after the stages on it; depth and labels stay."""

    def changes(before: CameraImage, after: CameraImage) -> dict[str, int]:
        return {"images changed": int(image_truth(after, before)["changed"].any())}

    return replace(image, rgb=_altered(image, stages, seam="image", at=at, changes=changes).rgb)


def altered_fixes(fixes: Fixes, stages: Stages, *, at: Situation) -> Fixes:
    """The fixes of a receiver after the stages on them; ground truth stays."""
    found = _altered_rows(fixes, stages, seam="fixes", at=at, truth=fixes_truth)
    return replace(
        found, **{name: getattr(fixes, name) for name in ("error", "true_lonlath", "true_velocity")}
    )


def altered_samples(samples: Inertial, stages: Stages, *, at: Situation) -> Inertial:
    """The samples of an inertial unit after the stages on them; ground truth stays."""
    found = _altered_rows(samples, stages, seam="samples", at=at, truth=samples_truth)
    return replace(found, true_gyro=samples.true_gyro, true_accel=samples.true_accel)


def _altered_rows(
    rows: Rows,
    stages: Stages,
    *,
    seam: str,
    at: Situation,
    truth: Callable[[Rows, Rows], Mapping[str, NDArray[Any]]],
) -> Rows:
    """Measurements after the stages on their seam, which is also what they are called."""

    def changes(before: Rows, after: Rows) -> dict[str, int]:
        return {f"{seam} changed": int(truth(after, before)["changed"].sum())}

    def fault(found: Rows) -> str:
        return "" if len(found) == len(rows) else f"{len(found)} of {len(rows)} {seam}"

    return _altered(rows, stages, seam=seam, at=at, changes=changes, fault=fault)


def _altered(
    data: T,
    stages: Stages,
    *,
    seam: str,
    at: Situation,
    changes: Callable[[T, T], Mapping[str, int]],
    pulses: tuple[Pulses, ...] = (),
    fault: Callable[[T], str] = lambda _: "",
) -> T:
    """Data after the stages on a seam.

    changes : what a stage changed, from the data before and after it
    pulses  : of echoes; none of other data
    fault   : what is wrong with the data that a stage returned; empty for nothing
    """
    for named in stages.at(seam, at.sensor):
        rng = named.rng(stages.seed, at.sensor, frame=at.frame)
        before, data = data, getattr(named.stage, seam)(*pulses, data, at=at, rng=rng)
        if found := fault(data):
            raise LidarError(f"stage {named.label} returned {found}")
        if at.effects is not None:
            at.effects.add(named.label, changes(before, data))
    return data


class _RepeatedNoise:
    """Noise of a detector that stays the same for an echo when stages add or remove others."""

    def __init__(self, sweep: Sweep) -> None:
        self._sweep, self._draw = sweep, deviates_of(sweep)
        self._known: dict[str, Float] = {}

    def first(self, purpose: str, echoes: Echoes) -> Float:
        """Draw for the unaltered echoes."""
        sweep, drawn = self._sweep, self._draw(purpose, echoes)
        known = np.full(len(sweep.echoes) + _FALSE_KINDS * len(sweep.firings) + 1, np.nan)
        known[cast("TracedEchoes", echoes).source] = drawn
        self._known[purpose] = known
        return drawn

    def again(self, purpose: str, echoes: Echoes) -> Float:
        """The same random numbers for the same echoes, and others for added ones."""
        sweep = self._sweep
        rng = generator(sweep.seed, sweep.sensor.name, sweep.frame, purpose, "altered")
        known = self._known[purpose][cast("TracedEchoes", echoes).source]
        return np.where(np.isnan(known), rng.standard_normal(len(echoes)), known)
