"""Exporters of datasets to other layouts, one function and one row in `EXPORTERS` each.

Modules are imported when a dataset is exported, so that a list of the exporters costs nothing.
"""

from __future__ import annotations

import importlib
import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from geoscene.support.files import atomic_folder
from geoscene.support.progress import Progress, silent
from geoscene.support.registry import Registry
from lidar.errors import InputError
from lidar.parameters import read_values

if TYPE_CHECKING:
    from lidar.dataset.layout import Dataset


@dataclass(frozen=True, slots=True)
class ExportSummary:
    """Result of an export.

    path   : the folder
    counts : number of objects of each kind that were written
    hint   : how to open it
    """

    path: Path
    counts: dict[str, int]
    hint: str


@dataclass(frozen=True, slots=True)
class Exporter:
    """A row of `EXPORTERS`, and a function of a module.

    ``export(dataset, folder, *, progress)`` writes a dataset into an empty folder and returns the number of
    objects that it wrote, by kind.

    name     : by which users choose it
    module   : in this folder
    meaning  : what is written, one line
    mark     : a file that is always written: a folder is overwritten only if it holds one
    names    : regular expression of the paths of the files that it writes; others are kept when overwriting
    hint     : how to open the export; ``{path}`` stands for its folder, ``{quoted}`` for it in a shell,
               ``{date}`` for the time of the drive's start
    function : of the module
    options  : class of the module, with parameters that follow the name; ``export`` takes it as ``options``
    """

    name: str
    module: str
    meaning: str
    mark: str
    names: str
    hint: str
    function: str = "export"
    options: str = ""

    def export(
        self,
        dataset: Dataset,
        out: Path,
        *,
        overwrite: bool = False,
        progress: Progress = silent,
        values: Mapping[str, Any] = MappingProxyType({}),
    ) -> ExportSummary:
        """Write a dataset into the folder ``out``, which appears when it is complete.

        values : of the layout's parameters

        Raises InputError for a parameter that the layout does not have and if the folder exists and may not
        be overwritten, and DatasetError for a dataset that lacks what the layout needs.
        """
        if out.exists() and not overwrite:
            raise InputError(f"{out}: exists already; set `overwrite` to replace it")
        from lidar.dataset.checksums import write_checksums  # noqa: PLC0415
        from lidar.dataset.derived import write_export_provenance  # noqa: PLC0415

        module, more = importlib.import_module(f"{__name__}.{self.module}"), dict[str, Any]()
        if values and not self.options:
            raise InputError(f"`to` {self.name}: has no parameters, and not {', '.join(values)}")
        if self.options:
            kind = getattr(module, self.options)
            more["options"] = kind(**read_values(kind, values))
        with atomic_folder(out, mark=self.mark, names=f"{self.names}|{_OURS}") as folder:
            counts = getattr(module, self.function)(dataset, folder, progress=progress, **more)
            write_export_provenance(dataset, folder, by=f"convert --to {self.name}")
            write_checksums(folder)
        hint = self.hint.format(path=out, quoted=shlex.quote(str(out)), date=dataset.start)
        return ExportSummary(out, counts, hint)


_OURS = r"provenance\.json|checksums\.sha256"
"""Files that every export has."""

