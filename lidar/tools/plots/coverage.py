"""Density of returns on a plan."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import Class
from geoscene.drawing.charts import Axes, Raster, Scale, Series, figure
from geoscene.support.progress import Progress
from geoscene.typing import Float, Ints
from lidar.dataset.formats.table import placed_returns
from lidar.dataset.layout import Dataset
from lidar.dataset.recorded import cloud_points, frames_within, scanner_clouds
from lidar.errors import DatasetError, InputError
from lidar.geometry.poses import Trajectory
from lidar.options.look import PlotOptions
from lidar.tools.plots import Drawn

Counts = NDArray[np.unsignedinteger[Any]]

_SIDES = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)
"""Sides of cells in metres, of which those that fit the picture are chosen."""

_FINEST = (0.1, 0.5, 1.0, 5.0, 10.0, 50.0)
"""Sides in which returns are counted at first: all larger ones of `_SIDES` are multiples."""

_ACROSS = 500
"""Cells across a picture, at most, unless their side is given."""

_BEYOND = 50.0
"""Metres beyond a scanner's range at which returns can be: it is not on the path, and ranges have noise."""

_MOST = 1 << 26
"""Cells that are counted, at most."""


def coverage(dataset: Dataset, options: PlotOptions, *, progress: Progress) -> Drawn:
    """Returns per square metre, from above, of one scanner or all; false returns are left out.

    Raises InputError for cells that are too small, and DatasetError for a drive without returns.
    """
    lidars = dataset.sensors("lidar")
    names = [options.sensor] if options.sensor or not lidars else list(lidars)
    streams = [frames_within(scanner_clouds(dataset, name), options.limits) for name in names]
    trajectory = dataset.trajectory()
    reach = _BEYOND + max(float(s.sensor.get("max_range", 100.0)) for s in streams)
    low = trajectory.position[:, :2].min(axis=0) - reach
    high = trajectory.position[:, :2].max(axis=0) + reach
    side = options.resolution or next(
        (s for s in _FINEST if np.prod(np.ceil((high - low) / s) + 1) <= _MOST), _FINEST[-1]
    )
    first = np.floor(low / side)
    wide, tall = (np.ceil(high / side) - first).astype(np.int64).tolist()
    if wide * tall > _MOST:
        raise InputError(f"`resolution` {side:g}: {wide} by {tall} cells are too many; give a coarser one")
    counts = np.zeros(wide * tall, np.uint32)
    total = sum(len(s.files) for s in streams)
    done = 0
    for clouds in streams:
        for path, start in zip(clouds.files, clouds.time_ns.tolist(), strict=True):
            progress("reading clouds", done, total=total)
            done += 1
            table = cloud_points(dataset.frame_file(path))
            matrix = clouds.mount.matrix
            placed, _ = placed_returns(table, trajectory, start_ns=start, vehicle_from_sensor=matrix)
            cell = np.floor(placed[table["label"] != Class.NOISE, :2] / side) - first
            x, y = np.clip(cell, 0, (wide - 1, tall - 1)).astype(np.int64).T
            np.add.at(counts, y * wide + x, np.uint32(1))
    if not counts.any():
        raise DatasetError(f"{dataset.path}: no returns in these frames of {', '.join(names)}")
    grid, first = _crop(counts.reshape(tall, wide), first.astype(np.int64), track=trajectory.position / side)
    if options.resolution is None:
        wanted = next((s for s in _SIDES if s >= side and max(grid.shape) * side / s <= _ACROSS), _SIDES[-1])
        grid, first = _coarser(grid, first, factor=round(wanted / side))
        side = wanted
    return _drawn(grid, corner=first.astype(float) * side, side=side, trajectory=trajectory, names=names)


def _crop(grid: Counts, first: Ints, *, track: Float) -> tuple[Counts, Ints]:
    """The part of counts (h, w) that holds all of them and a track (n, 2 or more), and its first cell (x, y).

    first : cell (2,) of the grid's first column and row
    track : in cells
    """
    rows, columns = (np.flatnonzero(grid.any(axis=axis)) for axis in (1, 0))
    path = np.floor(track[:, :2]).astype(np.int64) - first
    low = np.minimum([columns[0], rows[0]], path.min(axis=0))
    high = np.maximum([columns[-1], rows[-1]], path.max(axis=0))
    return grid[low[1] : high[1] + 1, low[0] : high[0] + 1], first + low


def _coarser(grid: Counts, first: Ints, *, factor: int) -> tuple[Counts, Ints]:
    """Counts in cells that are larger by a whole factor, whose borders are multiples of their side."""
    before = first % factor
    after = -(before + grid.shape[::-1]) % factor
    whole = np.pad(grid, ((before[1], after[1]), (before[0], after[0])))
    rows, columns = (n // factor for n in whole.shape)
    return whole.reshape(rows, factor, columns, factor).sum(axis=(1, 3)), (first - before) // factor


def _drawn(grid: Counts, *, corner: Float, side: float, trajectory: Trajectory, names: list[str]) -> Drawn:
    """The figure of counts (h, w) from the south; ``corner`` is their south-west one, scene metres."""
    scale = float(trajectory.scale.mean())
    density = grid / (side / scale) ** 2
    seen = density > 0
    low = float(density[seen].min())
    by_density = Scale(
        "returns per m^2", low, max(float(np.percentile(density[seen], 99.5)), 2 * low), log=True
    )
    (west, south), (east, north) = corner, corner + side * np.array(grid.shape[::-1])
    area = float(seen.sum() * (side / scale) ** 2)
    about = f"{', '.join(names)}: {int(grid.sum()):,} returns on {area:,.0f} m^2"
    axes = Axes(
        f"Coverage by {about}, cells of {side:g} m",
        "x, m (grid east, scene frame)",
        "y, m (grid north, scene frame)",
    )
    raster = Raster(
        axes,
        np.where(seen, density, np.nan)[::-1],
        (float(west), float(east)),
        (float(south), float(north)),
        scale=by_density,
        square=True,
        lines=[Series("path of the vehicle", *trajectory.position[:, :2].T, color="#c8281e")],
    )
    wide, tall = float(east - west), float(north - south)
    width = min(820, round(820 * wide / tall)) if tall > wide else 820
    size = (308 + width, 122 + max(round(width * tall / wide), 220))
    median = float(np.median(density[seen]))
    numbers = {"sensors": names, "returns": int(grid.sum()), "area_m2": area, "cell_m": side}
    numbers |= {"median_per_m2": median, "bounds_m": [float(v) for v in (west, south, east, north)]}
    note = f"{about} (cells of {side:g} m), median {median:.3g} per m^2"
    return Drawn(figure([raster], size=size), note, numbers)
