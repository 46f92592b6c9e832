"""Sweeps of a dataset's scanners in the vehicle's frame, and points without the vehicle's motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from geoscene.typing import Float, Ints
from lidar.dataset.formats import FORMATS, format_of
from lidar.dataset.layout import Dataset
from lidar.dataset.recorded import Stream, cloud_points, clouds_in, labelled_clouds
from lidar.errors import DatasetError, InputError

_FARTHEST = 100.0
"""Metres from a scanner: farther points are few, and their footprints large."""


def turns(motion: Float, share: Float) -> Rotation:
    """Rotations at times (n,) in steps of a motion (4, 4), which turns evenly."""
    return Rotation.from_rotvec(share[:, None] * Rotation.from_matrix(motion[:3, :3]).as_rotvec())


def still(points: Float, share: Float, *, motion: Float) -> Float:
    """Points (n, 3) in the vehicle's frame at the time of share 0, without the vehicle's motion.

    points : (n, 3) in the vehicle's frame, each at its own time
    share  : (n,) times, in steps of the motion
    motion : (4, 4) of the vehicle in one step: rotation and translation grow evenly with time
    """
    moved: Float = turns(motion, share).apply(points) + share[:, None] * motion[:3, 3]
    return moved


def moved_back(points: Float, share: Float, *, motion: Float) -> Float:
    """Points (n, 3) of the frame at share 0 in the frames that a body has at shares (n,) of a motion."""
    if not share.any():
        return points
    moved: Float = turns(motion, share).inv().apply(points - share[:, None] * motion[:3, 3])
    return moved


def scaled_motion(motion: Float, factor: float) -> Float:
    """The motion (4, 4) in ``factor`` times the time: rotation and translation grow evenly."""
    out = np.eye(4)
    out[:3, :3] = turns(motion, np.array([factor])).as_matrix()[0]
    out[:3, 3] = factor * motion[:3, 3]
    return out


@dataclass(frozen=True)
class SweepSequence:
    """Sweeps of one scanner, or of several that are merged.

    A sweep has the pose of its end, so that the motion between two poses is that within the later sweep.
    Clouds without times, those of KITTI, have no motion in them and the pose of their frame's start.

    streams   : of the scanners; frames are those of the first
    limits    : (m, 2) least and greatest range used of each, metres
    period_ns : of a sweep; 0 for clouds without times
    """

    streams: tuple[Stream, ...]
    limits: Float
    period_ns: int

    def __len__(self) -> int:
        return len(self.streams[0].frames)

    @property
    def time_ns(self) -> Ints:
        """Times (n,) of the sweeps' poses, since the drive's start."""
        times: Ints = self.streams[0].time_ns + self.period_ns
        return times

    @property
    def farthest(self) -> float:
        """The greatest range that is used, metres."""
        return float(self.limits[:, 1].max())

    def sweep(self, row: int) -> tuple[Float, Float]:
        """Points (n, 3) of a sweep in the vehicle's frame, each at its own time, and that time (n,).

        Times are in periods since the time of the sweep's pose. Points nearer or farther than the limits,
        which may be of the vehicle itself, are left out. Labels are not used.

        Raises FormatError or DatasetError for a damaged file.
        """
        end_ns, points, share = int(self.time_ns[row]), [], []
        for stream, (least, most) in zip(self.streams, self.limits, strict=True):
            after = stream.time_ns > end_ns - self.period_ns - (self.period_ns + 1) // 2
            near = after & (stream.time_ns <= end_ns - (self.period_ns + 1) // 2)
            rows = np.flatnonzero(near).tolist() if self.period_ns else [row]
            for k in rows:
                table = cloud_points(stream.files[k])
                xyz = np.column_stack([table[axis] for axis in "xyz"]).astype(np.float64)
                distance = np.linalg.norm(xyz, axis=1)
                kept = (distance >= least) & (distance <= most)
                mount = stream.mount.matrix
                points.append(xyz[kept] @ mount[:3, :3].T + mount[:3, 3])
                late = np.zeros(np.count_nonzero(kept))
                if self.period_ns:
                    late = (
                        stream.time_ns[k] - end_ns + table["time_ns"][kept].astype(np.int64)
                    ) / self.period_ns
                share.append(late)
        return np.concatenate(points), np.concatenate(share)


def scans_of(
    dataset: Dataset, names: tuple[str, ...] = (), *, least: float = 3.0, most: float | None = None
) -> SweepSequence:
    """The sweeps of scanners of a dataset; by default of the one whose first frame has the most points.

    names : of the scanners that are merged; frames are those of the first
    least : metres from a scanner; nearer points are left out
    most  : metres from a scanner; by default its maximum range, at most 100 m

    Raises InputError for names that the dataset lacks, and DatasetError without two sweeps.
    """
    lidars = dataset.sensors("lidar")
    if unknown := [name for name in names if name not in lidars]:
        known = f"there are {', '.join(lidars)}" if lidars else "there is none"
        raise InputError(f"`sensor` {unknown[0]}: no scanner in {dataset.path}; {known}")
    if not lidars:
        raise DatasetError(f"{dataset.path}: has no laser scanner; choose a `method` of cameras")
    found = [stream for name in names or lidars if (stream := _clouds(dataset, name)) is not None]
    if len(found) < max(len(names), 1):
        of = f" of {', '.join(names)}" if names else ""
        raise DatasetError(
            f"{dataset.path}: no clouds{of} in the sensor frame with times; drive with --format pcd"
        )
    if not names:
        found = [max(found, key=lambda stream: format_of(stream.files[0]).count(stream.files[0]))]
    if len(found[0].frames) < 2:
        raise DatasetError(
            f"{dataset.path}: {len(found[0].frames)} sweep of {found[0].name}; odometry needs two or more"
        )
    timed = [stream for stream in found if "time_ns" in format_of(stream.files[0]).columns]
    if timed and len(timed) < len(found):
        raise DatasetError(
            f"{dataset.path}: clouds of some scanners have times and of others not; name one `sensor`"
        )
    if len(found) > 1 and not timed:
        raise DatasetError(f"{dataset.path}: clouds without times cannot be merged; name one `sensor`")
    limits = [
        (least, min(float(stream.sensor.get("max_range", _FARTHEST)), most or _FARTHEST)) for stream in found
    ]
    period_ns = round(1e9 / float(found[0].sensor["rate_hz"])) if timed else 0
    return SweepSequence(tuple(found), np.array(limits), period_ns)


def _clouds(dataset: Dataset, name: str) -> Stream | None:
    """A scanner's clouds with times, or those of KITTI, whose motion was removed; None without either."""
    return labelled_clouds(dataset, name) or clouds_in(dataset, name, form=FORMATS["kitti"])
