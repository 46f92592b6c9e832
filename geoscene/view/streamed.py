"""The page of a scene as a folder that is loaded in parts, with coarser copies for views from far away."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from geoscene.classes import Class
from geoscene.export.kinds import compact_json
from geoscene.geometry.mesh import FLOOR, Mesh, ShapeInstances, concatenate
from geoscene.scene.tile_files import Tile
from geoscene.support.files import write_atomically
from geoscene.support.progress import Progress
from geoscene.support.splitmix import uniform_at
from geoscene.typing import Bools, Float, Ints
from geoscene.view.contents import PageContents

_ON_EDGE = 1e-6
"""Metres within which a vertex lies on a side of a box."""

_BARE = 4.0
"""Cells along a side of a cell of bare ground."""

_INSIDE, _BARE_INSIDE = 1.0, 5.0
"""Kinds of vertices of the ground inside a box; those on its sides are between them."""

_THINNEST = 0.5
"""Instances whose second-largest side is a smaller share of a cell are left out."""
NAMES = r"index\.html|attributes\.js|nodes/\d+\.js"
"""Paths of the files of a page's folder, a regular expression."""

MARK = "attributes.js"
"""A file that marks the folder of a page."""

_FACTOR = 4
"""Tiles, and then nodes, along a side of a node of the next coarser level."""

_CELL = 2 / 125
"""Side of the cells of the first coarser level as a share of the side of a tile: 4 m of 250 m."""

_SHARES = (1 / 3, 1 / 4)
"""Share of the instances that the first coarser level keeps, and each further one of those before."""

_ROOTS = 4
"""Nodes of the coarsest level, at most; they are loaded first."""


def coarser_mesh(mesh: Mesh, *, cell: float, box: Sequence[float]) -> Mesh:
    """The mesh with one vertex per cube of side ``cell``, without the faces that lose their area by it.

    Vertices move by at most the diagonal of a cell, to the vertex nearest to the middle of their cell (vertex
    clustering; Rossignac and Borrel 1993). Those of solids and of surfaces are apart, and so are those on the
    sides of ``box`` (xmin, ymin, xmax, ymax): surfaces of neighbouring boxes keep their common edges without
    gaps. Vertices of bare ground alone, inside the box, stand in cells of `_BARE` sides: what lies between
    them is even. Undersides of solids are left out.
    """
    faces = mesh.faces[~(mesh.closed & (mesh.surface & 3 == FLOOR))]
    rows = np.flatnonzero(~(mesh.closed & (mesh.surface & 3 == FLOOR)))
    ground = np.zeros(len(mesh.vertices), np.bool_)
    ground[faces[~mesh.closed[rows]]] = True
    bare = ground.copy()
    bare[faces[mesh.klass[rows] != Class.TERRAIN]] = False
    kind = _apart(mesh.vertices, ground, box=box)
    kind[bare & (kind == _INSIDE)] = _BARE_INSIDE
    sides = np.where(kind == _BARE_INSIDE, _BARE * cell, cell)
    keep = _nearest(mesh.vertices, sides=sides, apart=kind)
    faces = keep[faces]
    a, b, c = faces.T
    whole = (a != b) & (b != c) & (c != a)
    faces, rows = faces[whole], rows[whole]
    turned = np.take_along_axis(faces, (faces.argmin(axis=1)[:, None] + np.arange(3)) % 3, axis=1)
    _, first = np.unique(turned, axis=0, return_index=True)
    first.sort()
    kept = mesh.take(rows[first])
    used, number = np.unique(turned[first], return_inverse=True)
    return Mesh(
        mesh.vertices[used],
        number.reshape(-1, 3).astype(np.int32),
        kept.feature,
        kept.klass,
        kept.material,
        kept.surface,
        kept.color,
        kept.closed,
    )


def _apart(points: Float, ground: Bools, *, box: Sequence[float]) -> Float:
    """Number (n,) of a vertex's kind: of a solid, or of the ground, inside or on which sides of the box."""
    xmin, ymin, xmax, ymax = box
    on_x, on_y = (
        np.minimum(np.abs(points[:, axis] - low), np.abs(points[:, axis] - high)) < _ON_EDGE
        for axis, low, high in ((0, xmin, xmax), (1, ymin, ymax))
    )
    return np.where(ground, _INSIDE + on_x + 2 * on_y, 0).astype(float)


def _nearest(points: Float, *, sides: Float, apart: Float) -> Ints:
    """Row (n,) of the representative point of each point's cell, of the same side and kind."""
    place = np.floor(points / sides[:, None])
    away = np.square(points - (place + 0.5) * sides[:, None]).sum(axis=1)
    columns = (*points.T, away, *place.T, apart)
    order = np.lexsort(columns)
    keys = np.column_stack([*place.T, apart])[order]
    new = (
        np.concatenate([[True], (keys[1:] != keys[:-1]).any(axis=1)]) if len(keys) else np.empty(0, np.bool_)
    )
    out = np.empty(len(points), np.int64)
    out[order] = order[np.flatnonzero(new)][np.cumsum(new) - 1]
    return out


