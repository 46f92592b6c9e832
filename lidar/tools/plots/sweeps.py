"""Figures of a scanner's sweeps: range image, intensities and returns by range."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import Class, class_codes
from geoscene.drawing.charts import COLORS, Axes, Panel, Raster, Scale, Series, figure
from geoscene.support.progress import Progress
from geoscene.typing import Float, Ints
from lidar.dataset.formats.table import Table
from lidar.dataset.ground_truth import read_truth
from lidar.dataset.layout import Dataset
from lidar.dataset.recorded import Stream, cloud_points, frames_within, scanner_clouds
from lidar.errors import DatasetError
from lidar.geometry.attitude import Mount
from lidar.options.look import PlotOptions
from lidar.sensors.physics.origin import Origin
from lidar.tools.plots import WIDE, Drawn

_WIDTH = 872
"""Pixels across a range image: those of its panel."""

_ROWS = 64
"""Rows of a range image of a scanner without rings of constant elevation."""

_LEVEL = 0.05
"""Largest spread of a ring's elevations for rows that are rings, as a share of the field of view.

Lasers beside each other see elevations that vary with the range, those of an HDL-64E by up to 0.4 degrees.
"""

_UPRIGHT = 0.7
"""Cosine of the tilt of a scanner up to which its azimuths are about those of the vehicle."""

_DOWN_DEG = -50.0
"""Median elevation of the returns of scanners that look down, below which azimuths say little."""

_FLAT_DEG = 1.0
"""Range of elevations of scanners with one level."""

_LEGEND = 10
"""Classes that a figure names, at most; the others are together."""

_EMPTY = np.array((246, 246, 248), np.uint8)
"""Colour of directions without a return."""

_INTENSITIES = np.arange(0.0, 257.0, 2.0)
_RANGES = (0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0)
"""Widths of bins of ranges in metres, all multiples of the first, in which returns are counted."""

_BINS = 120
"""Bins of ranges, at most."""


def range_image(dataset: Dataset, options: PlotOptions, *, progress: Progress) -> Drawn:
    """Range, intensity and class of one sweep from the scanner: forward in the middle, left on the left.

    Of the returns in a cell the nearest is shown. Rows are rings if each has about one elevation, else
    elevations; of scanners that look down, times, and columns angles across.

    Raises DatasetError for a sweep without returns.
    """
    clouds = frames_within(scanner_clouds(dataset, options.sensor), options.limits)
    frame, path = int(clouds.frames[0]), dataset.frame_file(clouds.files[0])
    progress("reading clouds", 0, total=1)
    table = cloud_points(path)
    if not len(table["x"]):
        raise DatasetError(f"{path}: has no returns; choose another frame by `frames`")
    angle, across, rows = _image_sides(table, clouds.mount)
    distance, row, count = _directions(table)[2], rows.row, int(rows.row.max()) + 1
    low, high = math.floor(angle.min()), max(math.ceil(angle.max()), math.floor(angle.min()) + 1)
    column = np.clip(((high - angle) / (high - low) * _WIDTH).astype(np.int64), 0, _WIDTH - 1)
    first = np.full((count, _WIDTH), -1)
    for_each = np.lexsort([-distance])  # the nearest is written last
    first[count - 1 - row[for_each], column[for_each]] = for_each
    farthest = max(float(np.percentile(distance, 99)), 1.0)
    nearest = float(distance.min())
    ranges = Scale("range, m", max(nearest, 0.5), max(farthest, 1.1 * nearest), log=True, turned=True)
    codes, counts = np.unique(table["label"], return_counts=True)
    ranked = codes[np.argsort(-counts, kind="stable")][:_LEGEND].tolist()
    colors = class_codes().color
    legend = [(_class_name(c), "#" + bytes(colors[c]).hex()) for c in ranked]
    about = f"{clouds.name} ({clouds.sensor.get('model', 'scanner')}), frame {frame}"
    sides: dict[str, Any] = {"x": (high, low), "y": rows.ends}
    parts = [
        Raster(Axes(title, across, rows.title), np.append(values, np.nan)[first], scale=scale, **sides)
        for title, values, scale in (
            (f"Range image of {about}: {len(distance):,} returns", distance, ranges),
            (
                "Intensity (diffuse reflectivity in per cent up to 100)",
                table["intensity"],
                Scale("intensity", 0, 100),
            ),
        )
    ]
    classes = np.concatenate([colors[table["label"]], [_EMPTY]])[first]
    parts.append(Raster(Axes("Class", across, rows.title), classes, legend=legend, **sides))
    filled = float((first >= 0).mean())
    numbers = {"sensor": clouds.name, "frame": frame, "returns": len(distance), "rows": count}
    note = f"{about}: {len(distance):,} returns, {100 * filled:.0f} % of {count} x {_WIDTH} cells"
    return Drawn(figure(parts, size=(WIDE[0], 340)), note, numbers | {"filled": filled})


def _directions(table: Table) -> tuple[Float, Float, Float]:
    """Azimuth and elevation (n,) in degrees, and distance in metres, of returns."""
    x, y, z = (table[axis].astype(float) for axis in "xyz")
    flat = np.hypot(x, y)
    return np.degrees(np.arctan2(y, x)), np.degrees(np.arctan2(z, flat)), np.hypot(flat, z)


def _from_forward(azimuth: Float, mount: Mount) -> tuple[Float, str]:
    """Azimuths (n,) from the vehicle's forward direction; of a tilted scanner from its x axis."""
    axes = mount.rotation
    if axes[2, 2] < _UPRIGHT:
        return azimuth, "the scanner's x axis"
    turned = azimuth + np.degrees(np.arctan2(axes[1, 0], axes[0, 0]))
    return (turned + 180) % 360 - 180, "the vehicle's forward"


