"""The extent of a map: bounds in degrees, maps across 180° of longitude, and nodes far from all others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import shapely

from geoscene.errors import InputError
from geoscene.geometry.frames import beside
from geoscene.sources.data import METRES_PER_DEGREE, Area, Bounds, is_building, kind_of
from geoscene.sources.elements import UNITS, Elements
from geoscene.support.problems import Problem
from geoscene.typing import Bools, Float

_WIDE = 25_000.0
"""Metres of a gap between two groups of nodes, beyond which a small group is taken for misplaced."""

_FEW, _SHARE = 8, 0.01
"""Size of a small group of nodes: at most this many, or this share of the map's nodes."""

_EMPTY = 10_000.0
"""Metres by which bounds stated in a file may exceed the nodes; what lies beyond is cut off."""

_LONG = 50_000.0
"""Metres; a node farther than this from the map, joined only by segments longer than this, is misplaced."""

_OVERHANG = 2_000.0
"""Metres that a building may extend beyond the map's bounds; the largest buildings are about that long."""

_NEAR_180 = 146.0
"""Degrees of longitude beyond which nodes can change sides of 180°; int32 ends at 214.7°."""


def checked_bounds(bounds: Bounds) -> Bounds:
    """``bounds`` (west, south, east, north) as floats; across 180° of longitude, east is more than 180.

    Such bounds are given with east less than west. Raises one InputError that lists all faults.
    """
    try:
        west, south, east, north = (float(v) for v in bounds)
    except (TypeError, ValueError):
        raise InputError(f"bounds {bounds!r}: give west, south, east, north in degrees") from None
    given = f"bounds {west:g},{south:g},{east:g},{north:g}"
    if not np.isfinite([west, south, east, north]).all():
        raise InputError(f"{given}: not finite")
    if west < -180 <= east:
        west, east = west + 360, east + 360
    if east < west - 270:
        east += 360
    if max(abs(west), -east) > 180 or east > max(180, west + 90) or max(abs(south), abs(north)) > 90:
        raise InputError(
            f"{given}: outside ±180 (longitude) or ±90 (latitude) degrees; the order is west, south, east,"
            " north"
        )
    faults = []
    if west >= east:
        faults.append("west is not less than east")
    if south >= north:
        faults.append("south is not less than north")
    if faults:
        raise InputError(f"{given}: {'; '.join(faults)}")
    return west, south, east, north


def locate(elements: Elements, bounds: Bounds | None) -> tuple[Elements, Bounds, list[Problem]]:
    """Elements without nodes far from the map, the map's extent, and the removed elements.

    Longitudes of a map across 180° become continuous, those east of it over 180. The extent is that of
    ``bounds``, else that which the source states, else that of the nodes. Bounds that a source states are
    cut 10 km beyond the nodes.
    """
    elements = _continuous(elements, bounds)
    lonlat = elements.node_xy / UNITS
    stated = bounds or _stated_bounds(elements)
    inside = np.ones(len(lonlat), np.bool_)
    if stated is not None and _within(lonlat, stated).any():
        inside = _within(lonlat, stated)
    main = inside.copy()
    if bounds is None:
        main[inside] = _main_part(lonlat[inside])
    west, south = lonlat[main].min(axis=0).tolist()
    east, north = lonlat[main].max(axis=0).tolist()
    extent: Bounds = (west, south, east, north)
    problems: list[Problem] = []
    if bounds is not None:
        extent = bounds
    elif stated is not None:
        extent, problems = _cut(stated, extent)
    stray = ~main if stated is None else _lone(elements, _beyond(lonlat, extent) > _LONG)
    far = _beyond(lonlat[stray], extent) / 1000
    problems += [
        Problem(f"node/{i}", "node", "dropped", "far-away", f"{km:,.0f} km from the map")
        for i, km in zip(elements.node_id[stray].tolist(), far.tolist(), strict=True)
    ]
    return _without(elements, stray), extent, problems


def near_extent(areas: Sequence[Area], extent: Bounds) -> tuple[list[Area], list[Problem]]:
    """The areas without buildings that extend more than 2 km beyond the extent, and these as problems."""
    built = [k for k, area in enumerate(areas) if is_building(area.tags)]
    boxes = shapely.bounds(np.array([areas[k].geometry for k in built], object)).reshape(-1, 4)
    beyond = np.maximum(_beyond(boxes[:, :2], extent), _beyond(boxes[:, 2:], extent))
    far = {built[n]: beyond[n] / 1000 for n in np.flatnonzero(beyond > _OVERHANG)}
    problems = [
        Problem(
            areas[k].osm_id,
            kind_of(areas[k].tags, area=True),
            "dropped",
            "far-away",
            f"extends to {km:,.0f} km from the map",
        )
        for k, km in far.items()
    ]
    return [area for k, area in enumerate(areas) if k not in far], problems


def close_together(areas: Sequence[Area]) -> tuple[list[Area], Bounds, list[Problem]]:
    """Areas without small groups far from all others, their extent, and the removed areas."""
    boxes = shapely.bounds(np.array([area.geometry for area in areas], object)).reshape(-1, 4)
    main = _main_part((boxes[:, :2] + boxes[:, 2:]) / 2)
    west, south = boxes[main, :2].min(axis=0).tolist()
    east, north = boxes[main, 2:].max(axis=0).tolist()
    extent = (west, south, east, north)
    kept, problems = near_extent(areas, extent)
    return kept, extent, problems


