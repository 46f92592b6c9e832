"""Recorded clouds with the truth of the stages that changed them before."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lidar.dataset.foreign import foreign_truth
from lidar.dataset.formats import Format
from lidar.dataset.formats.table import table_cloud
from lidar.dataset.layout import reading_file
from lidar.dataset.truth_files import read_truth
from lidar.errors import DatasetError
from lidar.sensors.laser.cloud import Cloud
from lidar.sensors.rig.scanner import Sensor
from lidar.signal.past import Past, past_of
from lidar.signal.recorded_pulses import complete
from lidar.signal.run import Altered


def read_foreign(path: Path, form: Format, *, device: Sensor) -> Cloud:
    """A point cloud of KITTI or nuScenes."""
    return complete(table_cloud(form.read(path)), device, columns=form.columns)


def read_foreign_past(path: Path, form: Format, *, source: Path, device: Sensor) -> Past:
    """A point cloud of KITTI or nuScenes with the ground truth of earlier stages, if any."""
    truth = foreign_truth(source, path.relative_to(source), form=form)
    return read_past(truth, read_foreign(path, form, device=device))


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


def read_past(path: Path, cloud: Cloud) -> Past:
    """A recorded cloud with the ground truth of its truth file, if any; see `lidar.signal.past.past_of`.

    Raises DatasetError for a file that is damaged or of another cloud.
    """
    truth = read_truth(path, count=len(cloud))
    with reading_file(path):
        return past_of(cloud, truth)
