"""Check of a recorded drive: some of its frames, simulated again and compared with the reference."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from geoscene.support.progress import Progress, silent
from lidar.sensors.rig.devices import Camera, Scanner
from lidar.simulation.plan import DrivePlan
from lidar.tools.tradeoff.errors import ErrorEstimate, resample
from lidar.tools.tradeoff.profile_errors import blocks_of, measuring
from lidar.tools.tradeoff.sampled_images import image_errors_of, image_figures
from lidar.tools.tradeoff.sampling import errors_of, places, range_figures
from lidar.tools.tradeoff.sensor_errors import SensorErrors, stated

_FRAMES = 10
"""Frames of each sensor that are checked."""


@dataclass(frozen=True, slots=True)
class SpotCheck:
    """Errors that a drive has reached.

    percent : of the returns or pixels for which errors are stated
    kinds   : of errors that are stated, see `sensor_errors.stated`
    errors  : figures of each sensor, by its name, with intervals by resampling frames
    frames  : checked of each sensor
    """

    percent: float
    kinds: Collection[str]
    errors: dict[str, dict[str, ErrorEstimate]]
    frames: dict[str, int]

    @property
    def reached(self) -> SensorErrors:
        """What is stated."""
        return stated(self.errors, percent=self.percent, kinds=self.kinds)

    def to_text(self) -> str:
        """What was reached, in one line."""
        count = max(self.frames.values(), default=0)
        return f"spot check of {count} frames: {self.reached.to_text('are')}"

    def to_json(self) -> dict[str, Any]:
        """All figures."""
        every = {
            name: {"frames": self.frames[name]} | {figure: error.to_json() for figure, error in of.items()}
            for name, of in self.errors.items()
        }
        return self.reached.to_json("reached") | {"spot_check": every}


def spot_check(
    plan: DrivePlan, *, percent: float, kinds: Collection[str], progress: Progress = silent
) -> SpotCheck:
    """Errors of a sample of frames of a drive's sensors, without random effects and stages.

    kinds : of errors that are stated; sensors that have none of these are not checked

    Frames are spread over the drive. The same drive has the same sample.
    """
    found: dict[str, list[Any]] = {}
    scanners = [s for s in plan.sensors if isinstance(s, Scanner) and "ranges" in kinds]
    cameras = [
        s
        for s in measuring([s for s in plan.sensors if isinstance(s, Camera)])
        if ("colours" in kinds and "rgb" in s.spec.images) or ("depths" in kinds and "depth" in s.spec.images)
    ]
    total = _FRAMES * (len(scanners) + len(cameras))

    def add(name: str, errors: Sequence[Any]) -> None:
        found.setdefault(name, []).extend(errors)
        progress("checking errors", sum(map(len, found.values())), total=total)

    settings = plan.options.recording_settings
    for bench in places(plan, scanners, frames=_FRAMES):
        for scanner in scanners:
            for errors in errors_of(bench, scanner, settings=[settings.scanner]):
                add(scanner.name, errors)
    for bench in places(plan, cameras, frames=_FRAMES):
        for camera in cameras:
            for images in image_errors_of(
                bench, camera, settings=[settings.camera], blocks=blocks_of(cameras)
            ):
                add(camera.name, images)
    figures = {s.name: range_figures for s in scanners} | {
        c.name: partial(image_figures, camera=c) for c in cameras
    }
    estimates = {name: resample(of, seed=0, figures=figures[name]) for name, of in found.items()}
    return SpotCheck(percent, kinds, estimates, {name: len(of) for name, of in found.items()})
