"""Bodies on the ground or walls of tunnels: ribs, portals and equipment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely

from geoscene.classes import Class
from geoscene.geometry import polylines
from geoscene.geometry.intersections import close_faces
from geoscene.geometry.mesh import Mesh, concatenate
from geoscene.geometry.watertight import grid_cells, weld
from geoscene.structures.lining import (
    GAP,
    NICHE,
    NICHE_WIDTH,
    PORTAL_WIDTH,
    UNDER,
    niche_stations,
    portals,
    rib_form,
    ribs,
)
from geoscene.structures.table import Structures, slopes_across, surface_heights
from geoscene.structures.tubes import (
    Bodies,
    TubeWalls,
    between,
    between_rings,
    has_walkway,
    mouths,
    place_in_tunnel,
    random_shares,
    stations_every,
    swept,
    uprights,
)
from geoscene.typing import Bools, Float

_LAMPS, _LAMP = (6.0, 12.0), (1.3, 0.25, 0.12)
"""Metres between lamps; length, width and height of one. Assumed."""

_SIGNS, _SIGN = 25.0, (0.03, 0.5, 0.3)
"""Metres between signs of escape routes (RABT 2006: 25 m); thickness, width and height of one."""

_SOS = (0.05, 0.6, 0.6)
"""Metres: thickness, width and height of the sign over a niche."""

_FANS, _FAN_LENGTH, _FAN, _FAN_DOWN, _FAN_FROM = 90.0, 2.6, 0.6, 0.1, 300.0
"""Metres between pairs of jet fans, length and diameter of one, its distance below the ceiling, length of
the shortest tunnel with fans.

