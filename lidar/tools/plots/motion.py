"""The speed profile of a drive."""

from __future__ import annotations

import numpy as np

from geoscene.drawing.charts import COLORS, Axes
from geoscene.drawing.panels import Panel, Series, figure
from geoscene.support.progress import Progress
from lidar.dataset.layout import Dataset
from lidar.options import PlotOptions
from lidar.tools.plots.drawn import WIDE, Drawn, plain, thin

_SMOOTHED_S = 0.1
"""Seconds over which accelerations are differences."""


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
    ends = (float(seconds[0]), float(seconds[-1]))
    most = f"{fast.max():.1f} m/s ({3.6 * fast.max():.0f} km/h)"
    about = f"{length:,.0f} m in {ends[1] - ends[0]:,.1f} s, at most {most}"
    parts = [
        Panel(
            Axes(f"Speed: {about}", "time since the start, s", "m/s", plain),
            [Series("speed", thin(seconds, fast), color=COLORS[1])],
            x_log=False,
            y_log=False,
            x_ends=ends,
        ),
        Panel(
            Axes("Acceleration of the vehicle's reference point", "time since the start, s", "m/s^2", plain),
            [Series("forward", thin(seconds, along)), Series("to the left", thin(seconds, across))],
            x_log=False,
            y_log=False,
            x_ends=ends,
        ),
    ]
    numbers = {"length_m": length, "duration_s": ends[1] - ends[0], "maximum_speed_m_s": float(fast.max())}
    numbers |= {"mean_speed_m_s": length / (ends[1] - ends[0])}
    numbers |= {"maximum_forward_m_s2": float(np.abs(along).max())}
    numbers |= {"maximum_sideways_m_s2": float(np.abs(across).max())}
    return Drawn(figure(parts, columns=1, size=WIDE), about, numbers)
