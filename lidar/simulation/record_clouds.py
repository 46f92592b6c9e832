"""A frame of a scanner: its point cloud as files, with labels and the bounding boxes of road users."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.typing import Float
from lidar.dataset.formats.table import MOMENTS, FrameInfo, PointLabels, Table, cloud_table, deskew
from lidar.errors import LidarError
from lidar.geometry.flight_lines import edge_times, flight_columns
from lidar.geometry.random_streams import generator
from lidar.geometry.time_scales import gps_seconds
from lidar.sensors.laser.cloud import Cloud, TracedCloud, no_returns
from lidar.sensors.laser.doppler import radial_velocity, surface_velocity
from lidar.sensors.laser.scan import Sweep, cast, find_pulse, measure
from lidar.sensors.rig.devices import Scanner
from lidar.sensors.rig.patterns.beams import Firings
from lidar.signal.run import altered_sweep
from lidar.signal.truth import Altered, cloud_truth, trace_unaltered
from lidar.simulation.boxes import box_rows, count_points
from lidar.simulation.recording import MeasuredCloud, Recording, firing_times, placed_cloud
from lidar.simulation.situations import situation_of
from lidar.world.actors import Actors
from lidar.world.world import World, Worlds


def write_labelled_clouds(
    recording: Recording, scanner: Scanner, *, measured: MeasuredCloud, paths: dict[str, Path]
) -> None:
    """Write the cloud of a frame in every format, and its labels."""
    cloud = measured.cloud
    write_clouds(
        recording, scanner, frame=measured.frame, cloud=cloud, paths=paths, velocity=measured.velocity
    )
    for form in recording.settings.label_formats:
        form.write(paths[f"labels {form.name}"], _point_labels(cloud, recording.actors))


def _point_labels(cloud: Cloud, actors: Actors | None) -> PointLabels:
    road_user, moving = np.zeros(len(cloud), np.int64), np.zeros(len(cloud), bool)
    if actors is not None and len(actors):
        row = cloud.feature.astype(np.int64) - int(actors.feature[0])
        on = np.flatnonzero((row >= 0) & (row < len(actors)))
        road_user[on] = row[on] + 1
        moving[on] = ~actors.parked[row[on]]
    return PointLabels(cloud.klass, road_user, moving)


def measure_cloud(recording: Recording, scanner: Scanner, *, frame: int, worlds: Worlds) -> MeasuredCloud:
    """Scan one frame."""
    world, truth = worlds.during(*scanner.sensor.window_ns(frame)), dict[str, NDArray[Any]]()
    if recording.has_stages(scanner):
        altered = _alter(recording, scanner, frame=frame, worlds=worlds)
        truth = cloud_truth(altered, start_ns=scanner.frame_start_ns(frame))
        cloud: Cloud = altered.cloud
    else:
        cloud = _scan(recording, scanner, frame=frame, world=world)
    boxes: dict[str, NDArray[Any]] = {}
    if recording.actors is not None:
        with recording.watch.stage("boxes"):
            boxes = _boxes(recording, scanner, frame=frame, cloud=cloud, world=world)
    velocity = None
    if scanner.sensor.fmcw:
        with recording.watch.stage("velocity"):
            velocity = _velocity(recording, scanner, frame=frame, cloud=cloud)
    return MeasuredCloud(
        scanner.name,
        frame,
        scanner.frame_start_ns(frame),
        scanner.spec.mount,
        recording.trajectory,
        boxes,
        truth,
        cloud=cloud,
        period_ns=scanner.period_ns,
        velocity=velocity,
    )


def _scan(recording: Recording, scanner: Scanner, *, frame: int, world: World) -> Cloud:
    """Point cloud of a scanner in a frame; empty outside the times at which scanners work."""
    if not _works(recording, scanner, frame=frame):
        return no_returns(scanner.sensor.window_ns(frame)[0])
    with recording.watch.stage("scan"):
        cloud = measure(_swept(recording, scanner, frame=frame, world=world))
    return cloud if recording.scanning_ns is None else cloud.where(_while_on(recording, firing_times(cloud)))


def _alter(recording: Recording, scanner: Scanner, *, frame: int, worlds: Worlds) -> Altered:
    """Point cloud of a scanner in a frame, after the stages on it."""
    window = scanner.sensor.window_ns(frame)
    if not _works(recording, scanner, frame=frame):
        return trace_unaltered(no_returns(window[0]))

    def cloud_of(earlier: int) -> Cloud:
        _check_lookback(recording, scanner, frames=frame - earlier)
        then = worlds.during(*scanner.sensor.window_ns(earlier))
        cloud = _scan(recording, scanner, frame=earlier, world=then)
        worlds.during(*window)  # this thread's world is again that of the frame
        return cloud

    world = worlds.during(*window)
    at = situation_of(recording, scanner, frame=frame, world=world, cloud_of=cloud_of)
    with recording.watch.stage("scan"):
        sweep = _swept(recording, scanner, frame=frame, world=world)
        altered = altered_sweep(sweep, recording.settings.stages, at=at)
    if recording.scanning_ns is None:
        return altered
    return altered.where(lambda cloud: _while_on(recording, firing_times(cloud)))


def _check_lookback(recording: Recording, scanner: Scanner, *, frames: int) -> None:
    """Raise LidarError if no stage declares this lookback: earlier tiles are not loaded."""
    if frames * scanner.period_ns > recording.settings.stages.lookback_ns:
        raise LidarError(f"a stage looks back {frames} frames of {scanner.name}, more than its `lookback`")


def _swept(recording: Recording, scanner: Scanner, *, frame: int, world: World) -> Sweep:
    """The pulses and echoes of a frame."""
    return cast(
        scanner.sensor,
        scanner.spec.mount,
        trajectory=recording.trajectory,
        world=world,
        frame=frame,
        seed=recording.settings.seed,
        settings=recording.settings.scanner,
    )


def _works(recording: Recording, scanner: Scanner, *, frame: int) -> bool:
    """Whether scanners work at any time of a frame."""
    start, end = scanner.sensor.window_ns(frame)
    on = recording.scanning_ns
    return on is None or bool(((on[:, 0] <= end) & (on[:, 1] >= start)).any())


def sent_pulses(recording: Recording, scanner: Scanner, *, frame: int) -> Firings:
    """The pulses of a frame, as far as scanners work during it."""
    sent = find_pulse(scanner.sensor, frame, settings=recording.settings.scanner)
    return sent if recording.scanning_ns is None else sent.where(_while_on(recording, sent.time_ns))


def _while_on(recording: Recording, time_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Mask (n,) of times at which scanners work."""
    on = recording.scanning_ns
    assert on is not None  # noqa: S101
    first = np.searchsorted(on[:, 0], time_ns, side="right") - 1
    return (first >= 0) & (time_ns <= np.maximum.accumulate(on[:, 1])[first])


