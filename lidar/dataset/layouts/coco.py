"""Images of a drive with COCO's annotations: 2D boxes, masks of objects, and panoptic segments.

Lin et al. 2014 (objects), Kirillov et al. 2019 (panoptic). Objects are road users, signs, traffic lights and
benches; all else is stuff. Masks are of visible pixels.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import find_objects

from geoscene.classes import Class, class_codes
from geoscene.support.files import copy_file, write_atomically
from geoscene.support.progress import Progress
from geoscene.typing import Ints
from lidar.dataset.ground_truth import boxes_by_frame
from lidar.dataset.layout import Dataset, reading_file
from lidar.dataset.png import feature_to_image, image_to_feature, read_png, write_png
from lidar.dataset.recorded import Stream, all_images
from lidar.errors import DatasetError
from lidar.geometry.time_scales import iso_times

Row = dict[str, Any]

log = logging.getLogger(__name__)

THINGS = (
    Class.CAR, Class.VAN, Class.TRUCK, Class.BUS, Class.MOTORCYCLE, Class.BICYCLE, Class.CYCLIST,
    Class.PEDESTRIAN, Class.MOTORCYCLIST, Class.TRAFFIC_SIGN, Class.TRAFFIC_LIGHT, Class.BENCH,
)  # fmt: skip
"""Classes of which each object is a segment. Of others all pixels are one; `Class.UNLABELED` is none."""

_ROAD_USERS = frozenset(klass for klass in THINGS if klass >= Class.CAR)
_BOX = ("left", "top", "right", "bottom")
_COLUMNS = ("frame", "id", "instance", "class", *_BOX, "pixels", "visibility")
_SEEN = tuple(f"seen_{side}" for side in _BOX)
_EDGE = 0.5
"""Pixels from the coordinates of a dataset, whose first pixel has its centre at 0, to COCO's edges at 0."""
_SPREAD = 0x9E3779
"""Multiplier of numbers, modulo 2^24: odd, so that they stay apart, and their colours become different."""


def export(dataset: Dataset, folder: Path, *, progress: Progress) -> dict[str, int]:
    """Write images, ``instances.json`` and, with semantic and instance images, ``panoptic.json`` and its PNG.

    Raises DatasetError for a drive without colour images.
    """
    cameras = all_images(dataset)
    if not cameras:
        raise DatasetError(f"{dataset.path}: holds no colour images; drive with a rig that has cameras")
    images: list[Row] = []
    objects: list[Row] = []
    panoptic: list[Row] = []
    total = sum(len(camera.files) for camera in cameras)
    for camera in cameras:
        road_users = boxes_by_frame(dataset.paths.sensor_boxes(camera.name), _COLUMNS, key="instance")
        segmented = _has_segments(dataset, camera)
        for row, frame in enumerate(camera.frames.tolist()):
            image = _image(dataset, camera, row=row, number=len(images) + 1)
            images.append(image)
            copy_file(camera.files[row], folder / "images" / image["file_name"])
            boxes = road_users.get(frame, {})
            if segmented:
                segments = _segments(dataset, camera, frame=frame)
                panoptic.append(_panoptic(segments, image, folder=folder / "annotations" / "panoptic"))
                found = _mask(segments, boxes)
            else:
                found = (_annotate_box(box) for box in boxes.values() if box["pixels"])
            for annotation in found:
                number = {"id": len(objects) + 1, "image_id": image["id"]}
                objects.append(number | annotation)
            progress("COCO", len(images), total=total)
    common = _about(dataset) | {"images": images}
    document = common | {"annotations": objects, "categories": categories(things=True)}
    _write(folder, "instances", document=document)
    if panoptic:
        own = {row["image_id"] for row in panoptic}
        common["images"] = [image for image in images if image["id"] in own]
        _write(folder, "panoptic", document=common | {"annotations": panoptic, "categories": categories()})
    return {"images": len(images), "objects": len(objects), "panoptic images": len(panoptic)}


def categories(*, things: bool = False) -> list[Row]:
    """COCO's categories: the classes with their own codes, but `Class.UNLABELED`, which is no segment.

    things : only those of objects
    """
    return [
        {
            "id": int(klass),
            "name": klass.name.lower(),
            "supercategory": "road user" if klass in _ROAD_USERS else "scene",
            "isthing": int(klass in THINGS),
            "color": class_codes().color[klass].tolist(),
        }
        for klass in Class
        if klass != Class.UNLABELED and (klass in THINGS or not things)
    ]


