"""Figures of recorded drives: one function and one row in `FIGURES` each."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from geoscene.errors import need
from geoscene.support.files import write_atomically
from geoscene.support.progress import Progress, displayed, shows_progress
from geoscene.support.registry import Registry, load
from lidar.errors import InputError
from lidar.options.look import PlotOptions

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Chart

    from lidar.dataset.layout import DatasetLike

WIDE = (1180, 300)
"""Pixels of a panel of the width of a page."""


@dataclass(frozen=True, slots=True)
class Drawn:
    """A figure, with a note and its numbers.

    note    : its figures in one line
    numbers : the same by name
    """

    chart: Chart
    note: str
    numbers: dict[str, Any]


@dataclass(frozen=True, slots=True)
class Figure:
    """A row of `FIGURES`.

    name     : by which users choose it
    function : ``module:function`` in this folder; called with a dataset, options and ``progress``
    meaning  : what is drawn, one line
    takes    : options of `PlotOptions` that it uses
    """

    name: str
    function: str
    meaning: str
    takes: tuple[str, ...]


_FIGURES = (
    Figure(
        "range-image",
        "sweeps:range_image",
        "range, intensity and class of a sweep by azimuth and ring",
        ("sensor", "frames"),
    ),
    Figure("intensity", "sweeps:intensity", "histogram of intensities by class", ("sensor", "frames")),
    Figure("returns", "sweeps:returns", "returns by range, class and origin", ("sensor", "frames")),
    Figure("speed", "over_time:speed", "speed and acceleration of the vehicle over time", ()),
    Figure(
        "coverage",
        "coverage:coverage",
        "returns per square metre on a plan, with the path",
        ("sensor", "frames", "resolution"),
    ),
    Figure(
        "gnss",
        "over_time:gnss",
        "errors of a receiver east, north and up over time, with the stated standard deviation",
        ("sensor",),
    ),
)

FIGURES: Registry[Figure] = Registry("figure", {row.name: row for row in _FIGURES}, error=InputError)
"""The figures of a dataset by name."""


@shows_progress
def plot(
    dataset: DatasetLike,
    what: str,
    *,
    out: str | Path,
    options: PlotOptions = PlotOptions(),
    overwrite: bool = False,
    progress: Progress = displayed,
) -> Drawn:
    """Write a figure of a dataset as PNG or SVG, by the suffix of ``out``.

    what : name in `FIGURES`

    Raises InputError for an unknown figure and options that it does not take, and DatasetError for a dataset
    that lacks what it shows.
    """
    from lidar.dataset.layout import open_dataset  # noqa: PLC0415 - of no use to who lists figures

    dataset = open_dataset(dataset)
    row, out = FIGURES.find(what), Path(out)
    for name in ("sensor", "frames", "resolution"):
        if name not in row.takes and getattr(options, name) != getattr(PlotOptions(), name):
            raise InputError(f"`{name}`: {what} does not take it; leave it out")
    check_out(out, overwrite=overwrite)
    from geoscene.drawing.charts import encode  # noqa: PLC0415  (0.1 s)

    drawn: Drawn = load(f"lidar.tools.plots.{row.function}")(dataset, options, progress=progress)
    write_atomically(out, encode(drawn.chart, out.suffix.lower()))
    return drawn


def check_out(out: Path, *, overwrite: bool) -> None:
    """Raise InputError for a name that is not of a PNG or SVG, or that is taken.

    Raises MissingExtraError without matplotlib.
    """
    if out.suffix.lower() not in (".png", ".svg"):
        raise InputError(f"`out` {out}: plots are PNG or SVG; give a name that ends with .png or .svg")
    if out.exists() and not overwrite:
        raise InputError(f"{out}: exists already; set `overwrite` to replace it")
    need("matplotlib", "plots")
