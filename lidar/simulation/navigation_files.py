"""Files of satellite receivers and inertial units, after stages on them."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.geometry.frames import Frame
from geoscene.scene import Scene
from geoscene.support.csv_tables import table_blocks, write_blocks, write_columns
from geoscene.support.files import atomic_path
from lidar.dataset.layout import Paths, reading_file
from lidar.dataset.navigation_files import FixHeights
from lidar.geometry.poses import Trajectory
from lidar.geometry.time_scales import iso_times
from lidar.sensors.navigation.gnss import antenna_motion, epochs, gnss_columns, observe_gnss
from lidar.sensors.navigation.imu import imu_columns
from lidar.sensors.navigation.measurements import Fixes, Inertial
from lidar.sensors.navigation.nmea import HEIGHTS, geoid_at, height_note, nmea
from lidar.sensors.navigation.satellite_visibility import sky_view
from lidar.sensors.rig.specs import GnssSpec
from lidar.signal.registry import Stages
from lidar.signal.run import altered_fixes, altered_samples
from lidar.signal.situation import Situation
from lidar.signal.truth import fixes_truth, samples_truth
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
        truth = fixes_truth(fixes, original, past=_read_past(past, count=len(fixes)))
        write_columns(paths.measurements_truth(at.sensor), truth)
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


def _read_past(path: Path | None, *, count: int) -> dict[str, NDArray[Any]] | None:
    """The measurements (count,) in a truth file of earlier stages; None without one.

    Raises DatasetError for a damaged file.
    """
    if path is None or not count:
        return None
    kinds = {"time_ns": np.int64, "quality": np.int8, "satellites": np.int8}
    with reading_file(path), path.open(encoding="utf-8") as file:
        names = next(file, "").rstrip("\n").split(",")
        values = np.loadtxt(file, delimiter=",", ndmin=2)
        if len(values) < count:
            raise ValueError("is of fewer measurements")
        return {
            name: column.astype(kinds.get(name, np.float64))
            for name, column in zip(names, values[:count].T, strict=True)
            if name != "changed"
        }


def record_samples(
    paths: Paths,
    samples: Inertial,
    *,
    at: Situation,
    stages: Stages,
    start: datetime,
    past: Path | None = None,
) -> None:
    """Write the samples of the inertial unit ``at.sensor`` after the stages, with the truth of changes.

    past : truth file of the samples, if stages changed them already
    """
    if stages.at("samples", at.sensor):
        original, samples = samples, altered_samples(samples, stages, at=at)
        truth = samples_truth(samples, original, past=_read_past(past, count=len(samples)))
        write_columns(paths.measurements_truth(at.sensor), truth)
    blocks = (samples.take(rows) for rows in table_blocks(len(samples)))
    write_blocks(paths.measurements(at.sensor), (_sample_columns(rows, start) for rows in blocks))


def _sample_columns(rows: Inertial, start: datetime) -> dict[str, Any]:
    return {"timestamp": iso_times(start, rows.time_ns), **imu_columns(rows)}
