"""Trees in a point cloud: peaks of the canopy outside buildings, and the crowns around them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geoscene.clouds.ground import CloudGrid
from geoscene.support.columns import Columns
from geoscene.typing import Bools, Float, Ints

CELL = 0.5
"""Metres of the canopy's cells."""

MARGIN = 12.0
"""Metres around a square that crowns on its rim need."""

_LOWEST = 2.5  # metres of a tree; lower things are cars, walls and hedges
_SHARE = 0.4  # of a peak's height down to which the canopy around it is its crown
_SMALLEST, _WIDEST = 3.0, 24.0  # square metres of a crown; metres of its diameter
_ROUGHER, _ROUGH = 1.4, 0.02  # how much rougher than the ground, and metres more, crowns are than roofs
_PLANE, _PLANE_POINTS = 2.5, 6  # metres of the planes by which roughness is told, and points for one
_NEAR_GROUND = 0.3  # metres
_SLENDER = 0.12  # crown diameter over height, at least: lamps, masts and cranes have less


@dataclass(frozen=True, slots=True)
class DetectedTrees(Columns):
    """Trees found in a cloud.

    xy     : (n, 2) scene metres, the centre of the crown
    height : (n,) metres from the ground to the highest return
    crown  : (n,) metres, diameter of a circle with the crown's area
    """

    xy: Float
    height: Float
    crown: Float


def find_trees(xyz: Float, above: Float, *, grid: CloudGrid, excluded: Bools) -> DetectedTrees:
    """Trees whose crowns have their peaks in a grid.

    The canopy is the highest point of each cell, smoothed; its peaks within a distance that grows with the
    height are trees (Popescu and Wynne 2004), and cells go to the peak that a walk uphill leads to. Crowns
    that are small, slender or flat as a roof are left out.

    xyz      : (n, 3) points, ground and noise too
    above    : (n,) metres above the ground
    excluded : (rows, columns) cells where no tree is sought: buildings, bridges
    """
    from scipy.ndimage import gaussian_filter  # noqa: PLC0415 - slow to import

    cell = grid.cells(xyz[:, :2])
    free = ~excluded.ravel()[cell]
    top = np.zeros(grid.rows * grid.columns)
    np.maximum.at(top, cell[free], above[free])
    top = top.reshape(grid.shape)
    smooth = gaussian_filter(_close(top), 0.6 / grid.cell)
    peaks, crown = _crowns(smooth, top, cell=grid.cell)
    if not len(peaks):
        return DetectedTrees(np.empty((0, 2)), np.empty(0), np.empty(0))
    label = crown.ravel()
    count = np.bincount(label[label >= 0], minlength=len(peaks))
    height = np.zeros(len(peaks))
    np.maximum.at(height, label[label >= 0], top.ravel()[label >= 0])
    east, north = grid.centres()
    with np.errstate(invalid="ignore"):
        centre = (
            np.column_stack(
                [
                    np.bincount(label[label >= 0], some.ravel()[label >= 0], len(peaks))
                    for some in (east, north)
                ]
            )
            / count[:, None]
        )
    diameter = 2 * np.sqrt(count * grid.cell**2 / np.pi)
    member = np.where(free, label[cell], -1)
    member[member >= 0] = np.where(above > 0.4 * height[member], member, -1)[member >= 0]
    noise = float(_roughness(xyz, np.where(np.abs(above) < _NEAR_GROUND, 0, -1), count=1)[0])
    rough = _roughness(xyz, member, count=len(peaks))
    keep = (count * grid.cell**2 >= _SMALLEST) & (diameter <= _WIDEST) & (height >= _LOWEST)
    keep &= (rough > _ROUGHER * noise + _ROUGH) & (diameter > _SLENDER * height)
    return DetectedTrees(centre[keep], height[keep], diameter[keep])


