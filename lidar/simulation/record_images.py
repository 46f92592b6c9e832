"""A frame of a camera: its images as PNG, with the 2D bounding boxes of road users and signal heads."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import Class
from geoscene.support.columns import write_columns
from lidar.dataset.png import depth_to_counts, feature_to_image, flow_to_image, write_png
from lidar.geometry.poses import Poses
from lidar.geometry.random_streams import generator
from lidar.sensors.camera.light import Lamps
from lidar.sensors.camera.render import CameraImage as Image
from lidar.sensors.camera.render import optical_flow, render
from lidar.sensors.rig.camera_model import exposure_times
from lidar.sensors.rig.devices import Camera
from lidar.signal.run import altered_image
from lidar.signal.truth import image_truth
from lidar.simulation.boxes import image_boxes
from lidar.simulation.recording import MeasuredImages, Recording
from lidar.simulation.situations import clouds_during, situation_of, sun_during
from lidar.traffic.signal_heads import STATES, SignalStates
from lidar.world.world import World, Worlds


def write_images(recording: Recording, measured: MeasuredImages, *, paths: dict[str, Path]) -> None:
    """Write the images of a frame as PNG, and the signal heads in them."""
    if "signals" in paths:
        write_columns(paths["signals"], measured.signals)
    for kind in measured.camera.images:
        with recording.watch.stage(f"write {kind}"):
            _write_image(paths[kind], measured, kind=kind)


def measure_images(recording: Recording, camera: Camera, *, frame: int, worlds: Worlds) -> MeasuredImages:
    """Render one frame."""
    samples = recording.settings.camera.moments(camera.spec)
    times = exposure_times(camera.spec, camera.frame_start_ns(frame), samples=samples)
    rows = len(times) // samples
    first = (samples // 2) * rows  # of the exposure's middle sample, whose depth and labels are kept
    start = camera.frame_start_ns(frame)
    span_ns = start, max(int(times[-1]), start + 1)
    world = worlds.during(*span_ns)
    middle = int(times[first + rows // 2])
    pose = _poses(recording, camera, times=times[[first + rows // 2]])
    shown = recording.signals
    lamps = None if shown is None else lamps_at(shown, middle)
    image = _render(recording, camera, frame=frame, times=times, span_ns=span_ns, world=world, lamps=lamps)
    boxes, truth = dict[str, NDArray[Any]](), dict[str, NDArray[Any]]()
    signals = dict[str, NDArray[Any]]()
    if shown is not None:
        signals = signal_columns(shown, image, pose=pose, frame=frame, time_ns=middle)
    if recording.actors is not None:
        with recording.watch.stage("boxes"):
            boxes = image_boxes(
                recording.actors,
                camera.spec,
                pose=pose,
                frame=frame,
                time_ns=middle,
                instance=image.feature,
                span_ns=(start, int(times[-1])),
            )
    if recording.has_stages(camera):
        original = image
        at = situation_of(recording, camera, frame=frame, world=world)
        image = altered_image(image, recording.settings.stages, at=at)
        truth = image_truth(image, original)
    flow = None
    if "flow" in camera.spec.images:
        with recording.watch.stage("flow"):
            flow = _flow(recording, camera, times=times[first : first + rows], worlds=worlds)
    return MeasuredImages(
        camera.name,
        frame,
        start,
        camera.spec.mount,
        recording.trajectory,
        boxes,
        truth,
        camera=camera.spec,
        image=image,
        signals=signals,
        flow=flow,
    )


def _render(
    recording: Recording,
    camera: Camera,
    *,
    frame: int,
    times: NDArray[np.int64],
    span_ns: tuple[int, int],
    world: World,
    lamps: Lamps | None,
) -> Image:
    """A frame of a camera; ``times`` are its exposure times, ``span_ns`` the times of the world's motion."""
    settings, (start, end) = recording.settings, span_ns
    with recording.watch.stage("render"):
        return render(
            camera.spec,
            _poses(recording, camera, times=times),
            world=world,
            sun=sun_during(recording, start),
            times=None if recording.actors is None else (times - start) / (end - start),
            lamps=lamps,
            clouds=clouds_during(recording, start),
            random=generator(settings.seed, camera.name, frame, "image"),
            settings=settings.camera,
        )


