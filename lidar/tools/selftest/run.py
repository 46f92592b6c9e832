"""Runs the extremes on this machine, and tables of the outcomes."""

from __future__ import annotations

import platform
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from geoscene.drawing.report import Column, table_of
from geoscene.support.progress import Progress, silent
from geoscene.support.registry import unknown_name
from lidar.errors import BackendError, InputError
from lidar.raycast.library import library
from lidar.tools.selftest import footprints, places, pulses, rays, scale, statistics, times
from lidar.tools.selftest.case import ExtremeCase

CASES: tuple[ExtremeCase, ...] = (
    *rays.CASES,
    *pulses.CASES,
    *places.CASES,
    *footprints.CASES,
    *times.CASES,
    *statistics.CASES,
    *scale.CASES,
)
"""All cases, by group."""

GROUPS = tuple(dict.fromkeys(case.group for case in CASES))
"""Names of the groups of cases."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """The outcome of a case.

    count    : number of samples
    measured : in the case's unit; NaN if the case ended in an error
    error    : one line, or ""
    seconds  : wall time
    """

    case: ExtremeCase
    count: int
    measured: float
    error: str
    seconds: float

    @property
    def ok(self) -> bool:
        """Whether the bound holds."""
        return self.measured <= self.case.bound


def outcomes(
    groups: Sequence[str] = (), *, full: bool = False, progress: Progress = silent
) -> Iterator[Outcome]:
    """The outcome of each case of some groups, all by default, one after the other.

    Raises InputError for an unknown group.
    """
    if unknown := sorted(set(groups) - set(GROUPS)):
        raise InputError(unknown_name("`only`", unknown[0], known=GROUPS))
    chosen = [case for case in CASES if not groups or case.group in groups]
    for k, case in enumerate(chosen):
        yield outcome(case, case.full if full else case.quick)
        progress("cases", k + 1, total=len(chosen))


def outcome(case: ExtremeCase, count: int) -> Outcome:
    """The outcome of a case with ``count`` samples."""
    start = time.perf_counter()
    try:
        measured, error = case.measure(count), ""
    except Exception as failure:  # noqa: BLE001 - the other cases are wanted, whatever the reason
        measured, error = float("nan"), f"{type(failure).__name__}: {failure}"
    return Outcome(case, count, float(measured), " ".join(error.split()), time.perf_counter() - start)


def machine() -> dict[str, str]:
    """Processor, system and libraries on which the figures depend."""
    try:
        loaded = library()
        digits = loaded.embree.rtcGetDeviceProperty(loaded.device, 0)
        embree = f"{digits // 10000}.{digits // 100 % 100}.{digits % 100}"
        packets = str(loaded.width)
    except BackendError as error:
        embree, packets = f"none ({error})", "none: rays are cast in float64"
    return {
        "processor": _processor(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "numpy": np.__version__,
        "embree": embree,
        "rays per packet": packets,
    }


def _processor() -> str:
    """Name of the processor, if the system reports it."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.processor() or platform.machine())


def figure(value: float) -> str:
    """A number with two digits, three from 10 to a million; whole numbers as such."""
    if abs(value) < 1e6 and value == int(value):
        return f"{value:,.0f}"
    return f"{value:.3g}" if 10 <= abs(value) < 1e6 else f"{value:.2g}"


_COLUMNS: tuple[Column[Outcome], ...] = (
    Column("case", lambda done: done.case.name),
    Column("samples", lambda done: f"{done.count:,} {done.case.of}"),
    Column("bound", lambda done: f"{figure(done.case.bound)} {done.case.unit}"),
    Column("measured", lambda done: done.error or f"{figure(done.measured)} {done.case.unit}"),
    Column("", lambda done: "ok" if done.ok else "FAILS"),
)


def to_text(done: Sequence[Outcome]) -> str:
    """The outcomes, a table for each group, and the machine."""
    groups = dict.fromkeys(one.case.group for one in done)
    tables = [table_of(_COLUMNS, (one for one in done if one.case.group == group)) for group in groups]
    host = "\n".join(f"{name}: {value}" for name, value in machine().items())
    return "\n\n".join([*(table.to_text() for table in tables), host])


def markdown(done: Sequence[Outcome]) -> str:
    """The tables of docs/measurements/extremes.md, one for each group."""
    lines = ["Measured on: " + "; ".join(f"{name} {value}" for name, value in machine().items()) + "."]
    for group in dict.fromkeys(one.case.group for one in done):
        lines += ["", f"## {group.capitalize()}", "", "| case | samples | bound | measured | limited by |"]
        lines += ["|---|---:|---:|---:|---|"]
        for one in done:
            if one.case.group == group:
                *row, verdict = (column.text(one) for column in _COLUMNS)
                row[3] += "" if verdict == "ok" else " (FAILS)"
                lines.append("| " + " | ".join([*row, one.case.limit]) + " |")
    return "\n".join(lines)


def document(done: Sequence[Outcome]) -> dict[str, Any]:
    """The outcomes and the machine as JSON."""
    rows = [
        {name: getattr(one.case, name) for name in ("group", "name", "bound", "unit", "of", "limit")}
        | {
            "samples": one.count,
            "measured": None if np.isnan(one.measured) else one.measured,
            "ok": one.ok,
            "error": one.error,
            "seconds": round(one.seconds, 3),
        }
        for one in done
    ]
    return {"machine": machine(), "cases": rows}
