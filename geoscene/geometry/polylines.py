"""Polylines as arrays of points (n, 2) or (n, 3): length, cutting, resampling, offset lines, headings.

Lengths, stations and offsets are measured in plan (x, y); heights are interpolated. A station is the distance
along the line from its first point.
"""

from __future__ import annotations

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray

from geoscene.typing import Float, Ints

_LEVEL = 1e-3
"""Metres in height by which a line without a vertex may be off."""

_UNITS = 2.0**30
"""Units of stations per metre in which they are summed: a nanometre each."""


def flat(line: Float) -> shapely.LineString:
    """A line (n, 2 or 3) in plan, for shapely."""
    return shapely.LineString(line[:, :2])


def length(line: Float) -> float:
    """Length in plan."""
    return float(np.hypot(*np.diff(line[:, :2], axis=0).T).sum())


def stations(line: Float) -> Float:
    """Station (n,) of each point."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line[:, :2], axis=0).T))])


def points_at(line: Float, at: Float | list[float], *, along: Float | None = None) -> Float:
    """Points (k, 2 or 3) of the line at stations (k,), clamped to its ends.

    along : stations of the line's points, if already computed
    """
    along = stations(line) if along is None else along
    return np.stack([np.interp(at, along, column) for column in line.T], axis=1)


def cut(line: Float, start: float, *, end: float, gap: float = 0.0, least: float = 0.0) -> Float:
    """The part (k, 2 or 3) of the line between two stations, always with both end points.

    If ``end`` is before ``start``, only these two points are returned.

    gap   : vertices within this distance of the new ends are left out
    least : minimum length of the part; its end is moved further along the line to reach it
    """
    along = stations(line)
    start, end = max(start, 0.0), min(max(end, start + least) if least else end, float(along[-1]))
    inside = (along > start + gap) & (along < end - gap)
    return points_at(line, np.concatenate([[start], along[inside], [end]]), along=along)


def parts(line: Float, cuts: Float) -> NDArray[np.object_]:
    """The parts (k,) of a line (n, 2) between ascending stations (k + 1,), as shapely lines; see `cut`."""
    along = stations(line)
    cuts = np.clip(cuts, 0.0, along[-1])
    ends = points_at(line, cuts, along=along)
    begin, stop = np.searchsorted(along, cuts[:-1], side="right"), np.searchsorted(along, cuts[1:])
    inside = np.maximum(stop - begin, 0)
    vertex = np.repeat(begin - np.cumsum(inside) + inside, inside) + np.arange(inside.sum())
    part = np.arange(len(inside))
    points = np.concatenate([ends[:-1], line[vertex], ends[1:]])
    of = np.concatenate([part, np.repeat(part, inside), part])
    order = np.argsort(of, kind="stable")
    found: NDArray[np.object_] = shapely.linestrings(points[order], indices=of[order])
    return found


def add_up(steps: Float, first: Ints) -> Float:
    """Sums (n,) of steps (n,) after given earlier ones (n,): stations of points of many lines in one array.

    In whole nanometres, so that they do not depend on the lines before.
    """
    total = np.cumsum(np.rint(steps * _UNITS).astype(np.int64))
    return np.asarray((total - total[first]) / _UNITS, float)


def heads(lines: NDArray[np.object_], end: Float) -> NDArray[np.object_]:
    """The parts (n,) of shapely lines from their starts to stations (n,), clamped to their ends."""
    if not len(lines):
        return lines
    xy, of = shapely.get_coordinates(lines, return_index=True)
    first = np.flatnonzero(np.diff(of, prepend=-1))
    step = np.hypot(*np.diff(xy, axis=0, prepend=xy[:1]).T)
    step[first] = 0.0
    along = add_up(step, first[of])
    last = np.append(first[1:], len(of)) - 1
    end = np.minimum(end, along[last])
    # The cut is in the segment that ends in the first vertex beyond it.
    beyond = first + np.bincount(of, along < end[of], minlength=len(lines)).astype(np.int64)
    before = np.maximum(beyond - 1, first)
    run = np.maximum(along[beyond] - along[before], 1e-12)
    share = np.clip((end - along[before]) / run, 0.0, 1.0)
    cut_at = xy[before] + share[:, None] * (xy[beyond] - xy[before])
    kept = (along > 0.0) & (along < end[of])
    kept[first] = True
    points = np.concatenate([xy[kept], cut_at])
    owner = np.concatenate([of[kept], np.arange(len(lines))])
    order = np.argsort(owner, kind="stable")
    parts: NDArray[np.object_] = shapely.linestrings(points[order], indices=owner[order])
    return parts


def parallel(line: Float, offset: float) -> Float:
    """The line (k, 3) with every vertex moved ``offset`` to the left, with mitred corners.

    Repeated points are left out. Loops inside tight bends are kept; `offset_curve` removes them.
    """
    step = np.diff(line[:, :2], axis=0)
    size = np.hypot(*step.T)
    unit = step[size > 1e-9] / size[size > 1e-9, None]
    keep = np.concatenate([[True], size > 1e-9])
    moved: Float = line[keep].copy()
    if offset == 0.0 or not len(unit):
        return moved
    normal = np.column_stack([-unit[:, 1], unit[:, 0]])
    before, after = np.vstack([normal[:1], normal]), np.vstack([normal, normal[-1:]])
    mitre = (before + after) / np.maximum(1 + (before * after).sum(axis=1), 0.5)[:, None]
    moved[:, :2] += offset * mitre
    return moved


def offset_curve(line: Float, offset: float) -> Float:
    """The line (k, 3) offset to the left without loops inside bends; heights are those of the nearest points.

    Of vertices on a straight those at which the gradient changes are kept.

    If the offset line would be shorter than half the line, each vertex is moved instead, loops included.
    """
    centre = shapely.linestrings(line[:, :2])
    if offset == 0.0 or centre.length < 1e-6:
        return line
    moved = shapely.offset_curve(centre, offset, join_style="mitre", mitre_limit=2.0)
    if moved.geom_type != "LineString" or moved.is_empty or moved.length < 0.5 * centre.length:
        d = np.gradient(line[:, :2], axis=0)
        unit = d / np.maximum(np.hypot(*d.T), 1e-9)[:, None]
        left = np.stack([-unit[:, 1], unit[:, 0]], axis=1)
        return np.column_stack([line[:, :2] + offset * left, line[:, 2]])
    xy = shapely.get_coordinates(moved)
    along, height = stations(line), line[:, 2]
    near = shapely.line_locate_point(centre, shapely.points(xy))
    # GEOS leaves out vertices on straights, and with them their heights.
    kept = np.unique(near)
    between = np.interp(along, kept, np.interp(kept, along, height))
    lost = (along > kept[0]) & (along < kept[-1]) & ~np.isin(along, kept)
    if (np.abs(between - height)[lost] > _LEVEL).any():
        added = shapely.line_locate_point(moved, shapely.points(line[lost, :2]))
        xy = points_at(xy, np.union1d(stations(xy), added))
        near = shapely.line_locate_point(centre, shapely.points(xy))
    return np.column_stack([xy, np.interp(near, along, height)])


def unit(vector: Float) -> Float:
    """Unit vectors of vectors (..., 2); zero vectors stay zero."""
    size: Float = np.maximum(np.hypot(vector[..., 0], vector[..., 1]), 1e-9)
    return vector / size[..., None]


def end_headings(line: Float, *, reach: float) -> tuple[float, float]:
    """Headings in radians of the line's two ends, each averaged over the length ``reach``."""
    found = []
    for xy, sign in ((line[:, :2], 1.0), (line[::-1, :2], -1.0)):
        far = np.flatnonzero(np.hypot(*(xy - xy[0]).T) >= reach)
        dx, dy = sign * (xy[far[0] if len(far) else -1] - xy[0])
        found.append(float(np.arctan2(dy, dx)))
    return found[0], found[1]