def encoded_mask(mask: NDArray[np.bool_], *, top: int = 0, left: int = 0, size: tuple[int, int]) -> Row:
    """COCO's compressed run lengths of a mask within an image.

    mask      : (h, w), of the part of the image from row ``top`` and column ``left`` on
    size      : height and width of the image

    Runs go down the columns, first of pixels outside the mask. Each length, from the fourth on less the one
    two before it, is a two's complement in groups of five bits, the lowest first, as printable characters
    with a bit that says whether another follows (``rleToString`` of the COCO API).
    """
    height, width = size
    columns = np.zeros((mask.shape[1], height), bool)
    columns[:, top : top + mask.shape[0]] = mask.T
    flat = columns.ravel()
    turns = np.flatnonzero(np.diff(flat, prepend=False, append=False)) + left * height
    lengths = np.diff(np.concatenate([[0], turns, [height * width]]))
    if len(turns) and turns[-1] == height * width:
        lengths = lengths[:-1]
    value = lengths.copy()
    value[3:] -= lengths[1:-2]
    open_, rest = np.ones(len(value), bool), value
    groups = []
    while open_.any():
        low, rest = rest & 31, rest >> 5
        more = np.where(low & 16, rest != -1, rest != 0) & open_
        groups.append(np.where(open_, (low | more << 5) + 48, 0))
        open_ = more
    characters = np.stack(groups, axis=1).ravel()
    text = characters[characters > 0].astype(np.uint8).tobytes().decode("ascii")
    return {"size": [height, width], "counts": text}


@dataclass(frozen=True)
class _Segments:
    """The segments of an image.

    index    : (h, w) int64, number of each pixel's segment from 1; 0 for none
    klass    : (k,) of each segment
    instance : (k,) number of the feature or road user; -1 for stuff
    """

    index: Ints
    klass: Ints
    instance: Ints

    def boxes(self) -> list[tuple[slice, slice]]:
        """Rows and columns of each segment."""
        return list(find_objects(self.index, len(self.klass)))

    def areas(self) -> Ints:
        """Pixels (k,) of each segment."""
        return np.bincount(self.index.ravel(), minlength=len(self.klass) + 1)[1:]


def _segments(dataset: Dataset, camera: Stream, *, frame: int) -> _Segments:
    """The segments of a frame, by its semantic and instance images."""
    klass, instance = label_images(dataset, camera.name, frame=frame)
    instance = np.where(np.isin(klass, THINGS), instance, -1)
    keys, index = np.unique(klass << 32 | (instance + 1), return_inverse=True)
    index = index.reshape(klass.shape) + 1
    if keys[0] == Class.UNLABELED:
        index, keys = index - 1, keys[1:]
    return _Segments(index, keys >> 32, (keys & 0xFFFFFFFF) - 1)


def _bbox(place: tuple[slice, slice]) -> list[int]:
    """Left, top, width and height of rows and columns."""
    rows, columns = place
    return [columns.start, rows.start, columns.stop - columns.start, rows.stop - rows.start]


def _mask(segments: _Segments, boxes: Mapping[int, Row]) -> Iterator[Row]:
    """Annotations of the objects among the segments of an image.

    boxes : rows of the camera's boxes by the number of the instance
    """
    areas = segments.areas().tolist()
    for k, place in enumerate(segments.boxes()):
        if segments.instance[k] < 0:
            continue
        rows, columns = place
        mask = encoded_mask(
            segments.index[place] == k + 1, top=rows.start, left=columns.start, size=segments.index.shape
        )
        yield {
            "category_id": int(segments.klass[k]),
            "segmentation": mask,
            "area": areas[k],
            "bbox": _bbox(place),
            "iscrowd": 0,
            **_of_road_user(boxes.get(int(segments.instance[k]))),
        }


def _annotate_box(box: Row) -> Row:
    """The annotation of a road user of which only boxes are recorded."""
    bbox = _edges([box[name] for name in _SEEN])
    return {
        "category_id": int(Class[box["class"].upper()]),
        "area": box["pixels"],
        "bbox": bbox,
        "iscrowd": 0,
        **_of_road_user(box),
    }


def _of_road_user(box: Row | None) -> Row:
    """Entries of a road user beyond COCO's: track id, visibility and amodal box."""
    if box is None:
        return {}
    whole = _edges([box[name] for name in _BOX])
    return {"track_id": box["id"], "visibility": box["visibility"], "amodal_bbox": whole}


