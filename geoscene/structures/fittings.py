"""Bodies on the ground or walls of tunnels: ribs, portals and equipment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely

from geoscene.geometry.intersections import close_faces
from geoscene.geometry.mesh import Mesh, concatenate
from geoscene.geometry.watertight import grid_cells, weld
from geoscene.structures.bodies import Bodies
from geoscene.structures.equipment import fans, lamps, signs, trays
from geoscene.structures.lining import portals, ribs
from geoscene.structures.table import Structures
from geoscene.structures.tubes import has_walkway
from geoscene.typing import Bools


@dataclass(frozen=True, slots=True)
class Fittings:
    """Bodies in a tunnel piece.

    mesh      : of all bodies
    equipment : (m,) bool, faces of lamps, signs, jet fans and cable trays
    counts    : how many there are of each kind
    """

    mesh: Mesh
    equipment: Bools
    counts: dict[str, int]


def tunnel_fittings(
    table: Structures, k: int, *, tube: Mesh, driven: shapely.Geometry, equipment: bool
) -> Fittings:
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
    return Fittings(
        bodies.mesh,
        np.repeat(kind >= lining, bodies.size),
        {name: count for name, count in counts if count},
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
