"""Layers of the ground: polygons with a class, a material and a priority, as columns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray

from geoscene.classes import Class, materials
from geoscene.errors import InputError
from geoscene.support.columns import Columns
from geoscene.typing import Float

LANDCOVER, ROADS, PADS = 0.0, 100.0, 200.0
"""Lowest priorities of land cover, of road surfaces and of building pads."""

SIDEWALKS, SIDEWALK_ENDS = 112.0, 112.25
"""Priorities of the sidewalks of carriageways, and of their ends before bridges and tunnels."""

KERBS, KERB_ENDS, RAMPS, LOWERED, FLUSH, RAISED = 120.0, 120.25, 120.5, 121.0, 121.25, 121.5
"""Priorities of kerbs: of carriageways, of ends before bridges and tunnels, of kerbs that come down, and of
those that are lowered, flush, or mapped as raised."""

PATCHES, COVERS, GULLIES = 152.0, 172.0, 172.5
"""Priorities of patches in carriageways, which crossings and paint cover, of manhole covers and gullies."""


@dataclass(frozen=True, slots=True)
class Layers(Columns):
    """Polygons that compete for the ground; where two overlap the higher priority wins, then the earlier row.

    polygon  : (n,) object, shapely Polygon or MultiPolygon, scene metres
    klass    : (n,) uint8, `geoscene.classes.Class`
    material : (n,) uint8, code of `geoscene.classes.materials`
    priority : (n,) float64
    osm_id   : (n,) str, "" for none
    source   : (n,) str, origin of class, material and shape: ``tags``, ``surface`` (material from the
               tag), ``width`` (a line with its mapped width), ``default-width`` (a line with an assumed one),
               ``coastline``, ``assumed`` (the material) and others that begin so (all of it)
    body     : (n,) str: kind of water, which decides its level: ``sea``, ``standing``, ``river``; else ""
    feature  : (n,) int32 feature number, -1 for none
    """

    polygon: NDArray[np.object_]
    klass: NDArray[np.uint8]
    material: NDArray[np.uint8]
    priority: Float
    osm_id: NDArray[np.str_]
    source: NDArray[np.str_]
    body: NDArray[np.str_]
    feature: NDArray[np.int32]

    def __post_init__(self) -> None:
        """Raise InputError if columns differ in length."""
        lengths = {f.name: len(getattr(self, f.name)) for f in fields(self)}
        if len(set(lengths.values())) > 1:
            raise InputError(f"layer columns differ in length: {lengths}")

    @classmethod
    def of(
        cls,
        polygon: Sequence[object] | NDArray[np.object_],
        *,
        klass: ArrayLike,
        material: ArrayLike,
        priority: ArrayLike,
        osm_id: ArrayLike = "",
        source: ArrayLike = "tags",
        body: ArrayLike = "",
        feature: ArrayLike = -1,
    ) -> Layers:
        """Layers of polygons; every other column is broadcast over them."""
        column = np.fromiter(polygon, object)
        n = (len(column),)
        return cls(
            column,
            np.broadcast_to(np.asarray(klass, np.uint8), n).copy(),
            np.broadcast_to(np.asarray(material, np.uint8), n).copy(),
            np.broadcast_to(np.asarray(priority, np.float64), n).copy(),
            np.broadcast_to(np.asarray(osm_id, np.str_), n).copy(),
            np.broadcast_to(np.asarray(source, np.str_), n).copy(),
            np.broadcast_to(np.asarray(body, np.str_), n).copy(),
            np.broadcast_to(np.asarray(feature, np.int32), n).copy(),
        )

    @classmethod
    def empty(cls) -> Layers:
        """No polygons."""
        return cls.of([], klass=0, material=0, priority=0.0)


def building_pads(
    footprints: Sequence[object] | NDArray[np.object_], *, osm_id: ArrayLike = "", feature: ArrayLike = -1
) -> Layers:
    """The ground under buildings: one pad per footprint (scene metres), above all other layers.

    Footprints that are None, empty or without area make an empty row, so rows stay aligned with buildings.
    """
    return Layers.of(
        [shapely.Polygon() if f is None else f for f in footprints],
        klass=Class.BUILDING_PAD,
        material=materials()["concrete"].code,
        priority=PADS,
        osm_id=osm_id,
        feature=feature,
    )
