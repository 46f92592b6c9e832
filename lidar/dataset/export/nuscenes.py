"""A recorded drive as a nuScenes dataset: samples, sweeps and the tables that its development kit opens.

Caesar et al. 2020; the schema is that of nuscenes-devkit 1.1. Two frames per second are key frames. Clouds
are de-skewed to the start of their frame, and boxes are those of that moment.
"""

from __future__ import annotations

import hashlib
import json
import logging
import shutil
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from geoscene.classes import Class, class_codes
from geoscene.errors import GeosceneError
from geoscene.files import write_atomically
from geoscene.progress import Progress
from geoscene.scene import open_scene
from geoscene.typing import Float
from lidar.camera.png import write_png
from lidar.dataset.formats import FORMATS, Format, nuscenes, read_table
from lidar.dataset.formats.table import PointLabels, placed_returns
from lidar.dataset.layout import Dataset, read_rows
from lidar.errors import DatasetError
from lidar.geometry.poses import Poses, Trajectory

Row = dict[str, Any]

log = logging.getLogger(__name__)

VERSION = "v1.0-mini"
"""Folder of the tables; the development kit's default."""

KEY_NS = 500_000_000
"""Nanoseconds between key frames."""

CATEGORIES = (
    "noise", "animal", "human.pedestrian.adult", "human.pedestrian.child",
    "human.pedestrian.construction_worker", "human.pedestrian.personal_mobility",
    "human.pedestrian.police_officer", "human.pedestrian.stroller", "human.pedestrian.wheelchair",
    "movable_object.barrier", "movable_object.debris", "movable_object.pushable_pullable",
    "movable_object.trafficcone", "static_object.bicycle_rack", "vehicle.bicycle", "vehicle.bus.bendy",
    "vehicle.bus.rigid", "vehicle.car", "vehicle.construction", "vehicle.emergency.ambulance",
    "vehicle.emergency.police", "vehicle.motorcycle", "vehicle.trailer", "vehicle.truck",
    "flat.driveable_surface", "flat.other", "flat.sidewalk", "flat.terrain", "static.manmade",
    "static.other", "static.vegetation", "vehicle.ego",
)  # fmt: skip
"""Categories of nuScenes-lidarseg, in order of their codes."""

_ATTRIBUTES = (
    "vehicle.moving", "vehicle.stopped", "vehicle.parked", "cycle.with_rider", "pedestrian.moving",
    "pedestrian.standing",
)  # fmt: skip
_VISIBILITY = ("v0-40", "v40-60", "v60-80", "v80-100")
_MARGIN = 200.0
"""Metres from the drive's bounds to the origin of the tables' frame, so that coordinates are positive."""
_PIXEL = 0.1
"""Metres of the map's pixels: the development kit takes all maps to have them."""
_LARGEST_MASK = 4 * 10**8
_PAVED = ("flat.driveable_surface", "flat.sidewalk")
_WALKING, _DRIVING = 0.2, 0.5
"""Speeds in m/s above which pedestrians and vehicles have the attribute ``moving``."""


@dataclass(frozen=True)
class _Stream:
    """A sensor's frames: numbers, times (nanoseconds since the start) and files."""

    name: str
    channel: str
    modality: str
    sensor: Row
    frames: list[int]
    times: list[int]
    files: list[Path]


def export(dataset: Dataset, folder: Path, *, progress: Progress) -> dict[str, int]:
    """Write a finished drive as a nuScenes dataset; return the numbers of samples, clouds, images and boxes.

    Positions are true metres east and north of a point south-west of the drive, which the scene's description
    states. There is one scene; the map's mask shows the roads and sidewalks of the scene that was driven in.

    Raises DatasetError for a drive without labelled clouds in the sensor frame.
    """
    return _Export(dataset, _streams(dataset), out=folder).write(progress)


