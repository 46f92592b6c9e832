"""Street furniture of scenes with relief: further mapped kinds, and inferred objects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.buildings.guesses import region_at
from geoscene.classes import Class
from geoscene.geometry.frames import Frame
from geoscene.objects.siting import UNUSABLE, Sites
from geoscene.sources.data import OsmData, Tags
from geoscene.support.columns import Columns
from geoscene.support.splitmix import number_of, uniform_at
from geoscene.tags import parse_number
from geoscene.typing import Bools, Float, Ints

STATION = 12.0
"""Metres along a street between the places where furniture is guessed, on each side."""

_USUAL = {
    "sign_rectangle": 0.12,
    "waste_basket": 0.1,
    "street_cabinet": 0.05,
    "bicycle_stand": 0.04,
    "bench": 0.03,
    "planter": 0.03,
    "poster_box": 0.01,
    "post_box": 0.01,
}
"""Share of the stations with each kind: assumed, about one bin in 60 m of a street, one box in 120 m."""

_AMERICAN = {"hydrant_pillar": 0.08, "parking_meter": 0.06}
"""Kinds that stand on sidewalks in North America."""

_LAMPS = 3
"""Stations from lamp to lamp: 36 m, in turns on one side and the other."""

_KNOWN = 60.0
"""Metres around a mapped object within which none of its kind is guessed."""

_STREETS = frozenset(
    {"primary", "secondary", "tertiary", "unclassified", "residential", "living_street"}
)  # fmt: skip

_SEATED = ("restaurant", "cafe", "bar", "pub", "ice_cream", "biergarten", "fast_food")
_OUTSIDE = 0.3
"""Share of the places to eat that are taken to have tables outside, where the map does not say: assumed."""

_PARASOLS = 0.4
"""Share of them with parasols: assumed."""

_BESIDE = (-3.6, -1.8, 1.8, 3.6)
"""Metres along the front between the door and the tables."""

_WALKED = (Class.SIDEWALK, Class.PAVED, Class.TERRAIN)
"""Ground between a front and a carriageway; where the map has no sidewalk up to the front, it is bare."""

_KERB = 0.5
"""Metres between the kerb and the middle of what stands beside it."""

_REACH = np.arange(1.0, 13.01, 0.5)
"""Metres from a centre line at which its sidewalk is searched for."""

_APART = 2.0
"""Metres that guessed objects keep from each other, and from mapped objects and trees."""

_KINDS = {
    ("amenity", "waste_basket"): "waste_basket",
    ("amenity", "waste_disposal"): "waste_container",
    ("amenity", "bicycle_parking"): "bicycle_stand",
    ("amenity", "post_box"): "post_box",
    ("amenity", "vending_machine"): "vending_machine",
    ("amenity", "parking_meter"): "parking_meter",
    ("amenity", "telephone"): "telephone",
    ("amenity", "drinking_water"): "drinking_fountain",
    ("amenity", "charging_station"): "charging_station",
    ("amenity", "clock"): "clock",
    ("emergency", "phone"): "parking_meter",
    ("emergency", "fire_hydrant"): "hydrant_pillar",
    ("man_made", "street_cabinet"): "street_cabinet",
    ("power", "cable_distribution_cabinet"): "street_cabinet",
    ("man_made", "planter"): "planter",
    ("barrier", "planter"): "planter",
    ("barrier", "block"): "block",
    ("barrier", "jersey_barrier"): "block",
    ("advertising", "column"): "advertising_column",
    ("advertising", "poster_box"): "poster_box",
    ("advertising", "board"): "information_board",
}
_PARKED_INSIDE = ("building", "shed", "lockers", "floor", "two-tier", "informal")


def street_shape(tags: Tags) -> str | None:
    """Name of the shape for a node's tags that only scenes with relief have; None for others."""
    if tags.get("bicycle_parking") in _PARKED_INSIDE or tags.get("indoor") == "yes":
        return None
    if tags.get("amenity") == "recycling":
        return "recycling_container" if tags.get("recycling_type", "container") == "container" else None
    if tags.get("tourism") == "information":
        return "information_board" if tags.get("information") in {"board", "map"} else None
    if tags.get("amenity") == "shelter":
        return "bus_shelter" if tags.get("shelter_type") == "public_transport" else None
    if tags.get("highway") == "bus_stop":
        return "bus_shelter" if tags.get("shelter") == "yes" else "bus_stop"
    if tags.get("amenity") == "bench":
        return "bench_plain" if tags.get("backrest") == "no" else None
    return next((shape for (key, value), shape in _KINDS.items() if tags.get(key) == value), None)


