"""Cuts footprints along steps of the roof into bodies of one roof each."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import shapely
from shapely.ops import split as split_by

from geoscene.clouds.roofs import FEWEST, Roof, fit_roof, roof_points
from geoscene.typing import Float

_STEP = 1.0
"""Metres of a step between two roofs, at least: less is a parapet, or a steep roof over a bin's width."""

_BESIDE = 1.0
"""Metres to either side of a step in which the heights are compared."""

_ALONG = 1.0
"""Metres of a bin along a step."""

_STEPPED = 0.75
"""Share of the bins along a cut in which the roof steps, in the same direction, at least."""

_BETWEEN = 0.25
"""Metres between the cuts that are tried."""

_SNAP = 0.6
"""Metres within which a cut goes through a vertex of the footprint: extensions begin at corners of walls."""

_SMALLEST, _NARROWEST = 6.0, 1.5
"""Square metres and metres of a body, at least."""

_SHARE = 0.6
"""Share of its points that the roof of a body explains, at least."""

_GAIN = 0.05
"""Share of the points that bodies explain and one roof over all of them does not, at least."""

_CUTS = 3
"""Cuts of a footprint, at most."""


class Body(NamedTuple):
    """A piece of a footprint, scene metres, and its roof."""

    polygon: Any
    roof: Roof


def split_bodies(polygon: Any, xyz: Float, *, inset: float, seed: str) -> tuple[Body, ...]:
    """Bodies of a footprint with roofs at different heights, the highest first; empty if no cuts explain it.

    Cuts are straight, parallel to a main direction of the walls, and go where the roof steps by 1 m or more
    along three quarters of their length. Each piece must have a roof of its own that explains its points,
    and together they must explain more than one roof does, which may be steep; else the footprint stays
    whole.

    polygon : valid footprint, scene metres
    xyz     : (n, 3) points above it, those near its walls left out
    inset   : metres from the walls of the pieces within which points are not taken for their roofs
    seed    : name of the building, which the random choices depend on
    """
    pieces = _pieces(polygon, xyz, left=_CUTS)
    if len(pieces) < 2:
        return ()
    bodies, points = [], []
    for k, (piece, some) in enumerate(pieces):
        own = some[roof_points(piece, some, inset=inset)]
        roof = fit_roof(piece, own, seed=f"{seed}.{k}")
        if roof is None or roof.share < _SHARE:
            return ()
        bodies.append(Body(piece, roof))
        points.append(len(own))
    single = fit_roof(polygon, xyz[roof_points(polygon, xyz, inset=inset)], seed=seed)
    share = np.average([body.roof.share for body in bodies], weights=points)
    if single is not None and share < single.share + _GAIN:
        return ()
    return tuple(sorted(bodies, key=lambda body: -body.roof.top))


def _pieces(polygon: Any, xyz: Float, *, left: int) -> list[tuple[Any, Float]]:
    """Pieces of a footprint and their points, cut at the clearest step, then again."""
    found = _clearest(polygon, xyz) if left and len(xyz) >= 2 * FEWEST else None
    if found is None:
        return [(polygon, xyz)]
    out = []
    for piece in found:
        inside = shapely.contains_xy(piece, xyz[:, 0], xyz[:, 1])
        out += _pieces(piece, xyz[inside], left=left - 1)
    return out


def _clearest(polygon: Any, xyz: Float) -> tuple[Any, Any] | None:
    """The two halves of a footprint at the cut with the highest step along it; None without a clear one."""
    best, halves = 0.0, None
    for along in _directions(polygon):
        across = np.array([-along[1], along[0]])
        u, v = xyz[:, :2] @ across, xyz[:, :2] @ along
        corners = shapely.get_coordinates(polygon) @ across
        rated = sorted(((_rating(u, v, z=xyz[:, 2], at=at), at) for at in _places(corners)), reverse=True)
        for rating, at in rated[:4]:
            if rating <= best:
                break
            near = corners[np.argmin(np.abs(corners - at))]
            for place in (float(near), at) if abs(near - at) < _SNAP else (at,):
                pair = _cut(polygon, place, along=along, across=across)
                if pair is not None:
                    best, halves = rating, pair
                    break
    return halves


def _directions(polygon: Any) -> Iterator[Float]:
    """Unit vectors along the walls: the direction with the greatest length of walls, and across it."""
    ring = shapely.get_coordinates(shapely.get_exterior_ring(shapely.get_parts(polygon)[0]))
    sides = np.diff(ring, axis=0)
    length, turn = np.hypot(*sides.T), np.arctan2(sides[:, 1], sides[:, 0])
    mean = np.angle((length * np.exp(4j * turn)).sum()) / 4
    for angle in (mean, mean + np.pi / 2):
        yield np.array([np.cos(angle), np.sin(angle)])


def _places(corners: Float) -> list[float]:
    """Places of cuts, metres across, which leave a strip to either side."""
    low, high = corners.min() + _NARROWEST, corners.max() - _NARROWEST
    return np.arange(low, high, _BETWEEN).tolist() if low < high else []


def _rating(u: Float, v: Float, *, z: Float, at: float) -> float:
    """Mean step in metres along a cut at u = ``at``; 0 where too few bins step in one direction."""
    off = u - at
    near = np.abs(off) < _BESIDE
    if near.sum() < FEWEST:
        return 0.0
    bins = np.floor((v[near] - v.min()) / _ALONG).astype(np.int64)
    upper = off[near] > 0
    heights = [_medians(bins[side], z[near][side], count=int(bins.max()) + 1) for side in (~upper, upper)]
    step = heights[1] - heights[0]
    step = step[np.isfinite(step)]
    if len(step) < 2:
        return 0.0
    signed = step * np.sign(np.median(step))
    if (signed > _STEP).mean() < _STEPPED:
        return 0.0
    return float(np.minimum(signed, 5.0).mean() * np.sqrt(len(step)))


def _medians(group: Any, values: Float, *, count: int) -> Float:
    """Median (count,) of the values of each group, NaN for one of fewer than two."""
    order = np.lexsort((values, group))
    group, values = group[order], values[order]
    first = np.searchsorted(group, np.arange(count))
    many = np.searchsorted(group, np.arange(count), side="right") - first
    out = np.full(count, np.nan)
    known = many > 1
    out[known] = values[(first + many // 2)[known]]
    return out


def _cut(polygon: Any, at: float, *, along: Float, across: Float) -> tuple[Any, Any] | None:
    """The halves of a footprint on both sides of a line, if they are one piece each and not too small."""
    reach = float(shapely.length(polygon))
    middle = at * across + (shapely.get_coordinates(shapely.centroid(polygon))[0] @ along) * along
    line = shapely.LineString([middle - reach * along, middle + reach * along])
    parts = [piece for piece in split_by(polygon, line).geoms if shapely.area(piece) > 1e-3]
    if len(parts) != 2 or not all(_large(piece) for piece in parts):
        return None
    return parts[0], parts[1]


def _large(piece: Any) -> bool:
    return bool(shapely.area(piece) >= _SMALLEST and not shapely.buffer(piece, -_NARROWEST / 2).is_empty)