def _close(top: Float) -> Float:
    """The canopy with single cells that no point has hit taken from around."""
    from scipy.ndimage import grey_closing  # noqa: PLC0415 - slow to import

    return np.asarray(grey_closing(top, size=(3, 3)), float)


def _crowns(smooth: Float, top: Float, *, cell: float) -> tuple[Float, Ints]:
    """Cells (m, 2) of peaks, and the peak (rows, columns) whose crown a cell is in, -1 for none."""
    from scipy.ndimage import maximum_filter  # noqa: PLC0415 - slow to import

    rows, columns = smooth.shape
    number = np.arange(smooth.size).reshape(smooth.shape)
    # uphill: each cell points to the highest of the nine around it, ties to the first
    padded = np.pad(smooth, 1, constant_values=-np.inf)
    index = np.pad(number, 1, constant_values=-1)
    steps = [(r, c) for r in (1, 0, 2) for c in (1, 0, 2)]
    around = np.stack([padded[r : r + rows, c : c + columns] for r, c in steps])
    target = np.stack([index[r : r + rows, c : c + columns] for r, c in steps])
    up = np.take_along_axis(target, np.argmax(around, axis=0)[None], axis=0)[0].ravel()
    for _ in range(int(np.ceil(np.log2(rows + columns))) + 1):
        up = up[up]
    # minor peaks near a higher one belong to it
    reach = round(1.5 / cell)
    local = maximum_filter(smooth, size=2 * reach + 1)
    summit = np.unique(up)
    summit = summit[smooth.ravel()[summit] >= _LOWEST]
    main = np.full(smooth.size, -1)
    is_main = smooth.ravel()[summit] >= local.ravel()[summit] - 1e-9
    peaks = summit[is_main]
    main[peaks] = np.arange(len(peaks))
    if len(peaks) and (~is_main).any():
        from scipy.spatial import cKDTree  # noqa: PLC0415

        place = np.column_stack(np.divmod(peaks, columns))
        minor = summit[~is_main]
        main[minor] = cKDTree(place).query(np.column_stack(np.divmod(minor, columns)))[1]
    crown = main[up]
    low = smooth.ravel() < np.maximum(_SHARE * np.append(smooth.ravel()[peaks], np.inf)[crown], 1.5)
    crown[low | (top.ravel() <= 0)] = -1
    return np.column_stack(np.divmod(peaks, columns)).astype(float), crown.reshape(smooth.shape)


def _roughness(xyz: Float, group: Ints, *, count: int) -> Float:
    """Metres (count,), the typical standard deviation of a group's points about planes of 2.5 m; 0 without.

    Roofs of any shape are planes at this scale, but for a few cells at ridges; crowns are not.

    group : (n,) of each point, -1 for none
    """
    rows = np.flatnonzero(group >= 0)
    place = np.floor(xyz[rows, :2] / _PLANE).astype(np.int64)
    cells, owner, size = np.unique(
        np.column_stack([group[rows], place]), axis=0, return_inverse=True, return_counts=True
    )
    owner = owner.ravel()
    mean = np.column_stack([np.bincount(owner, xyz[rows, k]) for k in range(3)]) / size[:, None]
    x, y, z = (xyz[rows] - mean[owner]).T
    xx, xy, yy, xz, yz, zz = (
        np.bincount(owner, product) / size for product in (x * x, x * y, y * y, x * z, y * z, z * z)
    )
    flat = xx * yy - xy**2
    with np.errstate(divide="ignore", invalid="ignore"):
        explained = (yy * xz**2 - 2 * xy * xz * yz + xx * yz**2) / flat
    fitted = (size >= _PLANE_POINTS) & (flat > 1e-3)
    spread = np.sqrt(np.maximum(zz - explained, 0.0))[fitted]
    owners = cells[fitted, 0]
    order = np.lexsort((spread, owners))
    first, many = np.unique(owners[order], return_index=True, return_counts=True)[1:]
    out = np.zeros(count)
    out[owners[order][first]] = spread[order][first + many // 2]
    return out
