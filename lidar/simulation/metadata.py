"""Metadata files of a dataset: poses, calibration, time stamps, GNSS and IMU measurements after stages."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.geometry.frames import Frame
from geoscene.scene import Scene
from geoscene.support.columns import table_blocks, write_blocks, write_columns
from geoscene.support.files import atomic_path, write_json
from lidar.dataset.layout import Paths, reading_file
from lidar.dataset.layouts.kitti_drive import write_sequence
from lidar.dataset.navigation_files import FixHeights
from lidar.geometry.attitude import Mount, euler_from_quat, quat_from_matrix
from lidar.geometry.poses import Trajectory
from lidar.geometry.time_scales import iso_times
from lidar.sensors.navigation.gnss import antenna_motion, epochs, gnss_columns, observe_gnss
from lidar.sensors.navigation.imu import imu_columns, observe_imu
from lidar.sensors.navigation.measurements import Fixes, Inertial
from lidar.sensors.navigation.nmea import HEIGHTS, geoid_at, height_note, nmea
from lidar.sensors.navigation.satellite_visibility import sky_view
from lidar.sensors.rig.camera_model import intrinsic_matrix
from lidar.sensors.rig.devices import Camera, Scanner
from lidar.sensors.rig.specs import GnssSpec, Rig
from lidar.settings import RecordingSettings
from lidar.signal.registry import Stages
from lidar.signal.run import altered_fixes, altered_samples
from lidar.signal.situation import Effects, Situation
from lidar.signal.truth import fixes_truth, samples_truth
from lidar.simulation.situations import situation_of_unit
from lidar.world.world import World


def pose_columns(
    trajectory: Trajectory, frame: Frame, *, start: datetime, time_ns: NDArray[np.integer]
) -> dict[str, Any]:
    """Columns of ``poses.csv``: the vehicle at the starts of frames.

    x, y, z in scene metres; alpha, beta, gamma in radians with R = Rz(gamma) Ry(beta) Rx(alpha), scene axes
    from vehicle axes; lon, lat in degrees (WGS 84) and h in metres as the scene's heights.
    """
    poses = trajectory.at(time_ns)
    x, y, z = poses.position.T
    quat = quat_from_matrix(poses.rotation)
    lon, lat = frame.to_geographic(x, y)
    return {
        "timestamp": iso_times(start, time_ns),
        "frame": np.arange(len(time_ns)),
        "x": x,
        "y": y,
        "z": z,
        **dict(zip(("alpha", "beta", "gamma"), euler_from_quat(quat).T, strict=True)),
        **dict(zip(("qx", "qy", "qz", "qw"), quat.T, strict=True)),
        "lon": lon,
        "lat": lat,
        "h": z,
    }


def _mount(mount: Mount) -> dict[str, Any]:
    return {
        "vehicle_from_sensor": mount.matrix.tolist(),
        "translation": list(mount.translation),
        "quat_xyzw": list(mount.quat_xyzw),
    }


_SECRETS = ("firing_jitter_ns", "code_bits")
"""Stated of scanners that have them."""

_SCANNER = ("wavelength_nm", "min_range", "max_range", "range_quantum", "return_mode", "fmcw")


def calibration(rig: Rig, sensors: Sequence[Scanner | Camera]) -> dict[str, Any]:
    """The document ``calibration.json``: mounts, rates and intrinsics."""
    out: dict[str, Any] = {}
    for kind, specs in (("gnss", rig.gnss), ("imu", rig.imus)):
        for spec in specs:
            rates = {"rate_hz": spec.rate_hz, "time_offset_ns": spec.time_offset_ns}
            out[spec.name] = {"kind": kind, **rates, **_mount(spec.mount)}
    for sensor in sensors:
        if isinstance(sensor, Scanner):
            s = sensor.sensor
            out[sensor.name] = {
                "kind": "lidar",
                "model": f"{s.maker} {s.model}",
                "rate_hz": s.rate_hz,
                "time_offset_ns": s.start_ns,
                **{name: getattr(s, name) for name in _SCANNER},
                **{name: value for name in _SECRETS if (value := getattr(s, name))},
                **_mount(sensor.spec.mount),
            }
        else:
            c = sensor.spec
            out[sensor.name] = {
                "kind": "camera",
                "model": c.model,
                "rate_hz": c.rate_hz,
                "time_offset_ns": c.time_offset_ns,
                "width": c.width,
                "height": c.height,
                "K": intrinsic_matrix(c).tolist(),
                "distortion": list(c.distortion),
                "depth_counts_per_metre": 256,
                "exposure_ns": c.exposure_ns,
                "row_ns": c.row_ns,
                **_mount(c.mount),
            }
    return {
        "frames": {
            "vehicle": "x forward, y left, z up; origin: the rear axle's centre on the ground",
            "lidar": "x forward, y left, z up",
            "camera": "x right, y down, z forward; the centre of the top-left pixel is (0, 0)",
        },
        "sensors": out,
    }


def write_metadata(
    out: Path,
    scene: Scene,
    *,
    rig: Rig,
    sensors: Sequence[Scanner | Camera],
    trajectory: Trajectory,
    start: datetime,
    frames: Mapping[str, int],
    settings: RecordingSettings,
    effects: Effects | None = None,
) -> None:
    """Write all files of a dataset but clouds, images and boxes.

    ``poses.csv`` (a row for each frame of the first sensor), ``calibration.json``, time stamps of each
    sensor, and ``<name>.csv`` of every receiver (also as NMEA sentences) and inertial unit of the rig; with
    KITTI's clouds or labels the files that make each scanner's folder a sequence.

    frames : number of frames, by sensor
    """
    seed, paths = settings.seed, Paths(out)
    write_json(paths.calibration, calibration(rig, sensors))
    for k, sensor in enumerate(sensors):
        times = np.fromiter(map(sensor.frame_start_ns, range(frames[sensor.name])), np.int64)
        stamps: dict[str, Any] = {
            "frame": np.arange(len(times)),
            "time_ns": times,
            "timestamp": iso_times(start, times),
        }
        write_columns(paths.timestamps(sensor.name), stamps)
        if k == 0:
            write_columns(paths.poses, pose_columns(trajectory, scene.frame, start=start, time_ns=times))
        if settings.kitti and isinstance(sensor, Scanner):
            folder, mount = paths.sensor(sensor.name), sensor.spec.mount
            write_sequence(folder, rig, mount=mount, trajectory=trajectory, time_ns=times)
    stages = settings.stages
    situation = partial(situation_of_unit, trajectory=trajectory, start=start, seed=seed, effects=effects)
    for receiver in rig.gnss:
        fixes = observed_fixes(scene, receiver, trajectory=trajectory, start=start, seed=seed)
        at = situation(receiver.name, receiver.mount)
        heights = heights_of(scene.frame, fixes)
        record_fixes(paths, fixes, at=at, stages=stages, start=start, heights=heights)
    for unit in rig.imus:
        samples = observe_imu(trajectory, scene.frame, spec=unit, seed=seed)
        at = situation(unit.name, unit.mount)
        record_samples(paths, samples, at=at, stages=stages, start=start)


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
    with reading_file(path), path.open(encoding="utf-8-sig") as file:
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
