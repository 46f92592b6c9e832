"""Errors of the settings of a profile: of drives, with intervals for the next one."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from itertools import groupby
from typing import Any

from geoscene.support.progress import Progress
from lidar.errors import InputError
from lidar.sensors.camera.settings import CameraSettings
from lidar.sensors.physics.settings import ScannerSettings
from lidar.sensors.rig.devices import Camera, Scanner
from lidar.simulation.plan import DrivePlan
from lidar.tools.tradeoff.errors import E, ErrorEstimate, next_drive, resample
from lidar.tools.tradeoff.sampled_images import image_errors_of, image_figures
from lidar.tools.tradeoff.sampling import errors_of, places, range_figures

Errors = dict[str, list[dict[str, ErrorEstimate]]]
"""Figures of each setting, by sensor."""

_LEAST_M, _LEAST = 1e-6, {"rgb_rms": 0.01, "lost": 1e-5}
"""Errors below which drives count as equal: metres of files in float32, and by name levels of images of a
single colour and the share of returns that are missed or extra."""

_BLOCKS, _FEWEST = 48, 12
"""Blocks of pixels of a frame that are compared, of all cameras, and of each at least."""


def scanner_errors(
    plans: Sequence[DrivePlan], settings: Sequence[ScannerSettings], *, frames: int, progress: Progress
) -> Errors:
    """Range errors of scanners with some settings, in frames of drives."""
    scanners = [s for s in plans[0].sensors if isinstance(s, Scanner)]

    def samples(plan: DrivePlan) -> Iterator[tuple[str, list[Any]]]:
        for bench in places(plan, scanners, frames=frames):
            for scanner in scanners:
                for errors in errors_of(bench, scanner, settings=settings):
                    yield scanner.name, errors

    figures = {s.name: range_figures for s in scanners}
    return _estimates(plans, samples, figures=figures, total=frames, progress=progress)


def camera_errors(
    plans: Sequence[DrivePlan], settings: Sequence[CameraSettings], *, frames: int, progress: Progress
) -> Errors:
    """Errors of colours and depths of cameras with some settings, in frames of drives."""
    cameras = measuring([s for s in plans[0].sensors if isinstance(s, Camera)])

    def samples(plan: DrivePlan) -> Iterator[tuple[str, list[Any]]]:
        for bench in places(plan, cameras, frames=frames):
            for camera in cameras:
                for errors in image_errors_of(bench, camera, settings=settings, blocks=blocks_of(cameras)):
                    yield camera.name, errors

    figures = {c.name: partial(image_figures, camera=c) for c in cameras}
    return _estimates(plans, samples, figures=figures, total=frames, progress=progress)


def measuring(cameras: Sequence[Camera]) -> list[Camera]:
    """Cameras that write colours or depths."""
    return [c for c in cameras if {"rgb", "depth"} & set(c.spec.images)]


def blocks_of(cameras: Sequence[Camera]) -> int:
    """Blocks of pixels that are compared in a frame of each of some cameras."""
    return max(_FEWEST, _BLOCKS // len(cameras))


def _estimates(
    plans: Sequence[DrivePlan],
    samples: Callable[[DrivePlan], Iterator[tuple[str, list[Any]]]],
    *,
    figures: Mapping[str, Callable[[Sequence[Any]], dict[str, float]]],
    total: int,
    progress: Progress,
) -> Errors:
    """Figures of the settings of each sensor.

    samples : names of sensors and errors of all settings, of the frames of a drive
    figures : of frames, by sensor
    total   : frames of a sensor in a drive, at most
    """
    found: dict[str, list[tuple[int, list[Any]]]] = {name: [] for name in figures}
    count = len(plans) * total * len(figures)
    for k, plan in enumerate(plans):
        for name, errors in samples(plan):
            found[name].append((k, errors))
            progress("measuring errors", sum(map(len, found.values())), total=count)
    if idle := [name for name, of in found.items() if not of]:
        raise InputError(
            f"`rig`: {', '.join(idle)} has no frame in this drive, whose errors could be measured"
        )
    return {
        name: [
            drive_estimates([(drive, errors[k]) for drive, errors in of], figures=figures[name])
            for k in range(len(of[0][1]))
        ]
        for name, of in found.items()
    }


def drive_estimates(
    samples: Sequence[tuple[int, E]], *, figures: Callable[[Sequence[E]], Mapping[str, float]]
) -> dict[str, ErrorEstimate]:
    """Figures of frames, each with the number of its drive, which ascends.

    The intervals are those of the next drive; of frames of one drive, those of this drive. Figures that are
    NaN in all drives but one are left out.
    """
    drives = [[sample for _, sample in of] for _, of in groupby(samples, key=lambda pair: pair[0])]
    if len(drives) == 1:
        return resample(drives[0], seed=0, figures=figures)
    every = [figures(frames) for frames in drives]
    known = {name: [f[name] for f in every if not math.isnan(f[name])] for name in every[0]}
    return {
        name: next_drive(values, least=_LEAST.get(name, _LEAST_M))
        for name, values in known.items()
        if len(values) > 1
    }
