"""One partition of the plane: cells without gaps and overlaps, made tile by tile.

Every polygon's outline is put on a grid of `PRECISION`; in a tile, the outlines that come within a
centimetre of it, the tile's own sides and the terrain's lines are noded together by snap rounding (Hobby
1999; Guibas and Marimont 1998). Snap rounding is local: whether a segment bends
at a point depends only on the segments that pass that very point. As both tiles beside a border node the
same whole segments there, they find the same vertices on it, whichever other tiles are built.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.classes import Class, materials
from geoscene.errors import InputError
from geoscene.ground.faces import GroundFaces, distinct_places, faces, snap_rounded
from geoscene.ground.layers import Layers
from geoscene.ground.relief import Kerbs, Raised
from geoscene.ground.terrain_lattice import Lattice, TerrainHeights, lattice
from geoscene.support.columns import row_blocks, squares_between
from geoscene.typing import Bools, Float, Ints

PRECISION = 2.0**-9
"""Side of the grid that ground vertices lie on, 2 mm: twice the distance at which common tools merge them.

A power of two, so that moving a vertex by whole metres is exact in floating point."""

SLIVER = 0.02
"""A cell nowhere wider than this, metres, joins the neighbour with which it shares most border.

Narrower than the narrowest surface (a kerb or a line of 0.1 m), wider than the gaps that mappers leave
between areas meant to touch."""

BEND = 0.03
"""Vertices that bend the border between two cells by less than this squared, m2 of triangle, are left out.

They are what noding leaves on straight borders that hidden outlines cross; tiles' sides keep all."""

_AT_ONCE = 20_000
"""Polygons in which points are looked up at once."""

_POLYGONS, _SEGMENTS = 4096, 65536
"""Polygons whose outlines are read at once, and segments that are put into tiles at once: the copies that
this takes would be most of the memory of a plan."""

_FEW = 4
"""Points for which polygons are not taken apart."""

_REACH = 1e-2
"""How far beyond a tile's side outlines take part in its noding, metres: several times `PRECISION`."""


@dataclass(frozen=True, slots=True)
class GroundPlan:
    """Input of `partition_tile` for the whole scene; can be pickled for worker processes.

    extent    : (xmin, ymin, xmax, ymax) of the ground, scene metres, on the grid
    tile_size : side of a tile, metres
    lines     : spacing of the terrain's lines, metres, 0 for none
    ruled     : tiles that have these lines; None for all
    coarse    : spacing of the lines in the other tiles, 0 for none
    terrain   : heights that joined tiles follow instead of lines, None for none
    layers    : the polygons that compete for the ground
    tree      : STRtree over their polygons
    base      : (class, material code) where no polygon lies
    start, end : (m, 2) float64 segments of all outlines, on the grid
    string    : (m,) int32: segments of one outline that follow each other have the same number
    creases   : number of the first string that is no outline but a line along which the ground bends
    order, offset : segments by square, (k,) int32 and (t + 1,) int64: those of square (i, j) are
                ``order[offset[k]:offset[k + 1]]``, k its place in `tiles`
    tiles     : (t, 2) int64, all squares of the extent with the tile size, by row; each is a tile unless
                `geoscene.ground.join_tiles` has joined it to others
    span      : (t,) int64, squares along a side of the tile that each square is part of: 1, or a power of two
    kerbs     : by which sidewalks are raised above carriageways, None for level ones
    raised    : what stands above the planned height, None for nothing
    """

    extent: tuple[float, float, float, float]
    tile_size: float
    lines: float
    ruled: frozenset[tuple[int, int]] | None
    coarse: float
    terrain: TerrainHeights | None
    layers: Layers
    tree: shapely.STRtree
    base: tuple[int, int]
    start: Float
    end: Float
    string: NDArray[np.int32]
    creases: int
    order: NDArray[np.int32]
    offset: Ints
    tiles: Ints
    span: Ints
    kerbs: Kerbs | None = None
    raised: Raised | None = None


