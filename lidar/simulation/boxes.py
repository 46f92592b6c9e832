"""Bounding boxes (3D, 2D) of road users as a drive records them."""

from __future__ import annotations

import heapq
import itertools
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geoscene.classes import Class
from geoscene.support.files import atomic_path
from geoscene.typing import Ints
from lidar.dataset.ground_truth import COLUMNS
from lidar.dataset.layout import Paths, frame_numbers, read_sensors, reading_file
from lidar.geometry.attitude import quat_from_matrix
from lidar.geometry.poses import Poses, Trajectory
from lidar.sensors.camera.outline import outline
from lidar.sensors.rig.camera_model import project
from lidar.sensors.rig.specs import CameraSpec
from lidar.world.actors import Actors, existing_actors, poses_of, rotations, states


def box_rows(
    actors: Actors,
    ego: Trajectory,
    *,
    time_ns: int,
    end_ns: int = 0,
    frame: int,
    radius: float = np.inf,
    feature: NDArray[np.integer] | None = None,
) -> dict[str, NDArray[Any]]:
    """Columns of the 3D boxes at a time, one row per actor, ordered by id.

    The actors are those that exist at some time of a frame from ``time_ns`` to ``end_ns`` and are within
    ``radius`` true metres of the ego vehicle or among a cloud's column of feature numbers. Of an actor that
    appears after ``time_ns``, as a frame's rays meet it, the box is where it appears.

    frame, time_ns  : as given
    id, instance    : number among the actors; feature number in points and pixels
    class, kind     : as in `geoscene.classes.Class` and `lidar.world.actor_shapes.KINDS`
    x, y, z         : the box's centre, scene metres
    qx, qy, qz, qw  : scene axes from the box's (x forward, y left, z up); ``yaw`` in radians from the x axis
    length, width, height : true metres
    vx, vy, vz      : true m/s along the scene's axes
    ego_x, ego_y, ego_z, ego_yaw : the centre in the ego vehicle's frame, true metres, and the yaw about its z
    ego_vx, ego_vy, ego_vz : the velocity along the ego vehicle's axes, not relative to the ego's own
    moving          : whether it moves at any time of the drive
    """
    rows = existing_actors(actors, time_ns, end_ns=max(end_ns, time_ns))
    pose = ego.at([time_ns])
    away = states(actors, rows, time_ns=time_ns).position - pose.position
    seen = np.zeros(len(rows), bool) if feature is None else count_points(actors, rows, feature=feature) > 0
    rows = rows[(np.hypot(*away[:, :2].T) <= radius * actors.scale) | seen]
    at = states(actors, rows, time_ns=time_ns)
    turn = rotations(at.angles)
    up = turn[:, :, 2] * [actors.scale, actors.scale, 1.0]
    centre = at.position + up * actors.size[rows, 2:] / 2
    quat = quat_from_matrix(turn)
    velocity = at.velocity / [actors.scale, actors.scale, 1.0]
    body = pose.rotation[0].T
    local = ((centre - pose.position) / pose.scale) @ body.T
    forward = turn[:, :, 0] @ body.T
    moved = velocity @ body.T
    triples = {"": centre, "v": velocity, "ego_": local, "ego_v": moved}
    out: dict[str, NDArray[Any]] = {
        **_names(actors, rows, frame=frame, time_ns=time_ns),
        **dict(zip(("length", "width", "height"), actors.size[rows].T, strict=True)),
        "yaw": np.arctan2(turn[:, 1, 0], turn[:, 0, 0]),
        "ego_yaw": np.arctan2(forward[:, 1], forward[:, 0]),
        **dict(zip(("qx", "qy", "qz", "qw"), quat.T, strict=True)),
        "moving": ~actors.parked[rows],
    }
    for name, values in triples.items():
        out |= {f"{name}{axis}": values[:, c] for c, axis in enumerate("xyz")}
    return {name: out[name] for name in COLUMNS}


def _names(actors: Actors, rows: Ints, *, frame: int, time_ns: int) -> dict[str, NDArray[Any]]:
    """The columns of boxes that say when they are, and of which road users."""
    return {
        "frame": np.full(len(rows), frame),
        "time_ns": np.full(len(rows), time_ns),
        "id": rows,
        "instance": actors.feature[rows],
        "class": np.array([Class(int(k)).name.lower() for k in actors.klass[rows]], np.str_),
        "kind": actors.kind[rows],
    }


