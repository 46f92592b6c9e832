"""A recorded drive as a nuScenes dataset: samples, sweeps and the tables that its development kit opens.

Caesar et al. 2020; the schema is that of nuscenes-devkit 1.1. Two frames per second are key frames. Clouds
are de-skewed to the start of their frame, and boxes are those of that moment.
"""

from __future__ import annotations

import hashlib
import json
import logging
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from geoscene.classes import Class, class_codes
from geoscene.errors import GeosceneError
from geoscene.scene import open_scene
from geoscene.support.files import copy_file, write_atomically
from geoscene.support.progress import Progress
from geoscene.typing import Float, Ints
from lidar.dataset.formats import nuscenes
from lidar.dataset.ground_truth import COLUMNS, read_boxes
from lidar.dataset.layout import Dataset, reading_file
from lidar.dataset.png import write_png
from lidar.dataset.recorded import (
    Stream,
    color_images,
    labelled_clouds,
    nearest,
    no_clouds,
    recorded_labels,
    still_points,
)
from lidar.geometry.poses import Trajectory

Row = dict[str, Any]

log = logging.getLogger(__name__)

VERSION = "v1.0-mini"
"""Folder of the tables; the development kit's default."""

SCENE = "scene-0103"
"""Name of the scene: one of the development kit's split ``mini_val``, so that its evaluation takes it."""

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
    "vehicle.moving", "vehicle.stopped", "vehicle.parked", "cycle.with_rider", "cycle.without_rider",
    "pedestrian.moving", "pedestrian.standing",
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


def export(dataset: Dataset, folder: Path, *, progress: Progress) -> dict[str, int]:
    """Write a finished drive as a nuScenes dataset; return the numbers of samples, clouds, images and boxes.

    Positions are true metres east and north of a point south-west of the drive, which the scene's description
    states. There is one scene; the map's mask shows the roads and sidewalks of the scene that was driven in.

    Raises DatasetError for a drive without labelled clouds in the sensor frame.
    """
    return _Export(dataset, streams_of(dataset), out=folder).write(progress)


def streams_of(dataset: Dataset) -> dict[str, Stream]:
    """Scanners, the first as LIDAR_TOP, and cameras with colour images, by channel."""
    streams: dict[str, Stream] = {}
    for name, sensor in dataset.sensors("lidar", "camera").items():
        lidar = sensor["kind"] == "lidar"
        stream = labelled_clouds(dataset, name) if lidar else color_images(dataset, name)
        if stream is not None:
            streams["LIDAR_TOP" if lidar and "LIDAR_TOP" not in streams else name.upper()] = stream
    if "LIDAR_TOP" not in streams:
        raise no_clouds(dataset)
    return streams


def token_of(*parts: object) -> str:
    """A token of 32 hexadecimal digits: a hash of the arguments."""
    return hashlib.blake2b("/".join(map(str, parts)).encode(), digest_size=16).hexdigest()


def _chain(rows: Sequence[Row]) -> None:
    """Fill ``prev`` and ``next`` of rows in order of time."""
    for k, row in enumerate(rows):
        row["prev"] = rows[k - 1]["token"] if k else ""
        row["next"] = rows[k + 1]["token"] if k + 1 < len(rows) else ""


def table_frame(trajectory: Trajectory) -> tuple[Float, Float]:
    """Scale (3,) and origin (3,) of the tables' positions: the scene's over the scale, less the origin."""
    scale = np.array([trajectory.scale[0], trajectory.scale[0], 1.0])
    places = trajectory.position / scale
    return scale, np.append(np.floor(places[:, :2].min(axis=0) - _MARGIN), 0.0)