@dataclass(frozen=True, slots=True)
class Partition:
    """Cells that cover an area once.

    polygon  : (n,) object, shapely Polygon, scene metres, vertices on the `PRECISION` grid; neighbours share
               all vertices along their common border
    row      : (n,) int32, the row of the layers that won, -1 for the base
    klass, material : (n,) uint8
    feature  : (n,) int32
    tile     : (n, 2) int32
    slivers  : how many slivers were joined to a neighbour
    """

    polygon: NDArray[np.object_]
    row: NDArray[np.int32]
    klass: NDArray[np.uint8]
    material: NDArray[np.uint8]
    feature: NDArray[np.int32]
    tile: NDArray[np.int32]
    slivers: int

    def __len__(self) -> int:
        """Number of cells."""
        return len(self.polygon)


def plan_ground(
    extent: Sequence[float],
    layers: Layers,
    *,
    tile_size: float = 250.0,
    lines: float = 0.0,
    ruled: Iterable[tuple[int, int]] | None = None,
    coarse: float = 0.0,
    terrain: TerrainHeights | None = None,
    base: tuple[int, str] = (Class.TERRAIN, "soil"),
    kerbs: Kerbs | None = None,
    raised: Raised | None = None,
) -> GroundPlan:
    """The scene's outlines sorted by tile, ready for `partition_tile`.

    extent : (xmin, ymin, xmax, ymax), scene metres
    lines  : spacing in metres of lines (parallel to the axes, at its multiples) along which cells are cut, so
             that the ground can follow a terrain (still water is not cut); 0 for none
    ruled  : tiles that have such lines; all by default
    coarse : spacing of the lines in other tiles, 0 for none
    terrain : heights that tiles follow, instead of lines, that `geoscene.ground.join_tiles` makes of several
    base   : class and material where no polygon lies
    kerbs  : by which sidewalks of carriageways are raised above them (`geoscene.ground.kerbs`)
    raised : what stands above; its parts must be layers of their own (`geoscene.roadgraph.relief`)

    Raises InputError for an extent without area or non-finite, or sizes off the grid.
    """
    box = _snap(np.asarray(extent, float))
    if box.shape != (4,) or not np.isfinite(box).all() or box[0] >= box[2] or box[1] >= box[3]:
        raise InputError(
            f"the ground's extent {tuple(extent)} must be xmin < xmax, ymin < ymax in scene metres"
        )
    for name, size in (("tile_size", tile_size), ("lines", lines), ("coarse", coarse)):
        if size < 0 or size != _snap(np.asarray(size)):
            raise InputError(f"{name}={size}: give a multiple of {PRECISION} m, such as whole metres")
    if tile_size < 1.0:
        raise InputError(f"tile_size={tile_size}: a tile's side must be 1 m or more")
    start, end, string = _outlines(layers.polygon, box)
    low = np.floor(box[:2] / tile_size).astype(np.int64)
    high = np.maximum(np.ceil(box[2:] / tile_size).astype(np.int64), low + 1)
    count = high - low
    order, offset = _by_tile(start, end, low=low, count=count, tile_size=tile_size)
    j, i = np.divmod(np.arange(count[0] * count[1]), count[0])
    klass, material = base
    return GroundPlan(
        (float(box[0]), float(box[1]), float(box[2]), float(box[3])),
        tile_size,
        lines,
        None if ruled is None else frozenset(ruled),
        coarse,
        terrain,
        layers,
        shapely.STRtree(layers.polygon),
        (int(klass), materials()[material].code),
        start,
        end,
        string,
        int(string.max(initial=-1)) + 1,
        order,
        offset,
        np.stack([i, j], axis=1) + low,
        np.ones(len(i), np.int64),
        kerbs,
        raised,
    )