def count_points(actors: Actors, rows: ArrayLike, *, feature: NDArray[np.integer]) -> Ints:
    """Number of points (k,) on each of the actors ``rows``, from a cloud's column of feature numbers."""
    low = int(actors.feature[0]) if len(actors) else 0
    mine = feature[(feature >= low) & (feature < low + len(actors))] - low
    return np.bincount(mine, minlength=len(actors))[np.asarray(rows, np.int64)]


def image_boxes(
    actors: Actors,
    camera: CameraSpec,
    *,
    pose: Poses,
    frame: int,
    time_ns: int,
    instance: NDArray[np.integer],
    span_ns: tuple[int, int] | None = None,
) -> dict[str, NDArray[Any]]:
    """Columns of the 2D boxes of the actors in an image, one row each.

    pose     : the camera's one pose at the time of the image
    instance : (h, w) feature numbers of the image
    span_ns  : first and last time of the exposure

    left, top, right, bottom : pixels, within the image, occluded or not
    seen_left, ...  : pixels, of the visible pixels; NaN if there are none
    pixels          : number of visible pixels
    visibility      : 0 to 1, visible pixels over the pixels without occlusion
    frame, ... kind : as of `box_rows`

    The pixels without occlusion are those that the actor's projected triangles cover, except triangles that
    extend behind the camera. An actor without such triangles in the image, but with pixels, has their box
    and a visibility of 1.
    """
    first, last = span_ns or (time_ns, time_ns)
    rows = existing_actors(actors, first, end_ns=last)
    at = states(actors, rows, time_ns=time_ns)
    away = ((at.position - pose.position) / pose.scale) @ pose.rotation[0]
    size = np.linalg.norm(actors.size[rows], axis=1)
    ahead = (np.linalg.norm(away, axis=1) < camera.far + size) & (
        (away[:, 2] > -size) | np.full(len(rows), camera.model == "fisheye")
    )
    ahead |= count_points(actors, rows, feature=instance) > 0
    found: list[tuple[float, ...]] = []
    body = poses_of(actors, rows, at=at)
    pixels_of = _pixels_of(actors, instance)
    for k in np.flatnonzero(ahead).tolist():
        row = int(rows[k])
        mesh = actors.shapes[body[k]].mesh
        turn = rotations(at.angles[k : k + 1])[0]
        points = at.position[k] + (mesh.vertices * actors.stretch[row]) @ turn.T * pose.scale[0]
        pixels, _ = project(camera, ((points - pose.position) / pose.scale) @ pose.rotation[0])
        box, whole = outline(pixels[mesh.faces], camera.width, height=camera.height)
        inside = bool(np.isfinite(box[0]))
        v, u = np.divmod(pixels_of.get(row, np.zeros(0, np.int64)), camera.width)
        if inside:
            left, top, right, bottom = map(int, box)
            near = (u >= left - 1) & (v >= top - 1) & (u < right + 3) & (v < bottom + 3)
            v, u = v[near], u[near]
        seen = (u.min() - 0.5, v.min() - 0.5, u.max() + 0.5, v.max() + 0.5) if len(u) else (np.nan,) * 4
        if inside or len(u):
            visible = min(len(u) / max(whole, 1), 1.0)
            found.append((row, *(box if inside else seen), *seen, len(u), visible))
    table = np.array(found, float).reshape(-1, 11)
    sides = ("left", "top", "right", "bottom")
    return {
        **_names(actors, table[:, 0].astype(np.int64), frame=frame, time_ns=time_ns),
        **dict(zip(sides, np.round(table[:, 1:5], 2).T, strict=True)),
        **{f"seen_{side}": column for side, column in zip(sides, table[:, 5:9].T, strict=True)},
        "pixels": table[:, 9].astype(np.int64),
        "visibility": np.round(table[:, 10], 4),
    }


def _pixels_of(actors: Actors, instance: NDArray[np.integer]) -> dict[int, Ints]:
    """Numbers of the pixels, row by row from the top, that show each actor of an image, by its row."""
    low = int(actors.feature[0]) if len(actors) else 0
    number = instance.ravel()
    pixels = np.flatnonzero((number >= low) & (number < low + len(actors)))
    pixels = pixels[np.argsort(number[pixels], kind="stable")]
    rows, first = np.unique(number[pixels] - low, return_index=True)
    return dict(zip(rows.tolist(), np.split(pixels, first[1:]), strict=True)) if len(rows) else {}


