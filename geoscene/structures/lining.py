"""Relief of tunnels: walkways and niches in the tube, ribs of the lining and portals.

Maps do not hold any of it. Sizes and spacings are those of guidelines where a source is given, else assumed;
which of them a tunnel has depends on its OSM id alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely

from geoscene.geometry import polylines
from geoscene.structures.table import Structures, slopes_across, surface_heights
from geoscene.structures.tubes import (
    Bodies,
    TubeWalls,
    between,
    between_rings,
    carriageway,
    has_walkway,
    mouths,
    random_shares,
    stations_every,
    uprights,
)
from geoscene.typing import Float, Ints

WALKWAY = 0.15
"""Metres from the carriageway up to the walkways beside it (RABT 2006: kerbs of 7 to 15 cm)."""

NICHE = 2.4
"""Metres from the carriageway up to the ceiling of emergency niches."""

_NICHES = (50.0, 150.0)
"""Metres between emergency niches (RABT 2006, Directive 2004/54/EC: 150 m and less)."""

NICHE_WIDTH, _NICHE_DEPTH, _NICHE_WALL = 2.4, 0.35, 0.1
"""Metres of a niche along and across the tunnel, and of the wall that remains behind it."""

_RIBS, _RIB_WIDTH, _RIB_DEPTH = (5.0, 10.0), (0.3, 0.6), (0.12, 0.2)
"""Metres between the ribs of a lining, least and greatest; of a rib along and across the tunnel. Assumed."""

_FOOT_DEPTH = 0.06
"""Metres by which the ribs of pedestrian tunnels stand out."""

PORTAL_WIDTH, _PORTAL_DEPTH = 0.8, 0.3
"""Metres of the frame at a mouth, along and across the tunnel."""

_BEAM = 0.15
"""Metres by which beams reach down at most: 4.5 m of free height remain."""

GAP, UNDER = 0.02, 0.04
"""Metres from walls and from ceilings to what is mounted there, so that bodies do not cross."""


@dataclass(frozen=True, slots=True)
class Lining:
    """Areas of a tunnel piece whose floor is not the carriageway.

    walkway : area within the walls beside carriageways
    niches  : areas cut into the walls
    driven  : area that vehicles drive on, empty in pedestrian tunnels
    """

    walkway: shapely.Geometry
    niches: shapely.Geometry
    driven: shapely.Geometry


def read_lining(table: Structures, k: int) -> Lining:
    """Walkways and niches of tunnel piece ``k``; pedestrian tunnels have none."""
    if not has_walkway(table, k):
        return Lining(shapely.Polygon(), shapely.Polygon(), shapely.Polygon())
    driven = carriageway(table, k)
    walkway = _tidy(table.inner[k].intersection(table.polygon[k]).difference(driven))
    stations, sides = niche_stations(table, k)
    walls = TubeWalls.of(table, k, stations=stations)
    away = walls.metres[np.arange(len(sides)), sides]
    rows = np.flatnonzero(np.isfinite(away))
    boxes = shapely.polygons(
        walls.rectangles(
            rows=rows,
            side=sides[rows],
            along=(-NICHE_WIDTH / 2, NICHE_WIDTH / 2),
            across=(away[rows] - 0.3, away[rows] + _NICHE_DEPTH),
        )
    )
    solid = table.polygon[k].buffer(-_NICHE_WALL, join_style="mitre")
    niches = shapely.difference(shapely.intersection(boxes, solid), table.inner[k])
    deep = shapely.area(niches) > 0.8 * NICHE_WIDTH * _NICHE_DEPTH
    whole = shapely.get_type_id(niches) == shapely.GeometryType.POLYGON
    return Lining(walkway, shapely.multipolygons(niches[deep & whole]), driven)


def _tidy(shape: shapely.Geometry) -> shapely.Geometry:
    """A shape without parts and necks that are too narrow to support a solid."""
    return shape.buffer(-0.05, join_style="mitre").buffer(0.05, join_style="mitre").intersection(shape)


def niche_stations(table: Structures, k: int) -> tuple[Float, Ints]:
    """Stations of niches and their sides, which alternate; clear of the ends of pieces."""
    stations, number = stations_every(table, k, spacing=between(_NICHES, random_shares(table, k, count=4)[3]))
    room = NICHE_WIDTH / 2 + 0.3
    length = polylines.length(table.line[k])
    if length < 2 * room:
        return stations[:0], number[:0]
    return np.clip(stations, room, length - room), number % 2


@dataclass(frozen=True, slots=True)
class RibForm:
    """Metres between the ribs of a tunnel, and of a rib along the tunnel and from the wall."""

    spacing: float
    width: float
    depth: float


def rib_form(table: Structures, k: int) -> RibForm:
    """The ribs of the tunnel that piece ``k`` is part of."""
    spacing, width, depth, _ = random_shares(table, k, count=4)
    out = between(_RIB_DEPTH, depth) if has_walkway(table, k) else _FOOT_DEPTH
    return RibForm(between(_RIBS, spacing), between(_RIB_WIDTH, width), out)


def ribs(table: Structures, k: int, *, driven: shapely.Geometry) -> Bodies:
    """Ribs along a piece, clear of its ends, its niches and its portals."""
    form = rib_form(table, k)
    stations, _ = stations_every(table, k, spacing=form.spacing)
    length = polylines.length(table.line[k])
    stations = stations[(stations > form.width) & (stations < length - form.width)]
    niches = niche_stations(table, k)[0] if has_walkway(table, k) else np.empty(0)
    for others, room in ((mouths(table, k), 1.5), (niches, NICHE_WIDTH / 2 + form.width)):
        stations = stations[(np.abs(stations[:, None] - others) > room).all(axis=1)]
    return _frames(table, k, stations=stations, size=(form.width, form.depth), driven=driven)


def portals(table: Structures, k: int, *, driven: shapely.Geometry) -> Bodies:
    """Frames at the mouths of a piece."""
    depth = _PORTAL_DEPTH if has_walkway(table, k) else _FOOT_DEPTH
    return _frames(table, k, stations=mouths(table, k), size=(PORTAL_WIDTH, depth), driven=driven)


def _frames(
    table: Structures, k: int, *, stations: Float, size: tuple[float, float], driven: shapely.Geometry
) -> Bodies:
    """A frame of two posts and a beam across the tunnel at each station.

    Posts alone where a wall is missing or the ceiling slopes across, none on the carriageway.

    size : metres along the tunnel, and from the wall
    """
    if not len(stations):
        return Bodies.empty()
    wide, deep = size
    walls = TubeWalls.of(table, k, stations=stations)
    ahead = np.array([-wide / 2, wide / 2])
    away = walls.beside(table, k, ahead=ahead)[..., None]
    ends = (walls.at + ahead[:, None, None] * walls.along)[:, :, None]
    outer = ends + (away - GAP) * walls.outwards
    inner = outer - deep * walls.outwards
    feet = np.stack([*outer, *inner[::-1]], axis=2)  # (stations, sides, 4, 2)
    fits = np.isfinite(feet).all(axis=(2, 3))
    areas = shapely.polygons(feet[fits])
    room = table.inner[k].buffer(-GAP / 2, join_style="mitre")
    shapely.prepare([room, driven])
    fits[fits] = shapely.is_valid(areas) & room.contains(areas) & ~driven.intersects(areas)
    low = WALKWAY + GAP if has_walkway(table, k) else GAP
    top = float(table.rise[k]) - UNDER
    arched = fits.all(axis=1) & (not slopes_across(table, k))
    runs = np.split(np.arange(len(stations)), np.flatnonzero(np.diff(arched)) + 1)
    return Bodies.joined(
        [
            _arches(table, k, feet=feet[run], levels=(low, top - min(deep, _BEAM), top))
            if arched[run[0]]
            else uprights(table, k, feet=feet[run][fits[run]], low=low, top=top)
            for run in runs
        ]
    )


def _arches(table: Structures, k: int, *, feet: Float, levels: tuple[float, float, float]) -> Bodies:
    """Frames over the feet (n, 2, 4, 2) of their two posts: outside at both ends, then inside, reversed.

    levels : metres above the carriageway of the posts' lower ends, the beam's underside and its top
    """
    low, under, top = levels
    left, right = feet[:, 0], feet[:, 1]
    sections = [
        np.stack(
            [left[:, end]] * 2 + [right[:, end]] * 2 + [right[:, 3 - end]] * 2 + [left[:, 3 - end]] * 2, 1
        )
        for end in (0, 1)
    ]
    plan = np.stack(sections, axis=1)
    floor = surface_heights(table, k, xy=plan.reshape(-1, 2)).reshape(-1, 2, 8)
    z = floor + np.array([low, top, top, low, low, under, under, low])
    return between_rings(table, k, rings=np.concatenate([plan, z[..., None]], axis=-1), caps=_ARCH)


_ARCH = np.array([[0, 1, 7], [1, 6, 7], [1, 2, 6], [2, 5, 6], [2, 3, 5], [3, 4, 5]])
"""Triangles of an arch of eight corners: up the left outside, across, down, and back along the inside."""