def stands(tags: Tags, *, place: Float, heading: float, most: int) -> Float:
    """Places (k, 2) of the stands of a bicycle parking in a row across the heading, two bicycles each.

    Without a capacity there are four.
    """
    capacity = parse_number(tags.get("capacity"))
    count = 4 if capacity is None else int(np.clip(np.ceil(capacity / 2), 1, most))
    along = (np.arange(count) - (count - 1) / 2) * 0.9
    row: Float = place + along[:, None] * [-np.sin(heading), np.cos(heading)]
    return row


@dataclass(frozen=True, slots=True)
class FurnitureGuesses(Columns):
    """Candidate places of unmapped furniture, before the ground below them is known.

    xy      : (n, 2) on a street's centre line, or the place to eat; scene metres
    toward  : (n, 2) unit vector to the side of the street; zero for tables, which stand where the sidewalk is
    shape   : (n,) str
    draw    : (n,) from 0 to 1; of two that are too near to each other the smaller one stays
    slot    : (n,) int64, which of the tables of a place to eat
    source  : (n,) str: ``guess`` or ``outdoor_seating``
    osm_id  : (n,) str, of the street or the place to eat
    """

    xy: Float
    toward: Float
    shape: NDArray[np.str_]
    draw: Float
    slot: Ints
    source: NDArray[np.str_]
    osm_id: NDArray[np.str_]


def guess_furniture(osm: OsmData, frame: Frame, *, extent: Sequence[float]) -> FurnitureGuesses:
    """Candidate furniture along streets and at restaurants within an extent of a map.

    It is drawn by the OSM id of each street and the place on it, whatever else there is.
    """
    guesses = FurnitureGuesses.concatenate([_beside_streets(osm, frame), _tables(osm, frame)])
    low, high = np.array(extent[:2]), np.array(extent[2:])
    return guesses.take(((guesses.xy >= low) & (guesses.xy < high)).all(axis=1))


def _beside_streets(osm: OsmData, frame: Frame) -> FurnitureGuesses:
    west, south, east, north = osm.bounds
    usual = dict(_USUAL)
    if region_at((west + east) / 2, (south + north) / 2) == "north_america":
        usual |= _AMERICAN
    kinds = np.array([*usual, ""], "U20")
    steps = np.cumsum(list(usual.values()))
    parts = []
    for way in osm.ways:
        if (
            way.tags.get("highway") not in _STREETS
            or len(way.lonlat) < 2
            or way.tags.get("tunnel", "no") != "no"
        ):
            continue
        line = shapely.LineString(np.column_stack(frame.from_geographic(*way.lonlat.T)))
        nth = np.arange(int(line.length / STATION))
        if not len(nth):
            continue
        number = np.full(len(nth), number_of(way.osm_id), np.int64)
        for side in (0, 1):
            draw = uniform_at(number, 2 * nth + side, count=3)
            along = (nth + 0.1 + 0.8 * draw[0]) * STATION
            shape = kinds[np.searchsorted(steps, draw[1], side="right")]
            lamp = (nth + 2 * side) % (2 * _LAMPS) == 0
            if way.tags.get("lit") != "no":
                shape[lamp] = "street_lamp"
            chosen = shape != ""
            a, b = (shapely.get_coordinates(line.interpolate(along[chosen] + d)) for d in (-0.5, 0.5))
            course = b - a
            length = np.hypot(*course.T)
            course = np.divide(course, length[:, None], out=np.zeros_like(course), where=length[:, None] > 0)
            toward = course @ np.array([[0.0, 1.0], [-1.0, 0.0]]) * (1 - 2 * side)
            n = int(chosen.sum())
            parts.append(
                FurnitureGuesses(
                    (a + b) / 2,
                    toward,
                    shape[chosen],
                    draw[2, chosen],
                    np.zeros(n, np.int64),
                    np.full(n, "guess"),
                    np.full(n, way.osm_id),
                )
            )
    return FurnitureGuesses.concatenate([_nothing(), *parts])


