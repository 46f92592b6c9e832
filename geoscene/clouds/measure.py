"""Measures a cloud square by square, in worker processes: the ground, then roofs and trees above it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, TypeVar

import numpy as np
import shapely

from geoscene.buildings import Buildings
from geoscene.clouds import trees as canopy
from geoscene.clouds.ground import MARGIN, CloudGrid, ground_heights
from geoscene.clouds.levels import Body, split_bodies
from geoscene.clouds.read import GROUND, SIDE, VEGETATION, Spool, Square, SurveyPoints, without_outliers
from geoscene.clouds.roofs import FEWEST, block_of, fit_roof, roof_points
from geoscene.geometry.frames import Frame
from geoscene.ground.terrain import Terrain, base_heights
from geoscene.support.processes import run_tasks
from geoscene.support.progress import Progress
from geoscene.typing import Bools, Float

T = TypeVar("T")

_INSET = 0.5  # metres from a wall within which points are not taken for the roof: georeferencing, walls
_HIGH = 2.5  # metres above the ground that buildings are told by when the shift is sought
_LOWEST_ROOF = 1.0  # metres above the building's base
_NO_ROOF = (2, 3, 4, 5, 7, 9, 11, 17, 18)  # classes of ground, vegetation, noise, water, roads, bridges

SHIFT_CELL = 0.5
"""Metres of the rasters that are compared."""

SHIFT_REACH = 10
"""Cells by which they are shifted against each other, to each side."""

SHIFT_MARGIN = SHIFT_CELL * SHIFT_REACH
"""Metres around a square that the comparison needs."""


class Work(NamedTuple):
    """Input of the measurements of all squares; the shift is added to all points."""

    spool: Spool
    footprints: Any
    cell: float
    shift: tuple[float, float]


class GroundOf(NamedTuple):
    """The ground of a square, the agreement of buildings with the map, and the outliers left out."""

    square: Square
    heights: Float
    agreement: Float
    outliers: int


class _Objects(NamedTuple):
    """Bodies by row of the buildings, tops of walls without roofs, and trees, of a square."""

    square: Square
    bodies: list[tuple[int, tuple[Body, ...]]]
    walls: list[tuple[int, float]]
    trees: canopy.DetectedTrees


@dataclass(frozen=True, slots=True)
class CloudMeasurements:
    """Measurements from a point cloud.

    frame     : of the scene
    buildings : table of the map before the measurement
    rows      : (k,) rows of buildings that were sought
    bodies    : of those rows: one, or several where the roof steps, the highest first; none where too few
                points lie on the roof
    walls     : (k,) z up to which walls were seen where no roof was, as from the street; else NaN
    base      : (k,) z of the lowest ground along their outlines
    trees     : all that were found
    """

    frame: Frame
    buildings: Buildings
    rows: list[int]
    bodies: list[tuple[Body, ...]]
    walls: Float
    base: Float
    trees: canopy.DetectedTrees


def is_classified(spool: Spool) -> bool:
    """Whether the ground is told by class: of at least one point in a hundred."""
    return 100 * spool.ground >= spool.read - spool.outside


def box_of(square: Square, margin: float = 0.0) -> tuple[float, float, float, float]:
    """Bounds (xmin, ymin, xmax, ymax) of a square, scene metres, and of a margin around it."""
    x, y = square[0] * SIDE, square[1] * SIDE
    return x - margin, y - margin, x + SIDE + margin, y + SIDE + margin


def grid_of(square: Square, cell: float, *, margin: float) -> CloudGrid:
    """Cells of a square and of a margin around it, in whole cells."""
    around = int(np.ceil(margin / cell))
    x, y, _, _ = box_of(square, around * cell)
    many = round(SIDE / cell) + 2 * around
    return CloudGrid(x, y, many, many, cell)


def burnt(shapes: Any, grid: CloudGrid, *, buffer: float = 0.0) -> Bools:
    """Cells (rows, columns) whose centres lie in polygons, or within ``buffer`` metres of them."""
    from rasterio import Affine  # noqa: PLC0415 - slow to import
    from rasterio.features import rasterize  # noqa: PLC0415

    width, height = grid.columns * grid.cell, grid.rows * grid.cell
    box = shapely.box(grid.x, grid.y, grid.x + width, grid.y + height).buffer(buffer)
    near = shapes[shapely.intersects(shapes, box)]
    near = shapely.get_parts(shapely.buffer(near, buffer) if buffer else near)
    near = near[~shapely.is_empty(near)]
    if not len(near):
        return np.zeros(grid.shape, np.bool_)
    place = Affine(grid.cell, 0.0, grid.x, 0.0, grid.cell, grid.y)
    return np.asarray(rasterize(near.tolist(), grid.shape, transform=place, dtype="uint8"), np.bool_)


def _points(work: Work, square: Square, *, margin: float) -> tuple[SurveyPoints, int]:
    """The points of a square with a margin, without outliers, and the outliers in the square itself."""
    # a voxel more, so that what lies at the rim has all its neighbours
    wide = work.spool.around(box_of(square, margin + 3.0), shift=work.shift)
    kept = without_outliers(wide)
    xmin, ymin, xmax, ymax = box_of(square)
    within = [
        ((p.xyz[:, 0] >= xmin) & (p.xyz[:, 0] < xmax) & (p.xyz[:, 1] >= ymin) & (p.xyz[:, 1] < ymax)).sum()
        for p in (wide, kept)
    ]
    x0, y0, x1, y1 = box_of(square, margin)
    x, y = kept.xyz[:, 0], kept.xyz[:, 1]
    return kept.take((x >= x0) & (x < x1) & (y >= y0) & (y < y1)), int(within[0] - within[1])


def _run(work: Callable[[Square], T], squares: Sequence[Square], *, workers: int) -> Iterator[T]:
    """The results of all squares; with one worker by this process, as starting another takes seconds."""
    return run_tasks(work, squares, workers=workers) if workers > 1 else map(work, squares)


def grounds_of(work: Work, *, workers: int, progress: Progress) -> list[GroundOf]:
    """The ground of all squares, sorted."""
    low, high = (
        np.floor((np.array(some) * SIDE + work.shift) / SIDE).astype(int)
        for some in (np.min(work.spool.squares, axis=0), np.max(work.spool.squares, axis=0))
    )
    squares = [(i, j) for i in range(low[0], high[0] + 2) for j in range(low[1], high[1] + 2)]
    found = []
    for done, ground in enumerate(_run(partial(_ground_of, work), squares, workers=workers), 1):
        found.append(ground)
        progress("ground of the cloud", done, total=len(squares))
    return sorted(found, key=lambda ground: ground.square)


def _ground_of(work: Work, square: Square) -> GroundOf:
    """The ground of one square."""
    points, outliers = _points(work, square, margin=MARGIN)
    grid = grid_of(square, work.cell, margin=MARGIN)
    around = int(np.ceil(MARGIN / work.cell))
    own = slice(around, -around)
    none = np.zeros((2 * SHIFT_REACH + 1, 2 * SHIFT_REACH + 1))
    if not len(points):
        return GroundOf(square, np.full((grid.rows - 2 * around,) * 2, np.nan), none, 0)
    built = burnt(work.footprints, grid, buffer=0.5)
    heights = ground_heights(points, grid, classified=is_classified(work.spool), built=built)
    score = none
    if np.isfinite(heights).any() and built.any():
        fine = grid_of(square, SHIFT_CELL, margin=SHIFT_MARGIN)
        low = _nearest(heights)
        xy = points.xyz[:, :2]
        above = points.xyz[:, 2] - low.ravel()[grid.cells(xy)]
        inside = (xy >= (fine.x, fine.y)).all(axis=1)
        inside &= (xy < (fine.x + fine.columns * fine.cell, fine.y + fine.rows * fine.cell)).all(axis=1)
        high = np.zeros(fine.shape, np.bool_)
        tall = inside & (above > _HIGH) & ~np.isin(points.klass, VEGETATION)
        high.ravel()[fine.cells(xy[tall])] = True
        score = agreement(high, burnt(work.footprints, fine))
    return GroundOf(square, heights[own, own], score, outliers)


def _nearest(heights: Float) -> Float:
    from scipy.ndimage import distance_transform_edt  # noqa: PLC0415 - slow to import

    row, column = distance_transform_edt(np.isnan(heights), return_distances=False, return_indices=True)
    return np.asarray(heights[row, column], float)


def measure(
    work: Work, buildings: Buildings, *, terrain: Terrain, frame: Frame, workers: int, progress: Progress
) -> CloudMeasurements:
    """Roofs of all buildings and parts that are drawn, and all trees."""
    rows = np.flatnonzero(buildings.drawn & ~shapely.is_empty(buildings.footprint))
    outlines = _seen_from_above(buildings.footprint[rows], buildings.outline[rows])
    base = base_heights(buildings.footprint[buildings.outline[rows]], terrain.height)
    centre = shapely.bounds(outlines).reshape(-1, 2, 2).mean(axis=1)
    home = np.floor(centre / SIDE).astype(np.int64)
    tasks = sorted({(int(i), int(j)) for i, j in home} | set(work.spool.squares))
    mine = {square: [] for square in tasks}  # type: dict[Square, list[int]]
    for k, (i, j) in enumerate(home.tolist()):
        mine[i, j].append(k)
    shape = partial(
        _objects_of,
        work,
        outlines=outlines,
        whole=buildings.footprint[rows],
        base=base,
        names=buildings.osm_id[rows],
        single=~buildings.is_part[rows],
        mine=mine,
        terrain=terrain,
    )
    found: list[_Objects] = []
    for done, some in enumerate(_run(shape, tasks, workers=workers), 1):
        found.append(some)
        progress("buildings and trees of the cloud", done, total=len(tasks))
    found.sort(key=lambda some: some.square)
    bodies = dict(pair for some in found for pair in some.bodies)
    walls = dict(pair for some in found for pair in some.walls)
    trees = [some.trees for some in found]
    return CloudMeasurements(
        frame,
        buildings,
        rows.tolist(),
        [bodies.get(k, ()) for k in range(len(rows))],
        np.array([walls.get(k, np.nan) for k in range(len(rows))], float),
        base,
        canopy.DetectedTrees(
            *(np.concatenate([getattr(t, name) for t in trees]) for name in ("xy", "height", "crown"))
        ),
    )


def _seen_from_above(footprints: Any, owner: Any) -> Any:
    """Footprints (n,) of bodies without the smaller ones of the same building over them, which hide them."""
    tree = shapely.STRtree(footprints)
    out = footprints.copy()
    area = shapely.area(footprints)
    one, two = tree.query(footprints, predicate="overlaps")
    three, four = tree.query(footprints, predicate="contains")
    one, two = np.concatenate([one, three]), np.concatenate([two, four])
    hides = (owner[one] == owner[two]) & (area[two] < area[one])
    for k in np.unique(one[hides]).tolist():
        rest = shapely.difference(footprints[k], shapely.union_all(footprints[two[hides & (one == k)]]))
        if shapely.area(rest) > 0.1 * area[k]:
            out[k] = rest
    return out


def _objects_of(
    work: Work,
    square: Square,
    *,
    outlines: Any,
    whole: Any,
    base: Float,
    names: Any,
    single: Bools,
    mine: dict[Square, list[int]],
    terrain: Terrain,
) -> _Objects:
    """Roofs of the buildings whose middle is in a square, and its trees."""
    own = mine.get(square, [])
    reach = 0.0
    if own:
        boxes = shapely.bounds(outlines[own])
        xmin, ymin, xmax, ymax = box_of(square)
        over = np.column_stack(
            [xmin - boxes[:, 0], ymin - boxes[:, 1], boxes[:, 2] - xmax, boxes[:, 3] - ymax]
        )
        reach = max(float(over.max()), 0.0)
    points, _ = _points(work, square, margin=max(reach, canopy.MARGIN))
    order = np.argsort(points.xyz[:, 0], kind="stable")
    points = points.take(order)
    bodies, walls = [], []
    solid = ~np.isin(points.klass, _NO_ROOF)
    for k in own:
        xmin, _, xmax, _ = shapely.bounds(outlines[k])
        a, b = np.searchsorted(points.xyz[:, 0], (xmin - _INSET, xmax + _INSET))
        some = points.xyz[a:b][solid[a:b] & (points.xyz[a:b, 2] > base[k] + _LOWEST_ROOF)]
        roof = some[roof_points(outlines[k], some, inset=_INSET)]
        bodies.append((k, _bodies_of(whole[k], roof, seed=str(names[k]), split=bool(single[k]))))
        if not bodies[-1][1]:
            walls.append((k, _top_of_walls(outlines[k], some)))
    return _Objects(square, bodies, walls, _trees_of(work, square, points=points, terrain=terrain))


def _top_of_walls(polygon: Any, xyz: Float) -> float:
    """Height z of the highest points (n, 3) on the walls of a footprint; NaN for too few points."""
    near = shapely.buffer(shapely.boundary(polygon), _INSET)
    shapely.prepare(near)
    z = xyz[shapely.contains_xy(near, xyz[:, 0], xyz[:, 1]), 2]
    return float(np.percentile(z, 98)) if len(z) >= FEWEST else np.nan


def _bodies_of(polygon: Any, xyz: Float, *, seed: str, split: bool) -> tuple[Body, ...]:
    """Bodies of a footprint by the points (n, 3) above it: one where a roof explains them, else pieces.

    split : whether it may be cut: a part of the map, or what parts leave of an outline, stays whole
    """
    roof = fit_roof(polygon, xyz, seed=seed)
    if split and polygon.geom_type == "Polygon" and (roof is None or roof.levels):
        bodies = split_bodies(polygon, xyz, inset=_INSET / 2, seed=seed)
        if bodies:
            return bodies
    roof = roof or block_of(polygon, xyz)
    return () if roof is None else (Body(polygon, roof),)


def _trees_of(work: Work, square: Square, *, points: SurveyPoints, terrain: Terrain) -> canopy.DetectedTrees:
    """Trees whose crowns have their middle in a square."""
    x0, y0, x1, y1 = box_of(square, canopy.MARGIN)
    x, y = points.xyz[:, 0], points.xyz[:, 1]
    use = (x >= x0) & (x < x1) & (y >= y0) & (y < y1)
    vegetation = np.isin(points.klass, VEGETATION)
    if work.spool.vegetation:
        use &= vegetation | np.isin(points.klass, GROUND)
    else:
        use &= ~np.isin(points.klass, (6, 9, 11, 17))
    xyz = points.xyz[use]
    grid = grid_of(square, canopy.CELL, margin=canopy.MARGIN)
    built = burnt(work.footprints, grid, buffer=1.0)
    above = xyz[:, 2] - terrain.height(xyz[:, 0], xyz[:, 1])
    found = canopy.find_trees(xyz, above, grid=grid, excluded=built)
    xmin, ymin, xmax, ymax = box_of(square)
    x, y = found.xy.T
    return found.take((x >= xmin) & (x < xmax) & (y >= ymin) & (y < ymax))


def agreement(high: Bools, built: Bools) -> Float:
    """Cells (2 n + 1, 2 n + 1) of a mapped building's inside at a high place minus those around it.

    The value at [n + r, n + c], n = `SHIFT_REACH`, is for the cloud moved by r rows and c columns.

    high  : (rows, columns) bool, cells with points high above the ground, with `SHIFT_REACH` cells around
    built : (rows, columns) bool, cells in mapped buildings, of the same raster
    """
    inner = built[SHIFT_REACH:-SHIFT_REACH, SHIFT_REACH:-SHIFT_REACH]
    weight = (
        np.where(inner, 1.0, -1.0) * _near_edge(built)[SHIFT_REACH:-SHIFT_REACH, SHIFT_REACH:-SHIFT_REACH]
    )
    rows, columns = inner.shape
    out = np.zeros((2 * SHIFT_REACH + 1, 2 * SHIFT_REACH + 1))
    for r in range(-SHIFT_REACH, SHIFT_REACH + 1):
        for c in range(-SHIFT_REACH, SHIFT_REACH + 1):
            moved = high[
                SHIFT_REACH - r : SHIFT_REACH - r + rows, SHIFT_REACH - c : SHIFT_REACH - c + columns
            ]
            out[SHIFT_REACH + r, SHIFT_REACH + c] = weight[moved].sum()
    return out


def _near_edge(built: Bools) -> Bools:
    """Mask of the cells within 3 m of the outline of a mapped building, which determine the shift."""
    from scipy.ndimage import binary_dilation, binary_erosion  # noqa: PLC0415 - slow to import

    steps = int(3.0 / SHIFT_CELL)
    return np.asarray(binary_dilation(built, iterations=steps) & ~binary_erosion(built, iterations=steps))


def best_shift(score: Float) -> tuple[float, float, float]:
    """Metres east and north by which to move the cloud, and the gain over no shift as a share of the best.

    score : sum of `agreement` over all squares

    The peak between cells is that of a parabola through the best cell and its neighbours; zero without a
    clear peak, as where there are no buildings or the best lies at the rim.
    """
    best = score.max()
    if best <= 0:
        return 0.0, 0.0, 0.0
    row, column = np.unravel_index(int(np.argmax(score)), score.shape)
    if not (0 < row < 2 * SHIFT_REACH and 0 < column < 2 * SHIFT_REACH):
        return 0.0, 0.0, 0.0
    north = row - SHIFT_REACH + _vertex(score[row - 1 : row + 2, column])
    east = column - SHIFT_REACH + _vertex(score[row, column - 1 : column + 2])
    return (
        float(east * SHIFT_CELL),
        float(north * SHIFT_CELL),
        float((best - score[SHIFT_REACH, SHIFT_REACH]) / best),
    )


def _vertex(three: Float) -> float:
    """Place of the extremum of a parabola through values at -1, 0 and 1."""
    bend = three[0] - 2 * three[1] + three[2]
    return float(0.5 * (three[0] - three[2]) / bend) if bend < 0 else 0.0
