"""Point clouds of KITTI and nuScenes in folders that this program did not record."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from geoscene.support.files import write_json
from lidar.dataset.formats import FORMATS, Format
from lidar.dataset.formats.table import table_cloud
from lidar.dataset.layout import reading_file
from lidar.dataset.truth_files import read_past
from lidar.errors import DatasetError
from lidar.rig.scanner import Sensor
from lidar.sensors.cloud import Cloud
from lidar.signal.past import Past
from lidar.signal.recorded_pulses import completed
from lidar.signal.run import Altered

KITTI, NUSCENES = FORMATS["kitti"], FORMATS["nuscenes"]


def foreign_clouds(source: Path) -> list[tuple[Path, Format]]:
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


def read_foreign(path: Path, form: Format, *, device: Sensor) -> Cloud:
    """A point cloud of KITTI or nuScenes."""
    return completed(table_cloud(form.read(path)), device, columns=form.columns)


def read_foreign_past(path: Path, form: Format, *, source: Path, device: Sensor) -> Past:
    """A point cloud of KITTI or nuScenes with the truth of earlier stages, if there were any."""
    truth = foreign_truth(source, path.relative_to(source), form=form)
    return read_past(truth, read_foreign(path, form, device=device))


def read_foreign_stages(source: Path) -> list[dict[str, Any]]:
    """The stages that have acted on the clouds of a folder, as `NamedStage.to_json` writes them."""
    path = _stages_file(source)
    if not path.exists():
        return []
    with reading_file(path):
        stages: list[dict[str, Any]] = json.loads(path.read_text("utf-8"))["stages"]
        _ = [str(stage["name"]) for stage in stages]
    return stages


def write_foreign_stages(out: Path, stages: Sequence[dict[str, Any]]) -> None:
    """Write the list of the stages that have acted on the clouds of a folder."""
    write_json(_stages_file(out), {"stages": list(stages)})


def _stages_file(folder: Path) -> Path:
    return folder / "truth" / "stages.json"


@dataclass(frozen=True, slots=True)
class Former:
    """The point clouds before one in the order of names, of the same folder.

    clouds : all files
    row    : of the one
    """

    clouds: Sequence[tuple[Path, Format]]
    row: int
    source: Path
    device: Sensor

    def cloud(self, frames: int) -> Cloud | None:
        """The cloud a number of frames before, as without stages; None before the first."""
        path, _ = self.clouds[self.row]
        row = self.row - frames
        if row < 0 or self.clouds[row][0].parent != path.parent:
            return None
        return read_foreign_past(*self.clouds[row], source=self.source, device=self.device).original


def select_labels(path: Path, out: Path, *, altered: Altered) -> None:
    """Write labels of SemanticKITTI for the returns after stages; added ones are unlabelled (0)."""
    codes = np.append(np.fromfile(path, "<u4"), np.uint32(0))
    if len(codes) != len(altered.original) + 1:
        raise DatasetError(f"{path}: {len(codes) - 1} labels for {len(altered.original)} points")
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_bytes(codes[altered.cloud.source].astype("<u4").tobytes())