class _Export:
    """The tables of one drive, and the folder they are written to."""

    def __init__(self, dataset: Dataset, streams: Mapping[str, Stream], *, out: Path) -> None:
        self.dataset, self.streams, self.out = dataset, streams, out
        self.trajectory: Trajectory = dataset.trajectory()
        self.scale, self.zero = table_frame(self.trajectory)
        self.name = dataset.path.resolve().name
        self.tables: dict[str, list[Row]] = defaultdict(list)

    def write(self, progress: Progress) -> dict[str, int]:
        """Write all files; return the numbers of samples, clouds, images and boxes."""
        top = self.streams["LIDAR_TOP"]
        keys = key_rows(top.time_ns)
        samples = [
            {
                "token": token_of(self.name, "sample", int(top.frames[k])),
                "timestamp": self.dataset.microseconds(int(top.time_ns[k])),
                "scene_token": token_of(self.name, "scene"),
            }
            for k in keys
        ]
        _chain(samples)
        key_times = top.time_ns[keys]
        counts = {"lidar": 0, "camera": 0}
        total = sum(len(s.files) for s in self.streams.values())
        for channel, stream in self.streams.items():
            self._add_sensor(channel, stream)
            rows = []
            near = nearest(stream.time_ns, key_times)
            for k in range(len(stream.files)):
                rows.append(self._sample_data(channel, k, samples=samples, key_times=key_times, near=near))
                counts[stream.sensor["kind"]] += 1
                progress("nuScenes", sum(counts.values()), total=total)
            _chain(rows)
            self.tables["sample_data"] += rows
        self._annotate(top, keys, samples=samples)
        self._describe(samples)
        for name in (*_TABLES, *(("lidarseg",) if self.tables["lidarseg"] else ())):
            document = json.dumps(self.tables[name], indent=0)
            write_atomically(self.out / VERSION / f"{name}.json", document.encode("utf-8"))
        return {
            "samples": len(samples),
            "clouds": counts["lidar"],
            "images": counts["camera"],
            "annotations": len(self.tables["sample_annotation"]),
        }

    def _position(self, position: Float) -> list[float]:
        """A position (3,) of the scene in the tables' frame."""
        return [float(v) for v in position / self.scale - self.zero]

    def _add_sensor(self, channel: str, stream: Stream) -> None:
        token, modality = token_of("sensor", channel), stream.sensor["kind"]
        self.tables["sensor"].append({"token": token, "channel": channel, "modality": modality})
        mount = np.array(stream.sensor["vehicle_from_sensor"])
        self.tables["calibrated_sensor"].append(
            {
                "token": token_of(self.name, "calibrated", channel),
                "sensor_token": token,
                "translation": mount[:3, 3].tolist(),
                "rotation": _wxyz(mount[:3, :3]),
                "camera_intrinsic": stream.sensor.get("K", []),
            }
        )

    def _sample_data(
        self, channel: str, k: int, *, samples: Sequence[Row], key_times: Ints, near: Ints
    ) -> Row:
        """Write a frame's cloud or image and add its pose; return its row of ``sample_data``."""
        stream = self.streams[channel]
        time, source, lidar = int(stream.time_ns[k]), stream.files[k], stream.sensor["kind"] == "lidar"
        token = token_of(self.name, channel, int(stream.frames[k]))
        key = bool((near == k).any())
        sample = np.flatnonzero(near == k)[0] if key else nearest(key_times, stream.time_ns[k : k + 1])[0]
        pose = self.trajectory.at([time])
        self.tables["ego_pose"].append(
            {
                "token": token,
                "timestamp": self.dataset.microseconds(time),
                "translation": self._position(pose.position[0]),
                "rotation": _wxyz(pose.rotation[0]),
            }
        )
        suffix, folder = ".pcd.bin" if lidar else ".png", "samples" if key else "sweeps"
        name = f"{folder}/{channel}/{self.name}__{channel}__{self.dataset.microseconds(time)}{suffix}"
        path = self.out / name
        if lidar:
            self._write_cloud(stream, k, path=path, token=token, labelled=key)
        else:
            copy_file(source, path)
        return {
            "token": token,
            "sample_token": samples[sample]["token"],
            "ego_pose_token": token,
            "calibrated_sensor_token": token_of(self.name, "calibrated", channel),
            "timestamp": self.dataset.microseconds(time),
            "fileformat": "pcd" if lidar else "png",
            "is_key_frame": key,
            "height": stream.sensor.get("height", 0),
            "width": stream.sensor.get("width", 0),
            "filename": name,
        }

    def _write_cloud(self, stream: Stream, k: int, *, path: Path, token: str, labelled: bool) -> None:
        """Write a de-skewed cloud, and for a key frame the lidarseg classes of its points."""
        table = still_points(stream, self.trajectory, row=k)
        nuscenes.write(path, table)
        if labelled:
            name = f"lidarseg/{VERSION}/{token}_lidarseg.bin"
            nuscenes.write_labels(self.out / name, recorded_labels(table))
            self.tables["lidarseg"].append({"token": token, "sample_data_token": token, "filename": name})

    def _annotate(self, top: Stream, keys: Ints, *, samples: Sequence[Row]) -> None:
        """Add the boxes of key frames with returns or visibility, and the instances they belong to."""
        path = self.dataset.paths.sensor_boxes(top.name)
        if not path.exists():
            return
        sample_of = dict(zip(top.frames[keys].tolist(), samples, strict=True))
        annotations: dict[str, list[Row]] = defaultdict(list)
        category: dict[str, str] = {}
        for box in read_boxes(path, (*COLUMNS, "points", "visibility")):
            sample = sample_of.get(box["frame"])
            if sample is None or (box["points"] == 0 and box["visibility"] == 0.0):
                continue
            kind = CATEGORIES[int(class_codes().nuscenes[Class[box["class"].upper()]])]
            instance = token_of(self.name, "instance", box["id"])
            category[instance] = kind
            seen = int(np.searchsorted([0.4, 0.6, 0.8], box["visibility"], side="right"))
            annotations[instance].append(
                {
                    "token": token_of(self.name, "annotation", box["id"], box["frame"]),
                    "sample_token": sample["token"],
                    "instance_token": instance,
                    "visibility_token": str(seen + 1),
                    "attribute_tokens": [token_of("attribute", name) for name in attributes_of(kind, box)],
                    "translation": self._position(np.array([box[k] for k in "xyz"])),
                    "size": [box[k] for k in ("width", "length", "height")],
                    "rotation": [box[k] for k in ("qw", "qx", "qy", "qz")],
                    "num_lidar_pts": box["points"],
                    "num_radar_pts": 0,
                }
            )
        for instance, rows in annotations.items():
            _chain(rows)
            self.tables["sample_annotation"] += rows
            self.tables["instance"].append(
                {
                    "token": instance,
                    "category_token": token_of("category", category[instance]),
                    "nbr_annotations": len(rows),
                    "first_annotation_token": rows[0]["token"],
                    "last_annotation_token": rows[-1]["token"],
                }
            )

    def _describe(self, samples: Sequence[Row]) -> None:
        """Fill the tables that describe the whole drive."""
        path, manifest = self.dataset.paths.manifest, self.dataset.manifest
        with reading_file(path):
            place = str(manifest["scene"]["name"] or manifest["scene"]["path"])
            attribution, vehicle = str(manifest["attribution"]), str(manifest["rig"])
        log_token = token_of(self.name, "log")
        east, north = (self.zero * self.scale)[:2] + self.dataset.frame.origin
        self.tables["sample"] = list(samples)
        self.tables["scene"] = [
            {
                "token": token_of(self.name, "scene"),
                "log_token": log_token,
                "nbr_samples": len(samples),
                "first_sample_token": samples[0]["token"],
                "last_sample_token": samples[-1]["token"],
                "name": SCENE,
                "description": f"simulated in {place}; zero at {east:.3f}, {north:.3f} of"
                f" {self.dataset.frame.name}; {attribution}",
            }
        ]
        date = self.dataset.start.date().isoformat()
        self.tables["log"] = [
            {
                "token": log_token,
                "logfile": self.name,
                "vehicle": vehicle,
                "date_captured": date,
                "location": place,
            }
        ]
        mask = "maps/drivable.png"
        write_png(self.out / mask, self._map_mask())
        self.tables["map"] = [
            {
                "token": token_of(self.name, "map"),
                "log_tokens": [log_token],
                "category": "semantic_prior",
                "filename": mask,
            }
        ]
        self.tables["category"] = _name_of("category", CATEGORIES, numbered=True)
        self.tables["attribute"] = _name_of("attribute", _ATTRIBUTES)
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
        for triangles in _triangulate_pavement(self.dataset):
            xy = (triangles / self.scale[:2] - self.zero[:2]) / _PIXEL
            inside = ((xy.max(axis=1) >= 0) & (xy.min(axis=1) <= [width, height])).all(axis=1)
            for corners in (xy[inside] * [1, -1] + [0, height]).tolist():
                pen.polygon([tuple(corner) for corner in corners], fill=255)
        return np.asarray(mask)