def cut_along(plan: GroundPlan, creases: Float) -> GroundPlan:
    """The plan with segments (c, 2, 2), scene metres, along which cells are cut, so that the ground can bend.

    A segment that ends within a cell is cut back to where it enters it.
    """
    box, low = np.array(plan.extent), plan.tiles[0]
    start, end = _snap(creases).swapaxes(0, 1)
    kept = (start != end).any(axis=1) & _near_box(start, end, box=box)
    string = plan.creases + np.arange(int(kept.sum()), dtype=np.int32)
    start, end = np.concatenate([plan.start, start[kept]]), np.concatenate([plan.end, end[kept]])
    count = plan.tiles[-1] - low + 1
    order, offset = _by_tile(start, end, low=low, count=count, tile_size=plan.tile_size)
    string = np.concatenate([plan.string, string])
    return replace(plan, start=start, end=end, string=string, order=order, offset=offset)


def partition_tile(plan: GroundPlan, i: int, *, j: int) -> Partition:
    """The cells of tile (i, j), which covers [i, i + n) x [j, j + n) times the tile size, within the extent.

    n is the tile's `tile_span`. The result does not depend on which other tiles are made. Raises InputError
    for a tile outside the extent.
    """
    place = tile_place(plan, i, j=j)
    if place is None:
        raise InputError(f"tile ({i}, {j}) is not one of the {len(plan.tiles)} tiles of the ground")
    outlines = np.sort(plan.order[plan.offset[place] : plan.offset[place + 1]])
    sides, *across = ruling = _ruling(plan, i, j=j, box=tile_box(plan, i, j=j))
    if len(outlines) or across:
        polygon, row, slivers = _cells(plan, outlines, ruling=ruling, tile=(i, j))
    else:  # one cell: faces run clockwise
        polygon, slivers = shapely.polygons(_snap(sides)[None, ::-1]), 0
        row = rows_at(plan, shapely.get_coordinates(shapely.point_on_surface(polygon)))
    klass = values_at(plan.layers.klass, row, base=plan.base[0])
    material = values_at(plan.layers.material, row, base=plan.base[1])
    feature = values_at(plan.layers.feature, row, base=-1)
    tile = np.broadcast_to(np.array([i, j], np.int32), (len(polygon), 2)).copy()
    return Partition(polygon, row.astype(np.int32), klass, material, feature, tile, slivers)


def tile_box(plan: GroundPlan, i: int, *, j: int) -> tuple[float, float, float, float]:
    """(xmin, ymin, xmax, ymax) of a tile's part of the extent, scene metres."""
    size, (xmin, ymin, xmax, ymax), n = plan.tile_size, plan.extent, tile_span(plan, i, j=j)
    return max(i * size, xmin), max(j * size, ymin), min((i + n) * size, xmax), min((j + n) * size, ymax)


def tile_span(plan: GroundPlan, i: int, *, j: int) -> int:
    """The squares along a side of tile (i, j), whose south-west square is (i, j); 1 outside the extent."""
    place = tile_place(plan, i, j=j)
    return 1 if place is None else int(plan.span[place])


def tile_place(plan: GroundPlan, i: int, *, j: int) -> int | None:
    """The row of square (i, j) in the plan's tiles, None where it is not among them."""
    (west, south), (east, north) = plan.tiles[0].tolist(), plan.tiles[-1].tolist()
    return (j - south) * (east - west + 1) + i - west if west <= i <= east and south <= j <= north else None


def follows_terrain(plan: GroundPlan, i: int, *, j: int) -> bool:
    """Whether the ground of square (i, j) follows heights of the terrain, instead of lines."""
    return plan.terrain is not None and tile_span(plan, i, j=j) > 1


def tile_lattice(plan: GroundPlan, i: int, *, j: int) -> Lattice:
    """The vertices by which tile (i, j) follows the terrain; the plan must have its heights."""
    if plan.terrain is None:
        raise InputError("the ground's plan has no heights of the terrain")
    odd = bool((i + j - plan.tiles[0].sum()) % 2)
    span = tile_span(plan, i, j=j)
    return lattice(plan.terrain, (i, j), span=span, odd=odd, tile_size=plan.tile_size, extent=plan.extent)


