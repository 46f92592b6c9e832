"""Figures of one drive of the matrix: what an attack did to each frame, and what defences say of it."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene import __version__
from geoscene.scene import Scene, open_scene
from geoscene.scene.layout import using
from geoscene.support.digests import file_digest
from geoscene.support.files import write_json
from geoscene.support.untrusted import read_arrays
from geoscene.typing import Bools, Float, Ints
from lidar.dataset.ground_truth import read_boxes
from lidar.dataset.layout import Dataset, Paths, open_dataset, reading_file
from lidar.errors import LidarError
from lidar.tools.defences.observation import Observation, RecordedScans, read_scans
from lidar.tools.defences.registry import NamedDefence, judged_frames, lacks
from lidar.tools.defences.scores import frame_truth
from lidar.tools.detection import RULES
from lidar.tools.detection.detector import KINDS
from lidar.tools.detection.learned import read_detector

KIND_OF = {code.name.lower(): kind for code, kind in KINDS.items()}
"""What the detector calls a class of road users, by its name in files of boxes."""

FEWEST = 10
"""Returns of a road user from which on the detector should find it."""

NEAR = {"vehicle": 2.0, "person": 1.0, "cycle": 1.5}
"""Metres between a detection and a road user's middle within which it is found."""

_LOST = 0.5
"""Share of a road user's returns that an attack takes from which on the road user is a target."""

PLACED = "placed_object"
"""Kind of an object that an attacker puts into the scene."""

_COLUMNS = ("id", "instance", "kind", "x", "y", "vx", "vy", "length", "width", "points")


@dataclass(frozen=True)
class AttackCase:
    """A drive to measure.

    path     : its folder
    twin     : folder of the same drive without attack; None for one without
    out      : file for the figures
    defences : that judge it
    score    : of a detection from which on it counts
    detector : name of the one that gives the boxes
    """

    path: Path
    twin: Path | None
    out: Path
    defences: tuple[NamedDefence, ...]
    score: float
    detector: str = RULES.name


def measure_drive(case: AttackCase) -> dict[str, Any]:
    """The figures of a drive; from the file if it has them of the same drive, twin and defences.

    ``frames`` has a row for each frame of each scanner; in a drive with an attack, those that it leaves as
    they are have no verdicts. ``absent`` are defences whose needs the data lack.

    Raises LidarError for a dataset that cannot be read.
    """
    if (known := kept(case)) is not None:
        return known
    dataset = open_dataset(case.path)
    needs_scene = any("scene" in named.defence.needs for named in case.defences)
    opened = using(open_scene(dataset.scene_path), known=LidarError) if needs_scene else nullcontext()
    with opened as scene:
        document = _document(case, dataset, scene=scene)
    document = json.loads(json.dumps({"key": _key(case)} | document))
    write_json(case.out, document)
    return dict(document)


def kept(case: AttackCase) -> dict[str, Any] | None:
    """The figures in the file of a drive; None if they are not of the same drive, twin and defences."""
    with suppress(OSError, ValueError, LookupError, TypeError):
        document = json.loads(case.out.read_text("utf-8-sig"))
        if document["key"] == _key(case):
            return dict(document)
    return None


def _key(case: AttackCase) -> str:
    drives = [Paths(path).journal for path in (case.path, case.twin) if path is not None]
    identity = read_detector(case.detector).identity
    made_of = [__version__, case.score, identity, [file_digest(path) for path in drives]]
    return json.dumps([*made_of, [named.to_json() for named in case.defences]])


def _document(case: AttackCase, dataset: Dataset, *, scene: Scene | None) -> dict[str, Any]:
    detector = read_detector(case.detector)
    twin = [] if case.twin is None else read_scans(open_dataset(case.twin), detector=detector)
    twins = {scans.sensor.name: scans for scans in twin}
    frames: list[dict[str, Any]] = []
    absent: set[str] = set()
    for scans in read_scans(dataset, detector=detector):
        lacking = {named.name for named in case.defences if lacks(named.defence, scans)}
        absent |= lacking
        able = [named for named in case.defences if named.name not in lacking]
        frames += _frames(scans, able, twin=twins.get(scans.sensor.name), scene=scene, score=case.score)
    return {"absent": sorted(absent), "frames": frames}