@dataclass(frozen=True, slots=True)
class _Rows:
    """Row (n,) of each return from below, the values at the lower and upper border, and what they are."""

    row: Ints
    ends: tuple[float, float]
    title: str


def _image_sides(table: Table, mount: Mount) -> tuple[Float, str, _Rows]:
    """Angles (n,) of the columns of a range image in degrees, left positive, what they are, and its rows."""
    azimuth, elevation, _ = _directions(table)
    if np.median(elevation) < _DOWN_DEG:
        angle = np.degrees(np.arctan2(table["y"].astype(float), -table["z"].astype(float)))
        rows = _even_rows(table["time_ns"] / 1e6, "time in the sweep, ms")
        return angle, "angle across the scanner's x axis, deg (0: down; left positive)", rows
    azimuth, zero = _from_forward(azimuth, mount)
    rows = _image_rows(table["ring"].astype(np.int64), elevation)
    return azimuth, f"azimuth, deg (0: {zero}; left positive)", rows


def _image_rows(ring: Ints, elevation: Float) -> _Rows:
    """Rings as rows if each has about one elevation, else elevations."""
    rings = int(ring.max()) + 1
    returns = np.maximum(np.bincount(ring, minlength=rings), 1)
    mean = np.bincount(ring, elevation, rings) / returns
    spread = np.sqrt(np.maximum(np.bincount(ring, elevation**2, rings) / returns - mean**2, 0))
    flat = np.ptp(elevation) < _FLAT_DEG
    if flat or (rings >= 4 and spread.max() < _LEVEL * np.ptp(elevation)):
        return _Rows(ring, (-0.5, rings - 0.5), "ring")
    return _even_rows(elevation, "elevation, deg")


def _even_rows(value: Float, title: str) -> _Rows:
    """Values (n,) in 64 rows."""
    low, high = float(value.min()), max(float(value.max()), float(value.min()) + 1e-3)
    row = np.clip(((value - low) / (high - low) * _ROWS).astype(np.int64), 0, _ROWS - 1)
    return _Rows(row, (low, high), title)


def intensity(dataset: Dataset, options: PlotOptions, *, progress: Progress) -> Drawn:
    """Histogram of the intensities of each class, returns per sweep and unit of intensity."""
    clouds = frames_within(scanner_clouds(dataset, options.sensor), options.limits)
    counts = np.zeros((256, len(_INTENSITIES) - 1), np.int64)
    total = np.zeros(256)
    for table in _tables(dataset, clouds, progress=progress):
        value = np.clip(table["intensity"].astype(float), 0, 255)
        counts += _by_label(table["label"], value, edges=_INTENSITIES)
        total += np.bincount(table["label"], value, 256)
    per = len(clouds.frames) * (_INTENSITIES[1] - _INTENSITIES[0])
    series = _by_class(counts, edges=_INTENSITIES, per=per)
    points = counts.sum(axis=1)
    means = {_class_name(k): float(total[k] / points[k]) for k in _most_frequent(points, most=len(points))}
    about = f"{clouds.name}, {len(clouds.frames)} sweeps, {points.sum():,} returns"
    axes = Axes(
        f"Intensities of {about}",
        "intensity (0 to 100: diffuse reflectivity in per cent; above: retro-reflectors)",
        "returns per sweep and unit",
    )
    panel = Panel(axes, series, log=True)
    named = ", ".join(f"{name} {mean:.0f}" for name, mean in list(means.items())[:5])
    numbers = {"sensor": clouds.name, "sweeps": len(clouds.frames), "returns": int(points.sum())}
    numbers |= {"mean_intensity": means}
    return Drawn(figure([panel], size=(WIDE[0], 560)), f"{about}; mean intensities: {named}", numbers)