def rows_near(plan: GroundPlan, xmin: float, *, ymin: float, xmax: float, ymax: float) -> Ints:
    """Rows of the layers whose bounding boxes intersect a box, in no particular order."""
    return np.asarray(plan.tree.query(shapely.box(xmin, ymin, xmax, ymax)), np.int64)


def rows_at(plan: GroundPlan, xy: Float) -> Ints:
    """The row of the layers (n,) that holds each point (n, 2), -1 where none does."""
    if not len(xy):
        return np.empty(0, np.int64)
    low, high = xy.min(axis=0), xy.max(axis=0)
    near = rows_near(plan, low[0], ymin=low[1], xmax=high[0], ymax=high[1])
    axis = int(np.argmax(high - low))
    if len(near) > _AT_ONCE and low[axis] < high[axis]:  # bounds the memory
        row, lower = np.empty(len(xy), np.int64), xy[:, axis] < (low[axis] + high[axis]) / 2
        row[lower], row[~lower] = rows_at(plan, xy[lower]), rows_at(plan, xy[~lower])
        return row
    # Of those around a point the last has the highest priority and, among equals, is the earliest row.
    near = near[np.lexsort((-near, plan.layers.priority[near]))]
    return np.append(near, -1)[_last_around(plan.layers.polygon[near], xy)]


def _last_around(polygons: NDArray[np.object_], xy: Float) -> Ints:
    """The last of the polygons around each point, -1 for none; a point on an outline is not inside."""
    if len(xy) <= _FEW:
        within = shapely.contains_xy(polygons, xy[:, :1], xy[:, 1:])
        last: Ints = np.where(within, np.arange(len(polygons)), -1).max(axis=1, initial=-1)
        return last
    from geoscene.ground import kernels  # noqa: PLC0415 - slow to import

    rings, polygon = _rings(polygons)
    corners, ring = shapely.get_coordinates(rings, return_index=True)
    by_y = np.argsort(xy[:, 1])
    offset = np.searchsorted(ring, np.arange(len(rings) + 1))
    best, point, of = kernels.last_around(xy[by_y], corners, offset, polygon)
    around = shapely.contains_xy(polygons[of], *xy[by_y[point]].T)
    np.maximum.at(best, point[around], of[around])
    last = np.empty_like(best)
    last[by_y] = best
    return last


def values_at(column: NDArray[Any], row: NDArray[np.integer[Any]], *, base: object) -> NDArray[Any]:
    """A column's values (n,) at rows (n,), and ``base`` where the row is -1."""
    values = np.full(len(row), base, column.dtype)
    there = row >= 0
    values[there] = column[row[there]]
    return values


def distinct(points: Float) -> tuple[Float, Ints]:
    """Points (k, 2) on the grid, sorted by x, then y, each once, and the number (n,) of each given one."""
    places, number = distinct_places(np.round(points / PRECISION).astype(np.int64))
    return np.asarray(places * PRECISION, float), number


def _snap(values: Float) -> Float:
    return np.round(values / PRECISION) * PRECISION


def _outlines(polygons: NDArray[np.object_], box: Float) -> tuple[Float, Float, NDArray[np.int32]]:
    """Start and end (m, 2) of the outlines' segments near the box, on the grid, and their strings (m,)."""
    found, count = [], 0
    for block in row_blocks(len(polygons), _POLYGONS):
        rings, _ = _rings(polygons[block])
        coords, ring = shapely.get_coordinates(rings, return_index=True)
        coords = _snap(coords)
        start, end = coords[:-1], coords[1:]
        keep = (ring[:-1] == ring[1:]) & (start != end).any(axis=1) & _near_box(start, end, box=box)
        found.append((start[keep], end[keep], (ring[:-1][keep] + count).astype(np.int32)))
        count += len(rings)
    start, end, string = (np.concatenate(column) for column in zip(*found, strict=True))
    return start, end, string