def headings(line: Float) -> Float:
    """Unwrapped heading (n,) at each point, radians."""
    d = np.gradient(line[:, :2], axis=0)
    heading: Float = np.unwrap(np.arctan2(d[:, 1], d[:, 0]))
    return heading


def cross(u: Float, v: Float) -> Float:
    """Cross products (n,) of vectors (n, 2 or more) in plan: twice the signed areas of triangles."""
    product: Float = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
    return product


def curvatures(line: Float) -> Float:
    """Curvature (n,) at each point, 1 / unit of length, positive to the left."""
    xy = line[:, :2]
    a, b = xy[1:-1] - xy[:-2], xy[2:] - xy[1:-1]
    dot = (a * b).sum(axis=1)
    inner = 2.0 * np.arctan2(cross(a, b), dot) / np.maximum(np.hypot(*a.T) + np.hypot(*b.T), 1e-9)
    return np.concatenate([inner[:1], inner, inner[-1:]])


def directions(lines: NDArray[np.object_], at: Float, *, reach: ArrayLike) -> Float:
    """Unit vectors (k, 2) along shapely lines (k,) at stations (k,), averaged over ``reach`` both ways."""
    total = shapely.length(lines)
    back, ahead = (
        shapely.get_coordinates(shapely.line_interpolate_point(lines, np.clip(at + step, 0.0, total)))
        for step in (-np.asarray(reach), np.asarray(reach))
    )
    return unit(ahead - back)