def returns(dataset: Dataset, options: PlotOptions, *, progress: Progress) -> Drawn:
    """Returns by range: of each class, and of each origin where stages acted."""
    clouds = frames_within(scanner_clouds(dataset, options.sensor), options.limits)
    edges: Float = np.arange(0.0, float(clouds.sensor.get("max_range", 100.0)) + 2 * _RANGES[-1], _RANGES[0])
    counts = np.zeros((256, len(edges) - 1), np.int64)
    origins = np.zeros((len(Origin), len(edges) - 1), np.int64)
    known = False
    for row, table in enumerate(_tables(dataset, clouds, progress=progress)):
        distance = np.clip(_directions(table)[2], 0, edges[-1] - 1e-9)
        counts += _by_label(table["label"], distance, edges=edges)
        path = dataset.frame_file(dataset.paths.truth(clouds.name, int(clouds.frames[row])))
        if (truth := read_truth(path, count=len(distance))) is not None:
            known = True
            origins += _by_label(truth["origin"], distance, edges=edges)[: len(Origin)]
    sweeps = len(clouds.frames)
    everything = counts.sum(axis=0)
    total = int(everything.sum())
    median = float(edges[np.searchsorted(np.cumsum(everything), total / 2)]) if total else math.nan
    farthest = float(edges[np.flatnonzero(everything).max(initial=0) + 1])
    step = next((s for s in _RANGES if farthest / s <= _BINS), _RANGES[-1])
    group = np.arange(
        0, math.ceil(farthest / step - 1e-9) * round(step / _RANGES[0]), round(step / _RANGES[0])
    )
    counts, origins = (np.add.reduceat(each, group, axis=1) for each in (counts, origins))
    edges = np.arange(len(group) + 1, dtype=np.float64) * step
    about = f"{clouds.name}, {sweeps} sweeps, {total / sweeps:,.0f} returns per sweep"

    def panel(title: str, series: list[Series]) -> Panel:
        return Panel(Axes(title, "range, m", f"returns per sweep in {step:g} m"), series, log=True)

    parts = [panel(f"Returns by range of {about}", _by_class(counts, edges=edges, per=sweeps))]
    if known:
        found = [Origin(k) for k in _most_frequent(origins.sum(axis=1), most=len(Origin))]
        series = [_histogram(o.name.lower(), edges=edges, counts=origins[o] / sweeps) for o in found]
        parts.append(panel("By origin", series))
    note = f"{about}, half of them nearer than {median:g} m"
    numbers = {"sensor": clouds.name, "sweeps": sweeps, "returns": total, "median_m": median, "bin_m": step}
    return Drawn(figure(parts, size=(WIDE[0], 500)), note, numbers)


def _tables(dataset: Dataset, clouds: Stream, *, progress: Progress) -> Iterator[Table]:
    for k, path in enumerate(clouds.files):
        progress("reading clouds", k, total=len(clouds.files))
        yield cloud_points(dataset.frame_file(path))


def _by_label(label: NDArray[np.integer], value: Float, *, edges: Float) -> Ints:
    """Counts (256, k) of values (n,) by label and bin; bins are equally wide and hold all of them."""
    cell = np.clip(((value - edges[0]) / (edges[1] - edges[0])).astype(np.int64), 0, len(edges) - 2)
    bins = len(edges) - 1
    return np.bincount(label.astype(np.int64) * bins + cell, minlength=256 * bins).reshape(256, bins)


def _by_class(counts: Ints, *, edges: Float, per: float) -> list[Series]:
    """Histograms of all returns and of the most frequent classes, divided by ``per``."""
    named = _most_frequent(counts.sum(axis=1), most=_LEGEND)
    series = [_histogram("all", edges=edges, counts=counts.sum(axis=0) / per, color="#aaacb2")]
    series += [
        _histogram(_class_name(k), edges=edges, counts=counts[k] / per, color=COLORS[rank])
        for rank, k in enumerate(named)
    ]
    rest = np.delete(counts, named, axis=0).sum(axis=0)
    return (
        [*series, _histogram("other", edges=edges, counts=rest / per, color="#141414")]
        if rest.any()
        else series
    )


def _class_name(code: int) -> str:
    """The name of a class in words."""
    return Class(code).name.lower().replace("_", " ")


def _histogram(name: str, *, edges: Float, counts: Float, color: str | None = None) -> Series:
    """The outline of a histogram."""
    return Series(name, np.repeat(edges, 2)[1:-1], np.repeat(counts, 2), color=color)


def _most_frequent(counts: Ints, *, most: int) -> list[int]:
    """Rows of ``counts`` (n,) that are not 0, the largest first, at most ``most``."""
    ranked = np.argsort(-counts, kind="stable")
    return [int(k) for k in ranked[:most] if counts[k] > 0]
