"""Evaluations as text, and as folders: JSON, CSV tables, figures and a page."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from geoscene import __version__
from geoscene.drawing.charts import encode
from geoscene.drawing.report import Column, Page, ReportTable, table_of
from geoscene.support.columns import write_columns
from geoscene.support.files import atomic_folder, write_atomically, write_json
from lidar.errors import InputError
from lidar.tools.evaluation.figures import figures_of
from lidar.tools.evaluation.intervals import Statistics, Value
from lidar.tools.evaluation.nuscenes_detection import NuScenesScore
from lidar.tools.evaluation.objects import ObjectScores
from lidar.tools.evaluation.pose_errors import absolute, by_axis
from lidar.tools.evaluation.trajectory import Compared, SegmentErrors, TrajectoryErrors, method_of
from lidar.tools.maps.compare import SurfaceDistances

DOCUMENT = "evaluation.json"

_NAMES = (
    r"evaluation\.(json|html)|[a-z_]+\.(csv|png|svg|tum)"
    r"|map\.(laz|compare\.(csv|png)|laz\.provenance\.json)"
)


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

_MAP: tuple[Column[SurfaceDistances], ...] = (
    Column("class", lambda row: row.name),
    Column("mean", lambda row: f"{1000 * row.mean_m:.1f}"),
    Column("median", lambda row: f"{1000 * row.median_m:.1f}"),
    Column("95 percentile", lambda row: f"{1000 * row.p95_m:.1f}"),
    Column("points", lambda row: f"{row.points:,}"),
)


def text_of(value: Value) -> str:
    """A figure with its interval."""
    if value.low is None or value.high is None:
        return f"{value.value:.3g}"
    return f"{value.value:.3g} ({value.low:.3g} to {value.high:.3g})"
