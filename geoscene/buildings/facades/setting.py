"""Inputs of facades besides the walls: styles, neighbours, streets and mapped entrances."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.buildings.facades.styles import Styles, choose_styles
from geoscene.buildings.table import Buildings
from geoscene.geometry.frames import Frame
from geoscene.sources.data import OsmData, TaggedNode, Tags
from geoscene.support.columns import Columns
from geoscene.tags import first_value, parse_length
from geoscene.typing import Float, Ints

_ON_OUTLINE = 0.5
"""Metres from an outline within which an entrance belongs to it."""

_NOT_DOORS = ("no", "emergency", "exit;emergency")

_NARROWEST_GATE = 2.0
"""Metres of a mapped width from which a door is a gate; assumed."""

_SIZES = ((0.6, 6.0), (1.6, 6.0))
"""Least and greatest width and height of doors, metres; other mapped values are taken for errors."""

_SERVED = frozenset(["restaurant", "cafe", "bar", "pub", "fast_food", "ice_cream", "bank", "pharmacy"])
"""Values of ``amenity`` of places that have shop windows."""

_GROUND_FLOORS = ("", "0", "eg")
"""Values of ``level`` of places on the ground floor."""


@dataclass(frozen=True, slots=True)
class Entrances(Columns):
    """Mapped entrances on the outlines of buildings, sorted by building and id.

    building : (e,) int64 row of the table
    xy       : (e, 2) scene metres
    kind     : (e,) str, value of ``entrance``; ``garage`` for wide doors and those that open overhead
    size     : (e, 2) mapped width and height, metres, NaN where they are not mapped
    """

    building: Ints
    xy: Float
    kind: NDArray[np.object_]
    size: Float


@dataclass(frozen=True, slots=True)
class Shops(Columns):
    """Mapped places with shop windows on the ground floors of buildings, sorted by building and id.

    building : (s,) int64 row of the table
    xy       : (s, 2) scene metres
    """

    building: Ints
    xy: Float


@dataclass(frozen=True, slots=True)
class FacadeSetting:
    """Map-wide data for the facades of any tile; no tile depends on its neighbours being built.

    buildings : the table
    styles    : facade of each of its rows
    solid     : index of the footprints that are built
    rows      : row of the table of each of them
    streets   : index of the centre lines of drivable roads and of pedestrian streets
    entrances : mapped entrances
    shops     : mapped places with shop windows
    """

    buildings: Buildings
    styles: Styles
    solid: shapely.STRtree
    rows: Ints
    streets: shapely.STRtree
    entrances: Entrances
    shops: Shops

    @property
    def source(self) -> NDArray[np.object_]:
        """(n,) str, ``tag`` where the map has storeys, entrances, shops or balconies, else ``guess``."""
        own = self.buildings.outline
        tagged = self.styles.tagged | self.styles.balcony_tagged | self.styles.shop_tagged
        tagged |= np.isin(own, self.entrances.building) | np.isin(own, self.shops.building)
        return np.where(tagged, "tag", "guess").astype(object)


def read_setting(
    osm: OsmData, frame: Frame, *, buildings: Buildings, streets: NDArray[np.object_]
) -> FacadeSetting:
    """The setting of all facades of a map.

    streets : (m,) centre lines of drivable roads, scene metres; pedestrian streets are added
    """
    named = set(buildings.osm_id[: buildings.count].tolist())
    tags = {area.osm_id: area.tags for area in osm.areas if area.osm_id in named}
    rows = np.flatnonzero(buildings.drawn)
    return FacadeSetting(
        buildings,
        choose_styles(buildings, tags),
        shapely.STRtree(buildings.footprint[rows]),
        rows,
        shapely.STRtree(np.concatenate([streets, _pedestrian_streets(osm, frame)])),
        _entrances(osm, frame, buildings=buildings),
        _shops(osm, frame, buildings=buildings),
    )


def _pedestrian_streets(osm: OsmData, frame: Frame) -> NDArray[np.object_]:
    """Lines (p,) of streets without traffic, which houses and shops face all the same."""
    ways = [way for way in osm.ways if way.tags.get("highway") == "pedestrian" and len(way.lonlat) > 1]
    lines = [shapely.LineString(np.column_stack(frame.from_geographic(*way.lonlat.T))) for way in ways]
    return np.fromiter(lines, object, len(lines))


def _places(points: list[TaggedNode], frame: Frame) -> Float:
    """Scene coordinates (n, 2) of points."""
    lon, lat = np.array([p.lon for p in points], float), np.array([p.lat for p in points], float)
    return np.column_stack(frame.from_geographic(lon, lat)).reshape(-1, 2)


def _entrances(osm: OsmData, frame: Frame, *, buildings: Buildings) -> Entrances:
    points = sorted((p for p in osm.points if _is_entrance(p.tags)), key=lambda p: p.osm_id)
    xy = _places(points, frame)
    outlines = shapely.boundary(buildings.footprint[: buildings.count])
    at, row = shapely.STRtree(outlines).query(shapely.points(xy), predicate="dwithin", distance=_ON_OUTLINE)
    away = shapely.distance(shapely.points(xy[at]), outlines[row])
    order = np.lexsort((row, away, at))
    at, row = at[order], row[order]
    nearest = np.flatnonzero(np.diff(at, prepend=-1))
    at, row = at[nearest], row[nearest].astype(np.int64)
    tags = [points[k].tags for k in at.tolist()]
    size = np.array([_size(some) for some in tags], float).reshape(-1, 2)
    kinds = [_kind(some, width=width) for some, width in zip(tags, size[:, 0].tolist(), strict=True)]
    found = Entrances(row, xy[at], np.array(kinds, object), size)
    return found.take(np.argsort(row, kind="stable"))


def _is_entrance(tags: Tags) -> bool:
    """Whether a node is an entrance, or a door that people can use from outside."""
    if "entrance" in tags:
        return tags["entrance"] not in _NOT_DOORS
    return tags.get("door", "no") != "no" and not {"indoor", "room"} & set(tags)


def _size(tags: Tags) -> list[float]:
    """Mapped width and height of an entrance; NaN for sizes that no door has."""
    out = []
    for name, (least, most) in zip(("width", "height"), _SIZES, strict=True):
        value = parse_length(tags.get(f"door:{name}", tags.get(f"entrance:{name}", tags.get(name))))
        out.append(value if value is not None and least <= value <= most else np.nan)
    return out


def _kind(tags: Tags, *, width: float) -> str:
    if tags.get("door") in ("overhead", "roller") or width >= _NARROWEST_GATE:
        return "garage"
    return tags.get("entrance", "yes")


def _shops(osm: OsmData, frame: Frame, *, buildings: Buildings) -> Shops:
    points = sorted((p for p in osm.points if _is_shop(p.tags)), key=lambda p: p.osm_id)
    xy = _places(points, frame)
    at, row = shapely.STRtree(buildings.footprint[: buildings.count]).query(
        shapely.points(xy), predicate="intersects"
    )
    first = np.flatnonzero(np.diff(at[np.lexsort((row, at))], prepend=-1))
    order = np.lexsort((row, at))[first]
    at, row = at[order], row[order].astype(np.int64)
    return Shops(row, xy[at]).take(np.argsort(row, kind="stable"))


def _is_shop(tags: Tags) -> bool:
    """Whether a node is a place on the ground floor that has shop windows."""
    known = tags.get("shop", "no") != "no" or tags.get("entrance") == "shop"
    known = known or first_value(tags.get("amenity", "")) in _SERVED
    return known and tags.get("level", "").lower() in _GROUND_FLOORS
