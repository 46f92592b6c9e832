"""The drivable road graph as columns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class RoadGraph:
    """Directed drivable graph; one row an edge, two-way streets are two edges.

    node_id  : (n,) int64 OSM node ids
    node_xyz : (n, 3) float64, scene frame, metres
    tail, head : (m,) int32 node indices: traffic runs from tail to head
    geometry : (m,) object, each (k, 3) float64 centre line of the carriageway from tail to head, scene frame
    length   : (m,) float64, true metres
    speed    : (m,) float64, speed limit in m/s
    speed_source : (m,) str: ``maxspeed`` or ``default``
    lanes    : (m,) float64, lanes in this direction
    lanes_source : (m,) str
    width    : (m,) float64, metres of the whole carriageway (both directions)
    width_source : (m,) str
    oneway   : (m,) bool
    layer    : (m,) int8
    bridge, tunnel : (m,) bool
    highway  : (m,) str
    name     : (m,) str, "" if none
    osm_id   : (m,) str, ``way/123``
    """

    node_id: NDArray[np.int64]
    node_xyz: Float
    tail: NDArray[np.int32]
    head: NDArray[np.int32]
    geometry: NDArray[np.object_]
    length: Float
    speed: Float
    speed_source: NDArray[np.str_]
    lanes: Float
    lanes_source: NDArray[np.str_]
    width: Float
    width_source: NDArray[np.str_]
    oneway: NDArray[np.bool_]
    layer: NDArray[np.int8]
    bridge: NDArray[np.bool_]
    tunnel: NDArray[np.bool_]
    highway: NDArray[np.str_]
    name: NDArray[np.str_]
    osm_id: NDArray[np.str_]
