"""A trajectory against the truth: errors with intervals, over distances, and of the map made with it."""

from __future__ import annotations

import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from geoscene.support.progress import Progress, displayed, shows_progress
from lidar.dataset.layout import Dataset
from lidar.errors import InputError
from lidar.options.maps import MapOptions
from lidar.options.trajectories import EvaluateOptions
from lidar.tools.evaluation.pose_errors import (
    KITTI_LENGTHS,
    KITTI_STEP,
    Segments,
    Statistics,
    Value,
    absolute,
    lengths_for,
    over_frames,
    over_metres,
    segments,
    statistics,
)
from lidar.tools.evaluation.trajectories import (
    Path3D,
    PosePairs,
    TrajectoryAlignment,
    alignment,
    file_of,
    match_poses,
    read_path,
    read_truth,
    sensor_mount,
)

if TYPE_CHECKING:
    from lidar.tools.maps.compare import SurfaceDistances

_VOXEL = 0.1
"""Metres: side of the cubes of which a map keeps a point each when its error is measured."""


@dataclass(frozen=True, slots=True)
class RelativeError:
    """Errors of motion over a number of frames or metres, of all such pairs of poses.

    delta       : as the option says, ``1f`` or ``10m``
    translation : metres
    rotation    : degrees
    """

    delta: str
    translation: Statistics
    rotation: Statistics


@dataclass(frozen=True, slots=True)
class SegmentErrors:
    """Mean errors of segments of a way.

    length      : metres; None for all
    translation : percent of the length
    rotation    : degrees per 100 m
    """

    length: int | None
    translation: Value
    rotation: Value
    count: int


@dataclass(frozen=True, slots=True)
class TrajectoryErrors:
    """Errors of a trajectory.

    estimate, truth : what was compared
    poses, left_out : of the estimate with and without a counterpart in the truth
    way_m, way_estimate_m, duration_s : of the compared poses; the duration is None without times
    translation, rotation : absolute errors after the alignment, metres and degrees
    segments : of all lengths together first
    kitti    : whether the segments are those of KITTI's benchmark
    map      : distances of the map made with the estimate to the true surfaces
    """

    estimate: str
    truth: str
    association: str
    poses: int
    left_out: int
    way_m: float
    way_estimate_m: float
    duration_s: float | None
    alignment: TrajectoryAlignment
    translation: Statistics
    rotation: Statistics
    relative: list[RelativeError]
    segments: list[SegmentErrors]
    kitti: bool
    map: list[SurfaceDistances]

    def to_json(self) -> dict[str, Any]:
        """As ``evaluation.json``."""
        document = asdict(self)
        document["alignment"] |= {
            "rotation": self.alignment.rotation.tolist(),
            "shift": self.alignment.shift.tolist(),
        }
        return {"schema": 1, "kind": "trajectory", **document}


@dataclass(frozen=True, slots=True)
class Compared:
    """An estimated trajectory paired with ground truth: input of figures and tables.

    pairs   : aligned
    dataset : the truth, if it is one
    """

    errors: TrajectoryErrors
    pairs: PosePairs
    segments: Segments
    dataset: Dataset | None


