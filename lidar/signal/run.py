"""Runs stages on a frame and records the ground truth of their changes."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray

from geoscene.support.files import write_atomically
from geoscene.typing import Float
from lidar.errors import LidarError
from lidar.geometry.random_streams import generator
from lidar.sensors.laser.cloud import Cloud, TracedCloud
from lidar.sensors.laser.scan import Sweep, detect, deviates_of, report
from lidar.sensors.physics.detector import added_noise
from lidar.sensors.physics.echoes import Echoes, TracedEchoes, mix, trace
from lidar.sensors.physics.origin import Origin
from lidar.signal.effects import row_changes
from lidar.signal.registry import Stages
from lidar.signal.situation import Situation
from lidar.signal.stage import CloudStage, EchoStage, ImageStage, Pulses, pulses_of

if TYPE_CHECKING:
    from lidar.sensors.camera.render import CameraImage

_FALSE_KINDS = 3  # kinds of false echoes, each at most one per pulse


@dataclass(frozen=True, slots=True)
class Altered:
    """A frame after its stages.

    cloud    : the recorded cloud
    original : the cloud without stages
    """

    cloud: TracedCloud
    original: Cloud

    def where(self, keep: Callable[[Cloud], NDArray[np.bool_]]) -> Altered:
        """The returns that a rule keeps, of both clouds."""
        kept = keep(self.original)
        row = np.append(np.where(kept, np.cumsum(kept) - 1, -1), -1).astype(np.int32)
        cloud = self.cloud.where(keep(self.cloud))
        cloud = replace(cloud, source=row[cloud.source], hidden=row[cloud.hidden])
        return Altered(cloud, self.original.where(kept))


def trace_unaltered(cloud: Cloud) -> Altered:
    """A cloud that no stage has changed."""
    n = len(cloud)
    added: list[Any] = [
        np.full(n, Origin.SURFACE, np.uint8),
        np.arange(n, dtype=np.int32),
        np.full(n, -1, np.int32),
    ]
    return Altered(TracedCloud(cloud.start_ns, *cloud.columns().values(), *added), cloud)


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
    acting = stages.at("echoes", at.sensor)

    in_between = [one for one in (*stages.before, *acting) if one.sensor in ("", at.sensor)]

    def clearness(row: int, distance: float) -> float:
        shares = [one.stage.clearness(pulses, row, distance=distance, at=at) for one in in_between]
        return math.exp(-extinction * distance) * math.prod(shares)

    situation = replace(at, clearness=clearness)
    for named in acting:
        stage, rng = cast("EchoStage", named.stage), named.rng(stages.seed, at.sensor, frame=at.frame)
        before, echoes = echoes, stage.echoes(pulses, echoes, at=situation, rng=rng)
        if len(echoes) and not 0 <= echoes.pulse.min() <= echoes.pulse.max() < len(pulses):
            raise LidarError(f"stage {named.name} returned echoes of pulses that were not fired")
        if at.effects is not None:
            found = row_changes(before, echoes, unit="echoes", columns=("range", "apparent"))
            at.effects.add(named.label, found)
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
    for named in stages.at("cloud", at.sensor):
        rng = named.rng(stages.seed, at.sensor, frame=at.frame)
        before, cloud = cloud, cast("CloudStage", named.stage).cloud(cloud, at=at, rng=rng)
        if at.effects is not None:
            found = row_changes(before, cloud, unit="returns", columns=("xyz", "intensity"))
            at.effects.add(named.label, found)
    moved = (cloud.origin == Origin.MOVED) & (cloud.hidden < 0)
    return replace(cloud, hidden=np.where(moved, cloud.source, cloud.hidden))


def altered_image(image: CameraImage, stages: Stages, *, at: Situation) -> CameraImage:
    """An image with colours after the stages on it."""
    for named in stages.at("image", at.sensor):
        rng = named.rng(stages.seed, at.sensor, frame=at.frame)
        before = image
        image = replace(image, rgb=cast("ImageStage", named.stage).image(image, at=at, rng=rng).rgb)
        if at.effects is not None:
            changed = int(image_truth(image, before)["changed"].any())
            at.effects.add(named.label, {"images changed": changed})
    return image


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


def cloud_truth(
    altered: Altered, *, start_ns: int, rows: NDArray[np.integer] | None = None
) -> dict[str, NDArray[Any]]:
    """Columns of a truth file; ``removed_time_ns`` counts from ``start_ns``.

    rows : (m,) of the original, which ``altered.original`` holds; by default all

    origin, source, hidden : (n,) of the recorded returns, as in `TracedCloud`
    removed                : (k,) int32, rows of the original returns that are not among them, or were moved
    removed_*              : (k,) or (k, 3), the columns of those, as in `Cloud`
    """
    cloud, original = altered.cloud, altered.original
    kept = cloud.source[(cloud.source >= 0) & (cloud.origin != Origin.MOVED)]
    rows = np.arange(len(original)) if rows is None else rows
    is_lost = ~np.isin(rows, kept)
    removed_columns = original.take(np.flatnonzero(is_lost)).columns()
    time_ns = original.start_ns - start_ns + removed_columns["time_ns"].astype(np.int64)
    removed_columns["time_ns"] = time_ns.astype(np.int64)
    return {
        "origin": cloud.origin,
        "source": cloud.source,
        "hidden": cloud.hidden,
        "removed": rows[is_lost].astype(np.int32),
        **{f"removed_{name}": column for name, column in removed_columns.items()},
    }


def image_truth(image: CameraImage, original: CameraImage) -> dict[str, NDArray[Any]]:
    """Ground truth of the changes that stages made to an image, as `changed_pixels`."""
    assert image.rgb is not None  # noqa: S101
    assert original.rgb is not None  # noqa: S101
    return changed_pixels(image.rgb, original.rgb)


def changed_pixels(rgb: NDArray[np.uint8], original: NDArray[np.uint8]) -> dict[str, NDArray[Any]]:
    """Differences that stages made to colours (h, w, 3).

    changed : (h, w) bool
    removed : (k, 3) uint8, the colours of the changed pixels without stages, row by row
    """
    changed = (rgb != original).any(axis=2)
    return {"changed": changed, "removed": original[changed]}


def image_past(image: CameraImage, truth: Mapping[str, NDArray[Any]] | None) -> CameraImage:
    """A recorded image before the stages in its truth file.

    Raises ValueError for the truth of another image.
    """
    if truth is None or image.rgb is None:
        return image
    rgb = image.rgb.copy()
    rgb[truth["changed"]] = truth["removed"]
    return replace(image, rgb=rgb)


def write_truth(path: Path, columns: dict[str, NDArray[Any]]) -> None:
    """Write a truth file (NPZ)."""
    data = BytesIO()
    np.savez_compressed(data, **columns)  # type: ignore[arg-type]
    write_atomically(path, data.getvalue())
