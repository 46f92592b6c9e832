"""Figures of a trajectory against the truth: the plan, the drift, errors by axis, quality by the estimate."""

from __future__ import annotations

import csv
import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from geoscene.drawing.canvas import Canvas
from geoscene.drawing.charts import COLORS, Axes
from geoscene.drawing.panels import Panel, Raster, Series, ShadedBand, figure
from geoscene.errors import GeosceneError
from geoscene.scene import open_scene
from geoscene.typing import Float
from lidar.tools.evaluation.pose_errors import absolute, by_axis
from lidar.tools.evaluation.trajectories import ESTIMATE, file_of
from lidar.tools.evaluation.trajectory import Compared
from lidar.tools.plots.drawn import WIDE, plain, thin

_MARGIN = 25.0
"""Metres around the trajectories in the plan."""

_WIDTH = 1400
"""Pixels of the picture of the roads."""

_ROAD, _EARTH = (222, 224, 228), (255, 255, 255)
_BARS = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1000.0, 2000.0, 5000.0, 10000.0)
_TRUE, _FOUND = (40, 40, 46), (200, 60, 40)
_KNOWN = re.compile(r"timestamp|time_(ns|s)|frame|[xyz]|alpha|beta|gamma|q[xyzw]|lon|lat|h|sigma_.*")
"""Columns of times, poses and their uncertainty."""
_MOST_QUALITIES = 6


def figures_of(compared: Compared, estimate: Path) -> dict[str, Canvas]:
    """Figures by name."""
    found = {"plan": plan(compared), "drift": drift(compared), "axes": axes(compared)}
    if (quality := qualities(estimate)) is not None:
        found["quality"] = quality
    return found


def plan(compared: Compared) -> Canvas:
    """Both trajectories from above, over the roads of the scene where it is known, with a scale bar."""
    pairs = compared.pairs
    ways = [pairs.truth.position[:, :2], pairs.estimate.position[:, :2]]
    low = np.min([way.min(axis=0) for way in ways], axis=0) - _MARGIN
    high = np.max([way.max(axis=0) for way in ways], axis=0) + _MARGIN
    wide, tall = (high - low).tolist()
    pixels, roads = _roads(compared, low=low, high=high)
    bar = max(b for b in _BARS if b <= max(wide / 4, _BARS[0]))
    place = low + np.array([0.04 * wide, 0.05 * tall])
    lines = [
        Series("truth", thin(*ways[0].T), color=_TRUE),
        Series("estimate", thin(*ways[1].T), color=_FOUND),
        Series(f"{bar:g} m", [(place[0], place[1]), (place[0] + bar, place[1])], color=(0, 0, 0)),
    ]
    errors = compared.errors
    title = (
        f"{errors.way_m:,.0f} m, root mean square error {errors.translation.rmse.value:.3g} m"
        f" (alignment {errors.alignment.kind}{roads})"
    )
    shown = Axes(title, "x, m", "y, m", plain)
    ends = (float(low[0]), float(high[0])), (float(low[1]), float(high[1]))
    raster = Raster(shown, pixels, *ends, square=True, lines=lines)
    width = min(820, round(820 * wide / tall)) if tall > wide else 820
    width = max(width, 420)
    return figure([raster], size=(308 + width, 122 + max(min(round(width * tall / wide), 900), 160)))


def _roads(compared: Compared, *, low: Float, high: Float) -> tuple[NDArray[np.uint8], str]:
    """A picture of the roads of the scene, and a remark if they are not known."""
    wide, tall = (high - low).tolist()
    scale = _WIDTH / max(wide, tall)
    image = Image.new("RGB", (max(round(wide * scale), 1), max(round(tall * scale), 1)), _EARTH)
    dataset = compared.dataset
    if dataset is None:
        return np.asarray(image), ""
    try:
        graph = open_scene(dataset.scene_path).road_graph()
    except GeosceneError:
        return np.asarray(image), "; the scene is not there"
    pen = ImageDraw.Draw(image)
    shrink = float(dataset.trajectory().scale[0])
    for line, width in zip(graph.geometry, graph.width.tolist(), strict=True):
        xy = (line[:, :2] / shrink - low) * scale
        if (xy.max(axis=0) < 0).any() or (xy.min(axis=0) > [wide * scale, tall * scale]).any():
            continue
        xy[:, 1] = tall * scale - xy[:, 1]
        pen.line(
            [tuple(p) for p in xy.tolist()], fill=_ROAD, width=max(round(width * scale), 1), joint="curve"
        )
    return np.asarray(image), ""


