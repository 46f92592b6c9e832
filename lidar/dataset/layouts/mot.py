"""Tracks of road users in images, in the layout of MOTChallenge: one sequence for each camera."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from geoscene.classes import Class
from geoscene.support.files import copy_file, write_lines
from geoscene.support.progress import Progress
from lidar.dataset.ground_truth import read_boxes
from lidar.dataset.layout import Dataset
from lidar.dataset.recorded import Stream, all_images
from lidar.errors import DatasetError

CLASSES = {
    Class.PEDESTRIAN: 1,
    **dict.fromkeys((Class.CYCLIST, Class.MOTORCYCLIST), 2),
    Class.CAR: 3,
    Class.BICYCLE: 4,
    Class.MOTORCYCLE: 5,
    **dict.fromkeys((Class.VAN, Class.TRUCK, Class.BUS), 3),
}
"""MOT's classes: pedestrian, person on vehicle, car, bicycle, motorbike; larger vehicles count as cars."""


@dataclass(frozen=True, slots=True)
class TrackedBox:
    """A box of a road user in an image.

    track, image : from 0
    box          : left, top, right, bottom, pixels, the centre of the first being 0
    """

    track: int
    image: int
    box: tuple[float, float, float, float]
    kind: int
    visibility: float

    def text(self) -> str:
        """A line of MOT, whose numbers of images, tracks and pixels begin at 1."""
        left, top, right, bottom = self.box
        place = f"{left + 1:.2f},{top + 1:.2f},{right - left:.2f},{bottom - top:.2f}"
        return f"{self.image + 1},{self.track + 1},{place},1,{self.kind},{self.visibility:.4f}"


_COLUMNS = ("frame", "id", "left", "top", "right", "bottom", "pixels", "visibility")


def export(dataset: Dataset, folder: Path, *, progress: Progress) -> dict[str, int]:
    """Write the images and boxes of each camera; return the numbers of images, tracks and boxes.

    Boxes are those of the whole road user, cut off at the image, of those with visible pixels.

    Raises DatasetError for a drive without colour images or road users.
    """
    streams = [s for s in all_images(dataset) if dataset.paths.sensor_boxes(s.name).exists()]
    if not streams:
        raise DatasetError(f"{dataset.path}: no images with boxes of road users; drive with `traffic`")
    total, done, boxes = sum(len(s.files) for s in streams), 0, 0
    tracks: set[int] = set()
    for stream in streams:
        place = folder / "train" / stream.name
        lines = sequence(dataset, stream)
        tracks |= {line.track for line in lines}
        width, height = int(stream.sensor["width"]), int(stream.sensor["height"])
        write_lines(place / "gt" / "gt.txt", (line.text() for line in lines))
        info = {"name": stream.name, "imDir": "img1", "frameRate": f"{float(stream.sensor['rate_hz']):g}"}
        info |= {"seqLength": str(len(stream.files)), "imWidth": str(width), "imHeight": str(height)}
        info |= {"imExt": ".png"}
        write_lines(place / "seqinfo.ini", ["[Sequence]", *(f"{key}={value}" for key, value in info.items())])
        for k, path in enumerate(stream.files):
            copy_file(dataset.frame_file(path), place / "img1" / f"{k + 1:06d}.png")
            done += 1
            progress("MOT", done, total=total)
        boxes += len(lines)
    write_lines(folder / "seqmaps" / "all.txt", ["name", *(stream.name for stream in streams)])
    return {"images": done, "tracks": len(tracks), "boxes": boxes}


def sequence(dataset: Dataset, stream: Stream) -> list[TrackedBox]:
    """The boxes in a camera's images, by track and image."""
    number = {frame: k for k, frame in enumerate(stream.frames.tolist())}
    side = [int(stream.sensor[name]) - 1 for name in ("width", "height")]
    lines = []
    for box in read_boxes(dataset.paths.sensor_boxes(stream.name), _COLUMNS):
        if box["frame"] in number and box["pixels"]:
            left, right = (min(max(box[name], 0.0), side[0]) for name in ("left", "right"))
            top, bottom = (min(max(box[name], 0.0), side[1]) for name in ("top", "bottom"))
            kind = CLASSES[Class[box["class"].upper()]]
            place = (left, top, right, bottom)
            lines.append(TrackedBox(box["id"], number[box["frame"]], place, kind, float(box["visibility"])))
    return sorted(lines, key=lambda line: (line.track, line.image))
