"""Unions of the pieces of a building, on the grid, without edges of four faces."""

from __future__ import annotations

from typing import Any

import manifold3d as m3
import numpy as np

from geoscene.buildings.footprints import to_grid
from geoscene.buildings.shells import Triangles
from geoscene.mesh import WALL
from geoscene.typing import Float, Ints
from geoscene.watertight import degenerate_faces, edge_uses, weld

GROOVES = (2e-3, 2e-2, 1e-1)
"""Sizes of the groove that separates two bodies of a building which share only an edge, metres. The next size
is tried where the grid closes the groove again (thin wedges); if none works, beads of these sizes join the
bodies."""


def unite(shells: Triangles) -> tuple[Triangles, str] | None:
    """The union of the closed shells of one building, and a note on grooves or beads; None if it fails.

    Faces keep their piece and surface.
    """
    pieces = np.unique(shells.piece)
    first = m3.Manifold.reserve_ids(4 * len(pieces))
    # boolean operations lose digits far from the origin, so coordinates are relative to a corner
    origin = to_grid(shells.corners.reshape(-1, 3).min(axis=0))
    bodies = [_manifold(shells, piece, first=first + 4 * k, origin=origin) for k, piece in enumerate(pieces)]
    if any(body is None for body in bodies):
        return None
    union = m3.Manifold.batch_boolean(bodies, m3.OpType.Add)
    for operation, what in ((m3.OpType.Subtract, "parted by grooves"), (m3.OpType.Add, "joined by beads")):
        body, note = union, ""
        for reach in (*GROOVES, None):
            if body.status() != m3.Error.NoError or body.is_empty():
                return None
            corners, run = _triangles(body, first)
            seams = _non_manifold_edges(corners)
            if not len(seams):
                known = (run >= 0) & (run < 4 * len(pieces))
                piece = pieces[np.where(known, run // 4, 0)]
                surface = np.where(known, run % 4, WALL).astype(np.uint8)
                return Triangles(to_grid(corners + origin), piece, surface), note
            if reach is None:
                break
            note = f"{len(seams)} edges where bodies only touched, {what} of {1e3 * reach:.0f} mm"
            about = [_cutter(a, b, reach=reach) for a, b in seams]
            body = m3.Manifold.batch_boolean([body, *about], operation)
    return None


def _manifold(shells: Triangles, piece: int, *, first: int, origin: Float) -> Any:
    """One piece as a manifold whose faces have the id ``first`` plus surface; None if it is not a solid."""
    mine = shells.take(shells.piece == piece)
    order = np.argsort(mine.surface, kind="stable")
    corners, surface = mine.corners[order].reshape(-1, 3) - origin, mine.surface[order]
    ids, where = weld(corners, np.zeros(len(corners), np.int64))
    kinds, starts = np.unique(surface, return_index=True)
    mesh = m3.Mesh64(
        vert_properties=np.ascontiguousarray(corners[where]),
        tri_verts=np.ascontiguousarray(ids.reshape(-1, 3).astype(np.uint64)),
        run_index=(3 * np.r_[starts, len(surface)]).astype(np.uint64),
        run_original_id=first + kinds.astype(np.uint32),
    )
    body = m3.Manifold(mesh)
    return body if body.status() == m3.Error.NoError and not body.is_empty() else None


def _triangles(body: Any, first: int) -> tuple[Float, Ints]:
    """Corners (m, 3, 3) of a body's triangles, repaired on the grid, and their ids minus ``first``."""
    mesh = body.to_mesh64()
    faces = mesh.tri_verts.astype(np.int64)
    run = np.repeat(np.asarray(mesh.run_original_id, np.int64), np.diff(mesh.run_index) // 3) - first
    points = to_grid(mesh.vert_properties[:, :3])
    ids, where = weld(points, np.zeros(len(points), np.int64))
    return repair(points[where], ids[faces], run=run)


def repair(points: Float, faces: Ints, *, run: Ints) -> tuple[Float, Ints]:
    """Corners (m, 3, 3) and ids of triangles, without those that rounding has made degenerate.

    Faces with two equal corners are removed; faces with three collinear corners are merged into the neighbour
    at their longest edge. A closed surface stays closed.
    """
    distinct = (faces != np.roll(faces, -1, axis=1)).all(axis=1)
    faces, run = _cancel(faces[distinct], run[distinct])
    for _ in range(64):
        flat = np.flatnonzero(degenerate_faces(points, faces))
        if not len(flat):
            break
        faces, run = _cancel(*_split_flat_face(points, faces, run=run, flat=int(flat[0])))
    return points[faces], run


def _cancel(faces: Ints, run: Ints) -> tuple[Ints, Ints]:
    """Faces without pairs that have the same three vertices in opposite order and so enclose no volume."""
    turned = np.take_along_axis(faces, (np.argmin(faces, axis=1)[:, None] + np.arange(3)) % 3, axis=1)
    key = {tuple(f): i for i, f in enumerate(turned.tolist())}
    gone = [i for (a, b, c), i in key.items() if (a, c, b) in key]
    keep = np.ones(len(faces), np.bool_)
    keep[gone] = False
    return faces[keep], run[keep]


def _split_flat_face(points: Float, faces: Ints, *, run: Ints, flat: int) -> tuple[Ints, Ints]:
    """Faces without the collinear face ``flat``: its middle corner splits the face at its longest edge."""
    corners = faces[flat]
    length = np.linalg.norm(points[np.roll(corners, -1)] - points[corners], axis=1)
    k = int(np.argmax(length))
    a, b, middle = corners[k], corners[(k + 1) % 3], corners[(k + 2) % 3]
    other = np.flatnonzero(((faces == b) & (np.roll(faces, -1, axis=1) == a)).any(axis=1))
    if not len(other):
        return np.delete(faces, flat, axis=0), np.delete(run, flat)
    beyond = int(other[0])
    apex = int(faces[beyond][(faces[beyond] != a) & (faces[beyond] != b)][0])
    out, runs = faces.copy(), run.copy()
    out[beyond] = (b, middle, apex)
    out[flat] = (middle, a, apex)
    runs[flat] = run[beyond]
    return out, runs


def _non_manifold_edges(corners: Float) -> Float:
    """Edges (k, 2, 3) shared by more than two triangles."""
    flat = corners.reshape(-1, 3)
    ids, where = weld(flat, np.zeros(len(flat), np.int64))
    faces = ids.reshape(-1, 3)
    edge, uses, _ = edge_uses(faces)
    crowded = np.flatnonzero(uses > 2)
    half = np.full(len(uses), -1)
    half[edge[::-1]] = np.arange(len(edge))[::-1]
    chosen = half[crowded]
    face, k = chosen // 3, chosen % 3
    points = flat[where]
    return np.stack([points[faces[face, k]], points[faces[face, (k + 1) % 3]]], axis=1)


def _cutter(a: Float, b: Float, *, reach: float) -> Any:
    """A convex body around an edge, ``reach`` metres larger on all sides."""
    # rotated, so that none of its faces is coplanar with one of the building
    turn = np.array([[0.936, -0.275, 0.218], [0.290, 0.956, -0.036], [-0.199, 0.097, 0.975]])
    star = np.vstack([turn, -turn]) * reach
    return m3.Manifold.hull_points(np.vstack([a + star, b + star]))