_EXPORTERS = (
    Exporter(
        "bev",
        "sweep_images",
        "images from above of each sweep as GeoTIFF: height, intensity, number of returns",
        mark="bev.json",
        names=r"bev\.json|[^/]+/\d{6,}\.tif",
        hint="open a file of {path} with QGIS or rasterio",
        function="export_from_above",
    ),
    Exporter(
        "coco",
        "coco",
        "images with COCO's boxes, masks and panoptic segments",
        mark="annotations/instances.json",
        names=r"images/[^/]+_\d{6,}\.png|annotations/((instances|panoptic)\.json|panoptic/[^/]+_\d{6,}\.png)",
        hint="open it with pycocotools: COCO('{path}/annotations/instances.json')",
    ),
    Exporter(
        "kitti",
        "kitti",
        "a sequence of KITTI's odometry benchmark, with labels of SemanticKITTI and of objects",
        mark="sequences/00/calib.txt",
        names=r"poses/00\.txt|sequences/00/((calib|times|poses)\.txt|velodyne/\d{6}\.bin|labels/\d{6}\.label"
        r"|image_[0-3]/\d{6}\.png|(label_2|calib)/\d{6}\.txt)",
        hint="open it with pykitti.odometry('{path}', '00')",
    ),
    Exporter(
        "kitti-360",
        "kitti_360",
        "a sequence of KITTI-360 with poses, calibration, 3D boxes and labels of pixels",
        mark="calibration/perspective.txt",
        names=r"calibration/\w+\.txt|data_poses/\w+/(poses|cam0_to_world)\.txt|data_3d_bboxes/train/\w+\.xml"
        r"|data_3d_raw/\w+/velodyne_points/(timestamps\.txt|data/\d{10}\.bin)"
        r"|data_2d_raw/\w+/image_0[01]/(timestamps\.txt|data_rect/\d{10}\.png)"
        r"|data_2d_semantics/train/\w+/(instanceDict\.json|image_0[01]/(semantic|instance)/\d{10}\.png)",
        hint="open it with kitti360scripts: KITTI360_DATASET={quoted}",
    ),
    Exporter(
        "kitti-depth",
        "kitti_depth",
        "KITTI's depth completion: images, the scanner's depth in them, and the dense true depth",
        mark="depth.json",
        names=r"depth\.json|train/[^/]+/(intrinsics/[^/]+\.txt|[^/]+/data/\d{10}\.png"
        r"|proj_depth/(velodyne_raw|groundtruth)/[^/]+/\d{10}\.png)",
        hint="depth in metres is the PNG's value / 256, 0 without data: {path}/train",
    ),
    Exporter(
        "kitti-raw",
        "kitti_raw",
        "a drive of KITTI's raw recordings, with OXTS files of the true motion",
        mark="dataformat.txt",
        names=r"dataformat\.txt|\d{4}_\d\d_\d\d/(calib_\w+\.txt|\d{4}_\d\d_\d\d_drive_0001_sync/\w+"
        r"/(timestamps\w*\.txt|data/\d{10}\.(bin|png|txt)))",
        hint="open it with pykitti.raw('{path}', '{date:%Y_%m_%d}', '0001')",
    ),
    Exporter(
        "kitti-tracking",
        "kitti",
        "a sequence of KITTI's tracking benchmark: images, clouds and tracks of road users",
        mark="training/label_02/0000.txt",
        names=r"training/((label_02|calib)/0000\.txt|image_0[0-3]/0000/\d{6}\.png|velodyne/0000/\d{6}\.bin)",
        hint="the true tracks are {path}/training/label_02/0000.txt",
        function="export_tracking",
    ),
    Exporter(
        "mcap",
        "ros2",
        "one MCAP file of ROS 2 messages, with a layout for Foxglove",
        mark="foxglove.json",
        names=r"foxglove\.json|drive\.mcap",
        hint="open {path}/drive.mcap with Foxglove and import the layout foxglove.json",
        function="export_for_foxglove",
        options="RosOptions",
    ),
    Exporter(
        "mot",
        "mot",
        "images and tracks of road users in them, as MOTChallenge has them",
        mark="seqmaps/all.txt",
        names=r"seqmaps/all\.txt|train/[^/]+/(seqinfo\.ini|gt/gt\.txt|img1/\d{6}\.png)",
        hint="the true tracks of a camera are {path}/train/CAMERA/gt/gt.txt",
    ),
    Exporter(
        "nuscenes",
        "nuscenes",
        "samples and sweeps with all tables of nuScenes, two key frames per second",
        mark="v1.0-mini/sample.json",
        names=r"v1\.0-mini/[a-z_]+\.json|maps/drivable\.png|lidarseg/v1\.0-mini/[0-9a-f]{32}_lidarseg\.bin"
        r"|(samples|sweeps)/[^/]+/.+__\d+\.(pcd\.bin|png)",
        hint="open it with NuScenes('v1.0-mini', '{path}')",
    ),
    Exporter(
        "range-images",
        "sweep_images",
        "each sweep as an image of its pulses, with labels, from which its points come back",
        mark="range_images.json",
        names=r"range_images\.json|[^/]+/(geometry\.json|(range|instance)/\d{6,}\.npy|(png|label)/\d{6,}\.png)",
        hint="a point is at range * (cos e cos a, cos e sin a, sin e): {path}/SCANNER/geometry.json",
        function="export_range_images",
    ),
    Exporter(
        "ros2",
        "ros2",
        "a ROS 2 recording (rosbag2) in MCAP; ros2:points=velodyne, ouster, livox or livox-custom, imu=truth",
        mark="metadata.yaml",
        names=r"metadata\.yaml|drive\.mcap",
        hint="play it with ros2 bag play {quoted}",
        options="RosOptions",
    ),
    Exporter(
        "tum",
        "tum",
        "trajectories of the vehicle and of every sensor as text files of TUM and of KITTI",
        mark="vehicle.tum",
        names=r"(vehicle|sensors/[^/]+)\.(tum|kitti)",
        hint="compare with evo_ape tum {quoted}/vehicle.tum ESTIMATE",
    ),
    Exporter(
        "waymo",
        "waymo",
        "Parquet files of the Waymo Open Dataset 2, a component each",
        mark="segments.txt",
        names=r"segments\.txt|(vehicle_pose|lidar(_\w+)?|camera(_\w+)?)/[^/]+\.parquet",
        hint="open it with pyarrow, pandas or dask, or with waymo_open_dataset.v2",
    ),
)

EXPORTERS: Registry[Exporter] = Registry(
    "layout",
    {row.name: row for row in _EXPORTERS},
    error=InputError,
    removed={"ros2-sqlite3": "no longer written; use ros2 (MCAP), which ros2 bag convert turns into SQLite"},
)
"""Exporters by name."""