def _along(creases: NDArray[np.object_], ends: tuple[Float, Float]) -> Bools:
    """Whether segments (m,) between points are pieces of creases, which snap rounding moves a little."""
    tree, middle = shapely.STRtree(creases), shapely.points((ends[0] + ends[1]) / 2)
    piece, crease = tree.query(middle, predicate="dwithin", distance=PRECISION)
    for end in ends:
        near = np.asarray(shapely.dwithin(shapely.points(end[piece]), creases[crease], PRECISION))
        piece, crease = piece[near], crease[near]
    on = np.zeros(len(middle), np.bool_)
    on[piece] = True
    return on


def _near_box(start: Float, end: Float, *, box: Float) -> Bools:
    """Whether boxes around segments (m,) are near a box."""
    low, high = np.minimum(start, end), np.maximum(start, end)
    return np.asarray(
        (low <= box[2:] + _REACH).all(axis=1) & (high >= box[:2] - _REACH).all(axis=1), np.bool_
    )


def _rings(polygons: NDArray[np.object_]) -> tuple[NDArray[np.object_], Ints]:
    """The rings of polygons, and the polygon of each; parts are copies, which single polygons do not need."""
    polygon = np.repeat(np.arange(len(polygons)), shapely.get_num_geometries(polygons))
    several = shapely.get_type_id(polygons) != shapely.GeometryType.POLYGON
    parts = polygons[polygon]
    parts[several[polygon]] = shapely.get_parts(polygons[several])
    rings, part = shapely.get_rings(parts, return_index=True)
    return rings, polygon[part]


def _by_tile(
    start: Float, end: Float, *, low: Ints, count: Ints, tile_size: float
) -> tuple[NDArray[np.int32], Ints]:
    """Segments by tile, in compressed rows: (order, offset)."""
    segments, tiles = [], []
    for block in row_blocks(len(start), _SEGMENTS):
        a, b = start[block], end[block]
        first = np.floor((np.minimum(a, b) - _REACH) / tile_size).astype(np.int64) - low
        last = np.floor((np.maximum(a, b) + _REACH) / tile_size).astype(np.int64) - low
        first, last = np.clip(first, 0, count - 1), np.clip(last, 0, count - 1)
        square, own = squares_between(first, last)
        segments.append((block.start + own).astype(np.int32))
        tiles.append(square[:, 1] * count[0] + square[:, 0])
    tile = np.concatenate(tiles)
    order = np.argsort(tile, kind="stable")
    offset = np.searchsorted(tile[order], np.arange(count[0] * count[1] + 1))
    return np.concatenate(segments)[order], offset


def _spacing(plan: GroundPlan, i: int, *, j: int) -> float:
    """Spacing of the terrain's lines in tile (i, j), 0 where it has none."""
    if follows_terrain(plan, i, j=j):
        return 0.0
    return plan.lines if plan.ruled is None or (i, j) in plan.ruled else plan.coarse


def _multiples(low: float, high: float, *spacings: float) -> Float:
    """Multiples of the spacings (0 for none) between two numbers, ascending."""
    steps = [np.arange(np.floor(low / s) + 1, np.ceil(high / s)) * s for s in spacings if s > 0]
    return np.unique(np.concatenate([np.empty(0), *steps]))


def _ruling(plan: GroundPlan, i: int, *, j: int, box: tuple[float, float, float, float]) -> list[Float]:
    """The tile's sides, and the terrain's lines across it, as vertices (n, 2).

    A side has a vertex at every line and every vertex of the lattices of both tiles that share it, and at
    every corner of a square, so that tiles of any span agree.
    """
    xmin, ymin, xmax, ymax = box
    own, n = _spacing(plan, i, j=j), tile_span(plan, i, j=j)
    kept = _kept_on_sides(plan, i, j=j)
    bottom, top = (
        _stops(
            plan, (i, j), ends=(xmin, xmax), first=i, beside=[(i + k, row) for k in range(n)], kept=of_side
        )
        for row, of_side in zip((j - 1, j + n), kept[:2], strict=True)
    )
    left, right = (
        _stops(
            plan, (i, j), ends=(ymin, ymax), first=j, beside=[(column, j + k) for k in range(n)], kept=of_side
        )
        for column, of_side in zip((i - 1, i + n), kept[2:], strict=True)
    )
    ring = [
        (xmin, ymin), *((x, ymin) for x in bottom),
        (xmax, ymin), *((xmax, y) for y in right),
        (xmax, ymax), *((x, ymax) for x in top[::-1]),
        (xmin, ymax), *((xmin, y) for y in left[::-1]),
        (xmin, ymin),
    ]  # fmt: skip
    across = [[(x, ymin), (x, ymax)] for x in _multiples(xmin, xmax, own)]
    across += [[(xmin, y), (xmax, y)] for y in _multiples(ymin, ymax, own)]
    return [np.array(line) for line in (ring, *across)]