def write_clouds(
    recording: Recording,
    scanner: Scanner,
    *,
    frame: int,
    cloud: Cloud,
    paths: dict[str, Path],
    velocity: NDArray[np.float32] | None = None,
) -> None:
    """Write a cloud in every format: in the sensor frame, de-skewed, and in the world frame.

    velocity : (n,) radial velocities of a Doppler scanner, m/s; by default they are simulated
    """
    settings, watch = recording.settings, recording.watch
    begin, time_ns = scanner.frame_start_ns(frame), firing_times(cloud)
    table = cloud_table(cloud) | {"time_ns": (time_ns - begin).astype(np.uint32)}
    world_formats = [form for form in settings.cloud_formats if form.frame == "world"]
    placed = np.empty((0, 3))
    compensated = settings.deskew or any(form.kitti for form in settings.cloud_formats)
    if world_formats or compensated:
        mount = scanner.spec.mount
        with watch.stage("georeference"):
            placed = placed_cloud(cloud, recording.trajectory, mount=mount)
    if scanner.sensor.fmcw:
        if velocity is None:
            velocity = _velocity(recording, scanner, frame=frame, cloud=cloud)
        table["velocity"] = velocity

    def still_at(time_ns: int) -> Table:
        still = deskew(placed, recording.trajectory, mount=scanner.spec.mount, time_ns=time_ns)
        return table | dict(zip("xyz", still.T, strict=True))

    info = None
    if any(form.framed for form in settings.cloud_formats):
        pose = _pose_in_crs(recording, scanner, time_ns=begin)
        info = FrameInfo(scanner.name, frame, begin, pose)
    deskewed_table: Table = {}
    if settings.deskew:
        deskewed_table = still_at(begin + int(MOMENTS[settings.deskew] * scanner.period_ns))
    for form in settings.cloud_formats:
        if form.frame == "sensor":
            with watch.stage(f"write {form.name}"):
                form.write(paths[form.name], still_at(begin) if form.kitti else table, frame=info)
                if settings.deskew:
                    form.write(paths[f"deskewed {form.name}"], deskewed_table, frame=info)
    if world_formats:
        with watch.stage("georeference"):
            east, north, up = recording.geo.points(placed).T
            gps = gps_seconds(recording.start, time_ns)
            world_table = table | {"x": east, "y": north, "z": up, "gps_time": gps}
            if (strips := recording.scanning_ns) is not None:
                sent = sent_pulses(recording, scanner, frame=frame)
                edges = edge_times(sent.direction, mount=mount, time_ns=sent.time_ns, ring=sent.ring)
                world_table |= flight_columns(
                    placed, recording.trajectory, mount=mount, time_ns=time_ns, strips=strips, edges=edges
                )
        for form in world_formats:
            with watch.stage(f"write {form.name}"):
                form.write(paths[form.name], world_table, info=recording.las_info, frame=info)