def _streams(dataset: Dataset) -> list[_Stream]:
    """Scanners, the first as LIDAR_TOP, and cameras with colour images."""
    streams: list[_Stream] = []
    for name, sensor in dataset.sensors("lidar", "camera").items():
        if sensor["kind"] == "lidar":
            form = next((f for f in _formats() if any(dataset.files(name, f))), None)
            found = list(dataset.files(name, form)) if form else []
        else:
            images = sorted(dataset.paths.image(name, 0, kind="rgb").parent.glob("*.png"))
            found = [(int(path.stem), path) for path in images]
        if not found:
            continue
        lidar = sensor["kind"] == "lidar"
        first = lidar and not any(s.modality == "lidar" for s in streams)
        at = dataset.sample_times(name).tolist()
        frames = [frame for frame, _ in found]
        streams.append(
            _Stream(
                name,
                "LIDAR_TOP" if first else name.upper(),
                sensor["kind"],
                sensor,
                frames,
                [at[frame] for frame in frames],
                [path for _, path in found],
            )
        )
    if not any(s.modality == "lidar" for s in streams):
        names = ", ".join(form.name for form in _formats())
        raise DatasetError(
            f"{dataset.path}: holds no labelled clouds in the sensor frame; drive with `formats` {names}"
        )
    return streams


def _formats() -> list[Format]:
    """Formats that keep what samples need: points in the sensor frame with times and labels."""
    needed = {"time_ns", "label", "ring"}
    return [form for form in FORMATS.values() if form.frame == "sensor" and needed <= set(form.columns)]


def _token(*parts: object) -> str:
    """A token of 32 hexadecimal digits: a hash of the arguments."""
    return hashlib.blake2b("/".join(map(str, parts)).encode(), digest_size=16).hexdigest()


def _chained(rows: Sequence[Row]) -> None:
    """Fill ``prev`` and ``next`` of rows in order of time."""
    for k, row in enumerate(rows):
        row["prev"] = rows[k - 1]["token"] if k else ""
        row["next"] = rows[k + 1]["token"] if k + 1 < len(rows) else ""


