"""Bodies that stand or hang in tunnels: ribs, portals and equipment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geoscene.intersections import close_faces
from geoscene.mesh import Mesh, concatenate
from geoscene.structures.equipment import fans, lamps, signs, trays
from geoscene.structures.lining import portals, ribs
from geoscene.structures.table import Structures
from geoscene.structures.tubes import has_walkway
from geoscene.typing import Bools
from geoscene.watertight import grid_cells, weld

_LINING = {"portals": portals, "ribs": ribs}
"""Makers of the bodies that tunnels have without equipment, too."""


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


def tunnel_fittings(table: Structures, k: int, *, tube: Mesh, equipment: bool) -> Fittings:
    """Ribs and portals of tunnel piece ``k``, with ``equipment`` also lamps, signs, jet fans and cable trays.

    tube : the piece's own solid; what would cross it, or something before it in this order, is left out
    """
    makers = dict(_LINING)
    if equipment and has_walkway(table, k):
        makers |= {"lamps": lamps, "signs": signs, "fans": fans, "cable_trays": trays}
    bodies, kinds = list[Mesh](), list[str]()
    for kind, make in makers.items():
        made = make(table, k)
        bodies += made
        kinds += [kind] * len(made)
    clear = _clear(tube, bodies)
    kept = [row for row, free in enumerate(clear.tolist()) if free]
    kinds = [kinds[row] for row in kept]
    sizes = [len(bodies[row]) for row in kept]
    return Fittings(
        concatenate([bodies[row] for row in kept]),
        np.repeat([kind not in _LINING for kind in kinds], sizes).astype(np.bool_),
        {kind: kinds.count(kind) for kind in makers if kind in kinds},
    )


def _clear(tube: Mesh, bodies: list[Mesh]) -> Bools:
    """Whether each of the bodies crosses neither the tube nor a body before it that is clear itself."""
    clear = np.ones(len(bodies), np.bool_)
    if not bodies:
        return clear
    body = np.repeat(np.arange(-1, len(bodies)), [len(tube), *(len(mesh) for mesh in bodies)])
    mesh = concatenate([tube, *bodies])
    corners = mesh.vertices[mesh.faces].reshape(-1, 3)
    ids, first = weld(corners, np.zeros(len(corners), np.int64))
    pairs, _ = close_faces(
        grid_cells(corners[first]), ids.reshape(-1, 3), owner=np.zeros(len(mesh), np.int64), body=body
    )
    for one, other in np.unique(body[pairs], axis=0).tolist():
        clear[other] &= one >= 0 and not clear[one]
    return clear