def fewer_instances(
    copies: ShapeInstances, sizes: Float, *, cell: float, share: float, seed: int
) -> ShapeInstances:
    """A share of the instances that are at least half a cell thick, widened so that they cover as much.

    Which are kept depends on their places and the seed alone.

    sizes : (s, 3) metres, sides of the shapes
    """
    scale = np.sqrt(np.square(copies.transform[:, :, :3]).sum(axis=1))  # (k, 3) of the shape's axes
    wide = 1.0 / np.sqrt(share)
    sides = scale * sizes[copies.shape] * np.array([wide, wide, 1.0])
    place = np.rint(copies.transform[:, :2, 3] * 100).astype(np.int64)
    drawn = uniform_at(place[:, 0], place[:, 1], count=1, seed=seed)[0]
    kept = copies.take((np.sort(sides, axis=1)[:, 1] >= _THINNEST * cell) & (drawn < share))
    matrix = kept.transform.copy()
    matrix[:, :, :2] *= wide
    return ShapeInstances(kept.shape, matrix, kept.feature)


@dataclass(frozen=True, slots=True)
class StreamedPart:
    """A part of the scene in one file.

    low, high : (3,) whole metres
    error     : metres by which it may differ from the scene; 0 for a tile
    children  : numbers of the nodes that replace it from near
    """

    low: Float
    high: Float
    error: float
    children: tuple[int, ...]


class NodeWriter:
    """Writes the nodes of a tree over tiles, children before their parents.

    A node of level k covers `_FACTOR` ** k tiles along a side and holds all tiles therein, as coarse as its
    cells. Nodes of level 0 are tiles, whole; so is any node that a single larger tile fills.
    """

    def __init__(self, folder: Path, contents: PageContents, *, tiles: Ints, progress: Progress) -> None:
        self.nodes: list[StreamedPart] = []
        self.step = 0.0
        self._folder, self._contents, self._progress = folder / "nodes", contents, progress
        self._tiles, self._corner = tiles, tiles[:, :2].min(axis=0)
        self._sizes = np.array([np.ptp(mesh.vertices, axis=0) for mesh in contents.shapes]).reshape(-1, 3)
        self._folder.mkdir()

    def roots(self) -> list[int]:
        """Write all nodes; returns the numbers of the coarsest ones."""
        level = 1
        while len(self._cells(self._tiles, level)) > _ROOTS:
            level += 1
        return [self._node(own, level, cell=cell)[0] for cell, own in self._cells(self._tiles, level).items()]

    def _cells(self, tiles: Ints, level: int) -> dict[tuple[int, int], Ints]:
        """The tiles of each cell of a level, in order of cells."""
        places = (tiles[:, :2] - self._corner) // _FACTOR**level
        cells, of = np.unique(places, axis=0, return_inverse=True)
        return {(i, j): tiles[of.ravel() == k] for k, (i, j) in enumerate(cells.tolist())}

    def _node(self, tiles: Ints, level: int, *, cell: tuple[int, int]) -> tuple[int, Tile]:
        """Write the node of all tiles in a cell; returns its number and contents."""
        if len(tiles) == 1 and tiles[0, 2] >= _FACTOR**level:
            self._progress("page", len(self._contents.tiles), total=len(self._tiles))
            tile = self._contents.tile(*tiles[0, :2].tolist())
            return self._write(tile), tile
        below = [self._node(own, level - 1, cell=c) for c, own in self._cells(tiles, level - 1).items()]
        children = tuple(number for number, _ in below)
        side = _FACTOR**level * self._contents.scene.tile_size
        low = self._corner * self._contents.scene.tile_size + np.array(cell) * side
        size = _CELL * self._contents.scene.tile_size * _FACTOR ** (level - 1)
        mesh = concatenate([tile.mesh.shifted(tile.origin) for _, tile in below])
        copies = ShapeInstances.concatenate([tile.instances.shifted(tile.origin) for _, tile in below])
        tile = Tile(
            np.zeros(3),
            coarser_mesh(mesh, cell=size, box=(*low, *(low + side))),
            fewer_instances(copies, self._sizes, cell=size, share=_SHARES[min(level, 2) - 1], seed=level),
        )
        return self._write(tile, error=size, children=children), tile

    def _write(self, tile: Tile, *, error: float = 0.0, children: tuple[int, ...] = ()) -> int:
        number = len(self.nodes)
        told, data = self._contents.pack(tile)
        text = f'geosceneNode({number},{compact_json(told).decode()},"{b64encode(data).decode()}");\n'
        write_atomically(self._folder / f"{number}.js", text.encode())
        below = [self.nodes[k] for k in children]
        low, high = (np.array([told[name], *(getattr(n, name) for n in below)]) for name in ("low", "high"))
        self.nodes.append(StreamedPart(low.min(axis=0), high.max(axis=0), error, children))
        self.step = max(self.step, told["step"])
        return number


def write_streamed(
    contents: PageContents, tiles: Ints, *, folder: Path, progress: Progress
) -> dict[str, Any]:
    """Write the nodes and attributes of a page into an empty folder; returns the header's part about them."""
    writer = NodeWriter(folder, contents, tiles=tiles, progress=progress)
    roots = writer.roots()
    texts = ",".join(f'"{b64encode(data).decode()}"' for data in (contents.attributes(), contents.boxes()))
    write_atomically(folder / MARK, f"geosceneAttributes({texts});\n".encode())
    return {
        "step": writer.step,
        "roots": roots,
        "nodes": [
            [*(int(v) for v in (*node.low, *node.high)), node.error, *node.children] for node in writer.nodes
        ],
    }