def _kept_on_sides(plan: GroundPlan, i: int, *, j: int) -> list[Float]:
    """Coordinates of the lattice's vertices on a tile's south, north, west and east side.

    None where neither the tile nor one beside it follows the terrain.
    """
    n = tile_span(plan, i, j=j)
    near = [(i + dx, j + dy) for k in range(n) for dx, dy in ((k, -1), (k, n), (-1, k), (n, k))]
    if not any(follows_terrain(plan, column, j=row) for column, row in [(i, j), *near]):
        return [np.empty(0)] * 4
    points = tile_lattice(plan, i, j=j)
    x, y, kept = points.x, points.y, points.kept
    return [x[kept[:, 0]], x[kept[:, -1]], y[kept[0]], y[kept[-1]]]


def _stops(
    plan: GroundPlan,
    tile: tuple[int, int],
    *,
    ends: tuple[float, float],
    first: int,
    beside: Sequence[tuple[int, int]],
    kept: Float,
) -> Float:
    """Coordinates of the vertices along a tile's side between its ends, ascending.

    first  : index of the first square along the side
    beside : the squares beyond the side, in order
    kept   : coordinates of the lattice's vertices on the side
    """
    size, stops = plan.tile_size, [np.empty(0)]
    own, follows = _spacing(plan, tile[0], j=tile[1]), follows_terrain(plan, tile[0], j=tile[1])
    for k, (i, j) in enumerate(beside, start=first):
        start, end = max(k * size, ends[0]), min((k + 1) * size, ends[1])
        if start < end:
            border = follows and tile_place(plan, i, j=j) is None
            lines = _multiples(start, end, own, 0.0 if border else _spacing(plan, i, j=j))
            if follows or follows_terrain(plan, i, j=j):
                lines = np.union1d(lines, kept[(kept > start) & (kept < end)])
            stops += [np.array([start]), lines]
    return np.concatenate(stops)[1:]


def _cells(
    plan: GroundPlan, outlines: NDArray[np.int32], *, ruling: list[Float], tile: tuple[int, int]
) -> tuple[NDArray[np.object_], Ints, int]:
    """The cells of a tile: polygons, the row that each is of, and how many slivers joined a neighbour."""
    i, j = tile
    box = tile_box(plan, i, j=j)
    cells = _noded_faces(plan, outlines, ruling=ruling, box=box)
    row = rows_at(plan, cells.inner_points())
    row, slivers = _without_slivers(cells, row=row)
    level = np.isin(values_at(plan.layers.body, row, base=""), ("sea", "standing"))
    bent = outlines[plan.string[outlines] >= plan.creases]
    creases = shapely.linestrings(np.stack([plan.start[bent], plan.end[bent]], axis=1))
    joined, row = _dissolve(
        cells, row, box=box, lines=_spacing(plan, i, j=j), creases=np.atleast_1d(creases), level=level
    )
    return shapely.coverage_simplify(joined.polygons(), BEND, simplify_boundary=False), row, slivers