def _frames(
    scans: RecordedScans,
    defences: Sequence[NamedDefence],
    *,
    twin: RecordedScans | None,
    scene: Scene | None,
    score: float,
) -> Iterator[dict[str, Any]]:
    dataset, name = scans.dataset, scans.sensor.name
    changes = None if twin is None else [_change(scans, twin, row=row) for row in range(len(scans.frames))]
    rows = None if changes is None else {row for row, change in enumerate(changes) if is_attacked(change)}
    for row, judged in enumerate(judged_frames(scans, defences, scene=scene, rows=rows)):
        frame = judged.frame
        figures: dict[str, Any] = {
            "sensor": name,
            "frame": frame.number,
            "seconds": frame.start_ns * 1e-9,
            "suspicion": {key: round(v.frame, 5) for key, v in judged.verdicts.items()},
            "object_suspicion": {
                key: v.objects.round(5).tolist()
                for key, v in judged.verdicts.items()
                if v.objects is not None
            },
            "cost": {key: round(seconds, 5) for key, seconds in judged.seconds.items()},
        }
        if changes is not None:
            figures |= changes[row]
        if rows is None or row in rows:
            users = _users(dataset, name, frame=frame.number)
            matched = _match(frame, users)
            truth = frame_truth(scans, frame)
            forged = truth.objects(frame.members) | _near(frame, _place(users))
            figures["objects"] = _objects(frame, forged=forged, matched=matched)
            if twin is None:
                figures["users"] = _found(frame, users)
            else:
                found = set(matched[frame.objects.score >= score].tolist())
                figures |= _hidden(scans, twin, row=row, found=found, score=score)
        yield figures


def is_attacked(frame: Mapping[str, Any]) -> bool:
    """Whether an attack changed what the sensors deliver of a frame, of which the figures are given."""
    return any(frame.get(name, 0) > 0 for name in ("added", "lost", "images", "fix_error"))


def _change(scans: RecordedScans, twin: RecordedScans, *, row: int) -> dict[str, Any]:
    """Changes of an attack to a frame's returns, images and fixes, against the drive without it."""
    frame, other, name = scans.frame(row), twin.frame(row), scans.sensor.name
    placed = _place(_users(scans.dataset, name, frame=frame.number))
    truth, before = frame_truth(scans, frame), frame_truth(twin, other)
    pictures = zip(frame.pictures, other.pictures, strict=True)
    return {
        "added": int(truth.returns.sum()) + sum(int(user["points"]) for user in placed),
        "lost": max(len(truth.removed_xyz) - len(before.removed_xyz), 0),
        "images": sum(one.file.read_bytes() != another.file.read_bytes() for one, another in pictures),
        "fix_error": round(_fix_error(frame, other), 3),
    }


