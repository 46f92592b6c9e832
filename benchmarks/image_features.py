"""How well features of images can be followed from frame to frame, and what images cost, by settings.

    python benchmarks/image_features.py SCENE [--pairs 10] [--variant supersample=2 ...] [--traffic] [--json]

Prints a table of docs/measurements/sensors.md; needs the extra ``odometry``. A KITTI camera (1242 x 375,
10 Hz) drives at random; the images of consecutive frames are rendered with the standard settings and with
those of each variant (``NAME=VALUE,NAME=VALUE``), in turn, in one thread. ORB features of both are
matched (nearest descriptor, mutual, ratio below 0.8); a match is correct if it ends within 1.5 pixels of
where true optical flow leads.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from geoscene.classes import Class
from geoscene.scene import open_scene
from lidar.options.drive import DriveOptions
from lidar.sensors.rig.devices import Camera
from lidar.simulation.frame_loop import chunks
from lidar.simulation.plan import plan_drive
from lidar.simulation.record_images import measure_images
from lidar.simulation.recording import MeasuredImages, Recording
from lidar.traffic.options import TrafficOptions
from lidar.world.world import Worlds

GROUND = (
    *(Class.ROAD, Class.SIDEWALK, Class.PARKING, Class.KERB, Class.TERRAIN, Class.GRASS),
    *(Class.LANE_MARKING, Class.CROSSING),
)
FEATURES = 3000
RATIO = 0.8
NEAR = 1.5
"""Pixels from the true place within which a match is correct."""
APART = 2
"""Frames from one pair to the next."""
RIG = """
name = "one_camera"
vehicle = "car"
source = "camera 2 of KITTI"

[[camera]]
name = "image"
translation = [1.03, 0.0, 1.658]
quat_wxyz = [0.5, -0.5, 0.5, -0.5]
width = 1242
height = 375
fx = 721.5377
cx = 609.5593
cy = 172.854
rate_hz = 10.0
images = ["rgb", "depth", "semantic"{flow}]
"""


def timed(
    recording: Recording, camera: Camera, *, frame: int, worlds: Worlds
) -> tuple[float, MeasuredImages]:
    """CPU seconds of this thread for a frame, and its images."""
    began = time.thread_time()
    images = measure_images(recording, camera, frame=frame, worlds=worlds)
    return time.thread_time() - began, images


def matches(
    one: NDArray[np.uint8],
    two: NDArray[np.uint8],
    flow: NDArray[np.float32],
    *,
    within: tuple[NDArray[np.uint8], NDArray[np.uint8]] | None = None,
) -> NDArray[np.bool_]:
    """Whether each matched feature is correct; ``within`` are masks of the pixels that may be features."""
    orb = cv2.ORB.create(nfeatures=FEATURES)
    found = [
        orb.detectAndCompute(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), None if within is None else within[k])
        for k, image in enumerate((one, two))
    ]
    (points, words), (there, others) = found
    if not points or not there:
        return np.zeros(0, np.bool_)
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING)
    back = {m.queryIdx: m.trainIdx for m in matcher.match(others, words)}
    rows = []
    for first, second in matcher.knnMatch(words, others, k=2):
        if first.distance >= RATIO * second.distance or back[first.trainIdx] != first.queryIdx:
            continue
        x, y = points[first.queryIdx].pt
        ends = np.array([x, y]) + flow[round(y), round(x)]
        off = np.hypot(*(ends - there[first.trainIdx].pt))
        rows.append(off < NEAR)
    return np.array(rows, np.bool_)


def figures(one: MeasuredImages, two: MeasuredImages, flow: NDArray[np.float32]) -> dict[str, float]:
    """Matches of a pair of frames and the correct ones, everywhere and on the ground alone."""
    first, second = one.image, two.image
    assert first.rgb is not None  # noqa: S101
    assert second.rgb is not None  # noqa: S101
    found = matches(first.rgb, second.rgb, flow)
    ground = tuple(255 * np.isin(image.klass, GROUND).astype(np.uint8) for image in (first, second))
    below = matches(first.rgb, second.rgb, flow, within=(ground[0], ground[1]))
    return {
        "matches": len(found),
        "correct": int(found.sum()),
        "ground": len(below),
        "ground_correct": int(below.sum()),
    }


def rows(
    path: Path, rig: str, *, pairs: int, variants: list[str], traffic: bool, seed: int
) -> list[dict[str, Any]]:
    """One row for the standard settings, and one for each variant."""
    scene = open_scene(path)
    around = TrafficOptions() if traffic else None
    options = DriveOptions("random", 0.1 * APART * pairs + 0.1, rig=rig, seed=seed, traffic=around)
    plan = plan_drive(scene, options)
    settings: dict[str, tuple[tuple[str, str], ...]] = {"standard": ()}
    for text in variants:
        pairs_of = (word.partition("=") for word in text.split(","))
        settings[text] = tuple((name, value) for name, _, value in pairs_of)
    sides = {
        name: replace(plan, options=replace(options, settings=wanted)).recording(Path("unwritten"))
        for name, wanted in settings.items()
    }
    camera = next(sensor for sensor in plan.sensors if isinstance(sensor, Camera))
    plain = replace(camera, spec=replace(camera.spec, images=("rgb", "depth", "semantic")))
    worlds = Worlds(scene, plan.max_range, actors=sides["standard"].actors)
    jobs = {job.frame: region for part, region in chunks(plan.jobs, plan.trajectory) for job in part}
    spent: dict[str, list[float]] = {name: [] for name in sides}
    found: dict[str, list[dict[str, float]]] = {name: [] for name in sides}
    for pair in range(pairs):
        frame = APART * pair
        worlds.follow(jobs[frame])
        flow = measure_images(sides["standard"], camera, frame=frame, worlds=worlds).flow
        assert flow is not None  # noqa: S101
        for name, side in sides.items():
            if not pair:
                measure_images(side, plain, frame=frame, worlds=worlds)  # compile, and fill caches
            first, one = timed(side, plain, frame=frame, worlds=worlds)
            second, two = timed(side, plain, frame=frame + 1, worlds=worlds)
            spent[name] += [first, second]
            found[name].append(figures(one, two, flow))
    return [
        {
            "settings": name,
            "s": float(np.median(spent[name])),
            **{key: float(np.mean([one[key] for one in found[name]])) for key in found[name][0]},
        }
        for name in sides
    ]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--pairs", type=int, default=10)
    parser.add_argument("--variant", action="append", default=[])
    parser.add_argument("--traffic", action="store_true")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        rig = Path(folder) / "one_camera.toml"
        rig.write_text(RIG.format(flow=', "flow"'))
        table = rows(
            asked.scene,
            str(rig),
            pairs=asked.pairs,
            variants=asked.variant,
            traffic=asked.traffic,
            seed=asked.seed,
        )
    if asked.json:
        print(json.dumps(table, indent=1))
        return
    print("| settings | s per frame | matches | correct | on the ground | correct |")
    print("|---|---|---|---|---|---|")
    for row in table:
        share = row["correct"] / max(row["matches"], 1)
        below = row["ground_correct"] / max(row["ground"], 1)
        print(
            f"| {row['settings']} | {row['s']:.3f}"
            f" | {row['matches']:.0f} | {row['correct']:.0f} ({share:.0%})"
            f" | {row['ground']:.0f} | {row['ground_correct']:.0f} ({below:.0%}) |"
        )


if __name__ == "__main__":
    main()