def _triangulate_pavement(dataset: Dataset) -> Iterator[Float]:
    """Triangles (n, 3, 2), scene metres, of the roads and sidewalks in each tile of a dataset's scene."""
    try:
        scene = open_scene(dataset.scene_path)
        paved = np.isin(class_codes().nuscenes, [CATEGORIES.index(name) for name in _PAVED])
        for i, j in scene.tile_indices:
            tile = scene.tile(i, j, forests=False)
            xy = (tile.mesh.vertices + tile.origin)[:, :2]
            yield xy[tile.mesh.faces[paved[tile.mesh.klass]]]
    except GeosceneError as error:
        log.warning("the map's mask is not complete: %s", error)


_TABLES = (
    "attribute", "calibrated_sensor", "category", "ego_pose", "instance", "log", "map", "sample",
    "sample_annotation", "sample_data", "scene", "sensor", "visibility",
)  # fmt: skip


def _name_of(table: str, names: Iterable[str], *, numbered: bool = False) -> list[Row]:
    return [
        {"token": token_of(table, name), "name": name, "description": name}
        | ({"index": k} if numbered else {})
        for k, name in enumerate(names)
    ]


def _wxyz(rotation: Float) -> list[float]:
    from scipy.spatial.transform import Rotation  # noqa: PLC0415  (slow to import)

    x, y, z, w = Rotation.from_matrix(rotation).as_quat().tolist()
    return [w, x, y, z]


def key_rows(time_ns: Ints) -> Ints:
    """Indices of the frames nearest to every `KEY_NS`, without repetition."""
    wanted = np.arange(time_ns[0], time_ns[-1] + 1, KEY_NS)
    return np.unique(nearest(time_ns, wanted))


def attributes_of(kind: str, box: dict[str, Any]) -> list[str]:
    """NuScenes' attributes of a road user: moving, stopped, parked, ..."""
    speed = float(np.hypot(box["vx"], box["vy"]))
    if kind.startswith("human"):
        return ["pedestrian.moving" if speed > _WALKING else "pedestrian.standing"]
    if kind in ("vehicle.bicycle", "vehicle.motorcycle"):
        return ["cycle.with_rider" if box["class"] in ("cyclist", "motorcyclist") else "cycle.without_rider"]
    if kind.startswith("vehicle"):
        if speed > _DRIVING:
            return ["vehicle.moving"]
        return ["vehicle.stopped" if box["moving"] else "vehicle.parked"]
    return []
