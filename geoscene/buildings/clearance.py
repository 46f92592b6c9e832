"""Parts faces of solids that nearly touch, by moving vertices by single grid steps."""

from __future__ import annotations

import itertools

import numpy as np

from geoscene.buildings.footprints import to_grid
from geoscene.geometry.intersections import close_faces, common_corners, distances
from geoscene.geometry.watertight import GRID, grid_cells, weld
from geoscene.typing import Float, Ints

_MOVES = np.array([move for move in itertools.product((-1, 0, 1), repeat=3) if any(move)])
"""Grid steps by which a vertex can move at once."""


def part(corners: Float) -> Float:
    """Triangles (m, 3, 3) of a closed surface with some vertices moved, so that fewer faces are close.

    Each move is by a grid step, or a diagonal of one, and leaves fewer pairs of close faces.
    """
    ids, first = weld(corners.reshape(-1, 3), np.zeros(3 * len(corners), np.int64))
    faces, cells = ids.reshape(-1, 3), grid_cells(corners.reshape(-1, 3)[first])
    pairs = _close(cells, faces)
    while pairs is not None and len(pairs):
        for vertex, move in _moves(cells, faces, pairs=pairs):
            moved = cells.copy()
            moved[vertex] += move
            left = _close(moved, faces)
            if left is not None and len(left) < len(pairs):
                cells, pairs = moved, left
                break
        else:
            break
    return to_grid(np.asarray(cells * GRID, float))[faces]


def _close(cells: Ints, faces: Ints) -> Ints | None:
    """Pairs (k, 2) of close faces; None if faces cross or touch."""
    pairs, crossing = close_faces(cells, faces, owner=np.zeros(len(faces), np.int64))
    return None if crossing.any() else pairs


def _moves(cells: Ints, faces: Ints, *, pairs: Ints) -> list[tuple[int, Ints]]:
    """Vertices of the closest of pairs (k, 2) of faces and their moves, those that part it most first."""
    same = common_corners(*faces[pairs].transpose(1, 0, 2))
    closest = int(np.argmin(distances(*cells[faces[pairs]].transpose(1, 0, 2, 3), same=same)))
    pair = faces[pairs[closest]]
    vertices = np.repeat(np.setxor1d(*pair), len(_MOVES))
    moves = np.tile(_MOVES, (len(vertices) // len(_MOVES), 1))
    moving = (pair[:, None] == vertices[:, None])[..., None]
    moved = cells[pair][:, None] + moving * moves[:, None]
    apart = distances(*moved, same=np.repeat(same[:, :, [closest]], len(vertices), axis=2))
    order = np.argsort(-apart, kind="stable")
    return list(zip(vertices[order].tolist(), moves[order], strict=True))