@shows_progress
def evaluate_trajectory(
    estimate: Path,
    against: Path,
    *,
    options: EvaluateOptions = EvaluateOptions(),
    out: Path | None = None,
    progress: Progress = displayed,
) -> Compared:
    """Compare a trajectory with the truth.

    out : folder for the map of `EvaluateOptions.map_error`; it is not kept without one

    Raises InputError for trajectories that cannot be compared, and FormatError and DatasetError for damaged
    files.
    """
    truth, dataset = read_truth(against)
    mount = np.eye(4)
    if dataset is not None:
        mount = sensor_mount(dataset, options.sensor)
        truth = truth.mounted(mount)
    elif options.sensor or options.map_error:
        what = "sensor" if options.sensor else "map_error"
        raise InputError(f"`{what}` needs a dataset as the truth; {against} is none")
    found = read_path(estimate, truth=dataset, sensor=options.sensor)
    if file_of(estimate).is_dir():
        found = found.mounted(mount)
    pairs = match_poses(found, truth, how=options.associate, gap_s=options.max_gap)
    motion = alignment(pairs, options.align)
    aligned = PosePairs(motion.of(pairs.estimate), pairs.truth, pairs.left_out)
    way = pairs.truth.distance()
    parts = segments(aligned, lengths_for(float(way[-1])))
    moved, turned = absolute(aligned)
    distances = []
    if options.map_error and dataset is not None:
        whole = motion.of(found).mounted(np.asarray(np.linalg.inv(mount), float))
        distances = _map_errors(dataset, whole, out=out, progress=progress)
    span = float(pairs.truth.time_ns[-1] - pairs.truth.time_ns[0]) * 1e-9
    errors = TrajectoryErrors(
        estimate=str(estimate),
        truth=str(against),
        association=options.associate if pairs.truth.timed else "by number",
        poses=len(pairs),
        left_out=pairs.left_out,
        way_m=float(way[-1]),
        way_estimate_m=float(aligned.estimate.distance()[-1]),
        duration_s=span if pairs.truth.timed else None,
        alignment=motion,
        translation=statistics(moved),
        rotation=statistics(np.degrees(turned)),
        relative=[one for delta in options.delta if (one := _relative(aligned, delta)) is not None],
        segments=_segment_errors(parts, float(way[-1])),
        kitti=len(parts) > 0 and float(parts.length.min()) >= KITTI_LENGTHS[0],
        map=distances,
    )
    return Compared(errors, aligned, parts, dataset)


def _relative(pairs: PosePairs, delta: str) -> RelativeError | None:
    """Errors of pairs of poses that are a number of frames or metres apart; None without such pairs."""
    if delta.endswith("f"):
        found = over_frames(pairs, int(delta[:-1]))
    else:
        found = over_metres(pairs, float(delta[:-1]))
    if not len(found):
        return None
    least = int(np.median(found.last - found.first))
    return RelativeError(
        delta, statistics(found.shift, least=least), statistics(np.degrees(found.turn), least=least)
    )


def _segment_errors(parts: Segments, way: float) -> list[SegmentErrors]:
    """Mean errors of all segments and of those of each length."""
    if not len(parts):
        return []
    each = np.unique(parts.length)
    rows: list[SegmentErrors] = []
    for length in (None, *each.tolist()):
        some = parts if length is None else parts.where(parts.length == length)
        longest = float(some.length.max())
        least = int(np.ceil(len(some) * longest / way))
        translation = statistics(100 * some.shift, least=least).mean
        rotation = statistics(np.degrees(100 * some.turn), least=least).mean
        whole = None if length is None else int(length)
        rows.append(SegmentErrors(whole, translation, rotation, len(some)))
    return rows


def _map_errors(
    dataset: Dataset, vehicle: Path3D, *, out: Path | None, progress: Progress
) -> list[SurfaceDistances]:
    """Distances of the map that a trajectory of the vehicle gives to the surfaces of the dataset's scene."""
    from lidar.tools.maps.aggregate import aggregate  # noqa: PLC0415

    with tempfile.TemporaryDirectory(prefix="lidar-evaluate-") as scratch:
        folder = Path(scratch) if out is None else out
        poses = Path(scratch) / "aligned.tum"
        vehicle.write(poses)
        options = MapOptions(poses=str(poses), compare=dataset.scene_path, voxel=_VOXEL)
        return aggregate(dataset, folder / "map.laz", options=options, progress=progress).distances


def method_of(errors: TrajectoryErrors) -> str:
    """Description of how the errors were computed."""
    step = f"every {KITTI_STEP}th pose" if errors.kitti else "every pose"
    kind = "KITTI's benchmark" if errors.kitti else "shorter lengths than KITTI's benchmark (100 to 800 m)"
    return (
        f"{errors.poses:,} poses over {errors.way_m:,.1f} m, associated {errors.association},"
        f" {errors.left_out:,} left out; alignment {errors.alignment.kind}. Relative errors are of all pairs"
        f" of poses; segments begin at {step}, with {kind}. Intervals are 95 %, of a bootstrap of blocks"
        " longer than errors correlate; none where fewer than five blocks fit."
    )