def _edges(sides: list[float]) -> list[float]:
    """Left, top, width and height in COCO's pixels of left, top, right and bottom in those of a dataset."""
    left, top, right, bottom = sides
    return [round(v, 2) for v in (left + _EDGE, top + _EDGE, right - left, bottom - top)]


def _panoptic(segments: _Segments, image: Row, *, folder: Path) -> Row:
    """Write the panoptic image of a frame; return its annotation."""
    numbers = _numbers(segments)
    pixels = np.append(0, numbers)[segments.index]
    write_png(folder / image["file_name"], feature_to_image((pixels - 1).astype(np.int32)))
    rows = zip(numbers, segments.klass.tolist(), segments.areas().tolist(), segments.boxes(), strict=True)
    return {
        "image_id": image["id"],
        "file_name": image["file_name"],
        "segments_info": [
            {"id": number, "category_id": klass, "area": area, "bbox": _bbox(place), "iscrowd": 0}
            for number, klass, area, place in rows
        ],
    }


def _numbers(segments: _Segments) -> list[int]:
    """Numbers of segments, from 1 to 2^24 - 1, unique in the image; stuff has its class's colour."""
    red_first = class_codes().color.astype(np.int64) @ [1, 256, 65536]
    taken: dict[int, None] = {}
    for klass, instance in zip(segments.klass.tolist(), segments.instance.tolist(), strict=True):
        number = int(red_first[klass]) if instance < 0 else (instance + 1) * _SPREAD % 2**24
        while number in taken or number == 0:
            number = (number + 1) % 2**24
        taken[number] = None
    return list(taken)


def _has_segments(dataset: Dataset, camera: Stream) -> bool:
    """Whether a camera recorded semantic and instance images of all its colour images."""
    missing = missing_labels(dataset, camera.name, frames=camera.frames)
    if missing:
        log.warning(
            '%s: boxes without masks: it has no %s; masks need images = ["rgb", "semantic", "instance"]'
            " in the rig",
            camera.name, missing,
        )  # fmt: skip
    return not missing


LABEL_IMAGES = ("semantic", "instance")


def missing_labels(dataset: Dataset, name: str, *, frames: Ints) -> str:
    """The first semantic or instance image that a camera lacks of some frames (n,); empty for none."""
    for kind in LABEL_IMAGES:
        for frame in frames.tolist():
            if not dataset.frame_file(dataset.paths.image(name, frame, kind=kind)).exists():
                return f"{kind} image of frame {frame}"
    return ""


def label_images(dataset: Dataset, name: str, *, frame: int) -> tuple[Ints, Ints]:
    """Classes and feature numbers (h, w) of the pixels of a camera's frame, -1 for no feature.

    Raises DatasetError for damaged images.
    """
    semantic, instance = (dataset.paths.image(name, frame, kind=kind) for kind in LABEL_IMAGES)
    with reading_file(semantic):
        klass = read_png(semantic).astype(np.int64)
        if not np.isin(klass, [int(k) for k in Class]).all():
            raise ValueError("pixels of no class")
    with reading_file(instance):
        feature = image_to_feature(read_png(instance).astype(np.uint8)).astype(np.int64)
        if feature.shape != klass.shape:
            raise ValueError("not of the size of the semantic image")
    return klass, feature


def _image(dataset: Dataset, camera: Stream, *, row: int, number: int) -> Row:
    stamp = iso_times(dataset.start, camera.time_ns[row : row + 1])[0]
    return {
        "id": number,
        "file_name": f"{camera.name}_{camera.frames[row]:06d}.png",
        "width": int(camera.sensor["width"]),
        "height": int(camera.sensor["height"]),
        "license": 1,
        "date_captured": stamp,
        "camera": camera.name,
        "frame_number": int(camera.frames[row]),
    }


def _about(dataset: Dataset) -> Row:
    """COCO's ``info`` and ``licenses``."""
    manifest = dataset.manifest
    with reading_file(dataset.paths.manifest):
        attribution, licence = str(manifest["attribution"]), str(manifest.get("licence", ""))
    info = {
        "description": f"simulated drive {dataset.path.resolve().name}",
        "year": dataset.start.year,
        "contributor": attribution,
        "date_created": dataset.start.isoformat(),
    }
    return {"info": info, "licenses": [{"id": 1, "name": licence, "url": ""}]}


def _write(folder: Path, name: str, *, document: Row) -> None:
    write_atomically(folder / "annotations" / f"{name}.json", json.dumps(document).encode("utf-8"))
