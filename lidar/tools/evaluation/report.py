"""Evaluations as text, figures, and folders: JSON, CSV tables and a page."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from geoscene import __version__
from geoscene.drawing.charts import COLORS, Axes, Panel, Raster, Series, ShadedBand, encode, figure
from geoscene.drawing.report import Column, Page, ReportTable, table_of
from geoscene.errors import GeosceneError
from geoscene.scene import open_scene
from geoscene.support.columns import write_columns
from geoscene.support.files import atomic_folder, write_atomically, write_json
from geoscene.typing import Float
from lidar.errors import InputError
from lidar.tools.evaluation.nuscenes_detection import NuScenesScore
from lidar.tools.evaluation.objects import ObjectScores
from lidar.tools.evaluation.pose_errors import Statistics, Value, absolute, by_axis
from lidar.tools.evaluation.trajectories import ESTIMATE, file_of
from lidar.tools.evaluation.trajectory import Compared, SegmentErrors, TrajectoryErrors, method_of
from lidar.tools.maps.compare import SurfaceDistances
from lidar.tools.plots import WIDE

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_MARGIN = 25.0
"""Metres around the trajectories in the plan."""

_WIDTH = 1400
"""Pixels of the picture of the roads."""

_ROAD, _EARTH = (222, 224, 228), (255, 255, 255)
_BARS = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1000.0, 2000.0, 5000.0, 10000.0)
_TRUE = "#28282e"
_KNOWN = re.compile(r"timestamp|time_(ns|s)|frame|[xyz]|alpha|beta|gamma|q[xyzw]|lon|lat|h|sigma_.*")
"""Columns of times, poses and their uncertainty."""
_MOST_QUALITIES = 6
DOCUMENT = "evaluation.json"

_NAMES = (
    r"evaluation\.(json|html)|[a-z_]+\.(csv|png|svg|tum)"
    r"|map\.(laz|compare\.(csv|png)|laz\.provenance\.json)"
)

_MAP: tuple[Column[SurfaceDistances], ...] = (
    Column("class", lambda row: row.name),
    Column("mean", lambda row: f"{1000 * row.mean_m:.1f}"),
    Column("median", lambda row: f"{1000 * row.median_m:.1f}"),
    Column("95 percentile", lambda row: f"{1000 * row.p95_m:.1f}"),
    Column("points", lambda row: f"{row.points:,}"),
)


def figures_of(compared: Compared, estimate: Path) -> dict[str, Figure]:
    """Figures by name."""
    found = {"plan": plan(compared), "drift": drift(compared), "axes": axes(compared)}
    if (quality := qualities(estimate)) is not None:
        found["quality"] = quality
    return found


def plan(compared: Compared) -> Figure:
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
        Series("truth", *ways[0].T, color=_TRUE),
        Series("estimate", *ways[1].T, color=COLORS[0]),
        Series(f"{bar:g} m", place[0] + np.array([0, bar]), place[[1, 1]], color="black"),
    ]
    errors = compared.errors
    title = (
        f"{errors.way_m:,.0f} m, root mean square error {errors.translation.rmse.value:.3g} m"
        f" (alignment {errors.alignment.kind}{roads})"
    )
    ends = (float(low[0]), float(high[0])), (float(low[1]), float(high[1]))
    raster = Raster(Axes(title, "x, m", "y, m"), pixels, *ends, square=True, lines=lines)
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


def drift(compared: Compared) -> Figure:
    """Absolute errors over the way, and the mean errors of segments with their intervals by length."""
    pairs = compared.pairs
    way = pairs.truth.distance()
    moved, turned = absolute(pairs)
    title = f"Absolute error (alignment {compared.errors.alignment.kind})"
    parts = [
        Panel(Axes(title, "true way, m", "m"), [Series("translation", way, moved)]),
        Panel(
            Axes("", "true way, m", "degrees"), [Series("rotation", way, np.degrees(turned), color=COLORS[1])]
        ),
    ]
    rows = [row for row in compared.errors.segments if row.length is not None]
    for name, unit in (("translation", "%"), ("rotation", "degrees per 100 m")) if rows else ():
        lengths = np.array([row.length for row in rows], float)
        values = [getattr(row, name) for row in rows]
        means = [v.value for v in values]
        low, high = np.array([v.interval or (np.nan, np.nan) for v in values]).T
        what = "KITTI" if compared.errors.kitti else "shorter than KITTI's"
        title = f"Errors of segments ({what})" if name == "translation" else ""
        parts.append(
            Panel(
                Axes(title, "length of the segments, m", unit),
                [
                    Series(f"mean {name}", lengths, means, color=COLORS[2]),
                    Series("a length", lengths, means, dots=True, color=COLORS[2]),
                ],
                bands=[ShadedBand("95 %", lengths, low, high)] if np.isfinite(low).sum() > 1 else [],
            )
        )
    return figure(parts, size=(WIDE[0], 270))


def axes(compared: Compared) -> Figure:
    """Errors along the true axes of the body, and its roll, pitch and yaw, over the way."""
    pairs = compared.pairs
    way = pairs.truth.distance()
    moved, turned = by_axis(pairs)
    rows = [
        ("Errors along the true axes of the body", "m", ("forward (x)", "left (y)", "up (z)"), moved),
        ("Errors of its rotation", "degrees", ("roll", "pitch", "yaw"), np.degrees(turned)),
    ]
    parts = [
        Panel(
            Axes(title, "true way, m", unit),
            [Series(name, way, values[:, k]) for k, name in enumerate(names)],
        )
        for title, unit, names, values in rows
    ]
    return figure(parts, size=WIDE)


def qualities(estimate: Path) -> Figure | None:
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
    with beside.open(newline="", encoding="utf-8-sig") as file:
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
    parts = [
        Panel(
            Axes("By the estimate" if k == 0 else "", "frame", name),
            [Series(name, frame, v, color=COLORS[k % len(COLORS)])],
        )
        for k, (name, v) in enumerate(list(values.items())[:_MOST_QUALITIES])
    ]
    return figure(parts, size=(WIDE[0], 230))


@contextmanager
def report_folder(out: Path, *, overwrite: bool) -> Iterator[Path]:
    """Yield a folder that appears as ``out`` at the end unless the block raises.

    Raises InputError if it exists and may not be overwritten, or is not of an evaluation.
    """
    if out.exists() and not overwrite:
        raise InputError(f"{out}: exists already; set `overwrite` to replace it")
    with atomic_folder(out, mark=DOCUMENT, names=_NAMES) as folder:
        yield folder


def write_trajectory_report(compared: Compared, folder: Path, *, estimate: Path) -> None:
    """Write ``evaluation.json``, tables, figures, ``aligned.tum`` and ``evaluation.html`` into a folder."""
    pairs, errors = compared.pairs, compared.errors
    moved, turned = absolute(pairs)
    off, angles = by_axis(pairs)
    columns: dict[str, Any] = {"time_ns": pairs.truth.time_ns, "way_m": pairs.truth.distance()}
    columns |= {"translation_m": moved, "rotation_deg": np.degrees(turned)}
    columns |= dict(zip(("forward_m", "left_m", "up_m"), off.T, strict=True))
    columns |= dict(zip(("roll_deg", "pitch_deg", "yaw_deg"), np.degrees(angles).T, strict=True))
    write_columns(folder / "errors.csv", columns)
    parts = compared.segments
    write_columns(
        folder / "segments.csv",
        {
            "first": parts.first.astype(np.int64),
            "length_m": parts.length,
            "translation_percent": 100 * parts.shift,
            "rotation_deg_per_100m": np.degrees(100 * parts.turn),
            "speed_m_s": parts.speed,
        },
    )
    if pairs.truth.timed:
        pairs.estimate.write(folder / "aligned.tum")
    page = Page(f"{Path(errors.estimate).name} against {Path(errors.truth).name}")
    page.paragraph(method_of(errors))
    for table in trajectory_tables(errors):
        page.table(table)
    for name, chart in figures_of(compared, estimate).items():
        png = encode(chart)
        write_atomically(folder / f"{name}.png", png)
        write_atomically(folder / f"{name}.svg", encode(chart, ".svg"))
        page.picture(png, alt=name)
    write_atomically(folder / "evaluation.html", page.encoded())
    write_json(folder / DOCUMENT, {"generator": f"geoscene lidar {__version__}", **errors.to_json()})


def write_object_report(found: ObjectScores, folder: Path) -> None:
    """Write ``evaluation.json``, ``scores.csv`` (but of nuScenes' scores) and ``evaluation.html``."""
    if not isinstance(found.scores, NuScenesScore):
        rows = [asdict(one) for one in found.scores]
        write_columns(
            folder / "scores.csv",
            {name: ["" if row[name] is None else row[name] for row in rows] for name in rows[0]},
        )
    page = Page(f"{Path(found.estimate).name} against {Path(found.truth).name}")
    page.paragraph(f"{found.kind}: {found.frames:,} frames")
    for table in found.tables():
        page.table(table)
    write_atomically(folder / "evaluation.html", page.encoded())
    write_json(folder / DOCUMENT, {"generator": f"geoscene lidar {__version__}", **found.to_json()})


def trajectory_tables(errors: TrajectoryErrors) -> list[ReportTable]:
    """The tables of a trajectory's errors."""
    whole = [("translation, m", errors.translation), ("rotation, degrees", errors.rotation)]
    title = f"Absolute errors (alignment {errors.alignment.kind})"
    found = [table_of(_statistics_columns("poses"), whole, title=title)]
    parts = []
    for one in errors.relative:
        span = f"{one.delta[:-1]} {'frames' if one.delta.endswith('f') else 'm'}"
        parts.append((f"translation over {span}, m", one.translation))
        parts.append((f"rotation over {span}, degrees", one.rotation))
    if parts:
        found.append(table_of(_statistics_columns("pairs"), parts, title="Relative errors"))
    if errors.segments:
        kind = "KITTI" if errors.kitti else "shorter than KITTI's"
        found.append(table_of(_SEGMENTS, errors.segments, title=f"Errors of segments ({kind})"))
    if errors.map:
        found.append(table_of(_MAP, errors.map, title="Map to true surfaces, mm"))
    return found


def _statistics_columns(count: str) -> list[Column[tuple[str, Statistics]]]:
    """Columns of named statistics; ``count`` is the heading of their number."""
    return [
        Column("", lambda row: row[0]),
        Column("rmse", lambda row: text_of(row[1].rmse)),
        Column("mean", lambda row: text_of(row[1].mean)),
        Column("median", lambda row: text_of(row[1].median)),
        Column("max", lambda row: f"{row[1].max:.3g}"),
        Column(count, lambda row: f"{row[1].count:,}"),
    ]


_SEGMENTS: tuple[Column[SegmentErrors], ...] = (
    Column("length", lambda row: "all" if row.length is None else f"{row.length} m"),
    Column("%", lambda row: text_of(row.translation)),
    Column("degrees per 100 m", lambda row: text_of(row.rotation)),
    Column("segments", lambda row: f"{row.count:,}"),
)


def text_of(value: Value) -> str:
    """A figure with its interval."""
    if value.low is None or value.high is None:
        return f"{value.value:.3g}"
    return f"{value.value:.3g} ({value.low:.3g} to {value.high:.3g})"