def merge_box_files(out: Path) -> None:
    """Write the boxes of all frames of each sensor as one file, and ``boxes.csv`` of the dataset.

    The dataset's file holds the boxes of the first scanner, with a column ``points_<scanner>`` for each
    scanner: its points on the box in frames that start between the row's time and the next row's. A box
    that only another scanner has in that time is added as of that scanner's frame.
    """
    paths = Paths(out)
    calibration = read_sensors(paths)
    headers = {
        name: _merge(paths.frame_boxes(name, 0).parent, paths.sensor_boxes(name))
        for name, s in calibration.items()
        if s["kind"] in ("lidar", "camera")
    }
    scanners = [name for name in headers if calibration[name]["kind"] == "lidar"]
    if not scanners or not headers[scanners[0]]:
        return
    with reading_file(paths.calibration):  # its kinds of sensors and their box files may disagree
        if len({headers[name] for name in scanners} - {""}) > 1:
            raise ValueError("box files of scanners have other columns")
        first = calibration[scanners[0]]
        step = partial(_step, first_ns=first["time_offset_ns"], step_ns=10**9 / first["rate_hz"])
        streams = [
            _by_step(paths.sensor_boxes(name), order, step=step)
            for order, name in enumerate(scanners)
            if headers[name]
        ]
        with atomic_path(paths.boxes) as part, part.open("w", encoding="utf-8", newline="") as file:
            file.write(",".join([headers[scanners[0]], *(f"points_{name}" for name in scanners)]) + "\n")
            names = headers[scanners[0]].split(",")
            in_time = heapq.merge(*streams, key=itemgetter(0, 1))
            for k, group in itertools.groupby(in_time, key=itemgetter(0)):
                rows = {order: cells for _, order, cells in group}
                file.writelines(_merge_rows(names, k, rows=rows, scanners=len(scanners)))


def _by_step(
    path: Path, order: int, *, step: Callable[[int], int]
) -> Iterator[tuple[int, int, list[list[str]]]]:
    """Number of each step with boxes of a scanner, the scanner's order, and the cells of the rows in it."""
    with path.open(encoding="utf-8-sig", newline="") as file:
        time = next(file).rstrip("\n").split(",").index("time_ns")
        cells = (line.rstrip("\n").split(",") for line in file)
        for k, group in itertools.groupby(cells, key=lambda row: step(int(row[time]))):
            yield k, order, list(group)


def _merge_rows(
    names: list[str], step: int, *, rows: Mapping[int, list[list[str]]], scanners: int
) -> Iterator[str]:
    """Lines of the dataset's boxes of a step, from the rows of each scanner; ``names`` of their columns."""
    frame, number, points = (names.index(name) for name in ("frame", "id", "points"))
    boxes = {int(cells[number]): cells for cells in rows.get(0, ())}
    counts: list[Counter[int]] = []
    for order in range(scanners):
        count: Counter[int] = Counter()
        for cells in rows.get(order, ()):
            count[int(cells[number])] += int(cells[points])
        for cells in rows.get(order, ()):
            user = int(cells[number])
            if user not in boxes and count[user]:
                boxes[user] = [*cells[:frame], str(step), *cells[frame + 1 :]]
        counts.append(count)
    for user in sorted(boxes):
        yield ",".join([*boxes[user], *(str(count[user]) for count in counts)]) + "\n"


def _step(time_ns: int, *, first_ns: int, step_ns: float) -> int:
    """Number of the step that holds a frame's start; 1 ns is added because starts are rounded down."""
    return int((time_ns - first_ns + 1) // step_ns)


def merge_signal_files(out: Path) -> None:
    """Write the signal heads of all frames of each camera as one file, its ``signals.csv``."""
    paths = Paths(out)
    for name in read_sensors(paths, "camera"):
        _merge(paths.frame_signals(name, 0).parent, paths.sensor_signals(name))


def _merge(folder: Path, target: Path) -> str:
    """Write the tables of all frames in a folder as one; return the header, empty without files.

    Raises DatasetError for a damaged file.
    """
    header = ""
    frames = frame_numbers(folder, ".csv").tolist()
    if not frames:
        return header
    with atomic_path(target) as whole, whole.open("w", encoding="utf-8", newline="") as file:
        for part in (folder / f"{frame:06d}.csv" for frame in frames):
            with reading_file(part):
                own, *rows = part.read_text("utf-8-sig").splitlines()
                names = own.split(",")
                numbers = [names.index(key) for key in ("frame", "time_ns", "id", "points") if key in names]
                for cells in (row.split(",") for row in rows):
                    if len(cells) != len(names) or own != (header or own):
                        raise ValueError("rows and columns disagree")
                    _ = [int(cells[column]) for column in numbers]
            lines = rows if header else [own, *rows]
            header = header or own
            file.writelines(f"{line}\n" for line in lines)
    return header
