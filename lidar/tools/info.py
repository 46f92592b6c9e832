"""Description of recorded data from their metadata: contents, origin, missing parts."""

from __future__ import annotations

import math
import os
import re
from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from geoscene.classes import Class
from geoscene.errors import reason_of
from geoscene.support.progress import Progress, displayed, shows_progress
from geoscene.support.storage import shown
from geoscene.typing import Ints
from lidar.dataset.checksums import CHECKSUMS, files_in, read_checksums
from lidar.dataset.derived import read_folder_provenance
from lidar.dataset.foreign import ForeignFolder, open_recorded, read_foreign_stages
from lidar.dataset.formats import FORMATS, Format
from lidar.dataset.journal import read_journal
from lidar.dataset.layout import (
    Dataset,
    DatasetLike,
    Paths,
    opened_rows,
    reading_file,
)
from lidar.errors import DatasetError
from lidar.geometry.attitude import OPTICAL, euler_from_quat, quat_from_matrix
from lidar.signal.registry import ATTACKS

_TABLE_BYTES = 2**24
"""Size of tables beyond which they are read only when everything is."""

_GAP = 1.5
"""Periods of a sensor between its frames or samples from which on they count as a gap."""

_LISTED = 10
"""Gaps and missing frames that are listed of a sensor; all are counted."""

_FRAME = re.compile(r"(\d{6,})[._].*")

_FOREIGN_BYTES = {"kitti": 16, "nuscenes": 20}
"""Bytes of a return in the files of these formats."""


@dataclass(slots=True)
class _Sizes:
    """Files of a directory.

    kinds  : number of files and bytes, by kind: folder of frames, or suffix of another file
    frames : numbers of the frames that have a file, by folder
    """

    kinds: dict[str, list[int]] = field(default_factory=lambda: defaultdict(lambda: [0, 0]))
    frames: dict[str, set[int]] = field(default_factory=lambda: defaultdict(set))

    def to_json(self) -> dict[str, Any]:
        kinds = {kind: {"files": n, "bytes": size} for kind, (n, size) in sorted(self.kinds.items())}
        return {
            "files": sum(row["files"] for row in kinds.values()),
            "bytes": sum(row["bytes"] for row in kinds.values()),
            "kinds": kinds,
        }


@shows_progress
def describe(path: DatasetLike, *, full: bool = False, progress: Progress = displayed) -> dict[str, Any]:
    """Describe a dataset, or a folder with clouds of KITTI or nuScenes, as a JSON document.

    Only metadata and sizes are read.

    full : read all point clouds and tables, too: points by class, and rates of large tables

    Raises DatasetError for another directory, with the command that describes it, and for damaged metadata.
    """
    found = open_recorded(path)
    if isinstance(found, ForeignFolder):
        return _foreign(found.path, found.clouds)
    return _dataset(found, shown(path), full=full, progress=progress)


def _dataset(dataset: Dataset, name: str, *, full: bool, progress: Progress) -> dict[str, Any]:
    manifest = dataset.manifest
    sensors = dataset.sensors()
    sizes = _sizes(dataset, folders=sensors.keys())
    with reading_file(dataset.paths.manifest):
        recipe = manifest["recipe"]
        stages = [_stage(table) for key in ("stages", "applied_stages") for table in recipe.get(key) or ()]
        document: dict[str, Any] = {
            "path": name,
            "kind": "dataset",
            "generator": str(manifest.get("generator", "")),
            "versions": dict(manifest.get("versions", {})),
            "scene": dict(manifest["scene"]),
            "sources": [dict(source) for source in manifest.get("sources", ())],
            "licence": str(manifest.get("licence", "")),
            "attribution": str(manifest.get("attribution", "")),
            "start_time": dataset.start.isoformat(),
            "duration_s": float(manifest["duration_ns"]) / 1e9,
            "length_m": float(manifest["length_m"]),
            "frames": dataset.frames,
            "finished": int(manifest["frames_done"]) == dataset.frames,
            "rig": str(manifest["rig"]),
            "seed": int(manifest["seed"]),
            "traffic": dict(recipe.get("traffic") or {}),
            "crs": {
                "scene": dataset.frame.name,
                "export": _crs_name(dataset),
                "vertical": dataset.frame.vertical,
            },
            "stages": stages,
            "denoised": str(recipe.get("denoised", "")),
            "watermark_step_m": recipe.get("watermark"),
            "settings": {str(name): str(value) for name, value in recipe.get("settings") or ()},
            "recipe": recipe,
            "derived_from": [
                {k: str(v) for k, v in step.items()} for step in manifest.get("derived_from", ())
            ],
            "limits": list(manifest.get("limits", ())),
        }
    document["extent"] = _extent(dataset)
    found = {k: _sensor(dataset, k, row=row, sizes=sizes, full=full) for k, row in sensors.items()}
    document["sensors"] = found
    points = [row["points"] for row in found.values() if row.get("points") is not None]
    document["points"] = sum(points)
    document |= _integrity(dataset.path)
    if full:
        document["classes"] = _classes(dataset, progress=progress)
        document["road_users"] = _road_users(dataset)
    return document | {"size": sizes.to_json()}