class _Export:
    """The tables of one drive, and the folder they are written to."""

    def __init__(self, dataset: Dataset, streams: Sequence[_Stream], *, out: Path) -> None:
        self.dataset, self.streams, self.out = dataset, streams, out
        self.trajectory: Trajectory = dataset.trajectory()
        self.scale = np.array([self.trajectory.scale[0], self.trajectory.scale[0], 1.0])
        places = self.trajectory.position / self.scale
        self.zero = np.append(np.floor(places[:, :2].min(axis=0) - _MARGIN), 0.0)
        self.name = dataset.path.resolve().name
        self.tables: dict[str, list[Row]] = defaultdict(list)

    def write(self, progress: Progress) -> dict[str, int]:
        """Write all files; return the numbers of samples, clouds, images and boxes."""
        top = next(s for s in self.streams if s.modality == "lidar")
        keys = _key_frames(top.times)
        samples = [
            {
                "token": _token(self.name, "sample", top.frames[k]),
                "timestamp": self._stamp(top.times[k]),
                "scene_token": _token(self.name, "scene"),
            }
            for k in keys
        ]
        _chained(samples)
        key_times = np.array([top.times[k] for k in keys], np.int64)
        counts = {"lidar": 0, "camera": 0}
        total = sum(len(s.files) for s in self.streams)
        for stream in self.streams:
            self._add_sensor(stream)
            rows = []
            near = _nearest(stream.times, key_times)
            for k, frame in enumerate(stream.frames):
                rows.append(
                    self._sample_data(stream, k, frame=frame, samples=samples, key_times=key_times, near=near)
                )
                counts[stream.modality] += 1
                progress("nuScenes", sum(counts.values()), total=total)
            _chained(rows)
            self.tables["sample_data"] += rows
        self._annotate(top, keys, samples=samples)
        self._describe(samples)
        (self.out / VERSION).mkdir(parents=True, exist_ok=True)
        for name in (*_TABLES, *(("lidarseg",) if self.tables["lidarseg"] else ())):
            document = json.dumps(self.tables[name], indent=0)
            write_atomically(self.out / VERSION / f"{name}.json", document.encode("utf-8"))
        return {
            "samples": len(samples),
            "clouds": counts["lidar"],
            "images": counts["camera"],
            "annotations": len(self.tables["sample_annotation"]),
        }

    def _stamp(self, time_ns: int) -> int:
        """Microseconds since 1970."""
        return round(self.dataset.start.timestamp() * 1e6) + time_ns // 1000

    def _position(self, position: Float) -> list[float]:
        """A position (3,) of the scene in the tables' frame."""
        return [float(v) for v in position / self.scale - self.zero]

    def _add_sensor(self, stream: _Stream) -> None:
        token = _token("sensor", stream.channel)
        self.tables["sensor"].append({"token": token, "channel": stream.channel, "modality": stream.modality})
        mount = np.array(stream.sensor["vehicle_from_sensor"])
        self.tables["calibrated_sensor"].append(
            {
                "token": _token(self.name, "calibrated", stream.channel),
                "sensor_token": token,
                "translation": mount[:3, 3].tolist(),
                "rotation": _wxyz(mount[:3, :3]),
                "camera_intrinsic": stream.sensor.get("K", []),
            }
        )

    def _sample_data(
        self,
        stream: _Stream,
        k: int,
        *,
        frame: int,
        samples: Sequence[Row],
        key_times: NDArray[np.int64],
        near: NDArray[np.int64],
    ) -> Row:
        """Write a frame's cloud or image and add its pose; return its row of ``sample_data``."""
        time, source = stream.times[k], stream.files[k]
        token = _token(self.name, stream.channel, frame)
        key = bool((near == k).any())
        sample = int(np.flatnonzero(near == k)[0]) if key else int(_nearest(key_times.tolist(), [time])[0])
        pose = self.trajectory.at([time])
        self.tables["ego_pose"].append(
            {
                "token": token,
                "timestamp": self._stamp(time),
                "translation": self._position(pose.position[0]),
                "rotation": _wxyz(pose.rotation[0]),
            }
        )
        suffix = ".pcd.bin" if stream.modality == "lidar" else ".png"
        folder = "samples" if key else "sweeps"
        name = f"{folder}/{stream.channel}/{self.name}__{stream.channel}__{self._stamp(time)}{suffix}"
        path = self.out / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if stream.modality == "lidar":
            self._write_cloud(stream, source, time=time, path=path, token=token, labelled=key)
        else:
            shutil.copyfile(source, path)
        return {
            "token": token,
            "sample_token": samples[sample]["token"],
            "ego_pose_token": token,
            "calibrated_sensor_token": _token(self.name, "calibrated", stream.channel),
            "timestamp": self._stamp(time),
            "fileformat": "pcd" if stream.modality == "lidar" else "png",
            "is_key_frame": key,
            "height": stream.sensor.get("height", 0),
            "width": stream.sensor.get("width", 0),
            "filename": name,
        }

    def _write_cloud(
        self, stream: _Stream, source: Path, *, time: int, path: Path, token: str, labelled: bool
    ) -> None:
        """Write a de-skewed cloud, and for a key frame the lidarseg classes of its points."""
        table = read_table(source)
        mount = np.array(stream.sensor["vehicle_from_sensor"])
        placed, _ = placed_returns(table, self.trajectory, start_ns=time, vehicle_from_sensor=mount)
        here: Poses = self.trajectory.at([time]).mounted(mount[:3, 3], mount[:3, :3])
        still = ((placed - here.position[0]) / here.scale[0]) @ here.rotation[0]
        nuscenes.write(path, table | {axis: still[:, k] for k, axis in enumerate("xyz")})
        if labelled:
            name = f"lidarseg/{VERSION}/{token}_lidarseg.bin"
            (self.out / name).parent.mkdir(parents=True, exist_ok=True)
            n = len(placed)
            labels = PointLabels(table["label"].astype(np.int64), np.zeros(n, np.int64), np.zeros(n, bool))
            nuscenes.write_labels(self.out / name, labels)
            self.tables["lidarseg"].append({"token": token, "sample_data_token": token, "filename": name})

    def _annotate(self, top: _Stream, keys: Sequence[int], *, samples: Sequence[Row]) -> None:
        """Add the boxes of key frames with returns or visibility, and the instances they belong to."""
        path = self.dataset.paths.sensor_boxes(top.name)
        if not path.exists():
            return
        sample_of = {top.frames[k]: sample for k, sample in zip(keys, samples, strict=True)}
        annotations: dict[str, list[Row]] = defaultdict(list)
        category: dict[str, str] = {}
        for box in read_rows(path):
            sample = sample_of.get(int(box["frame"]))
            if sample is None or (int(box["points"]) == 0 and float(box["visibility"]) == 0.0):
                continue
            kind = CATEGORIES[int(class_codes().nuscenes[Class[box["class"].upper()]])]
            instance = _token(self.name, "instance", box["id"])
            category[instance] = kind
            seen = int(np.searchsorted([0.4, 0.6, 0.8], float(box["visibility"]), side="right"))
            annotations[instance].append(
                {
                    "token": _token(self.name, "annotation", box["id"], box["frame"]),
                    "sample_token": sample["token"],
                    "instance_token": instance,
                    "visibility_token": str(seen + 1),
                    "attribute_tokens": [_token("attribute", name) for name in _attributes(kind, box)],
                    "translation": self._position(np.array([float(box[k]) for k in "xyz"])),
                    "size": [float(box[k]) for k in ("width", "length", "height")],
                    "rotation": [float(box[k]) for k in ("qw", "qx", "qy", "qz")],
                    "num_lidar_pts": int(box["points"]),
                    "num_radar_pts": 0,
                }
            )
        for instance, rows in annotations.items():
            _chained(rows)
            self.tables["sample_annotation"] += rows
            self.tables["instance"].append(
                {
                    "token": instance,
                    "category_token": _token("category", category[instance]),
                    "nbr_annotations": len(rows),
                    "first_annotation_token": rows[0]["token"],
                    "last_annotation_token": rows[-1]["token"],
                }
            )

    def _describe(self, samples: Sequence[Row]) -> None:
        """Fill the tables that describe the whole drive."""
        manifest = self.dataset.manifest
        log_token, place = (
            _token(self.name, "log"),
            str(manifest["scene"]["name"] or manifest["scene"]["path"]),
        )
        east, north = (self.zero * self.scale)[:2] + self.dataset.frame.origin
        self.tables["sample"] = list(samples)
        self.tables["scene"] = [
            {
                "token": _token(self.name, "scene"),
                "log_token": log_token,
                "nbr_samples": len(samples),
                "first_sample_token": samples[0]["token"],
                "last_sample_token": samples[-1]["token"],
                "name": "scene-0001",
                "description": f"simulated in {place}; zero at {east:.3f}, {north:.3f} of"
                f" {self.dataset.frame.name}; {manifest['attribution']}",
            }
        ]
        date = self.dataset.start.date().isoformat()
        self.tables["log"] = [
            {
                "token": log_token,
                "logfile": self.name,
                "vehicle": manifest["rig"],
                "date_captured": date,
                "location": place,
            }
        ]
        mask = "maps/drivable.png"
        (self.out / "maps").mkdir(parents=True, exist_ok=True)
        write_png(self.out / mask, self._map_mask())
        self.tables["map"] = [
            {
                "token": _token(self.name, "map"),
                "log_tokens": [log_token],
                "category": "semantic_prior",
                "filename": mask,
            }
        ]
        self.tables["category"] = _named("category", CATEGORIES, numbered=True)
        self.tables["attribute"] = _named("attribute", _ATTRIBUTES)
        self.tables["visibility"] = [
            {"token": str(k + 1), "level": level, "description": f"visibility {level[1:]} %"}
            for k, level in enumerate(_VISIBILITY)
        ]

    def _map_mask(self) -> NDArray[np.uint8]:
        """The map's mask: 255 on roads and sidewalks, 0 elsewhere; a pixel is `_PIXEL` metres, row 0 north.

        It covers the drive and `_MARGIN` around it. It is 0 all over without the scene, and one pixel for
        drives over more than `_LARGEST_MASK` pixels.
        """
        places = self.trajectory.position[:, :2] / self.scale[:2] - self.zero[:2]
        width, height = (np.ceil((places.max(axis=0) + _MARGIN) / _PIXEL)).astype(int).tolist()
        if width * height > _LARGEST_MASK:
            log.warning("the drive is too long for a map's mask: the development kit cannot draw its map")
            return np.zeros((1, 1), np.uint8)
        mask = Image.new("L", (width, height))
        pen = ImageDraw.Draw(mask)
        for triangles in _paved(self.dataset):
            xy = (triangles / self.scale[:2] - self.zero[:2]) / _PIXEL
            inside = ((xy.max(axis=1) >= 0) & (xy.min(axis=1) <= [width, height])).all(axis=1)
            for corners in (xy[inside] * [1, -1] + [0, height]).tolist():
                pen.polygon([tuple(corner) for corner in corners], fill=255)
        return np.asarray(mask)


