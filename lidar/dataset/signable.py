"""Files of a dataset that are signed."""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

from lidar.dataset.checksums import CHECKSUMS
from lidar.dataset.layout import Dataset

_FRAME = re.compile(r"(\d{6,})[._].*")
_TRUTH = re.compile(r"\d{6,}\.npz")


@dataclass(frozen=True)
class SignedFiles:
    """The files of a dataset that are signed, by their paths relative to it.

    frames : by sensor and frame number
    others : that belong to no frame; of empty folders with a slash at the end
    links  : symbolic links, which are not signed and not followed
    lists  : files in the folder of signatures
    """

    frames: dict[str, dict[int, list[str]]]
    others: list[str]
    links: list[str]
    lists: list[str]

    @property
    def count(self) -> int:
        """Number of files."""
        return len(self.others) + sum(len(own) for group in self.frames.values() for own in group.values())


def signed_files(dataset: Dataset) -> SignedFiles:
    """The files of a dataset that are signed: all but checksums, signatures and the truth of its stages.

    Truth is not signed, as whoever reads the data does not have it.
    """
    kinds = {name: str(row["kind"]) for name, row in dataset.sensors().items()}
    sensors = [name for name, kind in kinds.items() if kind in ("lidar", "camera")]
    tables = {dataset.paths.measurements_truth(name).name for name in kinds}
    is_staged = any(dataset.manifest["recipe"].get(key) for key in ("stages", "applied_stages"))
    integrity = dataset.paths.integrity.name
    found = SignedFiles({name: {} for name in sensors}, [], [], [])
    for name in sorted(_entries(dataset.path)):
        place = Path(name)
        number = _FRAME.fullmatch(place.name)
        if (dataset.path / name).is_symlink():
            found.links.append(name)
        elif place.parts[0] == integrity:
            found.lists.append(name)
        elif name == CHECKSUMS or (is_staged and (name in tables or _is_truth(place, sensors))):
            continue
        elif place.parts[0] in sensors and len(place.parts) > 2 and number:
            found.frames[place.parts[0]].setdefault(int(number[1]), []).append(name)
        else:
            found.others.append(name)
    return found


def _is_truth(place: Path, sensors: Collection[str]) -> bool:
    """Whether a file is the truth of a frame."""
    folder, *below = place.parts
    return folder in sensors and below[:-1] == ["truth"] and _TRUTH.fullmatch(place.name) is not None


def _entries(folder: Path, place: str = "") -> Iterator[str]:
    """Paths of files, links and, with a slash at the end, empty folders; relative to a folder."""
    with os.scandir(folder / place) as listed:
        entries = list(listed)
    if place and not entries:
        yield place
    for entry in entries:
        if entry.is_dir(follow_symlinks=False):
            yield from _entries(folder, f"{place}{entry.name}/")
        else:
            yield f"{place}{entry.name}"
