"""Which files of a directory are signed: of datasets, and of folders of KITTI and nuScenes."""

from __future__ import annotations

import re
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

from lidar.dataset.checksums import CHECKSUMS
from lidar.dataset.foreign import foreign_clouds
from lidar.dataset.layout import Dataset, Paths, open_dataset
from lidar.errors import DatasetError

_FRAME = re.compile(r"(\d{6,})[._].*")
_KEYFRAME = re.compile(r".*__(\d{16})[._].*")
"""Names of nuScenes, which end in microseconds."""

_NOT_SIGNED = ("integrity", CHECKSUMS)
"""Signatures, and checksums, which are of signatures, too."""


@dataclass(frozen=True)
class SignedFiles:
    """The files of a directory that are signed, by their paths relative to it.

    frames : by sensor and frame number
    others : that belong to no frame
    """

    frames: dict[str, dict[int, list[str]]]
    others: list[str]

    @property
    def count(self) -> int:
        """Number of files."""
        return len(self.others) + sum(len(own) for group in self.frames.values() for own in group.values())


@dataclass(frozen=True)
class Signable:
    """A directory that can be signed.

    path    : the directory
    dataset : of this program; None for a folder of KITTI or nuScenes
    """

    path: Path
    dataset: Dataset | None = None

    @property
    def integrity(self) -> Path:
        """Folder of digests and the signature."""
        return Paths(self.path).integrity

    def files(self) -> SignedFiles:
        """The files that are signed."""
        return _files_of_folder(self.path) if self.dataset is None else signed_files(self.dataset)

    def time_ns(self, sensor: str, frames: list[int]) -> list[int]:
        """Nanoseconds of frames since a drive's start, or, of nuScenes, since 1970; -1 if not known."""
        if self.dataset is None:
            return [1000 * frame if frame > _LEAST_MICROSECONDS else -1 for frame in frames]
        times = self.dataset.sample_times(sensor).tolist()
        return [times[frame] if frame < len(times) else -1 for frame in frames]

    def rate_hz(self, sensor: str) -> float:
        """Frames of a sensor a second, by which clouds in the world frame are cut; 0 if unknown."""
        known = {} if self.dataset is None else self.dataset.sensors()
        return float(known.get(sensor, {}).get("rate_hz", 0.0))


_LEAST_MICROSECONDS = 10**15


def signable(path: Path) -> Signable:
    """A dataset, or a folder with clouds of KITTI or nuScenes.

    Raises DatasetError for another directory.
    """
    if Paths(path).manifest.exists():
        return Signable(path, open_dataset(path))
    if not foreign_clouds(path):
        raise DatasetError(f"{path}: no dataset.json, no velodyne*/*.bin and no *.pcd.bin in it")
    return Signable(path)


def is_truth(place: Path) -> bool:
    """Whether a file is ground truth of stages, which is not signed: whoever reads data does not have it."""
    return "truth" in place.parts[:-1] or place.name.endswith(".truth.csv")


def signed_files(dataset: Dataset) -> SignedFiles:
    """The files of a dataset that are signed."""
    sensors = dataset.sensors("lidar", "camera")
    found = SignedFiles({name: {} for name in sensors}, [])
    for place in _places(dataset.path):
        number = _FRAME.fullmatch(place.name)
        if place.parts[0] in sensors and len(place.parts) > 2 and number:
            found.frames[place.parts[0]].setdefault(int(number[1]), []).append(place.as_posix())
        else:
            found.others.append(place.as_posix())
    return found


def place_of(place: Path) -> tuple[str, int] | None:
    """Folder and number of a frame of KITTI or nuScenes; None for a file of no frame."""
    number = _FRAME.fullmatch(place.name) or _KEYFRAME.fullmatch(place.name)
    folder = place.parent.as_posix()
    return None if number is None else ("clouds" if folder == "." else folder, int(number[1]))


def _files_of_folder(path: Path) -> SignedFiles:
    frames: dict[str, dict[int, list[str]]] = defaultdict(lambda: defaultdict(list))
    others = []
    for place in _places(path):
        if found := place_of(place):
            frames[found[0]][found[1]].append(place.as_posix())
        else:
            others.append(place.as_posix())
    return SignedFiles({name: dict(own) for name, own in frames.items()}, others)


def _places(path: Path) -> list[Path]:
    """Paths of the files in a directory, relative to it, in order; no signatures, checksums or truth."""
    places = [file.relative_to(path) for file in sorted(path.rglob("*")) if not file.is_dir()]
    return [place for place in places if place.parts[0] not in _NOT_SIGNED and not is_truth(place)]