def drift(compared: Compared) -> Canvas:
    """Absolute errors over the way, and the mean errors of segments with their intervals by length."""
    pairs = compared.pairs
    way = pairs.truth.distance()
    moved, turned = absolute(pairs)
    ends = (0.0, max(float(way[-1]), 1e-3))
    kind = compared.errors.alignment.kind
    parts = [
        Panel(
            Axes(f"Absolute error (alignment {kind})", "true way, m", "m", plain),
            [Series("translation", thin(way, moved), color=COLORS[0])],
            x_log=False,
            y_log=False,
            x_ends=ends,
        ),
        Panel(
            Axes("", "true way, m", "degrees", plain),
            [Series("rotation", thin(way, np.degrees(turned)), color=COLORS[1])],
            x_log=False,
            y_log=False,
            x_ends=ends,
        ),
    ]
    rows = [row for row in compared.errors.segments if row.length is not None]
    for name, unit in (("translation", "%"), ("rotation", "degrees per 100 m")) if rows else ():
        values = [(float(row.length or 0), getattr(row, name)) for row in rows]
        known = [(x, *v.interval) for x, v in values if v.interval is not None]
        line = Series(f"mean {name}", [(x, v.value) for x, v in values], color=COLORS[2])
        dots = Series("a length", line.points, dots=True, color=COLORS[2])
        what = "KITTI" if compared.errors.kitti else "shorter than KITTI's"
        title = f"Errors of segments ({what})" if name == "translation" else ""
        parts.append(
            Panel(
                Axes(title, "length of the segments, m", unit, plain),
                [line, dots],
                x_log=False,
                y_log=False,
                bands=[ShadedBand("95 %", known)] if len(known) > 1 else [],
                x_ends=(0.0, 1.05 * values[-1][0]),
            )
        )
    return figure(parts, columns=1, size=(WIDE[0], 270))


def axes(compared: Compared) -> Canvas:
    """Errors along the true axes of the body, and its roll, pitch and yaw, over the way."""
    pairs = compared.pairs
    way = pairs.truth.distance()
    moved, turned = by_axis(pairs)
    ends = (0.0, max(float(way[-1]), 1e-3))
    rows = [
        ("Errors along the true axes of the body", "m", ("forward (x)", "left (y)", "up (z)"), moved),
        ("Errors of its rotation", "degrees", ("roll", "pitch", "yaw"), np.degrees(turned)),
    ]
    parts = [
        Panel(
            Axes(title, "true way, m", unit, plain),
            [Series(name, thin(way, values[:, k]), color=COLORS[k]) for k, name in enumerate(names)],
            x_log=False,
            y_log=False,
            x_ends=ends,
        )
        for title, unit, names, values in rows
    ]
    return figure(parts, columns=1, size=WIDE)


def qualities(estimate: Path) -> Canvas | None:
    """Quality figures that an estimate reports by frame, such as matches and inliers; None without any.

    It is in numeric columns, but those of poses, of a CSV file with the estimate's name, or of ``poses.csv``
    in the folder of an estimate.
    """
    estimate = file_of(estimate)
    beside = estimate.with_suffix(".csv")
    if estimate.name == ESTIMATE:
        beside = estimate.with_name("poses.csv")
    if not beside.is_file():
        return None
    with beside.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    columns = {}
    for name in rows[0] if rows else ():
        try:
            columns[name] = np.array([float(row[name] or "nan") for row in rows])
        except (TypeError, ValueError):
            continue
    values = {name: v for name, v in columns.items() if not _KNOWN.fullmatch(name) and np.isfinite(v).any()}
    if not values:
        return None
    frame = columns.get("frame", np.arange(len(rows), dtype=float))
    ends = (float(frame[0]), max(float(frame[-1]), float(frame[0]) + 1))
    parts = [
        Panel(
            Axes("By the estimate" if k == 0 else "", "frame", name, plain),
            [Series(name, thin(frame, v), color=COLORS[k % len(COLORS)])],
            x_log=False,
            y_log=False,
            x_ends=ends,
        )
        for k, (name, v) in enumerate(list(values.items())[:_MOST_QUALITIES])
    ]
    return figure(parts, columns=1, size=(WIDE[0], 230))
