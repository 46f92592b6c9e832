"""Density of returns on a plan."""

from __future__ import annotations

import numpy as np

from geoscene.axes import Axis
from geoscene.charts import Axes
from geoscene.classes import Class
from geoscene.panels import Raster, Scale, Series, figure
from geoscene.progress import Progress
from geoscene.typing import Float
from lidar.dataset.formats.table import placed_returns
from lidar.dataset.layout import Dataset
from lidar.dataset.recorded import cloud_points, frames_within, scanner_clouds
from lidar.errors import DatasetError, InputError
from lidar.geometry.poses import Trajectory
from lidar.maps.colors import ramp
from lidar.options import PlotOptions
from lidar.plots.drawn import Drawn, plain, thinned

_SIDES = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)
_ACROSS = 800
"""Cells across a picture, at most, unless their side is given."""

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
    reach = max(float(s.sensor.get("max_range", 100.0)) for s in streams)
    low = trajectory.position[:, :2].min(axis=0) - reach
    high = trajectory.position[:, :2].max(axis=0) + reach
    side = options.resolution or next((s for s in _SIDES if (high - low).max() / s <= 2 * _ACROSS), 200.0)
    first = np.floor(low / side)
    wide, tall = (np.ceil(high / side) - first).astype(np.int64).tolist()
    if wide * tall > _MOST:
        raise InputError(f"`resolution` {side:g}: {wide} by {tall} cells are too many; give a coarser one")
    counts = np.zeros(wide * tall, np.int64)
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
            inside = ((cell >= 0) & (cell < (wide, tall))).all(axis=1)
            x, y = cell[inside].astype(np.int64).T
            counts += np.bincount(y * wide + x, minlength=wide * tall)
    grid = counts.reshape(tall, wide)
    if not grid.any():
        raise DatasetError(f"{dataset.path}: no returns in these frames of {', '.join(names)}")
    scale = float(trajectory.scale.mean())
    return _drawn(grid, corner=first * side, side=side, scale=scale, trajectory=trajectory, names=names)


def _drawn(
    grid: np.ndarray, *, corner: Float, side: float, scale: float, trajectory: Trajectory, names: list[str]
) -> Drawn:
    """The figure of counts (h, w) from the south; ``corner`` is their south-west one, scene metres."""
    rows, columns = (np.flatnonzero(grid.any(axis=axis)) for axis in (1, 0))
    path = trajectory.position[:, :2]
    track = np.floor((path - corner) / side).astype(np.int64)
    first = np.minimum([columns[0], rows[0]], track.min(axis=0))
    last = np.maximum([columns[-1], rows[-1]], track.max(axis=0))
    part = grid[first[1] : last[1] + 1, first[0] : last[0] + 1]
    density = part / (side / scale) ** 2
    seen = density > 0
    axis = Axis(
        float(density[seen].min()),
        max(float(np.percentile(density[seen], 99.5)), 2 * float(density[seen].min())),
        log=True,
    )
    by_density = Scale(
        "returns per m^2", axis, lambda v: ramp(np.log(v), np.log(axis.low), high=np.log(axis.high))
    )
    pixels = np.full((*density.shape, 3), 255, np.uint8)
    pixels[seen] = by_density.colors(density[seen])
    (west, south), (east, north) = corner + first * side, corner + (last + 1) * side
    area = float(seen.sum() * (side / scale) ** 2)
    about = f"{', '.join(names)}: {int(part.sum()):,} returns on {area:,.0f} m^2"
    axes = Axes(
        f"Coverage by {about}, cells of {side:g} m",
        "x, m (grid east, scene frame)",
        "y, m (grid north, scene frame)",
        plain,
    )
    raster = Raster(
        axes,
        pixels[::-1],
        (float(west), float(east)),
        (float(south), float(north)),
        scale=by_density,
        square=True,
        lines=[Series("path of the vehicle", thinned(*path.T), color=(200, 40, 30))],
    )
    wide, tall = float(east - west), float(north - south)
    width = min(820, round(820 * wide / tall)) if tall > wide else 820
    size = (308 + width, 122 + round(width * tall / wide))
    median = float(np.median(density[seen]))
    numbers = {"sensors": names, "returns": int(part.sum()), "area_m2": area, "cell_m": side}
    numbers |= {"median_per_m2": median, "bounds_m": [float(v) for v in (west, south, east, north)]}
    note = f"{about} (cells of {side:g} m), median {median:.3g} per m^2"
    return Drawn(figure([raster], size=size), note, numbers)
