"""Drives without files: the frames of a drive, one after another, as `lidar.drive` would record them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np

from geoscene.drawing.previews import card
from geoscene.scene import SceneLike
from geoscene.support.option_values import expect
from geoscene.support.progress import Progress, displayed, shows_progress
from geoscene.typing import Float
from lidar.errors import InputError
from lidar.geometry.poses import Poses
from lidar.options.drive import DriveOptions
from lidar.sensors.camera.render import CameraImage as Image
from lidar.sensors.laser.cloud import Cloud
from lidar.sensors.navigation.imu import observe_imu
from lidar.sensors.navigation.measurements import Fixes, Inertial
from lidar.sensors.rig.specs import GnssSpec, ImuSpec
from lidar.signal.registry import Stages
from lidar.signal.run import altered_fixes, altered_samples
from lidar.signal.situation import Situation
from lidar.simulation.frame_loop import check_attackers, measure_frame, run_jobs
from lidar.simulation.metadata import observed_fixes
from lidar.simulation.plan import DrivePlan, SensorFrame, plan_drive
from lidar.simulation.recording import Columns, MeasuredCloud, MeasuredImages, Recording
from lidar.simulation.scene_source import opened_for
from lidar.simulation.situations import situation_of_unit
from lidar.world.world import Worlds

Readings = TypeVar("Readings", Fixes, Inertial)


@dataclass(frozen=True)
class DriveFrame:
    """Measurements of all sensors from the start of a frame of the first sensor to that of its next.

    The first frame also has what others measured before it, the last one what they measured after it.

    number     : of the frame, from 0
    time_ns    : its start, nanoseconds since the drive's start
    utc        : its start, to the microsecond
    pose       : the one pose of the ego vehicle in the scene at its start
    lonlath    : (3,) longitude and latitude in degrees (WGS 84) and height in metres, of the same pose
    measured   : frames of scanners and cameras with poses, boxes and truth, in order of time
    fixes      : of each GNSS receiver, by name
    samples    : of each inertial unit, by name
    """

    number: int
    time_ns: int
    utc: datetime
    pose: Poses
    lonlath: Float
    measured: tuple[MeasuredCloud | MeasuredImages, ...]
    fixes: dict[str, Fixes]
    samples: dict[str, Inertial]

    @property
    def sensors(self) -> dict[str, MeasuredCloud | MeasuredImages]:
        """The first frame of each scanner and camera in this one, by name."""
        found: dict[str, MeasuredCloud | MeasuredImages] = {}
        for one in self.measured:
            found.setdefault(one.sensor, one)
        return found

    @property
    def clouds(self) -> dict[str, Cloud]:
        """The first point cloud of each scanner, by name."""
        return {name: one.cloud for name, one in self.sensors.items() if isinstance(one, MeasuredCloud)}

    @property
    def images(self) -> dict[str, Image]:
        """The first images of each camera, by name."""
        return {name: one.image for name, one in self.sensors.items() if isinstance(one, MeasuredImages)}

    def _repr_html_(self) -> str:
        """The first cloud or image with figures of the frame, for notebooks."""
        rows = [
            ("time", f"{self.utc:%Y-%m-%d %H:%M:%S.%f} UTC, {self.time_ns / 1e9:g} s after the start"),
            ("place", "{:.6f}, {:.6f} degrees, {:.2f} m".format(*self.lonlath)),
            *((name, f"{len(cloud):,} returns") for name, cloud in self.clouds.items()),
            *((name, "{1} x {0} pixels".format(*image.depth.shape)) for name, image in self.images.items()),
            *((f"boxes of {name}", len(next(iter(box.values())))) for name, box in self.boxes.items()),
            *((f"fixes of {name}", len(fixes)) for name, fixes in self.fixes.items()),
            *((f"samples of {name}", len(samples)) for name, samples in self.samples.items()),
        ]
        shown = next((cloud._repr_png_() for cloud in self.clouds.values()), None)
        return card(f"Frame {self.number}", rows, picture=shown)

    @property
    def boxes(self) -> dict[str, Columns]:
        """Columns of the bounding boxes that go with `clouds` and `images`, by sensor; none without traffic.

        Of a scanner they are 3D boxes in the scene and from the ego vehicle, see
        `lidar.dataset.ground_truth.box_rows`; of a camera 2D boxes in pixels.
        """
        return {name: one.boxes for name, one in self.sensors.items() if one.boxes}


@dataclass(frozen=True)
class Simulation:
    """A planned drive, whose frames are simulated while they are iterated over; none is kept.

    Iterating again simulates the same frames again, bit for bit.

    plan : all that is fixed before the first frame: trajectory, road users, sensors
    """

    plan: DrivePlan

    def __len__(self) -> int:
        """Number of frames: those of the first sensor."""
        return next(iter(self.plan.frames.values()))

    def __iter__(self) -> Iterator[DriveFrame]:
        """Frames in order of time, prepared by threads: at most twice as many as workers."""
        plan = self.plan
        recording = plan.recording(Path())
        check_attackers(plan, recording)
        measured = run_jobs(
            partial(_measure_frame, recording=recording),
            plan.jobs,
            recording=recording,
            scene=plan.scene,
            workers=plan.options.workers,
            in_order=True,
        )
        stages = recording.settings.stages
        fixes, samples = _fixes(plan, stages), _samples(plan, stages)
        since_ns = np.iinfo(np.int64).min  # the first frame has all readings before it, too
        for number, (start_ns, end_ns, group) in enumerate(_steps(plan, measured)):
            pose = plan.trajectory.at([start_ns])
            x, y, z = pose.position[0].tolist()
            yield DriveFrame(
                number,
                start_ns,
                plan.start + timedelta(microseconds=start_ns // 1000),
                pose,
                np.array([*plan.scene.frame.to_geographic(x, y), z], float),
                measured=tuple(group),
                fixes={name: _within(readings, (since_ns, end_ns)) for name, readings in fixes.items()},
                samples={name: _within(readings, (since_ns, end_ns)) for name, readings in samples.items()},
            )
            since_ns = end_ns


@shows_progress
def simulate(scene: SceneLike, options: DriveOptions, *, progress: Progress = displayed) -> Simulation:
    """A drive through a scene whose frames are made one by one and not written.

    They are those that `lidar.drive` records with the same options, of which formats and labels do not count.

    scene : opened, its directory or URL, or a map file, of which the needed part is built

    Raises InputError (also as RouteError, RigError) for what cannot be driven.
    """
    expect(options, DriveOptions, name="options", error=InputError)
    scene = opened_for(scene, options, progress=progress)
    if options.scheduler:
        raise InputError("`scheduler`: frames that are not written are simulated by threads; leave it out")
    plan = plan_drive(scene, options, progress=progress)
    if not plan.sensors:
        raise InputError(f"rig {plan.rig.name} has neither scanners nor cameras, and so no frames; drive it")
    return Simulation(plan)


def _measure_frame(
    job: SensorFrame, worlds: Worlds, *, recording: Recording
) -> MeasuredCloud | MeasuredImages:
    return measure_frame(recording, job.sensor, frame=job.frame, worlds=worlds)


def _steps(
    plan: DrivePlan, measured: Iterable[MeasuredCloud | MeasuredImages]
) -> Iterator[tuple[int, int, Sequence[MeasuredCloud | MeasuredImages]]]:
    """Start, end and measurements of each frame of the first sensor; the last one's end is the drive's."""
    first, group = plan.sensors[0], list[MeasuredCloud | MeasuredImages]()
    frame = 0
    for one in measured:
        if one.sensor == first.name and one.frame > frame:
            yield first.frame_start_ns(frame), one.time_ns, group
            frame, group = one.frame, []
        group.append(one)
    if group:
        yield first.frame_start_ns(frame), plan.trajectory.duration_ns + 1, group


def _within(readings: Readings, span_ns: tuple[int, int]) -> Readings:
    first, last = np.searchsorted(readings.time_ns, span_ns)
    taken: Readings = readings.take(slice(int(first), int(last)))
    return taken


def _unit(plan: DrivePlan, spec: GnssSpec | ImuSpec) -> Situation:
    return situation_of_unit(
        spec.name,
        spec.mount,
        trajectory=plan.trajectory,
        start=plan.start,
        seed=plan.options.seed,
    )


def _fixes(plan: DrivePlan, stages: Stages) -> dict[str, Fixes]:
    """The fixes of the rig's receivers after the stages on them."""
    seed, found = plan.options.seed, dict[str, Fixes]()
    for spec in plan.rig.gnss:
        fixes = observed_fixes(plan.scene, spec, trajectory=plan.trajectory, start=plan.start, seed=seed)
        found[spec.name] = altered_fixes(fixes, stages, at=_unit(plan, spec))
    return found


def _samples(plan: DrivePlan, stages: Stages) -> dict[str, Inertial]:
    """The samples of the rig's inertial units after the stages on them."""
    found = dict[str, Inertial]()
    for spec in plan.rig.imus:
        samples = observe_imu(plan.trajectory, plan.scene.frame, spec=spec, seed=plan.options.seed)
        found[spec.name] = altered_samples(samples, stages, at=_unit(plan, spec))
    return found