def _write_image(path: Path, measured: MeasuredImages, *, kind: str) -> None:
    image, flow = measured.image, measured.flow
    if kind == "flow" and flow is not None:
        write_png(path, flow_to_image(flow))
    elif kind == "rgb" and image.rgb is not None:
        write_png(path, image.rgb)
    elif kind == "depth":
        write_png(path, depth_to_counts(image.depth))
    elif kind == "semantic":
        write_png(path, image.klass)
    elif kind == "instance":
        write_png(path, feature_to_image(image.feature))


def _poses(recording: Recording, camera: Camera, *, times: NDArray[np.int64]) -> Poses:
    """Poses of a camera at times (k,)."""
    mount = camera.spec.mount
    return recording.trajectory.at(times).mounted(mount.translation, mount.rotation)


def _flow(
    recording: Recording, camera: Camera, *, times: NDArray[np.int64], worlds: Worlds
) -> NDArray[np.float32]:
    """Optical flow to the next frame. It replaces this thread's world by one that spans both frames.

    times : of the rows in this frame, one for all without a rolling shutter
    """
    later = times + camera.period_ns
    start, end = int(times[0]), int(later[-1])
    world = worlds.during(start, end)
    shares = [(t - start) / (end - start) for t in (times, later)]
    here, there = (_poses(recording, camera, times=t) for t in (times, later))
    return optical_flow(camera.spec, here, later=there, world=world, times=shares[0], later_times=shares[1])


_LAMPS_Z = 2.9  # metres of the middle of the lamps above the foot of the post


def lamps_at(signals: SignalStates, time_ns: int) -> Lamps:
    """The lamps that are lit at a time, nanoseconds since the drive's start."""
    return Lamps(signals.heads.feature, signals.at(time_ns * 1e-9))


def signal_columns(
    signals: SignalStates, image: Image, *, pose: Poses, frame: int, time_ns: int
) -> dict[str, NDArray[Any]]:
    """Columns of ``signals.csv``: the signal heads (k,) in an image.

    image   : as it was rendered, before stages
    pose    : of the camera, one
    time_ns : at which the heads show their states, nanoseconds since the drive's start
    """
    heads = signals.heads
    v, u = np.nonzero(image.klass == Class.TRAFFIC_LIGHT)
    seen = image.feature[v, u]
    known = np.isin(seen, heads.feature)
    v, u, seen = v[known], u[known], seen[known]
    feature, which, pixels = np.unique(seen, return_inverse=True, return_counts=True)
    row = np.searchsorted(heads.feature, feature)
    k = len(feature)
    low, high = np.full((k, 2), np.inf), np.full((k, 2), -np.inf)
    for side, at in enumerate((u, v)):
        np.minimum.at(low[:, side], which, at - 0.5)
        np.maximum.at(high[:, side], which, at + 0.5)
    toward = pose.position - heads.place[row] - [0.0, 0.0, _LAMPS_Z]
    front = np.column_stack([np.cos(heads.heading[row]), np.sin(heads.heading[row]), np.zeros(k)])
    cosine = np.einsum("ij,ij->i", toward, front) / np.maximum(np.linalg.norm(toward, axis=1), 1e-9)
    return {
        "frame": np.full(k, frame),
        "time_ns": np.full(k, time_ns),
        "instance": feature,
        "state": np.array(STATES, np.str_)[signals.at(time_ns * 1e-9)[row]],
        "angle_deg": np.round(np.degrees(np.arccos(np.clip(cosine, -1, 1))), 1),
        "junction": heads.zone[row],
        "left": low[:, 0],
        "top": low[:, 1],
        "right": high[:, 0],
        "bottom": high[:, 1],
        "pixels": pixels,
    }
