"""Files of satellite receivers and inertial units, after stages on them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import datetime
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.geometry.frames import Frame
from geoscene.scene import Scene
from geoscene.support.csv_tables import table_blocks, write_blocks, write_columns
from geoscene.support.files import atomic_path
from lidar.dataset.layout import Paths, opened_rows, reading_file
from lidar.dataset.navigation_files import FixHeights
from lidar.geometry.poses import Trajectory
from lidar.geometry.time_scales import iso_times
from lidar.sensors.navigation.geoid import geoid_at
from lidar.sensors.navigation.gnss import antenna_motion, epochs, gnss_columns, observe_gnss
from lidar.sensors.navigation.imu import imu_columns
from lidar.sensors.navigation.measurements import Fixes, Inertial
from lidar.sensors.navigation.nmea import HEIGHTS, height_note, nmea
from lidar.sensors.navigation.satellite_visibility import sky_view
from lidar.sensors.rig.specs import GnssSpec
from lidar.signal.navigation import altered_fixes, altered_samples, fixes_truth, samples_truth
from lidar.signal.registry import Stages
from lidar.signal.situation import Situation
from lidar.world.world import World


def heights_of(frame: Frame, fixes: Fixes) -> FixHeights:
    """Vertical reference of the heights of fixes in a scene."""
    geoid = None if frame.vertical == "flat" else geoid_at(*fixes.true_lonlath[:, :2].T)
    return FixHeights(frame.vertical, geoid.separation, geoid.name) if geoid else FixHeights(frame.vertical)


def observed_fixes(
    scene: Scene, spec: GnssSpec, *, trajectory: Trajectory, start: datetime, seed: int
) -> Fixes:
    """The fixes of a receiver among the scene's buildings, without stages."""
    times = epochs(spec, trajectory.duration_ns)
    antenna, _ = antenna_motion(trajectory, scene.frame, spec=spec, time_ns=times)

    world = World(scene)

    def world_at(region: tuple[float, float, float, float]) -> World:
        world.follow(region)
        return world

    sky = sky_view(
        scene.frame,
        antenna,
        start=start,
        time_ns=times,
        world_at=world_at,
        mask_deg=spec.mask_deg,
        systems=spec.constellations,
    )
    return observe_gnss(trajectory, scene.frame, spec=spec, seed=seed, start=start, sky=sky)


def record_fixes(
    paths: Paths,
    fixes: Fixes,
    *,
    at: Situation,
    stages: Stages,
    start: datetime,
    heights: FixHeights,
    past: Path | None = None,
) -> None:
    """Write the fixes of the receiver ``at.sensor`` after the stages on them, with the truth of changes.

    past : truth file of the fixes, if stages changed them already
    """
    if stages.at("fixes", at.sensor):
        original, fixes = fixes, altered_fixes(fixes, stages, at=at)
        with _opened_past(past) as rows:
            before = _next_past(rows, past, count=len(fixes))
        write_columns(paths.measurements_truth(at.sensor), fixes_truth(fixes, original, past=before))
    _write_fixes(paths, at.sensor, fixes=fixes, start=start, heights=heights)


def _write_fixes(paths: Paths, name: str, *, fixes: Fixes, start: datetime, heights: FixHeights) -> None:
    columns = gnss_columns(fixes) | {"h_above": np.full(len(fixes), HEIGHTS[heights.vertical].split()[-1])}
    if heights.separation is not None:
        columns["geoid"] = heights.separation
    write_blocks(
        paths.measurements(name),
        (
            {
                "timestamp": iso_times(start, fixes.time_ns[rows]),
                **{name: column[rows] for name, column in columns.items()},
            }
            for rows in table_blocks(len(fixes))
        ),
    )
    with (
        atomic_path(paths.measurements(name, ".nmea")) as part,
        part.open("w", encoding="ascii", newline="") as file,
    ):
        file.write(height_note(heights.vertical, heights.geoid))
        file.writelines(nmea(fixes, start, vertical=heights.vertical, separation=heights.separation))


@contextmanager
def _opened_past(path: Path | None) -> Iterator[Iterator[dict[str, str]]]:
    """Yield the rows of a truth file of earlier stages, if there is one."""
    if path is None:
        yield iter(())
        return
    with opened_rows(path) as rows:
        yield rows


def _next_past(
    rows: Iterator[dict[str, str]], path: Path | None, *, count: int
) -> dict[str, NDArray[Any]] | None:
    """The measurements in the next rows of a truth file; None without one.

    Raises DatasetError for fewer rows.
    """
    if path is None:
        return None
    block = list(islice(rows, count))
    with reading_file(path):
        if len(block) < count:
            raise ValueError("is of fewer measurements")
        kinds = {"time_ns": np.int64, "quality": np.int8, "satellites": np.int8}
        names = [name for name in (block[0] if block else ()) if name != "changed"]
        return {
            name: np.array([row[name] for row in block]).astype(kinds.get(name, np.float64)) for name in names
        }


def record_samples(
    paths: Paths,
    samples: Callable[[], Iterator[Inertial]],
    *,
    at: Situation,
    stages: Stages,
    start: datetime,
    past: Path | None = None,
) -> None:
    """Write the samples of the inertial unit ``at.sensor`` after the stages, with the truth of changes.

    samples : the unit's samples in blocks, as without stages; called twice if there are stages
    past    : truth file of the samples, if stages changed them already
    """
    path = paths.measurements(at.sensor)
    if not stages.at("samples", at.sensor):
        write_blocks(path, (_sample_columns(rows, start) for rows in samples()))
        return
    with _opened_past(past) as rows:
        write_blocks(
            paths.measurements_truth(at.sensor),
            (
                samples_truth(*pair, past=_next_past(rows, past, count=len(pair[0])))
                for pair in altered_samples(samples(), stages, at=at)
            ),
        )
    again = altered_samples(samples(), stages, at=replace(at, effects=None))  # which are counted already
    write_blocks(path, (_sample_columns(rows, start) for rows, _ in again))


def _sample_columns(rows: Inertial, start: datetime) -> dict[str, Any]:
    return {"timestamp": iso_times(start, rows.time_ns), **imu_columns(rows)}
