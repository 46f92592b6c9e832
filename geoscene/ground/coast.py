"""The sea within a box, from coastlines with land on their left and water on their right."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.support.problems import Problem
from geoscene.typing import Float

_ASIDE = 0.01
"""Metres to each side of a coastline at which land and sea are sampled."""


def sea(
    coastlines: Sequence[Float], extent: Sequence[float], *, osm_id: Sequence[str] = ()
) -> tuple[NDArray[np.object_], list[Problem]]:
    """Polygons (n,) of the sea within the extent, and repairs.

    coastlines : (k, 2) scene metres each, in the direction of the map: land left, sea right
    extent     : (xmin, ymin, xmax, ymax)
    osm_id     : of each coastline, for the problems

    Without a coastline inside the extent there is no sea. A coastline that ends inside the extent (where an
    extract was cut) is extended to the nearest point of the border. A face whose shores contradict each
    other, which broken coastlines cause, becomes what most metres of its shore indicate.
    """
    box = shapely.box(*extent)
    names = list(osm_id) or [""] * len(coastlines)
    inside = [k for k, c in enumerate(coastlines) if len(c) > 1 and shapely.LineString(c).intersects(box)]
    if not inside:
        return np.empty(0, object), []
    problems: list[Problem] = []
    lines: list[Any] = [shapely.LineString(coastlines[k]) for k in inside]
    for k, point in _loose_ends([coastlines[k] for k in inside], box):
        border = shapely.shortest_line(shapely.Point(point), box.exterior)
        lines.append(_extend(border))
        detail = f"led {border.length:.1f} m on to the edge of the scene"
        problems.append(Problem(names[inside[k]], "coastline", "repaired", "open-end", detail))
    faces = shapely.get_parts(shapely.polygonize([shapely.union_all([*lines, box.exterior])]))
    faces = faces[shapely.contains_properly(box.buffer(_ASIDE), faces)]
    wet, dry = _shores(faces, [coastlines[k] for k in inside])
    for face, w, d in zip(faces, wet, dry, strict=True):
        if min(w, d) > 0.01 * max(w, d):
            at = face.representative_point()
            detail = f"sea by {w:.0f} m of shore, land by {d:.0f} m, at ({at.x:z.0f}, {at.y:z.0f})"
            problems.append(Problem("", "coastline", "repaired", "conflict", detail))
    return faces[wet > dry], problems


def _loose_ends(coastlines: Sequence[Float], box: Any) -> list[tuple[int, Float]]:
    """(coastline, point) of ends inside the box where no other coastline continues."""
    ends = np.array([[c[0], c[-1]] for c in coastlines]).reshape(-1, 2)
    _, place, count = np.unique(np.round(ends, 3), axis=0, return_inverse=True, return_counts=True)
    loose = (count[place.reshape(-1)] == 1) & shapely.contains_xy(box, ends[:, 0], ends[:, 1])
    return [(int(e) // 2, ends[e]) for e in np.flatnonzero(loose)]


def _extend(line: Any) -> Any:
    """A line (two points) extended slightly beyond its end, so that it crosses the touched line."""
    (x0, y0), (x1, y1) = line.coords
    length = max(line.length, _ASIDE)
    return shapely.LineString(
        [(x0, y0), (x1 + (x1 - x0) * _ASIDE / length, y1 + (y1 - y0) * _ASIDE / length)]
    )


def _shores(faces: NDArray[np.object_], coastlines: Sequence[Float]) -> tuple[Float, Float]:
    """Metres of shore of each face (n,) that indicate sea, and that indicate land."""
    start = np.concatenate([c[:-1] for c in coastlines])
    step = np.concatenate([np.diff(c, axis=0) for c in coastlines])
    length = np.hypot(*step.T)
    start, step, length = start[length > 0], step[length > 0], length[length > 0]
    right = np.stack([step[:, 1], -step[:, 0]], axis=1) / length[:, None] * _ASIDE
    tree = shapely.STRtree(faces)
    shores: list[Float] = []
    # Long segments may cross the border of the extent: they are sampled at several points.
    pieces = np.maximum(np.ceil(length / 5.0).astype(int), 1)
    segment = np.repeat(np.arange(len(length)), pieces)
    nth = np.arange(len(segment)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    middle = start[segment] + step[segment] * ((nth + 0.5) / pieces[segment])[:, None]
    weight = length[segment] / pieces[segment]
    for side in (1.0, -1.0):
        point, face = tree.query(shapely.points(middle + side * right[segment]), predicate="within")
        shores.append(np.bincount(face, weight[point], minlength=len(faces)).astype(np.float64))
    return shores[0], shores[1]
