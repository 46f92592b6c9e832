"""What facades depend on besides the walls themselves: styles, neighbours, streets and mapped entrances."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.buildings.facades.styles import Styles, choose_styles
from geoscene.buildings.table import Buildings
from geoscene.columns import Columns
from geoscene.frames import Frame
from geoscene.sources.data import OsmData
from geoscene.typing import Float, Ints

_ON_OUTLINE = 0.5
"""Metres from an outline within which an entrance belongs to it."""

_NOT_DOORS = ("no", "emergency", "exit;emergency")


@dataclass(frozen=True, slots=True)
class Entrances(Columns):
    """Mapped entrances on the outlines of buildings, sorted by building and id.

    building : (e,) int64 row of the table
    xy       : (e, 2) scene metres
    kind     : (e,) str, value of ``entrance``
    """

    building: Ints
    xy: Float
    kind: NDArray[np.object_]


@dataclass(frozen=True, slots=True)
class Setting:
    """Map-wide data for the facades of any tile; no tile depends on its neighbours being built.

    buildings : the table
    styles    : facade of each of its rows
    solid     : index of the footprints that are built
    rows      : row of the table of each of them
    streets   : index of the centre lines of drivable roads
    entrances : mapped entrances
    """

    buildings: Buildings
    styles: Styles
    solid: shapely.STRtree
    rows: Ints
    streets: shapely.STRtree
    entrances: Entrances

    @property
    def source(self) -> NDArray[np.object_]:
        """(n,) str, ``tag`` where the map has storeys, entrances or balconies, else ``guess``."""
        own = self.buildings.outline
        tagged = self.styles.tagged | self.styles.balcony_tagged | np.isin(own, self.entrances.building)
        return np.where(tagged, "tag", "guess").astype(object)


def read_setting(
    osm: OsmData, frame: Frame, *, buildings: Buildings, streets: NDArray[np.object_]
) -> Setting:
    """The setting of all facades of a map.

    streets : (m,) centre lines of drivable roads, scene metres
    """
    named = set(buildings.osm_id[: buildings.count].tolist())
    tags = {area.osm_id: area.tags for area in osm.areas if area.osm_id in named}
    rows = np.flatnonzero(buildings.drawn)
    return Setting(
        buildings,
        choose_styles(buildings, tags),
        shapely.STRtree(buildings.footprint[rows]),
        rows,
        shapely.STRtree(streets),
        _entrances(osm, frame, buildings=buildings),
    )


def _entrances(osm: OsmData, frame: Frame, *, buildings: Buildings) -> Entrances:
    points = [p for p in osm.points if p.tags.get("entrance", "no") not in _NOT_DOORS]
    points.sort(key=lambda p: p.osm_id)
    lon, lat = np.array([p.lon for p in points], float), np.array([p.lat for p in points], float)
    xy = np.column_stack(frame.from_geographic(lon, lat)).reshape(-1, 2)
    outlines = shapely.boundary(buildings.footprint[: buildings.count])
    at, row = shapely.STRtree(outlines).query(shapely.points(xy), predicate="dwithin", distance=_ON_OUTLINE)
    away = shapely.distance(shapely.points(xy[at]), outlines[row])
    order = np.lexsort((row, away, at))
    at, row = at[order], row[order]
    nearest = np.flatnonzero(np.diff(at, prepend=-1))
    at, row = at[nearest], row[nearest].astype(np.int64)
    kinds = np.array([points[k].tags["entrance"] for k in at.tolist()], object)
    found = Entrances(row, xy[at], kinds)
    return found.take(np.argsort(row, kind="stable"))
