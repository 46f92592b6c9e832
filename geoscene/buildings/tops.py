"""Tops that were measured in a point cloud: heights above the base that buildings are given on the ground."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from geoscene.buildings.heights import HIGHEST, THINNEST
from geoscene.buildings.table import Buildings
from geoscene.typing import Float


def with_measured_tops(buildings: Buildings, base: Float) -> Buildings:
    """Buildings whose measured tops lie at their heights z, on the base that the graded ground gives them.

    A cloud tells how high a roof lies, not where the base does: grading moves the ground along the outline.
    Bodies that stand on others of the same building move with them, so that none overlap and no slit opens.

    base : (count,) z in metres of each building's base, NaN for buildings that are not looked at
    """
    stands = base[buildings.outline]
    measured = np.isfinite(buildings.top) & np.isfinite(stands)
    if not measured.any():
        return buildings
    moved = np.zeros(buildings.count)
    row = np.flatnonzero(measured)[::-1]  # of several parts the first decides; all have the same base
    moved[buildings.outline[row]] = buildings.top[row] - stands[row] - buildings.height[row]
    by = moved[buildings.outline]
    raised = buildings.min_height > 0
    low = buildings.min_height + np.where(raised, by, 0.0)
    high = buildings.height + np.where(raised | measured, by, 0.0)
    high = np.clip(high, low + THINNEST, HIGHEST)
    return replace(
        buildings, min_height=low, height=high, roof_height=np.minimum(buildings.roof_height, high - low)
    )
