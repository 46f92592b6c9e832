"""Files of a dataset that are signed."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from lidar.dataset.checksums import CHECKSUMS
from lidar.dataset.layout import Dataset

_FRAME = re.compile(r"(\d{6,})[._].*")

_NOT_SIGNED = ("integrity", CHECKSUMS)
"""Signatures, and checksums, which are of signatures, too."""


@dataclass(frozen=True)
class SignedFiles:
    """The files of a dataset that are signed, by their paths relative to it.

    frames : by sensor and frame number
    others : that belong to no frame
    """

    frames: dict[str, dict[int, list[str]]]
    others: list[str]

    @property
    def count(self) -> int:
        """Number of files."""
        return len(self.others) + sum(len(own) for group in self.frames.values() for own in group.values())


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


def is_truth(place: Path) -> bool:
    """Whether a file is ground truth of stages, which is not signed: whoever reads data does not have it."""
    return "truth" in place.parts[:-1] or place.name.endswith(".truth.csv")


def _places(path: Path) -> list[Path]:
    """Paths of the files in a directory, relative to it, in order; no signatures, checksums or truth."""
    places = [file.relative_to(path) for file in sorted(path.rglob("*")) if not file.is_dir()]
    return [place for place in places if place.parts[0] not in _NOT_SIGNED and not is_truth(place)]