def _continuous(elements: Elements, bounds: Bounds | None) -> Elements:
    """The elements with longitudes on one side of 180° if the map lies on both."""
    lon = elements.node_xy[:, 0] / UNITS
    if bounds is not None:
        middle = (bounds[0] + bounds[2]) / 2
    else:
        across = np.where(lon < -_NEAR_180, lon + 360, lon)
        if not ((lon > _NEAR_180).any() and (lon < -_NEAR_180).any() and np.ptp(across) < np.ptp(lon)):
            return elements
        middle = 180.0
    moved = beside(lon, middle)
    turned = (moved != lon) & (np.abs(lon) > _NEAR_180)
    if not turned.any():
        return elements
    node_xy = elements.node_xy.copy()
    node_xy[turned, 0] += np.round((moved - lon)[turned]).astype(np.int32) * UNITS
    return replace(elements, node_xy=node_xy)


def _stated_bounds(elements: Elements) -> Bounds | None:
    """Bounds stated by the source; None if they span the globe."""
    if elements.bounds is None:
        return None
    west, south, east, north = elements.bounds
    if east < west:
        east += 360
    if east - west > 180:
        west, east = (f(elements.node_xy[:, 0]) / UNITS for f in (np.min, np.max))
    middle = float(np.median(elements.node_xy[:, 0])) / UNITS
    turn = float(beside(np.array((west + east) / 2), middle)) - (west + east) / 2
    return west + turn, south, east + turn, north


def _within(lonlat: Float, bounds: Bounds) -> Bools:
    west, south, east, north = bounds
    lon, lat = lonlat.T
    return np.asarray((lon >= west) & (lon <= east) & (lat >= south) & (lat <= north), np.bool_)


def _beyond(lonlat: Float, bounds: Bounds) -> Float:
    """Metres (n,) from points in degrees (n, 2) to the bounds, 0 within; the larger of both axes."""
    west, south, east, north = bounds
    lon, lat = lonlat.T
    across = np.maximum(west - lon, lon - east) * np.cos(np.radians((south + north) / 2))
    metres: Float = np.maximum(np.maximum(across, south - lat), np.maximum(lat - north, 0.0))
    return metres * METRES_PER_DEGREE


def widened(bounds: Bounds, metres: float) -> Bounds:
    """Bounds in degrees with a margin on all sides."""
    west, south, east, north = bounds
    up = metres / METRES_PER_DEGREE
    aside = up / max(float(np.cos(np.radians((south + north) / 2))), 1e-6)
    return west - aside, south - up, east + aside, north + up


def _main_part(lonlat: Float) -> Bools:
    """(n,) bool, points not in a small group at an end beyond a wide gap in longitude or latitude."""
    kept = np.arange(len(lonlat))
    few = max(_FEW, int(_SHARE * len(lonlat)))
    while True:
        before = len(kept)
        for axis in (1, 0):
            degree = METRES_PER_DEGREE
            if axis == 0:
                degree *= float(np.cos(np.radians(np.median(lonlat[kept, 1]))))
            order = np.argsort(lonlat[kept, axis], kind="stable")
            gaps = np.flatnonzero(np.diff(lonlat[kept[order], axis]) * degree > _WIDE) + 1
            groups = np.split(order, gaps)
            sizes = [len(group) for group in groups]
            large = [k for k, size in enumerate(sizes) if size > few or size == max(sizes)]
            kept = kept[np.sort(np.concatenate(groups[large[0] : large[-1] + 1]))]
        if len(kept) == before:
            break
    main = np.zeros(len(lonlat), np.bool_)
    main[kept] = True
    return main if 4 * len(kept) > 3 * len(lonlat) else np.ones(len(lonlat), np.bool_)


def _cut(stated: Bounds, found: Bounds) -> tuple[Bounds, list[Problem]]:
    """Stated bounds, limited to 10 km beyond the nodes' extent, and a report."""
    wide = widened(found, _EMPTY)
    west, south = max(stated[0], wide[0]), max(stated[1], wide[1])
    east, north = min(stated[2], wide[2]), min(stated[3], wide[3])
    if west >= east or south >= north:
        west, south, east, north = found
    elif (west, south, east, north) == stated:
        return stated, []
    detail = f"{','.join(f'{v:g}' for v in stated)} became {west:g},{south:g},{east:g},{north:g}"
    return (west, south, east, north), [Problem("", "bounds", "repaired", "far-from-nodes", detail)]


def _lone(elements: Elements, far: Bools) -> Bools:
    """(n,) bool, the ``far`` nodes that are only on segments of ways longer than 50 km, on at least one."""
    if not far.any():
        return far
    way = np.repeat(np.arange(len(elements.way_tags)), np.diff(elements.way_start))
    a, b = elements.ref[:-1], elements.ref[1:]
    segment = (way[:-1] == way[1:]) & (a >= 0) & (b >= 0)
    a, b = a[segment], b[segment]
    near_far = far[a] | far[b]
    a, b = a[near_far], b[near_far]
    step = np.abs(elements.lonlat(a) - elements.lonlat(b)) * METRES_PER_DEGREE
    step[:, 0] *= np.cos(np.radians(elements.lonlat(a)[:, 1]))
    long = np.hypot(*step.T) > _LONG
    on_long, on_short = np.zeros(len(far), np.bool_), np.zeros(len(far), np.bool_)
    on_long[a[long]] = on_long[b[long]] = True
    on_short[a[~long]] = on_short[b[~long]] = True
    return far & on_long & ~on_short


def _without(elements: Elements, gone: Bools) -> Elements:
    """The elements without some nodes, which count as missing in ways."""
    if not gone.any():
        return elements
    number = np.where(gone, -1, np.cumsum(~gone) - 1)
    names = set(elements.node_id[gone].tolist())
    return replace(
        elements,
        node_id=elements.node_id[~gone],
        node_xy=elements.node_xy[~gone],
        node_tags={i: tags for i, tags in elements.node_tags.items() if i not in names},
        ref=np.where(elements.ref >= 0, number[elements.ref], -1),
    )