def _paved(dataset: Dataset) -> Iterator[Float]:
    """Triangles (n, 3, 2), scene metres, of the roads and sidewalks in each tile of a dataset's scene."""
    try:
        scene = open_scene(dataset.manifest["scene"]["path"])
        tiles = [scene.tile(i, j) for i, j in scene.tile_indices]
    except GeosceneError as error:
        log.warning("the map's mask is empty: %s", error)
        return
    paved = np.isin(class_codes().nuscenes, [CATEGORIES.index(name) for name in _PAVED])
    for tile in tiles:
        xy = (tile.mesh.vertices + tile.origin)[:, :2]
        yield xy[tile.mesh.faces[paved[tile.mesh.klass]]]


_TABLES = (
    "attribute", "calibrated_sensor", "category", "ego_pose", "instance", "log", "map", "sample",
    "sample_annotation", "sample_data", "scene", "sensor", "visibility",
)  # fmt: skip


def _named(table: str, names: Iterable[str], *, numbered: bool = False) -> list[Row]:
    return [
        {"token": _token(table, name), "name": name, "description": name} | ({"index": k} if numbered else {})
        for k, name in enumerate(names)
    ]


def _wxyz(rotation: Float) -> list[float]:
    from scipy.spatial.transform import Rotation  # noqa: PLC0415  (slow to import)

    x, y, z, w = Rotation.from_matrix(rotation).as_quat().tolist()
    return [w, x, y, z]