def _place(users: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Objects that an attacker placed and that the scanner sees."""
    return [user for user in users if user["kind"] == PLACED and user["points"] > 0]


def _objects(frame: Observation, *, forged: Bools, matched: Ints) -> dict[str, Any]:
    """Columns of the detector's boxes; ``user`` is the number of the road user, -1 for none."""
    boxes = frame.objects
    return {
        "score": boxes.score.round(4).tolist(),
        "distance": np.hypot(*boxes.centre[:, :2].T).round(2).tolist(),
        "kind": boxes.kind.tolist(),
        "forged": forged.tolist(),
        "user": matched.tolist(),
    }


def _hidden(
    scans: RecordedScans, twin: RecordedScans, *, row: int, found: set[int], score: float
) -> dict[str, int]:
    """Number of road users that an attack hides.

    found : numbers of the road users that the detector finds in spite of it

    ``targets`` are road users that the detector finds in the twin, the drive without attack, and that lose
    half of their returns to it; it no longer finds the ``hidden`` ones.
    """
    name, number = scans.sensor.name, int(scans.frames[row])
    users = _users(twin.dataset, name, frame=number)
    taken, before = (_remove(of.dataset.paths.truth(name, number)) for of in (scans, twin))
    robbed = set()
    for user in users:
        returns, feature = int(user["points"]), int(user["instance"])
        lost = np.count_nonzero(taken == feature) - np.count_nonzero(before == feature)
        if returns >= FEWEST and lost >= _LOST * returns:
            robbed.add(int(user["id"]))
    if not robbed:
        return {"targets": 0, "hidden": 0}
    frame = twin.frame(row)
    targets = robbed & set(_match(frame, users)[frame.objects.score >= score].tolist())
    return {"targets": len(targets), "hidden": len(targets - found)}


def _remove(path: Path) -> NDArray[np.int32]:
    """Features (k,) of the returns that stages removed or moved."""
    if not path.exists():
        return np.empty(0, np.int32)
    with reading_file(path):
        features: NDArray[np.int32] = read_arrays(path)["removed_feature"]
    return features


def _fix_error(frame: Observation, twin: Observation) -> float:
    """Metres between the last fixes before the end of a frame and of its twin; 0 without fixes."""
    if frame.navigation is None or twin.navigation is None:
        return 0.0
    end = frame.time_ns.max(initial=frame.start_ns)
    row = int(np.searchsorted(frame.navigation.gnss["time_ns"], end, side="right")) - 1
    if row < 0 or row >= len(twin.navigation.east_north):
        return 0.0
    apart = frame.navigation.east_north[row] - twin.navigation.east_north[row]
    return float(np.nan_to_num(np.hypot(*apart)))


def _users(dataset: Dataset, sensor: str, *, frame: int) -> list[dict[str, Any]]:
    """Boxes of road users of a frame."""
    path = dataset.paths.frame_boxes(sensor, frame)
    return read_boxes(path, _COLUMNS) if path.exists() else []


def _match(frame: Observation, users: Sequence[Mapping[str, Any]]) -> Ints:
    """Number of the road user that each box of the detector is of; -1 for none.

    A box is of the nearest road user of its kind that no better one is of. Both are compared at the time of
    the box's returns.
    """
    boxes = frame.objects
    number = np.full(len(boxes), -1, np.int64)
    if not users:
        return number
    away = _apart(frame, users)
    kinds = np.array([KIND_OF.get(user["class"], "") for user in users])
    free = np.ones(len(users), bool)
    for k in range(len(boxes)):
        apart = np.where(free & (kinds == boxes.kind[k]), away[k], np.inf)
        nearest = int(np.argmin(apart))
        if apart[nearest] <= NEAR[str(boxes.kind[k])]:
            number[k], free[nearest] = users[nearest]["id"], False
    return number


def _near(frame: Observation, placed: Sequence[Mapping[str, Any]]) -> Bools:
    """Whether each box of the detector is at an object that an attacker placed."""
    if not placed:
        return np.zeros(len(frame.objects), bool)
    reach = np.array([np.hypot(user["length"], user["width"]) / 2 + 1.0 for user in placed])
    near: Bools = np.any(_apart(frame, placed) <= reach, axis=1)
    return near


def _apart(frame: Observation, users: Sequence[Mapping[str, Any]]) -> Float:
    """Metres (k, m) from the middles of the detector's boxes to those of road users, at the boxes' times."""
    time_ns = np.array([_time(frame, rows) for rows in frame.members], np.int64)
    place = frame.placed(frame.objects.centre, time_ns)[:, None, :2]
    scale = float(frame.poses([frame.start_ns]).scale[0, 0])
    xy, speed = (np.array([[user[a], user[b]] for user in users]) for a, b in (("x", "y"), ("vx", "vy")))
    later = ((time_ns - frame.start_ns) * 1e-9)[:, None, None]
    apart: Float = np.linalg.norm(xy + later * speed * scale - place, axis=2) / scale
    return apart


def _time(frame: Observation, rows: NDArray[np.intp]) -> int:
    """Time of the returns of a box."""
    return int(np.median(frame.time_ns[rows])) if len(rows) else frame.start_ns


def _found(frame: Observation, users: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Road users that have returns, with their distances from the scanner in metres."""
    pose = frame.poses([frame.start_ns])
    rows = []
    for user in users:
        away = float(np.hypot(*(np.array([user["x"], user["y"]]) - pose.position[0, :2])) / pose.scale[0, 0])
        if user["points"] > 0:
            kind = KIND_OF.get(user["class"], "")
            rows.append(
                {"id": user["id"], "kind": kind, "distance": round(away, 2), "points": user["points"]}
            )
    return rows