def _stage(table: Mapping[str, Any]) -> dict[str, Any]:
    """A stage with its group: weather, attack or stage."""
    name = str(table["name"])
    group = "attack" if name in ATTACKS else "weather" if name.startswith("weather") else "stage"
    return {"group": group, **table}


def _crs_name(dataset: Dataset) -> str:
    code = dataset.crs.to_epsg()
    return dataset.crs.name + (f" (EPSG:{code})" if code else "")


def _integrity(folder: Path) -> dict[str, Any]:
    """Whether a folder has checksums, and a signature."""
    paths, found = Paths(folder), dict[str, Any]()
    if paths.checksums.is_file():
        stated = read_checksums(paths.checksums)
        found["checksums"] = {"files": len(stated.sha256), "digest": stated.digest}
    else:
        found["checksums"] = None
    return found | {"signed": paths.chain.is_file()}


def _extent(dataset: Dataset) -> dict[str, Any] | None:
    """Bounds of the ego vehicle's poses; None of a drive without any."""
    path = dataset.paths.poses
    with reading_file(path), opened_rows(path) as rows:
        places = np.array([_place_of(row, line=line) for line, row in enumerate(rows, 2)])
    if not len(places):
        if dataset.frames:
            raise DatasetError(
                f"{path}: has no poses of {dataset.frames} frames; drive again with `overwrite`"
            )
        return None
    lon = places[:, 0]
    if np.ptp(lon) > 180:  # over the antimeridian: west is then the greater number
        lon = np.where(lon < 0, lon + 360, lon)
    west, east = (float((value + 180) % 360 - 180) for value in (lon.min(), lon.max()))
    south, low = places[:, 1:].min(axis=0).tolist()
    north, high = places[:, 1:].max(axis=0).tolist()
    return {"west": west, "south": south, "east": east, "north": north, "low_m": low, "high_m": high}


def _place_of(row: Mapping[str, str], *, line: int) -> tuple[float, float, float]:
    """Longitude, latitude and height of a row of poses; raises ValueError for one that holds no pose."""
    try:
        values = {name: float(text) for name, text in row.items() if name != "timestamp"}
    except ValueError as error:
        raise ValueError(f"line {line}: {reason_of(error)}") from None
    if bad := [name for name, value in values.items() if not math.isfinite(value)]:
        raise ValueError(f"line {line}: {bad[0]} is {row[bad[0]]}, not a finite number")
    return values["lon"], values["lat"], values["h"]


def _sensor(
    dataset: Dataset, name: str, *, row: Mapping[str, Any], sizes: _Sizes, full: bool
) -> dict[str, Any]:
    """Model, mount, rates, gaps and points of a sensor."""
    with reading_file(dataset.paths.calibration):
        kind, mount = str(row["kind"]), np.array(row["vehicle_from_sensor"], float)
        if kind == "camera":
            mount[:3, :3] = mount[:3, :3] @ OPTICAL.T  # body axes, as rigs state them
        angles = np.degrees(euler_from_quat(quat_from_matrix(mount[None, :3, :3])))[0]
        rate_hz = float(row["rate_hz"])
        if not 0 < rate_hz < math.inf:
            raise ValueError(f"rate_hz of {name} is {rate_hz}")
        out: dict[str, Any] = {
            "kind": kind,
            "model": str(row.get("model", "")),
            "rate_hz": rate_hz,
            "mount": {
                "xyz_m": [round(v, 6) for v in mount[:3, 3].tolist()],
                "roll_pitch_yaw_deg": [round(v, 6) + 0.0 for v in angles.tolist()],
            },
        }
    framed = kind in ("lidar", "camera")
    table = dataset.paths.timestamps(name) if framed else dataset.paths.measurements(name)
    if not table.is_file():
        return out | {"frames" if framed else "samples": 0}
    if full or table.stat().st_size <= _TABLE_BYTES:
        times = dataset.sample_times(name)
        out["frames" if framed else "samples"] = len(times)
        out |= _rates(times, rate_hz)
        if framed:
            out |= _missing(len(times), name, sizes=sizes)
    elif framed:
        out["frames"] = _lines(table) - 1
        out |= _missing(out["frames"], name, sizes=sizes)
    if kind == "lidar":
        out |= _points(dataset, name)
    return out


def _lines(path: Path) -> int:
    """Number of lines of a file."""
    with path.open("rb") as file:
        return sum(block.count(b"\n") for block in iter(lambda: file.read(2**20), b""))


def _rates(times_ns: Ints, rate_hz: float) -> dict[str, Any]:
    """Measured rate and gaps of frames or samples."""
    steps = np.diff(times_ns)
    if not len(steps):
        return {"gaps": {"count": 0, "longest_s": 0.0, "first": []}}
    wide = np.flatnonzero(steps > _GAP * 1e9 / rate_hz)
    first = [[int(times_ns[k]) / 1e9, int(times_ns[k + 1]) / 1e9] for k in wide[:_LISTED].tolist()]
    return {
        "measured_hz": round(float(1e9 / np.median(steps)), 6),
        "gaps": {
            "count": len(wide),
            "longest_s": float(steps[wide].max()) / 1e9 if len(wide) else 0.0,
            "first": first,
        },
    }


