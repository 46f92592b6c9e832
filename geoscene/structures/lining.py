"""Relief of tunnels: walkways and niches in the tube, ribs of the lining and portals.

Maps do not hold any of it. Sizes and spacings are those of guidelines where a source is given, else assumed;
which of them a tunnel has depends on its OSM id alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely

from geoscene import polylines
from geoscene.mesh import Mesh
from geoscene.structures.bodies import body, upright
from geoscene.structures.heights import slopes_across, surface_heights
from geoscene.structures.table import Structures
from geoscene.structures.tubes import (
    Walls,
    between,
    carriageway,
    has_walkway,
    mouths,
    random_shares,
    rectangle,
    stations_every,
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
    """

    walkway: shapely.Geometry
    niches: shapely.Geometry


def read_lining(table: Structures, k: int) -> Lining:
    """Walkways and niches of tunnel piece ``k``; pedestrian tunnels have none."""
    if not has_walkway(table, k):
        return Lining(shapely.Polygon(), shapely.Polygon())
    walkway = table.inner[k].intersection(table.polygon[k]).difference(carriageway(table, k))
    walkway = _tidy(walkway)
    boxes = []
    stations, sides = niche_stations(table, k)
    walls = Walls.of(table, k, stations=stations)
    solid = table.polygon[k].buffer(-_NICHE_WALL, join_style="mitre")
    for row, side in enumerate(sides.tolist()):
        away = walls.metres[row, side]
        if np.isnan(away):
            continue
        box = rectangle(walls, row, side=side, along=(-NICHE_WIDTH / 2, NICHE_WIDTH / 2),
                    across=(away - 0.3, away + _NICHE_DEPTH))  # fmt: skip
        niche = box.intersection(solid).difference(table.inner[k])
        whole = NICHE_WIDTH * _NICHE_DEPTH
        if niche.area > 0.8 * whole and niche.geom_type == "Polygon":
            boxes.append(niche)
    return Lining(walkway, shapely.MultiPolygon(boxes))


def _tidy(shape: shapely.Geometry) -> shapely.Geometry:
    """A shape without parts and necks that are too narrow to stand on."""
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


def ribs(table: Structures, k: int) -> list[Mesh]:
    """Ribs along a piece, clear of its ends, its niches and its portals."""
    form = rib_form(table, k)
    stations, _ = stations_every(table, k, spacing=form.spacing)
    length = polylines.length(table.line[k])
    stations = stations[(stations > form.width) & (stations < length - form.width)]
    for others, room in ((mouths(table, k), 1.5), (_niches_along(table, k), NICHE_WIDTH / 2 + form.width)):
        stations = stations[(np.abs(stations[:, None] - others) > room).all(axis=1)]
    return _frames(table, k, stations=stations, size=(form.width, form.depth))


def portals(table: Structures, k: int) -> list[Mesh]:
    """Frames at the mouths of a piece."""
    depth = _PORTAL_DEPTH if has_walkway(table, k) else _FOOT_DEPTH
    return _frames(table, k, stations=mouths(table, k), size=(PORTAL_WIDTH, depth))


def _niches_along(table: Structures, k: int) -> Float:
    return niche_stations(table, k)[0] if has_walkway(table, k) else np.empty(0)


def _frames(
    table: Structures,
    k: int,
    *,
    stations: Float,
    size: tuple[float, float],
) -> list[Mesh]:
    """A frame of two posts and a beam across the tunnel at each station.

    Posts alone where a wall is missing or the ceiling slopes across, none on the carriageway.

    size : metres along the tunnel, and from the wall
    """
    if not len(stations):
        return []
    wide, deep = size
    walls = Walls.of(table, k, stations=stations)
    ends = [walls.at + sign * wide / 2 * walls.along for sign in (-1.0, 1.0)]
    reach = np.array([[walls.distance(table, k, points=end, side=side) for side in (0, 1)] for end in ends])
    room = table.inner[k].buffer(-GAP / 2, join_style="mitre")
    keep_out = carriageway(table, k) if has_walkway(table, k) else shapely.Polygon()
    beams = not slopes_across(table, k)
    out: list[Mesh] = []
    for row in range(len(stations)):
        feet: list[Float | None] = []
        for side in (0, 1):
            sign = 1.0 if side == 0 else -1.0
            left = sign * walls.left(row)
            outer = [
                end[row] + (metres - GAP) * left
                for end, metres in zip(ends, reach[:, side, row], strict=True)
            ]
            foot = np.array([*outer, *(p - deep * left for p in outer[::-1])])
            fits = bool(np.isfinite(foot).all())
            if fits:
                area = shapely.Polygon(foot)
                fits = bool(area.is_valid and room.contains(area) and not keep_out.intersects(area))
            feet.append(foot if fits else None)
        out += _frame(table, k, feet=feet, deep=deep, beams=beams)
    return out


def _frame(
    table: Structures, k: int, *, feet: Sequence[Float | None], deep: float, beams: bool
) -> list[Mesh]:
    """A frame over the feet (4, 2) of its posts: outside at both ends, then inside at both, reversed."""
    low = WALKWAY + GAP if has_walkway(table, k) else GAP
    left, right = feet
    if left is not None and right is not None and beams:
        sections = []
        for end in (0, 1):
            plan = np.array([left[end], left[end], right[end], right[end],
                             right[3 - end], right[3 - end], left[3 - end], left[3 - end]])  # fmt: skip
            floor = surface_heights(table, k, xy=plan)
            top = table.rise[k] - UNDER
            under = top - min(deep, _BEAM)
            rise = np.array([low, top, top, low, low, under, under, low])
            sections.append(np.column_stack([plan, floor + rise]))
        return [body(table, k, rings=sections, caps=_ARCH)]
    posts = [foot for foot in feet if foot is not None]
    return [upright(table, k, foot=foot, low=low, top=float(table.rise[k]) - UNDER) for foot in posts]


_ARCH = np.array([[0, 1, 7], [1, 6, 7], [1, 2, 6], [2, 5, 6], [2, 3, 5], [3, 4, 5]])
"""Triangles of an arch of eight corners: up the left outside, across, down, and back along the inside."""
