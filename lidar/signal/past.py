"""Stages on clouds that stages have changed before: the truth of both against the first original."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidar.sensors.laser.cloud import Cloud
from lidar.sensors.physics.origin import Origin
from lidar.signal.run import Altered, cloud_truth, trace_unaltered

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
