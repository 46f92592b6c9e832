"""Evaluations as text, and as folders: JSON, CSV tables, figures and a page."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from geoscene import __version__
from geoscene.drawing.charts import html_page, html_picture, html_table
from geoscene.support.csv_tables import write_columns
from geoscene.support.files import atomic_folder, write_atomically, write_json
from lidar.errors import InputError
from lidar.tools.evaluation.figures import figures_of
from lidar.tools.evaluation.intervals import Statistics, Value
from lidar.tools.evaluation.nuscenes_detection import NuScenesScore
from lidar.tools.evaluation.objects import ObjectScores
from lidar.tools.evaluation.pose_errors import absolute, by_axis
from lidar.tools.evaluation.trajectory import Compared, TrajectoryErrors, method_of

DOCUMENT = "evaluation.json"

_NAMES = (
    r"evaluation\.(json|html)|[a-z_]+\.(csv|png|svg|tum)"
    r"|map\.(laz|compare\.(csv|png)|laz\.provenance\.json)"
)

Rows = list[list[str]]


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
    body = [f"<p>{method_of(errors)}</p>"]
    body += [f"<h2>{title}</h2>{html_table(head, rows)}" for title, head, rows in tables(errors)]
    for name, canvas in figures_of(compared, estimate).items():
        png = canvas.encoded(".png")
        write_atomically(folder / f"{name}.png", png)
        write_atomically(folder / f"{name}.svg", canvas.encoded(".svg"))
        body.append(html_picture(png, alt=name))
    title = f"{Path(errors.estimate).name} against {Path(errors.truth).name}"
    write_atomically(folder / "evaluation.html", html_page(title, "".join(body)))
    write_json(folder / DOCUMENT, {"generator": f"geoscene lidar {__version__}", **errors.to_json()})


def write_object_report(found: ObjectScores, folder: Path) -> None:
    """Write ``evaluation.json``, ``scores.csv`` (but of nuScenes' scores) and ``evaluation.html``."""
    if not isinstance(found.scores, NuScenesScore):
        rows = [asdict(one) for one in found.scores]
        write_columns(
            folder / "scores.csv",
            {name: ["" if row[name] is None else row[name] for row in rows] for name in rows[0]},
        )
    body = [f"<p>{found.kind}: {found.frames:,} frames</p>"]
    body += [f"<h2>{title}</h2>{html_table(head, rows)}" for title, head, rows in found.tables()]
    title = f"{Path(found.estimate).name} against {Path(found.truth).name}"
    write_atomically(folder / "evaluation.html", html_page(title, "".join(body)))
    write_json(folder / DOCUMENT, {"generator": f"geoscene lidar {__version__}", **found.to_json()})


def tables(errors: TrajectoryErrors) -> list[tuple[str, list[str], Rows]]:
    """Title, head and rows of each table."""
    rows = [
        ["translation, m", *_cells(errors.translation)],
        ["rotation, degrees", *_cells(errors.rotation)],
    ]
    head = ["", "rmse", "mean", "median", "max", "poses"]
    found = [(f"Absolute errors (alignment {errors.alignment.kind})", head, rows)]
    relative = []
    for one in errors.relative:
        words = f"{one.delta[:-1]} {'frames' if one.delta.endswith('f') else 'm'}"
        relative.append([f"translation over {words}, m", *_cells(one.translation)])
        relative.append([f"rotation over {words}, degrees", *_cells(one.rotation)])
    if relative:
        found.append(("Relative errors", [*head[:-1], "pairs"], relative))
    if errors.segments:
        rows = [
            [
                "all" if row.length is None else f"{row.length} m",
                text_of(row.translation),
                text_of(row.rotation),
                f"{row.count:,}",
            ]
            for row in errors.segments
        ]
        kind = "KITTI" if errors.kitti else "shorter than KITTI's"
        found.append((f"Errors of segments ({kind})", ["length", "%", "degrees per 100 m", "segments"], rows))
    if errors.map:
        rows = [
            [row.name, *(f"{1000 * v:.1f}" for v in (row.mean_m, row.median_m, row.p95_m)), f"{row.points:,}"]
            for row in errors.map
        ]
        found.append(
            ("Map to true surfaces, mm", ["class", "mean", "median", "95 percentile", "points"], rows)
        )
    return found


def text_of(value: Value) -> str:
    """A figure with its interval."""
    if value.low is None or value.high is None:
        return f"{value.value:.3g}"
    return f"{value.value:.3g} ({value.low:.3g} to {value.high:.3g})"


def _cells(found: Statistics) -> Sequence[str]:
    return [
        *(text_of(v) for v in (found.rmse, found.mean, found.median)),
        f"{found.max:.3g}",
        f"{found.count:,}",
    ]
