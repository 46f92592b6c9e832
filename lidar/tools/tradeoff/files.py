"""What point-cloud formats lose: clouds written and read back, against the exact points."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from geoscene.support.progress import Progress
from geoscene.typing import Float
from lidar.dataset.formats import FORMATS, Format
from lidar.dataset.formats.las import SCALE, LasInfo
from lidar.dataset.formats.table import Table, cloud_table, rows
from lidar.geometry.time_scales import gps_seconds
from lidar.sensors.rig.devices import Scanner
from lidar.tools.tradeoff.comparison import Listing, Record
from lidar.tools.tradeoff.errors import percentile, rms
from lidar.tools.tradeoff.simulate import Bench, SimulatedFrame, measured_frame

_STEPS = {"csv": 1e-4}
"""Metres between numbers of formats that write decimals."""

LAS_SCALES = (SCALE, SCALE / 10, SCALE * 10)
"""Metres per count of LAS coordinates that are compared; drives write the first."""


@dataclass(frozen=True, slots=True)
class Stored:
    """One way to store a frame.

    table : the points as they are written
    exact : (n, 3) the same points without any rounding
    write : writes the table
    bound : metres by which rounding moves a point at most
    shift : (3,) metres to add to what is read
    """

    label: str
    format: Format
    table: Table
    exact: Float
    write: Callable[[Path, Table], None]
    bound: float
    note: str = ""
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(slots=True)
class _Tally:
    """Errors and costs of one way to store frames."""

    note: str
    away: list[Float] = field(default_factory=list)
    bound: float = 0.0
    points: int = 0
    size: int = 0
    write_s: float = 0.0
    read_s: float = 0.0

    def add(self, stored: Stored, folder: Path) -> None:
        """Write a frame, read it back and compare."""
        path = folder / f"cloud{stored.format.suffix}"
        began = time.process_time()
        stored.write(path, stored.table)
        written = time.process_time()
        back = stored.format.read(path)
        self.read_s += time.process_time() - written
        self.write_s += written - began
        xyz = np.column_stack([back[axis] for axis in "xyz"]).astype(np.float64) + stored.shift
        self.away.append(np.linalg.norm(xyz - stored.exact, axis=1))
        self.bound = max(self.bound, stored.bound)
        self.points += len(xyz)
        self.size += path.stat().st_size

    def record(self, label: str) -> Record:
        """The row of the table."""
        away, each = np.concatenate(self.away), max(1, self.points)
        figures = {
            "rms_m": rms(away),
            "99.9_m": percentile(away, 0.999),
            "max_m": percentile(away, 1.0),
            "bound_m": self.bound,
            "per_point_bytes": self.size / each,
            "write_s": 1e6 * self.write_s / each,
            "read_s": 1e6 * self.read_s / each,
        }
        return Record(label, figures, self.note)


def formats_listing(bench: Bench, scanner: Scanner, *, progress: Progress) -> Listing:
    """Errors of coordinates, bytes and CPU time of every format, on the sampled frames of a scanner."""
    tallies: dict[str, _Tally] = {}
    frames = bench.frames[scanner.name]
    with TemporaryDirectory() as folder:
        for k, frame in enumerate(frames):
            progress(f"formats of {scanner.name}", k, total=len(frames))
            seen = measured_frame(bench, scanner, frame=frame)
            for stored in (
                *_in_sensor_frame(bench, scanner, seen=seen, frame=frame),
                *_in_world(bench, scanner, seen=seen),
            ):
                if stored.label not in tallies:
                    _Tally("").add(stored, Path(folder))  # warms up
                tallies.setdefault(stored.label, _Tally(stored.note)).add(stored, Path(folder))
    points = next(iter(tallies.values())).points
    return Listing(
        "files",
        f"Formats of {scanner.name}: {points:,} points of {len(frames)} frames",
        "Coordinates read back from files against float64 ones; the bound is that of rounding, by half a"
        " step along each axis. Seconds are CPU time for a million points. Bytes are those of whole files,"
        " with all columns that a format keeps.",
        tuple(tally.record(label) for label, tally in tallies.items()),
    )


def float32_bound(xyz: Float) -> float:
    """Metres by which float32 moves any of these points (n, 3) at most."""
    far = np.abs(xyz).max(axis=0, initial=0.0).astype(np.float32)
    return float(np.linalg.norm(np.spacing(far).astype(np.float64))) / 2


def _in_sensor_frame(bench: Bench, scanner: Scanner, *, seen: SimulatedFrame, frame: int) -> Iterator[Stored]:
    """Formats of the sensor frame; KITTI's are de-skewed to the frame's start."""
    table, mount = cloud_table(seen.cloud), scanner.spec.mount
    pose = bench.plan.trajectory.at([scanner.frame_start_ns(frame)]).mounted(
        mount.translation, mount.rotation
    )
    still = ((seen.placed - pose.position) / pose.scale) @ pose.rotation[0]
    for form in FORMATS.values():
        if form.frame == "sensor" and form.installed():
            exact = still if form.kitti else seen.exact
            bound = float32_bound(exact) + _STEPS.get(form.name, 0.0) * 3**0.5 / 2
            bound += float32_bound(seen.exact) if form.kitti else 0.0
            columns = table
            if form.kitti:
                columns = table | dict(zip("xyz", still.astype(np.float32).T, strict=True))
            note = "" if len(form.columns) > 5 else f"keeps {', '.join(form.columns)} only"
            yield Stored(form.name, form, columns, exact, form.write, bound, note)


def _in_world(bench: Bench, scanner: Scanner, *, seen: SimulatedFrame) -> Iterator[Stored]:
    """LAS and LAZ in steps of several sizes, and maps as PCD and PLY, in the export CRS."""
    plan = bench.plan
    exact, mount = plan.geo.points(seen.placed), scanner.spec.mount
    placed = plan.trajectory.place(
        seen.cloud.xyz, seen.time_ns, translation=mount.translation, rotation=mount.rotation
    )  # as a drive places its float32 cloud
    rounded = float32_bound(seen.exact)
    table = cloud_table(seen.cloud) | dict(zip("xyz", plan.geo.points(placed).T, strict=True))
    table["gps_time"] = gps_seconds(plan.start, seen.time_ns)
    info = LasInfo(plan.geo.crs, plan.geo.offset, plan.start)
    for form, scale in product((FORMATS["las"], FORMATS["laz"]), LAS_SCALES):
        write = partial(form.write, info=replace(info, scale=scale))
        note = "" if scale == SCALE else "for comparison; drives write steps of 1 mm"
        label = f"{form.name} in steps of {scale * 1000:g} mm"
        yield Stored(label, form, table, exact, write, rounded + scale * 3**0.5 / 2, note)
    mapped = {k: table[k] for k in ("x", "y", "z", "intensity", "gps_time", "ring", "label", "instance")}
    mapped |= {k: np.zeros(rows(table), np.uint8) for k in ("red", "green", "blue")}

    for form, bound, note, shift in (
        (
            FORMATS["pcd"],
            rounded + float32_bound(exact - info.offset),
            "float32 less a whole-metre offset",
            info.offset,
        ),
        (FORMATS["ply"], rounded, "float64", (0.0, 0.0, 0.0)),
    ):
        write = partial(_write_map, form=form, info=info)
        yield Stored(f"{form.name} map", form, mapped, exact, write, bound, note, shift)


def _write_map(path: Path, table: Table, *, form: Format, info: LasInfo) -> None:
    with form.open_map(path, info=info, columns=tuple(table)) as append:
        append(table)