def _key_frames(times: Sequence[int]) -> list[int]:
    """Indices of the frames nearest to every `KEY_NS`, without repetition."""
    wanted = np.arange(times[0], times[-1] + 1, KEY_NS)
    return sorted({int(k) for k in _nearest(times, wanted)})


def _nearest(times: Sequence[int], wanted: Sequence[int] | NDArray[np.int64]) -> NDArray[np.int64]:
    """Index of the nearest of increasing ``times`` to each target; of equally near ones the earlier."""
    have = np.asarray(times, np.int64)
    target = np.asarray(wanted, np.int64)
    after = np.clip(np.searchsorted(have, target), 1, max(len(have) - 1, 1))
    if len(have) == 1:
        return np.zeros(len(target), np.int64)
    return after - (target - have[after - 1] <= have[after] - target)


def _attributes(kind: str, box: dict[str, str]) -> list[str]:
    """NuScenes' attributes of a road user: moving, stopped, parked, ..."""
    speed = float(np.hypot(float(box["vx"]), float(box["vy"])))
    if kind.startswith("human"):
        return ["pedestrian.moving" if speed > _WALKING else "pedestrian.standing"]
    if kind in ("vehicle.bicycle", "vehicle.motorcycle"):
        return ["cycle.with_rider"]
    if kind.startswith("vehicle"):
        if speed > _DRIVING:
            return ["vehicle.moving"]
        return ["vehicle.stopped" if box["moving"] == "True" else "vehicle.parked"]
    return []