def _pose_in_crs(recording: Recording, scanner: Scanner, *, time_ns: int) -> Float:
    """The pose (4, 4) of a scanner in the export CRS: the rotation nearest to the projection's map."""
    mount = scanner.spec.mount
    pose = recording.trajectory.at([time_ns]).mounted(mount.translation, mount.rotation)
    ends = recording.geo.points(pose.position[0] + np.vstack([np.zeros(3), pose.rotation[0].T]))
    left, _, right = np.linalg.svd((ends[1:] - ends[0]).T)
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = left @ right, ends[0]
    return out


def _velocity(recording: Recording, scanner: Scanner, *, frame: int, cloud: Cloud) -> NDArray[np.float32]:
    """Radial velocities (n,) as measured, m/s; with noise if ranges have noise."""
    moving = None
    if recording.actors is not None:
        placed = placed_cloud(cloud, recording.trajectory, mount=scanner.spec.mount)
        moving = surface_velocity(recording.actors, cloud.feature, placed=placed, time_ns=firing_times(cloud))
    mount, sigma = scanner.spec.mount, scanner.sensor.velocity_sigma
    velocity = radial_velocity(cloud, mount, trajectory=recording.trajectory, moving=moving)
    if sigma and recording.settings.scanner.range_noise != "none":
        rng = generator(recording.settings.seed, scanner.name, frame, "velocity noise")
        if isinstance(cloud, TracedCloud):  # a return keeps its noise when stages remove others
            row = np.where(cloud.source >= 0, cloud.source, cloud.source.max(initial=-1) + 1)
            noise = rng.standard_normal(int(row.max(initial=-1)) + 1, np.float32)[row]
        else:
            noise = rng.standard_normal(len(velocity), np.float32)
        velocity = velocity + np.float32(sigma) * noise
    return velocity


def _boxes(
    recording: Recording, scanner: Scanner, *, frame: int, cloud: Cloud, world: World
) -> dict[str, NDArray[Any]]:
    """Columns of the 3D boxes of road users, with the number of points on each and its visibility."""
    actors, visibility = recording.actors, recording.visibility
    assert actors is not None  # noqa: S101
    assert visibility is not None  # noqa: S101
    (begin, end), mount = scanner.sensor.window_ns(frame), scanner.spec.mount
    columns = box_rows(
        actors,
        recording.trajectory,
        time_ns=begin,
        end_ns=end,
        frame=frame,
        radius=recording.max_range,
        feature=cloud.feature,
    )
    points = count_points(actors, columns["id"], feature=cloud.feature)
    origin = recording.trajectory.at([begin]).mounted(mount.translation, mount.rotation).position[0]
    share = visibility.seen_from(origin, world, rows=columns["id"], time_ns=begin)
    return {**columns, "points": points, "visibility": np.round(share, 4)}
