"""Ground truth of what stages have changed, also of data that stages had changed before."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geoscene.support.files import write_atomically
from lidar.sensors.laser.cloud import Cloud, TracedCloud
from lidar.sensors.navigation.gnss import gnss_columns
from lidar.sensors.navigation.imu import imu_columns
from lidar.sensors.navigation.measurements import Fixes, Inertial
from lidar.sensors.physics.origin import Origin

if TYPE_CHECKING:
    from lidar.sensors.camera.render import CameraImage


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


_OF_RETURNS = ("origin", "source", "hidden")
"""Truth of each recorded return."""


@dataclass(frozen=True, slots=True)
class Past:
    """A recorded cloud with the truth of the stages that have changed it.

    cloud    : as recorded
    origin, source, hidden : (n,) of its returns, as in `TracedCloud`; rows of the original, without any stage
    original : the returns of the original that are known: those in ``cloud``, and those in its truth file
    rows     : (m,) int64, their rows in the original, ascending; all of them unless a filter removed some
    others   : further columns of the truth file, such as of a filter
    """

    cloud: Cloud
    origin: NDArray[np.uint8]
    source: NDArray[np.int32]
    hidden: NDArray[np.int32]
    original: Cloud
    rows: NDArray[np.int64]
    others: Mapping[str, NDArray[Any]]


def past_of(cloud: Cloud, truth: Mapping[str, NDArray[Any]] | None) -> Past:
    """A recorded cloud with the columns of its truth file; without one nothing has changed it.

    ``cloud`` starts at the moment that ``removed_time_ns`` counts from. Returns that are in it have the
    columns with which they are recorded there: what earlier stages dimmed stays dimmed.

    Raises ValueError for the truth of another cloud.
    """
    if truth is None:
        same = trace_unaltered(cloud).cloud
        return Past(cloud, same.origin, same.source, same.hidden, cloud, np.arange(len(cloud)), {})
    origin, source, hidden = (truth[name] for name in _OF_RETURNS)
    names = cloud.columns()
    gone = {name: truth[f"removed_{name}"].astype(column.dtype) for name, column in names.items()}
    kept = np.flatnonzero((source >= 0) & (origin != Origin.MOVED))
    rows = np.concatenate([source[kept], truth["removed"]]).astype(np.int64)
    order = np.argsort(rows)
    if (np.diff(rows[order], prepend=-1) <= 0).any():
        raise ValueError("rows that are not those of one cloud, each once")
    original = Cloud.concatenate([cloud.take(kept), Cloud(cloud.start_ns, **gone)]).take(order)
    known = {*_OF_RETURNS, "removed", *(f"removed_{name}" for name in names)}
    others = {name: column for name, column in truth.items() if name not in known}
    return Past(cloud, origin, source, hidden, original, rows[order], others)


def truth_since(past: Past, altered: Altered, *, start_ns: int) -> dict[str, NDArray[Any]]:
    """Columns of the truth file, as `cloud_truth`, of stages before and now.

    altered : what the stages made of ``past.cloud`` now, whose rows its sources and hidden returns are

    A return that hides an added one hides what that one hid. An added return of a pulse whose original
    return was removed before hides that.
    """
    now = altered.cloud
    source = _of(past.source, now.source, default=-1)
    covered = np.where(past.source >= 0, past.source, past.hidden)
    hidden = np.where(
        now.hidden >= 0,
        _of(covered, now.hidden, default=-1),
        _of(past.hidden, now.source, default=-1),
    )
    untouched = (now.source >= 0) & (now.origin == Origin.SURFACE)
    origin = np.where(untouched, _of(past.origin, now.source, default=0), now.origin)
    kept = np.isin(past.rows, source[(source >= 0) & (origin != Origin.MOVED)])
    lone = np.flatnonzero((source < 0) & (hidden < 0))
    hidden[lone] = _lost_of_pulses(past, np.flatnonzero(~kept), of=now.take(lone))
    traced = replace(
        now,
        origin=origin.astype(np.uint8),
        source=source.astype(np.int32),
        hidden=hidden.astype(np.int32),
    )
    found = cloud_truth(Altered(traced, past.original), start_ns=start_ns, rows=past.rows)
    return {**found, **past.others}


def _of(column: NDArray[Any], row: NDArray[np.int32], *, default: int) -> NDArray[Any]:
    """Rows of a column; the default for negative ones."""
    return np.append(column, column.dtype.type(default))[np.where(row >= 0, row, len(column))]


def _lost_of_pulses(past: Past, lost: NDArray[np.int64], *, of: Cloud) -> NDArray[np.int64]:
    """The first lost original return (k,) of the pulse of each return; -1 for none.

    lost : (l,) places in ``past.original``, ascending
    """
    if not len(lost):
        return np.full(len(of), -1)
    pulse, first = np.unique(_pulse(past.original.take(lost)), return_index=True)
    at = np.minimum(np.searchsorted(pulse, _pulse(of)), len(pulse) - 1)
    return np.where(pulse[at] == _pulse(of), past.rows[lost[first[at]]], -1)


def _pulse(cloud: Cloud) -> NDArray[np.int64]:
    """A number (n,) for each pulse, by column and ring."""
    return cloud.column.astype(np.int64) << 16 | cloud.ring