Assumed. They hang over walkways, so the clearance over the carriageway is kept."""

_TRAY, _TRAY_DOWN, _TRAY_STEP, _TRAY_LEAST = (0.3, 0.08), 1.0, 2.0, 3
"""Metres: width and height of a cable tray, its distance below the ceiling, steps in which it bends, and
the least number of its bends and ends."""


@dataclass(frozen=True, slots=True)
class Built:
    """A piece, or bodies in it, as a mesh.

    equipment : (m,) bool, faces of a tunnel's equipment: lamps, signs, jet fans and cable trays
    guessed   : how many guessed parts of each kind it has
    """

    mesh: Mesh
    equipment: Bools
    guessed: dict[str, int]


def tunnel_fittings(
    table: Structures, k: int, *, tube: Mesh, driven: shapely.Geometry, equipment: bool
) -> Built:
    """Ribs and portals of tunnel piece ``k``, with ``equipment`` also lamps, signs, jet fans and cable trays.

    tube   : the piece's own solid; what would cross it, or something before it in this order, is left out
    driven : area that vehicles drive on
    """
    made = {"portals": portals(table, k, driven=driven), "ribs": ribs(table, k, driven=driven)}
    lining = len(made)
    if equipment and has_walkway(table, k):
        made |= {"lamps": lamps(table, k), "signs": signs(table, k)}
        made |= {"fans": fans(table, k), "cable_trays": trays(table, k)}
    bodies = Bodies.joined(list(made.values()))
    kind = np.repeat(np.arange(len(made)), [len(some) for some in made.values()])
    clear = _clear(tube, bodies)
    bodies, kind = bodies.take(clear), kind[clear]
    counts = zip(made, np.bincount(kind, minlength=len(made)).tolist(), strict=True)
    return Built(
        bodies.mesh, np.repeat(kind >= lining, bodies.size), {name: count for name, count in counts if count}
    )


def _clear(tube: Mesh, bodies: Bodies) -> Bools:
    """Whether each of the bodies crosses neither the tube nor a body before it that is clear itself."""
    clear = np.ones(len(bodies), np.bool_)
    if not len(bodies):
        return clear
    body = np.repeat(np.arange(-1, len(bodies)), [len(tube), *bodies.size])
    mesh = concatenate([tube, bodies.mesh])
    corners = mesh.vertices[mesh.faces].reshape(-1, 3)
    ids, first = weld(corners, np.zeros(len(corners), np.int64))
    pairs, _ = close_faces(
        grid_cells(corners[first]), ids.reshape(-1, 3), owner=np.zeros(len(mesh), np.int64), body=body
    )
    for one, other in np.unique(body[pairs], axis=0).tolist():
        clear[other] &= one >= 0 and not clear[one]
    return clear


def lamps(table: Structures, k: int) -> Bodies:
    """A row of lamps over the middle of the carriageway."""
    if slopes_across(table, k):
        return Bodies.empty()
    length, width, tall = _LAMP
    stations, _ = stations_every(table, k, spacing=between(_LAMPS, random_shares(table, k, count=5)[4]))
    stations = np.clip(stations, length, max(polylines.length(table.line[k]) - length, length))
    walls = TubeWalls.of(table, k, stations=stations)
    clear = _clear_of_ribs(table, k, stations=stations, reach=length / 2)
    rows = np.flatnonzero(np.isfinite(walls.metres).all(axis=1) & clear)
    across = (np.array(-width / 2), np.array(width / 2))
    feet = walls.rectangles(rows=rows, side=0, along=(-length / 2, length / 2), across=across)
    top = float(table.rise[k]) - UNDER
    return uprights(table, k, feet=feet, low=top - tall, top=top, klass=Class.POLE, material="metal")


def _clear_of_ribs(table: Structures, k: int, *, stations: Float, reach: float) -> Bools:
    """Whether bodies of length ``reach`` at stations (n,) are clear of ribs and portals."""
    form = rib_form(table, k)
    ribs = np.concatenate([stations_every(table, k, spacing=form.spacing)[0], mouths(table, k)])
    room = reach + max(form.width, PORTAL_WIDTH) / 2 + 0.05
    clear: Bools = (np.abs(stations[:, None] - ribs) > room).all(axis=1)
    return clear


def signs(table: Structures, k: int) -> Bodies:
    """Signs of escape routes on both walls, and one across over each niche."""
    stations, _ = stations_every(table, k, spacing=_SIGNS)
    niche_at, niche_side = niche_stations(table, k)
    escape = np.repeat([True, False], [2 * len(stations), len(niche_at)])
    at = np.concatenate([np.repeat(stations, 2), niche_at])
    side = np.concatenate([np.tile([0, 1], len(stations)), niche_side])
    walls = TubeWalls.of(table, k, stations=at)
    away = walls.metres[np.arange(len(at)), side] - GAP
    clear = _clear_of_ribs(table, k, stations=at, reach=0.3) & np.isfinite(away)
    clear &= (np.abs(at[:, None] - niche_at) > NICHE_WIDTH).all(axis=1) | ~escape
    room = table.inner[k].buffer(-GAP / 2, join_style="mitre")
    shapely.prepare(room)
    made = []
    for flat, (thick, wide, tall), low in ((True, _SIGN, 1.0), (False, _SOS, NICHE + 0.3)):
        rows = np.flatnonzero(clear & (escape == flat))
        along, across = (wide / 2, thick) if flat else (thick / 2, wide)
        feet = walls.rectangles(
            rows=rows, side=side[rows], along=(-along, along), across=(away[rows] - across, away[rows])
        )
        feet = feet[room.contains(shapely.polygons(feet))]
        made.append(
            uprights(table, k, feet=feet, low=low, top=low + tall, klass=Class.TRAFFIC_SIGN, material="metal")
        )
    return Bodies.joined(made)


def fans(table: Structures, k: int) -> Bodies:
    """Pairs of jet fans under the ceiling, over the walkways of long tunnels."""
    if place_in_tunnel(table, k)[1] < _FAN_FROM or slopes_across(table, k):
        return Bodies.empty()
    stations, _ = stations_every(table, k, spacing=_FANS)
    clear = _clear_of_ribs(table, k, stations=stations, reach=_FAN_LENGTH / 2)
    spacing = rib_form(table, k).spacing
    # Midway between two ribs there is room for a fan.
    stations = np.where(clear, stations, stations + spacing / 2)
    inside = (stations > _FAN_LENGTH) & (stations < polylines.length(table.line[k]) - _FAN_LENGTH)
    stations = stations[inside & _clear_of_ribs(table, k, stations=stations, reach=_FAN_LENGTH / 2)]
    walls = TubeWalls.of(table, k, stations=stations)
    middle = walls.metres - GAP - _FAN / 2 - 0.05
    rows, side = np.nonzero(np.isfinite(middle))
    middle, half = middle[rows, side], _FAN_LENGTH / 2
    plans = walls.rectangles(
        rows=rows, side=side, along=(-half, half), across=(middle - _FAN / 2, middle + _FAN / 2)
    )
    room = table.inner[k].buffer(-GAP / 2, join_style="mitre")
    fits = room.contains(shapely.polygons(plans))
    rows, side, middle = rows[fits], side[fits], middle[fits]
    ahead = np.array([-half, half])[:, None] * walls.along[rows, None]
    centre = walls.at[rows, None] + ahead + (middle[:, None] * walls.outwards[rows, side])[:, None]
    z = surface_heights(table, k, xy=centre.reshape(-1, 2)).reshape(-1, 2, 1)
    z = z + table.rise[k] - _FAN_DOWN - _FAN / 2
    around = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
    left = walls.outwards[rows, None, None, 0] * _FAN / 2
    xy = centre[:, :, None] + np.cos(around)[:, None] * left
    rings = np.concatenate([xy, (z + np.sin(around) * _FAN / 2)[..., None]], axis=-1)
    caps = np.array([[0, j, j + 1] for j in range(1, 11)])
    return between_rings(table, k, rings=rings, caps=caps, material="metal")


def trays(table: Structures, k: int) -> Bodies:
    """Cable trays along the right wall, between the ribs' insides and the carriageway's clearance."""
    length = polylines.length(table.line[k])
    deep = rib_form(table, k).depth
    width, tall = _TRAY
    stops = np.linspace(0.1, length - 0.1, max(int(length / _TRAY_STEP), 1) + 1)
    walls = TubeWalls.of(table, k, stations=stops)
    away = walls.metres[:, 1] - deep - 3 * GAP
    rings = []
    for low, across in ((-tall, 0.0), (0.0, 0.0), (0.0, width), (-tall, width)):
        xy = walls.at - (away - across)[:, None] * walls.outwards[:, 0]
        z = surface_heights(table, k, xy=np.nan_to_num(xy)) + table.rise[k] - deep - _TRAY_DOWN + low
        rings.append(np.column_stack([xy, z]))
    corners = np.stack(rings, axis=1)  # (stops, 4, 3)
    # A tray ends where the wall does, or leaps.
    whole = np.isfinite(away) & (away > width) & (np.abs(stops[:, None] - mouths(table, k)) > 2.0).all(axis=1)
    joined = whole[:-1] & whole[1:] & (np.abs(np.diff(away)) < width)
    runs = np.split(np.arange(len(stops)), np.flatnonzero(~joined) + 1)
    room = table.inner[k].buffer(-GAP / 2, join_style="mitre")
    out = [Bodies.empty()]
    for run in runs:
        if len(run) < _TRAY_LEAST:
            continue
        plan = shapely.Polygon(np.concatenate([corners[run, 1, :2], corners[run[::-1], 2, :2]]))
        if plan.is_valid and room.contains(plan):
            out.append(swept(table, k, rings=corners[run]))
    return Bodies.joined(out)
