"""Kerbs that the map describes, and where raised sidewalks end."""

from __future__ import annotations

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.geometry import polylines
from geoscene.geometry.frames import Frame
from geoscene.ground.kerbs import MappedKerbs
from geoscene.roadgraph.carriageways import KERB, Carriageways
from geoscene.sources.data import OsmData

_KINDS = {"raised": "raised", "yes": "raised", "lowered": "lowered", "rolled": "lowered"} | dict.fromkeys(
    ("flush", "no"), "flush"
)


def mapped_kerbs(osm: OsmData, frame: Frame) -> MappedKerbs:
    """The nodes with a tag ``kerb`` (raised, lowered, rolled, flush or no)."""
    points = [point for point in osm.points if point.tags.get("kerb") in _KINDS]
    if not points:
        return MappedKerbs.empty()
    x, y = frame.from_geographic([point.lon for point in points], [point.lat for point in points])
    return MappedKerbs(
        shapely.points(np.column_stack([x, y])),
        np.array([_KINDS[point.tags["kerb"]] for point in points], "U8"),
        np.array([point.tags.get("highway") == "crossing" for point in points], np.bool_),
    )


def sidewalk_ends(roads: Carriageways) -> NDArray[np.object_]:
    """Lines (n,) across carriageways on the ground, sidewalks included, where bridges and tunnels begin."""
    place = roads.place
    mouth = np.zeros(len(roads.node_xy), np.bool_)
    mouth[roads.ends[place != 0]] = True
    road, end = np.nonzero(mouth[roads.ends] & (place == 0)[:, None])
    along = np.where(end == 0, 0.0, shapely.length(roads.line[road]))
    ahead = polylines.directions(roads.line[road], along, reach=1.0)
    across = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
    half = roads.width[road] / 2 + KERB + roads.walk[road].max(axis=1, initial=0.0)
    node = roads.node_xy[roads.ends[road, end]]
    ends = np.stack([node - half[:, None] * across, node + half[:, None] * across], axis=1)
    return np.asarray(shapely.linestrings(ends), object) if len(ends) else np.empty(0, object)