def _tables(osm: OsmData, frame: Frame) -> FurnitureGuesses:
    """Four places for tables at each place to eat that has some outside, or may have."""
    parts = []
    for point in osm.points:
        stated = point.tags.get("outdoor_seating", "")
        if point.tags.get("amenity") not in _SEATED or stated == "no":
            continue
        number = np.array([number_of(point.osm_id)])
        draw = uniform_at(number, np.zeros(1, np.int64), count=2)[:, 0]
        if not stated and draw[0] >= _OUTSIDE:
            continue
        n = len(_BESIDE)
        parts.append(
            FurnitureGuesses(
                np.tile(
                    np.column_stack(frame.from_geographic(*np.array([[point.lon], [point.lat]]))), (n, 1)
                ),
                np.zeros((n, 2)),
                np.full(n, "table_parasol" if draw[1] < _PARASOLS else "table"),
                np.full(n, draw[0]),
                np.arange(n),
                np.full(n, "outdoor_seating" if stated else "guess"),
                np.full(n, point.osm_id),
            )
        )
    return FurnitureGuesses.concatenate([_nothing(), *parts])


def _nothing() -> FurnitureGuesses:
    text = np.empty(0, "U1")
    return FurnitureGuesses(
        np.empty((0, 2)), np.empty((0, 2)), text, np.empty(0), np.empty(0, np.int64), text, text
    )


@dataclass(frozen=True, slots=True)
class Taken:
    """Places that guessed furniture keeps away from.

    xy      : (n, 2) of mapped furniture and of trees, scene metres
    shape   : (n,) str, of the furniture, "" for trees
    areas   : shapes of barriers
    """

    xy: Float
    shape: NDArray[np.str_]
    areas: NDArray[np.object_]


def site_guesses(guesses: FurnitureGuesses, sites: Sites, *, taken: Taken) -> tuple[Ints, Float, Float]:
    """Rows (k,) of the guesses that find a place, the places (k, 2), and the headings (k,).

    Beside the kerb of a sidewalk, where it is 1.5 m wide or more and goes on by a metre on both sides; tables
    along the front, where 1.2 m stay free before them. What comes within `_APART` of
    a mapped object, a tree or a barrier is left out, and so is the kind that is mapped within `_KNOWN`.
    """
    rows = _select_unmapped(guesses, taken)
    at_table = ~guesses.toward[rows].any(axis=1)
    beside = _at_kerbs(guesses, sites, rows=rows[~at_table])
    seated = _at_fronts(guesses, sites, rows=rows[at_table])
    row = np.concatenate([beside[0], seated[0]])
    xy = np.concatenate([beside[1], seated[1]])
    heading = np.concatenate([beside[2], seated[2]])
    free = _apart(xy, taken=taken, guesses=guesses.take(row))
    row, xy, heading = row[free], xy[free], heading[free]
    order = np.argsort(row)
    return row[order], xy[order], heading[order]


def _select_unmapped(guesses: FurnitureGuesses, taken: Taken) -> Ints:
    """Rows of the guesses without a mapped object of their kind near them."""
    near = np.zeros(len(guesses), np.bool_)
    for shape in np.unique(taken.shape):
        own = np.flatnonzero(guesses.shape == shape)
        if not shape or not len(own):
            continue
        tree = shapely.STRtree(shapely.points(taken.xy[taken.shape == shape]))
        hit = tree.query(shapely.points(guesses.xy[own]), predicate="dwithin", distance=_KNOWN)[0]
        near[own[hit]] = True
    return np.flatnonzero(~near)