def _noded_faces(
    plan: GroundPlan,
    outlines: NDArray[np.int32],
    *,
    ruling: list[Float],
    box: tuple[float, float, float, float],
) -> GroundFaces:
    """The cells of a tile between segments of the outlines, its sides and the terrain's lines."""
    start = np.concatenate([plan.start[outlines], *(line[:-1] for line in ruling)])
    end = np.concatenate([plan.end[outlines], *(line[1:] for line in ruling)])
    string = np.repeat(np.arange(-len(ruling), 0), [len(line) - 1 for line in ruling])
    string = np.concatenate([plan.string[outlines], string])
    start, end = (np.round(ends / PRECISION).astype(np.int64) for ends in (start, end))
    fresh = np.append(True, (string[1:] != string[:-1]) | (start[1:] != end[:-1]).any(axis=1))
    corners = np.round(np.array(box) / PRECISION).astype(np.int64)
    points, ends, rank = snap_rounded(start, end, fresh=fresh, box=corners.tolist())
    return faces(np.asarray(points * PRECISION, float), ends, rank=rank, box=box)


def _without_slivers(edges: GroundFaces, *, row: Ints) -> tuple[Ints, int]:
    """Rows after each sliver took that of the wider cell it shares most border with; how many changed."""
    # The area is at most the radius of the greatest circle within times the outline (Bonnesen), so all
    # slivers are among the few cells that pass this; those with a wider spot are then excluded.
    p, q = edges.points[edges.a] - edges.points[0], edges.points[edges.b] - edges.points[0]
    length = np.hypot(*(p - q).T)
    area = 0.5 * np.bincount(edges.cell, q[:, 0] * p[:, 1] - p[:, 0] * q[:, 1])
    thin = 2.0 * area < SLIVER * np.bincount(edges.cell, length)
    thin[thin] = shapely.is_empty(shapely.buffer(edges.polygons(thin), -SLIVER / 2, quad_segs=4))
    if not thin.any():
        return row, 0
    row = row.copy()
    changed = np.zeros(len(edges), bool)
    todo = thin.copy()
    while todo.any():
        # Slivers beside a settled cell take its row; then those beside them.
        use = todo[edges.cell] & (edges.other >= 0) & ~todo[edges.other]
        if not use.any():
            break
        pair, nth = distinct_places(np.stack([edges.cell[use], edges.other[use]], axis=1))
        shared = np.bincount(nth, weights=length[use])
        order = np.lexsort((-pair[:, 1], shared, pair[:, 0]))
        last = np.append(pair[order[1:], 0] != pair[order[:-1], 0], True)  # the longest border of each
        chosen = pair[order[last]]
        changed[chosen[:, 0]] = row[chosen[:, 0]] != row[chosen[:, 1]]
        row[chosen[:, 0]] = row[chosen[:, 1]]
        todo[chosen[:, 0]] = False
    return row, int(changed.sum())


def _dissolve(
    edges: GroundFaces,
    row: Ints,
    *,
    box: tuple[float, float, float, float],
    lines: float,
    creases: NDArray[np.object_],
    level: Bools,
) -> tuple[GroundFaces, Ints]:
    """Cells of one row joined, over creases and the terrain's lines only where they are level; their rows.

    Vertices on what remains of the borders all stay.
    """
    kept: Bools = (edges.other < 0) | (row[edges.cell] != row[edges.other])
    if lines > 0:
        p, q = edges.points[edges.a], edges.points[edges.b]
        on_line = (p == q) & (p == np.round(p / lines) * lines)
        kept[on_line.any(axis=1) & ~level[edges.cell]] = True
    if len(creases):
        inner = np.flatnonzero(~kept & ~level[edges.cell])
        kept[inner] = _along(creases, (edges.points[edges.a[inner]], edges.points[edges.b[inner]]))
    drawn = np.flatnonzero(kept & ((edges.a < edges.b) | (edges.other < 0)))
    ends = np.stack([edges.a[drawn], edges.b[drawn]])
    joined = faces(edges.points, ends, rank=np.arange(2 * len(drawn)).reshape(-1, 2).T, box=box)
    # A joined cell's first half-edge is one of the cells it was made of.
    key = edges.a * len(edges.points) + edges.b
    order = np.argsort(key)
    first = joined.a[joined.first] * len(edges.points) + joined.b[joined.first]
    return joined, row[edges.cell[order[np.searchsorted(key[order], first)]]]
