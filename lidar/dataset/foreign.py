"""Point clouds of KITTI and nuScenes in folders that this program did not record."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from geoscene.scene.layout import SceneFiles
from geoscene.support.files import write_json
from lidar.dataset.formats import FORMATS, Format
from lidar.dataset.layout import Dataset, DatasetLike, is_dataset, open_dataset, reading_file
from lidar.errors import DatasetError

KITTI, NUSCENES = FORMATS["kitti"], FORMATS["nuscenes"]


@dataclass(frozen=True, slots=True)
class ForeignFolder:
    """A folder with point clouds of KITTI or nuScenes, in order, each with its format."""

    path: Path
    clouds: list[tuple[Path, Format]]


def open_recorded(place: DatasetLike) -> Dataset | ForeignFolder:
    """Open a dataset, or a folder with clouds of KITTI or nuScenes; opened datasets pass.

    Raises DatasetError for another place, with what it is, and as `open_dataset` does.
    """
    if is_dataset(place):
        return open_dataset(place)
    folder = Path(place)
    if not folder.is_dir():
        what = "is a file; give the directory of a dataset" if folder.exists() else "is not there"
        raise DatasetError(f"{folder}: {what}")
    if SceneFiles(folder).manifest.is_file():
        raise DatasetError(f"{folder}: is a scene; geoscene info describes it, lidar drive records in it")
    if (folder / "sweep.json").is_file():
        raise DatasetError(f"{folder}: holds the drives of a sweep; give one of its directories")
    if clouds := _foreign_clouds(folder):
        return ForeignFolder(folder, clouds)
    raise DatasetError(
        f"{folder}: no dataset.json, no velodyne*/*.bin and no *.pcd.bin in it; give a dataset of lidar"
        " drive, or a folder with clouds of KITTI or nuScenes"
    )


def _foreign_clouds(source: Path) -> list[tuple[Path, Format]]:
    """Point clouds of KITTI and nuScenes in a folder, in order."""
    found = []
    for path in sorted(filter(Path.is_file, source.rglob("*.bin"))):
        if path.name.endswith(NUSCENES.suffix):
            found.append((path, NUSCENES))
        elif path.parent == source or any(
            part.startswith("velodyne") for part in path.relative_to(source).parts[:-1]
        ):
            found.append((path, KITTI))
    return found


def foreign_truth(folder: Path, place: Path, *, form: Format) -> Path:
    """Truth file of the cloud at ``place`` in a folder."""
    return (folder / "truth" / place).with_name(f"{place.name.removesuffix(form.suffix)}.npz")


def foreign_labels(path: Path) -> Path:
    """SemanticKITTI's labels of a cloud of KITTI."""
    return path.parent.parent / "labels" / f"{path.stem}.label"


def read_foreign_stages(source: Path) -> list[dict[str, Any]]:
    """The stages that have acted on the clouds of a folder, as `NamedStage.to_json` writes them."""
    path = _stages_file(source)
    if not path.exists():
        return []
    with reading_file(path):
        stages: list[dict[str, Any]] = json.loads(path.read_text("utf-8-sig"))["stages"]
        _ = [str(stage["name"]) for stage in stages]
    return stages


def write_foreign_stages(out: Path, stages: Sequence[dict[str, Any]]) -> None:
    """Write the list of the stages that have acted on the clouds of a folder."""
    write_json(_stages_file(out), {"stages": list(stages)})


def _stages_file(folder: Path) -> Path:
    return folder / "truth" / "stages.json"