def _missing(frames: int, name: str, *, sizes: _Sizes) -> dict[str, Any]:
    """Frames of a sensor that lack a file which others have."""
    folders = {place: have for place, have in sizes.frames.items() if place.startswith(f"{name}/")}
    lacking: set[int] = set(range(frames)) if not folders else set()
    for have in folders.values():
        lacking |= set(range(frames)) - have
    return {"missing": {"count": len(lacking), "first": sorted(lacking)[:_LISTED]}}


def _points(dataset: Dataset, name: str) -> dict[str, Any]:
    """Points of a scanner: of all frames and, where the drive noted them, the fewest and most of one."""
    table = read_journal(dataset.paths.journal).of(name)
    total = dataset.manifest.get("points", {}).get(name)
    if not len(table):
        return {"points": total}
    counts = table.points
    per_frame = {"fewest": int(counts.min()), "median": float(np.median(counts)), "most": int(counts.max())}
    return {"points": int(counts.sum()) if total is None else total, "points_per_frame": per_frame}


def _list_files(folder: Path) -> Iterator[tuple[str, int]]:
    """Paths of all files of a directory, relative to it, and their bytes."""
    for name in files_in(folder):
        yield name, os.lstat(folder / name).st_size
    if Paths(folder).checksums.exists():
        yield CHECKSUMS, Paths(folder).checksums.stat().st_size


def _sizes(dataset: Dataset, *, folders: Collection[str]) -> _Sizes:
    """Files and bytes of a dataset, by kind.

    folders : names of sensors, whose folders hold a folder for each kind of file
    """
    found, stored = _Sizes(), dataset.stored
    files = _list_files(dataset.path)
    if stored is not None:
        files = ((name, int(about.get("size") or 0)) for name, about in stored.listed().items())
    for name, size in files:
        parts = name.split("/")
        own = len(parts) > 2 and parts[0] in folders
        kind = parts[1] if own else "integrity" if parts[0] == "integrity" else "tables and metadata"
        row = found.kinds[kind]
        row[0] += 1
        row[1] += size
        if own and (number := _FRAME.fullmatch(parts[-1])):
            found.frames[f"{parts[0]}/{parts[1]}"].add(int(number[1]))
    return found


def _classes(dataset: Dataset, *, progress: Progress) -> dict[str, dict[str, int]]:
    """Points by class of each scanner whose clouds are labelled."""
    found: dict[str, dict[str, int]] = {}
    names = {int(klass): klass.name.lower() for klass in Class}
    labelled = [form for form in FORMATS.values() if "label" in form.columns]
    for name in dataset.sensors("lidar"):
        every = ([(form, path) for _, path in dataset.files(name, form)] for form in labelled)
        files = next(filter(None, every), [])
        counts = np.zeros(256, np.int64)
        for done, (form, path) in enumerate(files):
            progress(f"reading {name}", done, total=len(files))
            counts += np.bincount(form.read(path)["label"], minlength=256)[:256]
        if files:
            progress(f"reading {name}", len(files), total=len(files))
            rows = np.flatnonzero(counts).tolist()
            found[name] = {names.get(code, f"code {code}"): int(counts[code]) for code in rows}
    return found


def _road_users(dataset: Dataset) -> dict[str, int]:
    """Road users near the first scanner, by class."""
    path, users = dataset.paths.boxes, dict[str, set[str]]()
    if path.exists():
        with reading_file(path), opened_rows(path) as rows:
            for row in rows:
                users.setdefault(Class[str(row["class"]).upper()].name.lower(), set()).add(row["id"])
    return {name: len(users[name]) for name in sorted(users)}


def _foreign(folder: Path, clouds: Sequence[tuple[Path, Format]]) -> dict[str, Any]:
    """Describe a folder of KITTI or nuScenes."""
    groups: dict[str, dict[str, Any]] = {}
    for path, form in clouds:
        place, size = path.parent.relative_to(folder).as_posix(), path.stat().st_size
        row = groups.setdefault(place, {"format": form.name, "frames": 0, "points": 0, "damaged": []})
        points, rest = divmod(size, _FOREIGN_BYTES[form.name])
        row["frames"] += 1
        row["points"] += points
        if rest:
            row["damaged"].append(path.name)
    known = read_folder_provenance(folder)
    found = _Sizes()
    for name, size in _list_files(folder):
        count = found.kinds[name.rpartition("/")[0] or "."]
        count[0], count[1] = count[0] + 1, count[1] + size
    return {
        "path": str(folder),
        "kind": "folder of " + " and ".join(sorted({form.name for _, form in clouds})),
        "clouds": groups,
        "points": sum(row["points"] for row in groups.values()),
        "stages": [_stage(table) for table in read_foreign_stages(folder)],
        "provenance": known,
        **_integrity(folder),
        "size": found.to_json(),
    }
