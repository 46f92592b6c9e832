"""A frame of a scanner: its point cloud as files, with labels and the bounding boxes of road users."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geoscene.files import write_columns
from geoscene.typing import Float
from lidar.dataset.boxes import box_rows, count_points
from lidar.dataset.deskew import MOMENTS, deskewed
from lidar.dataset.formats.las import gps_seconds
from lidar.dataset.formats.table import Table, cloud_table, point_labels
from lidar.dataset.recording import Recording
from lidar.random_streams import generator
from lidar.rig.devices import Scanner
from lidar.sensors.cloud import Cloud, no_returns
from lidar.sensors.doppler import radial_velocity, surface_velocity
from lidar.sensors.scan import scan
from lidar.world.world import World


def record_cloud(recording: Recording, scanner: Scanner, *, frame: int, world: World) -> int:
    """Scan one frame and write its clouds, labels and boxes; return the number of points."""
    paths = recording.paths(scanner, frame)
    cloud = _scanned(recording, scanner, frame=frame, world=world)
    _write_clouds(recording, scanner, frame=frame, cloud=cloud, paths=paths)
    for form in recording.contents.label_formats:
        form.write(paths[f"labels {form.name}"], point_labels(cloud, recording.actors))
    if recording.actors is not None:
        with recording.watch.stage("boxes"):
            _write_boxes(recording, scanner, frame=frame, cloud=cloud, world=world, path=paths["boxes"])
    return len(cloud)


def _scanned(recording: Recording, scanner: Scanner, *, frame: int, world: World) -> Cloud:
    """What a scanner measures in a frame, during the times at which scanners work."""
    start, end = scanner.sensor.window_ns(frame)
    on = recording.scanning_ns
    if on is not None and not ((on[:, 0] <= end) & (on[:, 1] >= start)).any():
        return no_returns(start)
    with recording.watch.stage("scan"):
        cloud = scan(
            scanner.sensor,
            scanner.spec.mount,
            trajectory=recording.trajectory,
            world=world,
            frame=frame,
            seed=recording.contents.seed,
            settings=recording.contents.scanner,
        )
    if on is None:
        return cloud
    time_ns = _times(cloud)
    first = np.searchsorted(on[:, 0], time_ns, side="right") - 1
    return cloud.where((first >= 0) & (time_ns <= np.maximum.accumulate(on[:, 1])[first]))


def _times(cloud: Cloud) -> NDArray[np.int64]:
    """Times (n,) of a cloud's returns, nanoseconds since the drive's start."""
    return cloud.start_ns + cloud.time_ns.astype(np.int64)


def _write_clouds(
    recording: Recording, scanner: Scanner, *, frame: int, cloud: Cloud, paths: dict[str, Path]
) -> None:
    """Write a cloud in every format: in the sensor frame, de-skewed, and in the world frame."""
    contents, watch = recording.contents, recording.watch
    begin, time_ns = scanner.frame_start_ns(frame), _times(cloud)
    table = cloud_table(cloud) | {"time_ns": (time_ns - begin).astype(np.uint32)}
    world_formats = [form for form in contents.cloud_formats if form.frame == "world"]
    placed = np.empty((0, 3))
    if world_formats or contents.deskew or scanner.sensor.fmcw:
        mount = scanner.spec.mount
        with watch.stage("georeference"):
            placed = recording.trajectory.place(
                cloud.xyz, time_ns, translation=mount.translation, rotation=mount.rotation
            )
    if scanner.sensor.fmcw:
        with watch.stage("velocity"):
            table["velocity"] = _velocity(recording, scanner, frame=frame, cloud=cloud, placed=placed)
    deskewed_table: Table = {}
    if contents.deskew:
        moment = begin + int(MOMENTS[contents.deskew] * scanner.period_ns)
        still = deskewed(placed, recording.trajectory, mount=scanner.spec.mount, time_ns=moment)
        deskewed_table = table | dict(zip("xyz", still.T, strict=True))
    for form in contents.cloud_formats:
        if form.frame == "sensor":
            with watch.stage(f"write {form.name}"):
                form.write(paths[form.name], table)
                if contents.deskew:
                    form.write(paths[f"deskewed {form.name}"], deskewed_table)
    if world_formats:
        with watch.stage("georeference"):
            east, north, up = recording.geo.points(placed).T
            gps = gps_seconds(recording.start, time_ns)
            world_table = table | {"x": east, "y": north, "z": up, "gps_time": gps}
        for form in world_formats:
            with watch.stage(f"write {form.name}"):
                form.write(paths[form.name], world_table, info=recording.las_info)


def _velocity(
    recording: Recording, scanner: Scanner, *, frame: int, cloud: Cloud, placed: Float
) -> NDArray[np.float32]:
    """Radial velocities (n,) as measured, m/s; with noise if ranges have noise.

    placed : (n, 3) the returns, scene metres
    """
    moving = None
    if recording.actors is not None:
        moving = surface_velocity(recording.actors, cloud.feature, placed=placed, time_ns=_times(cloud))
    mount, sigma = scanner.spec.mount, scanner.sensor.velocity_sigma
    velocity = radial_velocity(cloud, mount, trajectory=recording.trajectory, moving=moving)
    if sigma and recording.contents.scanner.range_noise != "none":
        rng = generator(recording.contents.seed, scanner.name, frame, "velocity noise")
        velocity = velocity + np.float32(sigma) * rng.standard_normal(len(velocity), np.float32)
    return velocity


def _write_boxes(
    recording: Recording, scanner: Scanner, *, frame: int, cloud: Cloud, world: World, path: Path
) -> None:
    """Write the 3D boxes of road users, with the number of points on each and its visibility."""
    actors, visibility = recording.actors, recording.visibility
    assert actors is not None  # noqa: S101
    assert visibility is not None  # noqa: S101
    begin, mount = scanner.frame_start_ns(frame), scanner.spec.mount
    columns = box_rows(actors, recording.trajectory, time_ns=begin, frame=frame, reach=recording.max_range)
    points = count_points(actors, columns["id"], feature=cloud.feature)
    origin = recording.trajectory.at([begin]).mounted(mount.translation, mount.rotation).position[0]
    share = visibility.seen_from(origin, world, rows=columns["id"], time_ns=begin)
    write_columns(path, {**columns, "points": points, "visibility": np.round(share, 4)})
