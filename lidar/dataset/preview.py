"""A dataset as notebooks show it: the way of the ego vehicle over some of its points, and its figures."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from geoscene.classes import class_codes
from geoscene.drawing.previews import DARK, PreviewPlan, around, card
from geoscene.typing import Float
from lidar.dataset.formats.table import placed_returns
from lidar.dataset.layout import Dataset
from lidar.dataset.recorded import Stream, cloud_points, labelled_clouds
from lidar.geometry.poses import Trajectory

_CLOUDS = 8
"""Clouds of the first scanner that a picture is made of, spread over the drive."""

_POSES = 2000
_MARGIN = 40.0
_WAY = (255, 90, 60)


def png(dataset: Dataset) -> bytes:
    """A PNG picture of a drive from above, points coloured by class."""
    trajectory = dataset.trajectory()
    way = trajectory.position[:: max(len(trajectory) // _POSES, 1), :2]
    plan = PreviewPlan(around(way, margin=_MARGIN), DARK)
    name = next(iter(dataset.sensors("lidar")), None)
    clouds = None if name is None else labelled_clouds(dataset, name)
    if clouds is not None:
        plan.points(*_sample(clouds, trajectory))
    plan.line(way, _WAY)
    return plan.png()


def _sample(clouds: Stream, trajectory: Trajectory) -> tuple[Float, np.ndarray]:
    """Points (n, 3) of some clouds in the scene, and their colours."""
    rows = np.unique(np.linspace(0, len(clouds.files) - 1, _CLOUDS).astype(int)).tolist()
    places, labels = [], []
    for row in rows:
        table, start_ns = cloud_points(clouds.files[row]), int(clouds.time_ns[row])
        mount = clouds.mount.matrix
        placed, _ = placed_returns(table, trajectory, start_ns=start_ns, vehicle_from_sensor=mount)
        places.append(placed)
        labels.append(table["label"])
    return np.concatenate(places), class_codes().color[np.concatenate(labels)]


def html(dataset: Dataset) -> str:
    """The picture and a table of figures."""
    return card(f"Drive {dataset.path.name}", _figures(dataset), picture=png(dataset))


def _figures(dataset: Dataset) -> Iterator[tuple[str, str]]:
    manifest = dataset.manifest
    yield "scene", manifest["scene"]["name"] or Path(manifest["scene"]["path"]).name
    yield "start", f"{dataset.start:%Y-%m-%d %H:%M:%S} UTC"
    yield "drive", f"{manifest['duration_ns'] / 1e9:g} s, {manifest['length_m']:,.0f} m"
    done = int(manifest["frames_done"])
    yield "frames", f"{done:,} of {dataset.frames:,}"
    yield "rig", f"{manifest['rig']}: {', '.join(dataset.sensors())}"
    for name, count in manifest.get("points", {}).items():
        yield f"points of {name}", f"{count:,}"
    recipe = manifest["recipe"]
    acted = [str(s["name"]) for key in ("stages", "applied_stages") for s in recipe.get(key) or ()]
    if acted:
        yield "stages", ", ".join(acted)
    yield "credit", manifest.get("attribution", "")
