"""Point clouds of signed data, in any format, with the pulses of their watermark."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geoscene.typing import Float
from lidar.dataset.formats import FORMATS, Format
from lidar.dataset.formats.table import Table, table_cloud
from lidar.dataset.layout import Dataset
from lidar.dataset.recorded import cloud_points
from lidar.errors import FormatError, InputError
from lidar.geometry.time_scales import drive_ns
from lidar.sensors.rig.devices import Scanner, scanners
from lidar.sensors.rig.patterns.beams import Firings
from lidar.sensors.rig.specs import rig_of
from lidar.simulation.record_clouds import sent_pulses
from lidar.simulation.recording import Recording
from lidar.tools.integrity.watermark import WatermarkCells
from lidar.tools.rerecord import recording_again
from lidar.tools.sign import cells_of, marked_formats

_STEPS = (1.0, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01, 0.005, 0.002, 0.001)
"""Metres that coordinates may be rounded to, the coarsest first."""

_ON_STEP = 0.02
"""Share of a step by which single precision puts rounded coordinates off it, at most 200 m away."""

_FEW = 20
"""Returns; fewer may lie on the multiples of a step by chance."""


@dataclass(frozen=True)
class MarkedCloud:
    """A cloud as its file says it is.

    xyz   : (n, 3) metres, sensor frame
    step  : metres that coordinates are multiples of; 0 if they are of none
    """

    xyz: NDArray[np.floating]
    cells: WatermarkCells
    step: float


@dataclass(frozen=True)
class MarkedCloudFile:
    """A file of a cloud that may bear a watermark; `read` reads it."""

    dataset: Dataset
    path: Path
    form: Format
    sensor: str
    frame: int
    geometry: _Geometry

    @property
    def place(self) -> str:
        """Path in the directory."""
        return self.path.relative_to(self.dataset.path).as_posix()

    def read(self) -> MarkedCloud:
        """The cloud; raises LidarError for a file that is missing or damaged."""
        path = self.dataset.frame_file(self.path)
        if self.form.frame == "sensor":
            cloud = table_cloud(cloud_points(path))
            cells = cells_of(cloud, sensor=self.sensor, frame=self.frame)
            return MarkedCloud(cloud.xyz, cells, coarseness(cloud.xyz))
        table = self.form.read(path)
        if missing := [name for name in ("ring", "gps_time") if name not in table]:
            raise FormatError(f"{path}: lacks {', '.join(missing)}")
        world: Float = np.column_stack([table[axis] for axis in "xyz"]).astype(np.float64)
        if not np.isfinite(world).all() or not np.isfinite(table["gps_time"]).all():
            raise FormatError(f"{path}: damaged (coordinates that are not numbers)")
        xyz, cells = self.geometry.in_sensor(world, table, name=self.sensor, frame=self.frame)
        return MarkedCloud(xyz, cells, coarseness(world))


def cloud_files(dataset: Dataset) -> Iterator[MarkedCloudFile]:
    """The files of a dataset's clouds that may bear a watermark, in order.

    Raises InputError for a dataset without a format that keeps one.
    """
    formats = tuple(dataset.manifest["recipe"].get("formats", ()))
    forms = readable_formats(tuple(name for name in formats if name in FORMATS))
    if not forms:
        known = ", ".join(form.name for form in readable_formats(tuple(FORMATS)))
        raise InputError(
            f"{dataset.path}: clouds are {','.join(formats)}, which lack ring or pulse; a watermark is read"
            f" from {known}"
        )
    geometry = _Geometry(dataset)
    for name in dataset.sensors("lidar"):
        for frame in range(len(dataset.sample_times(name))):
            for form in forms:
                path = form.path(dataset.paths.sensor(name), frame)
                yield MarkedCloudFile(dataset, path, form, name, frame, geometry)


def readable_formats(formats: tuple[str, ...]) -> list[Format]:
    """The formats, of some, from whose files a dataset's watermark can be read."""
    of_sensor = marked_formats(formats)
    return [FORMATS[n] for n in formats if FORMATS[n] in of_sensor or "gps_time" in FORMATS[n].columns]


def coarseness(xyz: NDArray[np.floating]) -> float:
    """The coarsest step in metres that all coordinates (n, 3) are multiples of; 0 for none."""
    if len(xyz) < _FEW:
        return 0.0
    given = xyz.astype(np.float64)
    for step in _STEPS:
        off = np.abs(given / step - np.rint(given / step))
        if off.max() < _ON_STEP:
            return step
    return 0.0


class _Geometry:
    """Poses and pulses of a dataset, to take points in the world frame back to the sensors."""

    def __init__(self, dataset: Dataset) -> None:
        self._dataset = dataset

    @cached_property
    def _recording(self) -> Recording:
        return recording_again(self._dataset, self._dataset.path)

    @cached_property
    def _scanners(self) -> dict[str, Scanner]:
        return {one.name: one for one in scanners(rig_of(self._dataset.manifest["recipe"]["rig"]))}

    def in_sensor(self, world: Float, table: Table, *, name: str, frame: int) -> tuple[Float, WatermarkCells]:
        """Points (n, 3) of the export CRS in the sensor frame, each at its pulse's time, and their pulses."""
        recording, scanner = self._recording, self._scanners[name]
        sent = sent_pulses(recording, scanner, frame=frame)
        ring = np.asarray(table["ring"]).astype(np.int64)
        row = _find_pulse(ring, drive_ns(recording.start, table["gps_time"]), sent=sent)
        mount = scanner.spec.mount
        poses = recording.trajectory.at(sent.time_ns[row]).mounted(mount.translation, mount.rotation)
        echo = table.get("echo", np.ones(len(ring), np.uint8))
        cells = WatermarkCells(name, frame, ring, sent.column[row], echo)
        return poses.seen(recording.geo.scene_points(world)), cells


def _find_pulse(ring: NDArray[np.int64], time_ns: NDArray[np.int64], *, sent: Firings) -> NDArray[np.int64]:
    """Row (n,) of the pulse of each return: of its ring, the nearest in time.

    Raises FormatError for rings without a pulse.
    """
    sent_ring, sent_ns = sent.ring.astype(np.int64), sent.time_ns
    if not np.isin(ring, sent_ring).all():
        raise FormatError("rings that the scanner does not fire in this frame")
    if not len(ring):
        return np.empty(0, np.int64)
    start = int(min(sent_ns.min(), time_ns.min()))
    span = int(max(sent_ns.max(), time_ns.max())) - start + 1
    order = np.lexsort((sent_ns, sent_ring))
    key = sent_ring[order] * 4 * span + sent_ns[order] - start
    wanted = ring * 4 * span + time_ns - start
    after = np.clip(np.searchsorted(key, wanted), 1, len(key) - 1)
    nearer = wanted - key[after - 1] <= key[after] - wanted
    return order[np.where(nearer, after - 1, after)]