def _at_kerbs(guesses: FurnitureGuesses, sites: Sites, *, rows: Ints) -> tuple[Ints, Float, Float]:
    """Rows with a place beside the kerb, the places, and the headings towards the street."""
    start, toward = guesses.xy[rows], guesses.toward[rows]
    walk = _classes(sites, start[:, None] + _REACH[:, None] * toward[:, None]) == Class.SIDEWALK
    edge = walk[:, 1:] & ~walk[:, :-1]
    found = edge.any(axis=1)
    start, toward, rows = start[found], toward[found], rows[found]
    near = _REACH[edge[found].argmax(axis=1)]
    fine = near[:, None] + np.arange(0.1, 0.55, 0.1)
    on = _classes(sites, start[:, None] + fine[:, :, None] * toward[:, None]) == Class.SIDEWALK
    kerb = np.where(on.any(axis=1), fine[np.arange(len(fine)), on.argmax(axis=1)] - 0.1, near + 0.5)
    place = start + (kerb + _KERB)[:, None] * toward
    course = toward @ np.array([[0.0, -1.0], [1.0, 0.0]])
    probes = [place, place + toward * 0.4, place + toward, place + course, place - course]
    roomy = (_classes(sites, np.stack(probes, axis=1)) == Class.SIDEWALK).all(axis=1)
    heading = np.arctan2(-toward[:, 1], -toward[:, 0])
    along = np.isin(guesses.shape[rows], ("sign_rectangle",))
    heading = np.where(along, heading + np.pi / 2, heading)
    return rows[roomy], place[roomy], heading[roomy]


def _at_fronts(guesses: FurnitureGuesses, sites: Sites, *, rows: Ints) -> tuple[Ints, Float, Float]:
    """Rows of tables beside their building where a sidewalk is near, the places, and headings."""
    start = guesses.xy[rows]
    reach = np.arange(0.0, 18.1, 0.5)
    turn = 2 * np.pi * np.arange(24) / 24
    fan = np.column_stack([np.cos(turn), np.sin(turn)])
    seen = _classes(sites, start[:, None, None] + reach[:, None, None] * fan)  # (n, radius, 24)
    walk = seen == Class.SIDEWALK
    first = np.where(walk.any(axis=1), walk.argmax(axis=1), len(reach))  # (n, 24)
    nth, best = np.arange(len(rows)), first.argmin(axis=1)
    front = (seen != Class.BUILDING_PAD).argmax(axis=1)[nth, best]  # the first step out of the building
    found = (first[nth, best] < len(reach)) & (front > 0)
    rows, start, toward = rows[found], start[found], fan[best[found]]
    aside = toward @ np.array([[0.0, 1.0], [-1.0, 0.0]])
    place = start + (reach[front[found]] + 0.8)[:, None] * toward
    place += np.array(_BESIDE)[guesses.slot[rows]][:, None] * aside
    corners = [place + a * 0.55 * toward + b * 1.0 * aside for a in (-1, 0, 1) for b in (-1, 0, 1)]
    corners += [place + 1.2 * toward, place + 1.8 * toward]
    roomy = np.isin(_classes(sites, np.stack(corners, axis=1)), _WALKED).all(axis=1)
    heading = np.arctan2(toward[:, 1], toward[:, 0])
    return rows[roomy], place[roomy], heading[roomy]


def _classes(sites: Sites, xy: Float) -> NDArray[np.uint8]:
    """Classes of the ground at points (..., 2)."""
    return sites.classes(xy.reshape(-1, 2)).reshape(xy.shape[:-1])


def _apart(xy: Float, *, taken: Taken, guesses: FurnitureGuesses) -> Bools:
    """Whether points (n, 2) keep a distance of `_APART` from objects and from earlier guesses."""
    points, free = shapely.points(xy), np.ones(len(xy), np.bool_)
    stand = shapely.STRtree(shapely.points(taken.xy))
    free[stand.query(points, predicate="dwithin", distance=_APART)[0]] = False
    areas = shapely.STRtree(taken.areas)
    free[areas.query(points, predicate="dwithin", distance=1.0)[0]] = False
    own, other = shapely.STRtree(points).query(points, predicate="dwithin", distance=_APART)
    table = np.char.startswith(guesses.shape, "table")
    together = table[own] & table[other] & (guesses.osm_id[own] == guesses.osm_id[other])
    later = (guesses.draw[own] > guesses.draw[other]) | (
        (guesses.draw[own] == guesses.draw[other]) & (own > other)
    )
    free[own[later & ~together]] = False
    return free


def usable(sites: Sites, xy: Float) -> Bools:
    """Whether points (n, 2) are free for an object."""
    return ~np.isin(sites.classes(xy), UNUSABLE)
