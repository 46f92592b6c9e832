"""Figures over time: the speed profile of a drive, and errors of its receivers against the truth."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geoscene.drawing.charts import COLORS, Axes, Panel, Series, ShadedBand, figure
from geoscene.geometry.frames import Frame
from geoscene.support.progress import Progress
from geoscene.typing import Float
from lidar.dataset.layout import Dataset
from lidar.dataset.navigation_files import read_fixes
from lidar.errors import DatasetError, InputError
from lidar.options.look import PlotOptions
from lidar.sensors.navigation.measurements import Fixes, fix_variances
from lidar.tools.plots import WIDE, Drawn

_TIME = "time since the start, s"
_SMOOTHED_S = 0.1
"""Seconds over which accelerations are differences."""

_DIRECTIONS = ("east", "north", "up")


def speed(dataset: Dataset, options: PlotOptions, *, progress: Progress) -> Drawn:  # noqa: ARG001
    """Speed of the ego vehicle, and its acceleration along and across the direction of motion."""
    trajectory = dataset.trajectory()
    seconds = trajectory.time_ns * 1e-9
    fast = np.linalg.norm(trajectory.velocity, axis=1)
    step = max(round(_SMOOTHED_S / max(float(np.median(np.diff(seconds))), 1e-9)), 1)
    before, after = np.maximum(np.arange(len(seconds)) - step, 0), np.arange(len(seconds)) + step
    after = np.minimum(after, len(seconds) - 1)
    change = (trajectory.velocity[after] - trajectory.velocity[before]) / (seconds[after] - seconds[before])[
        :, None
    ]
    forward = trajectory.at(trajectory.time_ns).rotation[:, :, 0]
    left = np.column_stack([-forward[:, 1], forward[:, 0]])
    left /= np.maximum(np.linalg.norm(left, axis=1), 1e-12)[:, None]
    along, across = (change * forward).sum(axis=1), (change[:, :2] * left).sum(axis=1)
    length = float(np.sum((fast[1:] + fast[:-1]) / 2 * np.diff(seconds)))
    duration = float(seconds[-1] - seconds[0])
    most = f"{fast.max():.1f} m/s ({3.6 * fast.max():.0f} km/h)"
    about = f"{length:,.0f} m in {duration:,.1f} s, at most {most}"
    parts = [
        Panel(Axes(f"Speed: {about}", _TIME, "m/s"), [Series("speed", seconds, fast, color=COLORS[1])]),
        Panel(
            Axes("Acceleration of the vehicle's reference point", _TIME, "m/s^2"),
            [Series("forward", seconds, along), Series("to the left", seconds, across)],
        ),
    ]
    numbers = {"length_m": length, "duration_s": duration, "maximum_speed_m_s": float(fast.max())}
    numbers |= {"mean_speed_m_s": length / (duration)}
    numbers |= {"maximum_forward_m_s2": float(np.abs(along).max())}
    numbers |= {"maximum_sideways_m_s2": float(np.abs(across).max())}
    return Drawn(figure(parts, size=WIDE), about, numbers)


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
    parts = []
    for k, direction in enumerate(_DIRECTIONS):
        title = f"Errors of {name}: {known.sum():,} of {len(fixes):,} epochs with a fix" if k == 0 else ""
        band = ShadedBand("± 1 sigma, as stated", seconds, -sigma[:, k], sigma[:, k])
        line = Series(f"error {direction}", seconds, error[:, k], color=COLORS[k])
        parts.append(Panel(Axes(title, _TIME, f"{direction}, m"), [line], bands=[band]))
    used = Series("satellites used", seconds, fixes.satellites, color=COLORS[5])
    parts.append(Panel(Axes("", _TIME, "satellites"), [used]))
    numbers: dict[str, object] = {"receiver": name, "epochs": len(fixes), "fixes": int(known.sum())}
    words = []
    for k, direction in enumerate(_DIRECTIONS if known.any() else ()):
        rms, stated = (float(np.sqrt(np.mean(v[known, k] ** 2))) for v in (error, sigma))
        inside = float(np.mean(np.abs(error[known, k]) <= sigma[known, k]))
        numbers |= {f"rms_{direction}_m": rms, f"sigma_{direction}_m": stated, f"inside_{direction}": inside}
        words.append(f"{direction} {rms:.3g} m (stated {stated:.3g})")
    note = f"{name}: {known.sum():,} fixes, rms errors {', '.join(words)}" if words else f"{name}: no fix"
    return Drawn(figure(parts, size=(WIDE[0], 260)), note, numbers)


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
