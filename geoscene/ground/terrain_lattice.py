"""Triangles of ground on which nothing lies: as few as the terrain needs.

A tile is halved along diagonals again and again, down to a lattice about as fine as the terrain's lines (a
right-triangulated irregular network, Evans, Kirkpatrick and Townsend 2001). A vertex of the lattice is
left out, together with its descendants in the hierarchy, if without them the height of no vertex is off by
more than a tolerance. The descendants of a vertex on a tile's side lie within one square of it, so two
neighbouring tiles choose the same vertices on their common side, in whatever order they are built.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely

from geoscene.typing import Bools, Float, Height, Ints

_GRAIN = 2.0**-14
"""Metres to which heights are rounded before they are compared: more than calls of a function differ by."""


@dataclass(frozen=True, slots=True)
class TerrainHeights:
    """Heights that bare ground follows.

    height    : z of the terrain at x, y
    tolerance : maximum difference in metres from the heights of the lattice's vertices
    spacing   : metres between those vertices; up to a quarter more, as a square has a power of two of steps
    """

    height: Height
    tolerance: float
    spacing: float

    def steps(self, tile_size: float) -> int:
        """Steps of the lattice along a square, a power of two."""
        return int(2 ** np.ceil(np.log2(max(tile_size / self.spacing / 1.25, 1.0))))


@dataclass(frozen=True, slots=True)
class Lattice:
    """The vertices that a tile's ground may have.

    x, y : (n + 1,) float64, scene metres, ascending; those beyond the extent are on its border
    kept : (n + 1, n + 1) bool by column and row, vertices that the triangles have, the tile's corners aside
    """

    x: Float
    y: Float
    kept: Bools


def lattice(
    terrain: TerrainHeights,
    square: tuple[int, int],
    *,
    span: int,
    odd: bool,
    tile_size: float,
    extent: Sequence[float],
) -> Lattice:
    """The vertices of a tile of bare ground.

    The corners of squares on the tile's sides are kept in any case.

    square : (i, j) of the south-west square
    span   : squares along a side, a power of two
    odd    : whether i + j, counted from a corner that all tiles have in common, is odd, which tells the
             diagonal that halves the square; used if the span is 1
    """
    k = terrain.steps(tile_size)
    around = np.arange(-k, (span + 1) * k + 1) / k
    x, y = (np.clip((v + around) * tile_size, extent[a], extent[a + 2]) for a, v in enumerate(square))
    z = terrain.height(*(axis.ravel() for axis in np.meshgrid(x, y, indexing="ij")))
    height = np.round(z.reshape(len(x), len(y)) / _GRAIN) * _GRAIN
    error = np.zeros_like(height)
    for step in _double_until(1, k):
        _add_level(error, height, x=x, y=y, step=step, odd=odd and 2 * step == k)
    x, y, height, error = x[k:-k], y[k:-k], height[k:-k, k:-k], error[k:-k, k:-k]
    error[:: span * k, ::k] = error[::k, :: span * k] = np.inf
    for step in _double_until(k, span * k):
        _add_level(error, height, x=x, y=y, step=step, odd=False)
    return Lattice(x, y, error > terrain.tolerance)


def lattice_corners(vertices: Lattice, outline: shapely.Polygon) -> Float:
    """Corners (m, 3, 2) of the triangles of a tile of bare ground, counter-clockwise.

    outline : the tile's box, with all vertices that its sides have
    """
    number = _halve(vertices.kept)
    corners = np.stack([vertices.x[number[..., 0]], vertices.y[number[..., 1]]], axis=-1)
    u, v = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    corners = corners[u[:, 0] * v[:, 1] != u[:, 1] * v[:, 0]]  # beyond the extent they are lines
    ring = shapely.get_coordinates(outline)
    for axis in (0, 1):
        for side in (ring[:, axis].min(), ring[:, axis].max()):
            stops = np.unique(ring[ring[:, axis] == side, 1 - axis])
            corners = _with_stops(corners, stops, axis=axis, side=side)
    return corners


def _double_until(first: int, stop: int) -> list[int]:
    """Powers of two from ``first`` to below ``stop``."""
    return [2**n for n in range(first.bit_length() - 1, stop.bit_length() - 1)]


def _add_level(error: Float, height: Float, *, x: Float, y: Float, step: int, odd: bool) -> None:
    """Enter the errors of vertices amid sides and amid squares of two steps.

    error : (n, m) metres by which heights may be off without a vertex and those that depend on it
    odd   : the first square is halved from its south-east corner
    """
    _add_sides(error, height, x=x, step=step)
    _add_sides(error.T, height.T, x=y, step=step)
    _add_middles(error, height, x=x, y=y, step=step, odd=odd)


def _add_sides(error: Float, height: Float, *, x: Float, step: int) -> None:
    """Errors of the vertices amid sides along x."""
    s = slice(None, None, 2 * step)
    low, middle, high = slice(0, -1, 2 * step), slice(step, None, 2 * step), slice(2 * step, None, 2 * step)
    share = _share(x, step)[:, None]
    line = height[low, s] * (1 - share) + height[high, s] * share
    below = np.zeros(line.shape)
    if step > 1:
        squares = error[step // 2 :: step, step // 2 :: step]
        beside = np.pad(np.maximum(squares[0::2], squares[1::2]), [(0, 0), (1, 1)])
        below = np.maximum(beside[:, 0::2], beside[:, 1::2])
    error[middle, s] = np.abs(height[middle, s] - line) + below


def _add_middles(error: Float, height: Float, *, x: Float, y: Float, step: int, odd: bool) -> None:
    """Errors of the vertices amid squares, which halve one of the two diagonals."""
    low, middle, high = slice(0, -1, 2 * step), slice(step, None, 2 * step), slice(2 * step, None, 2 * step)
    u, v = _share(x, step)[:, None], _share(y, step)
    sw, se, nw, ne = height[low, low], height[high, low], height[low, high], height[high, high]
    rising = _on_diagonal(sw, ne, beyond=(se, nw), shares=(u, v))
    falling = _on_diagonal(se, nw, beyond=(sw, ne), shares=(1 - u, v))
    column, row = np.indices(sw.shape)
    plane = np.where((column + row + odd) % 2 == 0, rising, falling)
    below = np.maximum(
        np.maximum(error[low, middle], error[high, middle]),
        np.maximum(error[middle, low], error[middle, high]),
    )
    error[middle, middle] = np.abs(height[middle, middle] - plane) + below


def _on_diagonal(
    start: Float, end: Float, *, beyond: tuple[Float, Float], shares: tuple[Float, Float]
) -> Float:
    """Height in a square that is halved by a diagonal; ``beyond`` are its corners below and above that.

    A place is given by its shares of the square's sides from the diagonal's start; 0.5 but for squares that
    the extent cuts.
    """
    u, v = np.broadcast_arrays(*shares)
    off = np.where(u > v, beyond[0], beyond[1])
    height: Float = start * (1 - np.maximum(u, v)) + end * np.minimum(u, v) + off * np.abs(u - v)
    return height


def _share(x: Float, step: int) -> Float:
    """Where the middles of pairs of steps lie between their ends, 0 to 1."""
    low, middle, high = x[0 : -1 : 2 * step], x[step :: 2 * step], x[2 * step :: 2 * step]
    wide = high > low
    share: Float = np.where(wide, (middle - low) / np.where(wide, high - low, 1.0), 0.5)
    return share


def _halve(kept: Bools) -> Ints:
    """Columns and rows (m, 3, 2) of the corners of triangles, counter-clockwise."""
    n = len(kept) - 1
    todo = np.array([[[n, n], [0, 0], [n, 0]], [[0, 0], [n, n], [0, n]]])
    done = []
    while len(todo):
        a, b, c = todo[:, 0], todo[:, 1], todo[:, 2]
        middle, rest = np.divmod(a + b, 2)
        split = ~rest.any(axis=1) & kept[middle[:, 0], middle[:, 1]]
        done.append(todo[~split])
        a, b, c, middle = a[split], b[split], c[split], middle[split]
        todo = np.concatenate([np.stack([c, a, middle], axis=1), np.stack([b, c, middle], axis=1)])
    return np.concatenate(done)


def _with_stops(corners: Float, stops: Float, *, axis: int, side: float) -> Float:
    """Triangles (m, 3, 2) that have all vertices of a tile's side: those with too few are cut into fans.

    axis  : 0 for a side of constant x
    stops : (k,) coordinates of the vertices along the side
    """
    on = corners[:, :, axis] == side
    fans, whole = [np.empty((0, 3, 2))], np.ones(len(corners), bool)
    for row in np.flatnonzero(on.sum(axis=1) == 2):
        apex = int(np.flatnonzero(~on[row])[0])
        start, end, tip = corners[row][[(apex + 1) % 3, (apex + 2) % 3, apex]]
        first, last = start[1 - axis], end[1 - axis]
        between = stops[(stops > min(first, last)) & (stops < max(first, last))]
        if len(between):
            whole[row] = False
            along = np.concatenate([[first], between if first < last else between[::-1], [last]])
            edge = np.full((len(along), 2), side)
            edge[:, 1 - axis] = along
            fans.append(np.stack([edge[:-1], edge[1:], np.broadcast_to(tip, edge[1:].shape)], axis=1))
    return np.concatenate([corners[whole], *fans])
