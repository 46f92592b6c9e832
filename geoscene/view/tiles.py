"""Tiles as compact bytes for the page: quantised columns, one after another, deflated."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import Class
from geoscene.geometry.mesh import Mesh
from geoscene.scene import Scene
from geoscene.scene.tile_files import Tile
from geoscene.typing import Bools, Float, Ints
from geoscene.view.assembly import gzip
from geoscene.view.looks import FacadeLooks

STEP = 1 / 128
"""Quantisation step of vertices in metres; a power of two, so that tiles share one grid and
leave no gaps. Doubled for a tile that spans more than 512 m, until 16 bits hold it."""

TURN = 2 * np.pi / 2048
"""Quantisation step of the heading of upright copies in radians: 5 mm at the rim of a 7 m crown."""

SCALE = 1 / 256
"""Quantisation step of the scale of upright copies: 2 mm for a shape of one metre."""

GROUND = "ground"
"""Name of the group of ground faces other than roads: bare terrain, land cover, building pads."""

_WITHIN = {"building_parts": "buildings", "landcover": GROUND, "roads": "road_surfaces"}


@dataclass(frozen=True, slots=True)
class Groups:
    """Groups of features that the viewer shows or hides together.

    names : of the groups, ground first
    of    : (n + 1,) uint8, the group of each feature; the last one's is that of feature -1
    """

    names: tuple[str, ...]
    of: NDArray[np.uint8]

    def faces(self, mesh: Mesh) -> NDArray[np.uint8]:
        """Group (m,) of each face."""
        group: NDArray[np.uint8] = self.of[mesh.feature]
        return np.where(mesh.klass == Class.BUILDING_PAD, np.uint8(0), group)


def groups_of(scene: Scene) -> Groups:
    """One group per layer that has faces or copies of its own, and the ground."""
    ranges = sorted(scene.layers.items(), key=lambda item: item[1])
    names = [GROUND, *(n for n, (a, b) in ranges if b > a and n not in _WITHIN)]
    of = np.zeros(max((b for _, (_, b) in ranges), default=0) + 1, np.uint8)
    for name, (start, stop) in ranges:
        home = _WITHIN.get(name, name)
        of[start:stop] = names.index(home) if home in names else 0
    return Groups(tuple(names), of)


def only(tile: Tile, groups: Groups, *, kept: Bools) -> Tile:
    """The faces and copies of a tile that are in the kept groups (n,)."""
    if kept.all():
        return tile
    copies = tile.instances
    faces, whole = kept[groups.faces(tile.mesh)], kept[groups.of[copies.feature]]
    return Tile(tile.origin, tile.mesh.take(faces), copies.take(whole))


def pack_tile(tile: Tile, groups: Groups, *, facades: FacadeLooks) -> tuple[dict[str, Any], bytes]:
    """Header of a tile and its bytes, deflated.

    Vertex q of the bytes lies at (base + q) * step in scene metres. Faces are in order of group, ``ends`` of
    which are given; copies in order of group, shape and x, of which ``runs`` are (group, shape, number).
    The bytes are little-endian columns: corners (m, 3) uint32, feature (m,) int32, the copies' feature (k,)
    int32, the facades' feature (b,) int32 and base (b,) float32, vertices (n, 3) uint16, class (m,), material
    (m,), surface (m,), sRGB colour (m, 3) and the facades' codes (b, 4) uint8. Last are the copies' places:
    where all are ``upright`` (a scale across, one upwards, a turn about the vertical) six columns of uint16,
    the low bytes of each before the high ones: steps from base in x (less that of the copy before), y and z,
    turn in `TURN`, scales in `SCALE`. Else they are the twelve columns of
    transforms (k, 3, 4) float32 to metres from base * step, bytes of equal rank together, too.
    """
    mesh, copies = tile.mesh, tile.instances
    points = mesh.vertices + tile.origin
    anchors = copies.transform[:, :, 3] + tile.origin
    every = np.concatenate([points, anchors])
    low, high = (every.min(axis=0), every.max(axis=0)) if len(every) else (tile.origin, tile.origin)
    step = STEP
    while (high - low).max() / step > 65_534:
        step *= 2
    base = np.floor(low / step).astype(np.int64)
    vertices = np.rint(points / step).astype(np.int64) - base

    group = groups.faces(mesh)
    order = np.argsort(group, kind="stable")
    home = groups.of[copies.feature].astype(np.int64)
    rank = np.lexsort((anchors[:, 0], copies.shape, home))
    runs, counts = np.unique(np.column_stack([home, copies.shape]), axis=0, return_counts=True)
    transform = copies.transform[rank].copy()
    transform[:, :, 3] += tile.origin - base * step
    upright = _upright(transform, step)

    header = {
        "step": step,
        "base": base.tolist(),
        "low": np.floor(low).tolist(),
        "high": np.ceil(high).tolist(),
        "vertices": len(points),
        "ends": np.cumsum(np.bincount(group, minlength=len(groups.names))).tolist(),
        "runs": [[int(g), int(s), int(n)] for (g, s), n in zip(runs, counts, strict=True)],
        "upright": upright is not None,
        "facades": len(facades),
    }
    places = transform.reshape(-1, 12).T.astype("<f4") if upright is None else upright.astype("<u2")
    planes = np.moveaxis(
        np.ascontiguousarray(places).view(np.uint8).reshape(*places.shape, places.itemsize), 2, 1
    )
    columns: list[tuple[NDArray[Any], str]] = [
        (mesh.faces[order], "<u4"),
        (mesh.feature[order], "<i4"),
        (copies.feature[rank], "<i4"),
        (facades.feature, "<i4"),
        (facades.base, "<f4"),
        (vertices, "<u2"),
        (mesh.klass[order], "u1"),
        (mesh.material[order], "u1"),
        (mesh.surface[order], "u1"),
        (mesh.color[order], "u1"),
        (facades.codes, "u1"),
        (planes, "u1"),
    ]
    return header, gzip(b"".join(values.astype(kind).tobytes() for values, kind in columns))


def _upright(transform: Float, step: float) -> Ints | None:
    """Quantised columns (6, k) of upright transforms (k, 3, 4), or None if any is not upright."""
    along, lift = np.hypot(transform[:, 0, 0], transform[:, 1, 0]), transform[:, 2, 2]
    turn = np.arctan2(transform[:, 1, 0], transform[:, 0, 0])
    linear = _turn(along, lift, turn=turn)
    if not np.allclose(linear, transform[:, :, :3], rtol=0, atol=1e-5) or (lift <= 0).any():
        return None
    steps = np.rint(transform[:, :, 3].T / step).astype(np.int64)
    steps[0] = np.diff(steps[0], prepend=0) % 65_536
    whole = np.vstack([steps, np.rint(turn / TURN) % 2048, np.rint(along / SCALE), np.rint(lift / SCALE)])
    return None if whole.max(initial=0) > 65_535 else whole.astype(np.int64)


def _turn(along: Float, lift: Float, *, turn: Float) -> Float:
    """Matrices (k, 3, 3) that scale horizontally and vertically and rotate about the vertical."""
    matrix = np.zeros((len(turn), 3, 3))
    matrix[:, 0, 0] = matrix[:, 1, 1] = along * np.cos(turn)
    matrix[:, 1, 0] = along * np.sin(turn)
    matrix[:, 0, 1] = -matrix[:, 1, 0]
    matrix[:, 2, 2] = lift
    return matrix


def pack_shapes(shapes: list[Mesh]) -> tuple[list[list[int]], bytes]:
    """(vertices, faces) of each shape, and their deflated bytes, one shape after another.

    Columns of a shape: vertices (n, 3) float32, corners (m, 3) uint32, then class, material, surface and
    colour as in `pack_tile`, filled up to a multiple of four bytes.
    """
    parts = []
    for mesh in shapes:
        columns = [
            mesh.vertices.astype("<f4"),
            mesh.faces.astype("<u4"),
            mesh.klass,
            mesh.material,
            mesh.surface,
            mesh.color,
        ]
        raw = b"".join(np.ascontiguousarray(values).tobytes() for values in columns)
        parts.append(raw + bytes(-len(raw) % 4))
    return [[len(mesh.vertices), len(mesh)] for mesh in shapes], gzip(b"".join(parts))
