"""Errors of satellite receivers against the truth."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geoscene.drawing.charts import COLORS, Axes
from geoscene.drawing.panels import Panel, Series, ShadedBand, figure
from geoscene.geometry.frames import Frame
from geoscene.support.progress import Progress
from geoscene.typing import Float
from lidar.dataset.layout import Dataset
from lidar.dataset.navigation_files import read_fixes
from lidar.errors import DatasetError, InputError
from lidar.options import PlotOptions
from lidar.sensors.navigation.measurements import Fixes, fix_variances
from lidar.tools.plots.drawn import WIDE, Drawn, plain, thin

_DIRECTIONS = ("east", "north", "up")


def gnss(dataset: Dataset, options: PlotOptions, *, progress: Progress) -> Drawn:  # noqa: ARG001
    """Errors of a receiver's positions, with plus and minus one stated standard deviation, and satellites.

    Raises InputError for an unknown receiver, and DatasetError for a dataset without receivers or fixes.
    """
    receivers = list(dataset.sensors("gnss"))
    if not receivers:
        raise DatasetError(f"{dataset.path}: no GNSS receiver in it; drive with a rig that has one")
    name = options.sensor or receivers[0]
    if name not in receivers:
        raise InputError(f"`sensor` {name}: no receiver in {dataset.path}; there are {', '.join(receivers)}")
    fixes, _ = read_fixes(dataset.paths, name, vertical=dataset.frame.vertical)
    if len(fixes) < 2:
        raise DatasetError(f"{dataset.paths.measurements(name)}: has {len(fixes)} epochs; a plot needs two")
    error = position_errors(dataset.frame, fixes)
    known: NDArray[np.bool_] = np.asarray(np.isfinite(error).all(axis=1))
    sigma = np.where(known[:, None], np.sqrt(fix_variances(fixes)), np.nan)
    seconds = fixes.time_ns * 1e-9
    ends = (float(seconds[0]), float(seconds[-1]))
    parts = []
    for k, direction in enumerate(_DIRECTIONS):
        band = list(zip(seconds.tolist(), (-sigma[:, k]).tolist(), sigma[:, k].tolist(), strict=True))
        title = f"Errors of {name}: {known.sum():,} of {len(fixes):,} epochs with a fix" if k == 0 else ""
        parts.append(
            Panel(
                Axes(title, "time since the start, s", f"{direction}, m", plain),
                [Series(f"error {direction}", thin(seconds, error[:, k]), color=COLORS[k])],
                x_log=False,
                y_log=False,
                bands=[ShadedBand("± 1 sigma, as stated", band)],
                x_ends=ends,
            )
        )
    used = Series("satellites used", thin(seconds, fixes.satellites.astype(float)), color=COLORS[5])
    axes = Axes("", "time since the start, s", "satellites", plain)
    parts.append(Panel(axes, [used], x_log=False, y_log=False, x_ends=ends))
    numbers: dict[str, object] = {"receiver": name, "epochs": len(fixes), "fixes": int(known.sum())}
    words = []
    for k, direction in enumerate(_DIRECTIONS if known.any() else ()):
        rms, stated = (float(np.sqrt(np.mean(v[known, k] ** 2))) for v in (error, sigma))
        inside = float(np.mean(np.abs(error[known, k]) <= sigma[known, k]))
        numbers |= {f"rms_{direction}_m": rms, f"sigma_{direction}_m": stated, f"inside_{direction}": inside}
        words.append(f"{direction} {rms:.3g} m (stated {stated:.3g})")
    note = f"{name}: {known.sum():,} fixes, rms errors {', '.join(words)}" if words else f"{name}: no fix"
    return Drawn(figure(parts, columns=1, size=(WIDE[0], 260)), note, numbers)


def position_errors(frame: Frame, fixes: Fixes) -> Float:
    """Measured minus true positions (n, 3), metres east, north and up; NaN without a fix."""
    measured, true = fixes.lonlath, fixes.true_lonlath
    known = np.isfinite(measured).all(axis=1)
    out = np.full((len(fixes), 3), np.nan)
    if not known.any():
        return out
    shift = np.subtract(*(np.column_stack(frame.from_geographic(*p[known, :2].T)) for p in (measured, true)))
    lon, lat = true[known, :2].T
    turn, scale = frame.convergence(lon, lat), frame.scale(lon, lat)
    (x, y), c, s = shift.T / scale, np.cos(turn), np.sin(turn)
    out[known] = np.column_stack([x * c + y * s, y * c - x * s, (measured - true)[known, 2]])
    return out
