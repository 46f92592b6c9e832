"""Equipment of road tunnels: lamps, signs, jet fans and cable trays."""

from __future__ import annotations

import numpy as np
import shapely

from geoscene import polylines
from geoscene.classes import Class
from geoscene.mesh import Mesh
from geoscene.structures.bodies import body, swept, upright
from geoscene.structures.heights import slopes_across, surface_heights
from geoscene.structures.lining import (
    GAP,
    NICHE,
    NICHE_WIDTH,
    PORTAL_WIDTH,
    UNDER,
    niche_stations,
    rib_form,
)
from geoscene.structures.table import Structures
from geoscene.structures.tubes import (
    Walls,
    between,
    mouths,
    place_in_tunnel,
    random_shares,
    rectangle,
    stations_every,
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


def lamps(table: Structures, k: int) -> list[Mesh]:
    """A row of lamps over the middle of the carriageway."""
    if slopes_across(table, k):
        return []
    length, width, tall = _LAMP
    stations, _ = stations_every(table, k, spacing=between(_LAMPS, random_shares(table, k, count=5)[4]))
    stations = np.clip(stations, length, max(polylines.length(table.line[k]) - length, length))
    walls = Walls.of(table, k, stations=stations)
    clear = _clear_of_ribs(table, k, stations=stations, reach=length / 2)
    out = []
    for row in np.flatnonzero(np.isfinite(walls.metres).all(axis=1) & clear).tolist():
        foot = shapely.get_coordinates(
            rectangle(walls, row, side=0, along=(-length / 2, length / 2), across=(-width / 2, width / 2))
        )[:4]
        top = float(table.rise[k]) - UNDER
        out.append(upright(table, k, foot=foot, low=top - tall, top=top, klass=Class.POLE, material="metal"))
    return out


def _clear_of_ribs(table: Structures, k: int, *, stations: Float, reach: float) -> Bools:
    """Whether bodies that reach so far along the line from stations (n,) stand clear of ribs and portals."""
    form = rib_form(table, k)
    ribs = np.concatenate([stations_every(table, k, spacing=form.spacing)[0], mouths(table, k)])
    room = reach + max(form.width, PORTAL_WIDTH) / 2 + 0.05
    clear: Bools = (np.abs(stations[:, None] - ribs) > room).all(axis=1)
    return clear


def signs(table: Structures, k: int) -> list[Mesh]:
    """Signs of escape routes on both walls, and one across over each niche."""
    stations, _ = stations_every(table, k, spacing=_SIGNS)
    niche_at, niche_side = niche_stations(table, k)
    signs = [(float(s), side, _SIGN, 1.0, True) for s in stations for side in (0, 1)]
    signs += [
        (float(s), int(side), _SOS, NICHE + 0.3, False) for s, side in zip(niche_at, niche_side, strict=True)
    ]
    if not signs:
        return []
    at = np.array([sign[0] for sign in signs])
    walls = Walls.of(table, k, stations=at)
    clear = _clear_of_ribs(table, k, stations=at, reach=0.3) & np.isfinite(
        walls.metres[np.arange(len(at)), [sign[1] for sign in signs]]
    )
    clear &= (np.abs(at[:, None] - niche_at) > NICHE_WIDTH).all(axis=1) | (
        np.arange(len(at)) >= 2 * len(stations)
    )
    room = table.inner[k].buffer(-GAP / 2, join_style="mitre")
    out = []
    for row in np.flatnonzero(clear).tolist():
        _, side, (thick, wide, tall), low, flat = signs[row]
        away = walls.metres[row, side] - GAP
        along, across = (wide / 2, thick) if flat else (thick / 2, wide)
        foot = rectangle(walls, row, side=side, along=(-along, along), across=(away - across, away))
        if room.contains(foot):
            corners = shapely.get_coordinates(foot)[:4]
            out.append(
                upright(
                    table,
                    k,
                    foot=corners,
                    low=low,
                    top=low + tall,
                    klass=Class.TRAFFIC_SIGN,
                    material="metal",
                )
            )
    return out


def fans(table: Structures, k: int) -> list[Mesh]:
    """Pairs of jet fans under the ceiling, over the walkways of long tunnels."""
    if place_in_tunnel(table, k)[1] < _FAN_FROM or slopes_across(table, k):
        return []
    stations, _ = stations_every(table, k, spacing=_FANS)
    clear = _clear_of_ribs(table, k, stations=stations, reach=_FAN_LENGTH / 2)
    spacing = rib_form(table, k).spacing
    # Midway between two ribs there is room for a fan.
    stations = np.where(clear, stations, stations + spacing / 2)
    inside = (stations > _FAN_LENGTH) & (stations < polylines.length(table.line[k]) - _FAN_LENGTH)
    stations = stations[inside & _clear_of_ribs(table, k, stations=stations, reach=_FAN_LENGTH / 2)]
    walls = Walls.of(table, k, stations=stations)
    around = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
    caps = np.array([[0, j, j + 1] for j in range(1, 11)])
    room = table.inner[k].buffer(-GAP / 2, join_style="mitre")
    out = []
    for row in range(len(stations)):
        for side, sign in ((0, 1.0), (1, -1.0)):
            middle = walls.metres[row, side] - GAP - _FAN / 2 - 0.05
            if np.isnan(middle):
                continue
            half = _FAN_LENGTH / 2
            plan = rectangle(
                walls, row, side=side, along=(-half, half), across=(middle - _FAN / 2, middle + _FAN / 2)
            )
            if not room.contains(plan):
                continue
            rings = []
            for ahead in (-half, half):
                centre = walls.at[row] + ahead * walls.along[row] + sign * middle * walls.left(row)
                z = (
                    float(surface_heights(table, k, xy=centre[None])[0])
                    + table.rise[k]
                    - _FAN_DOWN
                    - _FAN / 2
                )
                left = walls.left(row) * _FAN / 2
                rings.append(
                    np.column_stack([centre + np.cos(around)[:, None] * left, z + np.sin(around) * _FAN / 2])
                )
            out.append(body(table, k, rings=rings, caps=caps, material="metal"))
    return out


def trays(table: Structures, k: int) -> list[Mesh]:
    """Cable trays along the right wall, between the ribs' insides and the carriageway's clearance."""
    length = polylines.length(table.line[k])
    deep = rib_form(table, k).depth
    width, tall = _TRAY
    stops = np.linspace(0.1, length - 0.1, max(int(length / _TRAY_STEP), 1) + 1)
    walls = Walls.of(table, k, stations=stops)
    away = walls.metres[:, 1] - deep - 3 * GAP
    rings = []
    for low, across in ((-tall, 0.0), (0.0, 0.0), (0.0, width), (-tall, width)):
        xy = walls.at - (away - across)[:, None] * walls.left()
        z = surface_heights(table, k, xy=np.nan_to_num(xy)) + table.rise[k] - deep - _TRAY_DOWN + low
        rings.append(np.column_stack([xy, z]))
    corners = np.stack(rings, axis=1)  # (stops, 4, 3)
    # A tray ends where the wall does, or leaps.
    whole = np.isfinite(away) & (away > width) & (np.abs(stops[:, None] - mouths(table, k)) > 2.0).all(axis=1)
    joined = whole[:-1] & whole[1:] & (np.abs(np.diff(away)) < width)
    runs = np.split(np.arange(len(stops)), np.flatnonzero(~joined) + 1)
    room = table.inner[k].buffer(-GAP / 2, join_style="mitre")
    out = []
    for run in runs:
        if len(run) < _TRAY_LEAST:
            continue
        plan = shapely.Polygon(np.concatenate([corners[run, 1, :2], corners[run[::-1], 2, :2]]))
        if plan.is_valid and room.contains(plan):
            out.append(swept(table, k, rings=corners[run]))
    return out
