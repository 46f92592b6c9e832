"""Sorts clouds of any size into square files on disk, so that no more than a square is in memory."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pyproj.exceptions import ProjError

from geoscene.clouds.read import GROUND, NOISE, VEGETATION, SurveyFile
from geoscene.errors import InputError
from geoscene.geometry.frames import Frame
from geoscene.support.columns import Columns
from geoscene.support.progress import Progress, silent
from geoscene.typing import Bools, Float

SIDE = 128.0
"""Metres of a square: 0.3 million points of an airborne cloud, some ten million of a mobile one."""

_RECORD = np.dtype([("xyz", "<i4", 3), ("klass", "u1"), ("last", "?")])
_STEP = 0.001  # metres of the integer coordinates
_HELD = 4_000_000  # points in memory before they are written
_LOWEST, _HIGHEST = -500.0, 9500.0  # metres of land and of towers on it; other heights are errors
_VOXEL, _FEWEST = 3.0, 4  # points with fewer than this many in the 27 cubes of 3 m around are outliers

Square = tuple[int, int]


@dataclass(frozen=True, slots=True)
class SurveyPoints(Columns):
    """Points of a survey, as columns.

    xyz   : (n, 3) float64, scene metres
    klass : (n,) uint8 class of the ASPRS, 0 if unknown
    last  : (n,) bool, the last return of its pulse
    """

    xyz: Float
    klass: NDArray[np.uint8]
    last: Bools


@dataclass(frozen=True, slots=True)
class Spool:
    """Points in a folder, one file a square.

    squares : those with points, sorted
    read    : points of all files
    within  : points of each file within the bounds
    noise   : points of class noise, withheld ones, and those at impossible heights
    ground  : points of the classes of ground within the bounds
    vegetation : points of the classes of vegetation within the bounds
    """

    folder: Path
    squares: tuple[Square, ...]
    read: int
    within: tuple[int, ...]
    noise: int
    ground: int
    vegetation: int

    @property
    def outside(self) -> int:
        """Points beyond the bounds."""
        return self.read - sum(self.within)

    def around(self, bounds: Sequence[float], *, shift: tuple[float, float] = (0.0, 0.0)) -> SurveyPoints:
        """The points within bounds (xmin, ymin, xmax, ymax) after a shift in metres is added to all."""
        low = np.floor((np.array(bounds[:2]) - shift) / SIDE).astype(int)
        high = np.floor((np.array(bounds[2:]) - shift) / SIDE).astype(int)
        parts = [np.empty(0, _RECORD)]
        for i in range(low[0], high[0] + 1):
            for j in range(low[1], high[1] + 1):
                path = self.folder / f"{i}_{j}.points"
                if path.exists():
                    parts.append(np.fromfile(path, _RECORD))
        rows = np.concatenate(parts)
        xyz = rows["xyz"] * _STEP + (*shift, 0.0)
        inside = ((xyz[:, :2] >= bounds[:2]) & (xyz[:, :2] < bounds[2:])).all(axis=1)
        return SurveyPoints(xyz[inside], rows["klass"][inside], rows["last"][inside])


def spool_clouds(
    clouds: Sequence[SurveyFile],
    frame: Frame,
    *,
    bounds: Sequence[float],
    folder: Path,
    progress: Progress = silent,
) -> Spool:
    """Points of clouds within bounds (xmin, ymin, xmax, ymax; scene metres), sorted into squares.

    Raises InputError for a cloud whose CRS cannot be transformed to the scene's, and if no point lies within
    the bounds.
    """
    held: dict[Square, list[NDArray[np.void]]] = defaultdict(list)
    squares: set[Square] = set()
    waiting = read = noise = ground = plants = 0
    inside = [0] * len(clouds)
    total = sum(cloud.count for cloud in clouds)
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for k, cloud in enumerate(clouds):
        for chunk in cloud.chunks():
            try:
                x, y = frame.from_crs(chunk.xyz[:, 0], chunk.xyz[:, 1], crs=cloud.crs)
            except ProjError as error:
                raise InputError(
                    f"{cloud.path}: its CRS {cloud.crs.name} cannot be transformed to the scene's ({error})"
                ) from error
            xyz = np.column_stack([x, y, chunk.xyz[:, 2] * cloud.to_metres])
            finite = np.isfinite(xyz).all(axis=1)
            low = np.minimum(low, xyz[finite, :2].min(axis=0, initial=np.inf))
            high = np.maximum(high, xyz[finite, :2].max(axis=0, initial=-np.inf))
            within = finite & ((xyz[:, :2] >= bounds[:2]) & (xyz[:, :2] < bounds[2:])).all(axis=1)
            bad = within & (np.isin(chunk.klass, NOISE) | (xyz[:, 2] < _LOWEST) | (xyz[:, 2] > _HIGHEST))
            keep = within & ~bad
            rows = np.empty(int(keep.sum()), _RECORD)
            rows["xyz"] = np.rint(xyz[keep] / _STEP).astype(np.int64)
            rows["klass"], rows["last"] = chunk.klass[keep], chunk.last[keep]
            for square, some in _by_square(rows):
                held[square].append(some)
                squares.add(square)
            inside[k] += int(within.sum())
            read, noise = read + len(xyz), noise + int(bad.sum())
            ground += int(np.isin(rows["klass"], GROUND).sum())
            plants += int(np.isin(rows["klass"], VEGETATION).sum())
            waiting += len(rows)
            if waiting > _HELD:
                _flush(held, folder)
                waiting = 0
            progress("point cloud", read, total=total)
    _flush(held, folder)
    if not squares:
        raise InputError(_beside(clouds, frame, bounds=bounds, covered=(*low.tolist(), *high.tolist())))
    return Spool(folder, tuple(sorted(squares)), read, tuple(inside), noise, ground, plants)


def without_outliers(points: SurveyPoints) -> SurveyPoints:
    """The points without single ones and small groups far from all others, such as birds and low noise."""
    if not len(points):
        return points
    cell = np.floor(points.xyz / _VOXEL).astype(np.int64)
    cell -= cell.min(axis=0) - 1
    shape = cell.max(axis=0) + 2
    key, owner, count = np.unique(
        np.ravel_multi_index(cell.T, shape), return_inverse=True, return_counts=True
    )
    around = np.zeros(len(key), np.int64)
    for dx in (-1, 0, 1):
        for dy in (-1, 0, 1):
            for dz in (-1, 0, 1):
                near = key + (dx * shape[1] + dy) * shape[2] + dz
                at = np.minimum(np.searchsorted(key, near), len(key) - 1)
                around += np.where(key[at] == near, count[at], 0)
    return points.take(around[owner] >= _FEWEST)


def _by_square(rows: NDArray[np.void]) -> list[tuple[Square, NDArray[np.void]]]:
    """The rows of each square, in their order."""
    if not len(rows):
        return []
    square = rows["xyz"][:, :2] // round(SIDE / _STEP)
    low = square.min(axis=0)
    many = square.max(axis=0) - low + 1
    key = np.ravel_multi_index((square - low).T.astype(np.int64), many)
    order = np.argsort(key, kind="stable")
    keys, first = np.unique(key[order], return_index=True)
    squares = np.column_stack(np.unravel_index(keys, many)) + low
    parts = np.split(rows[order], first[1:])
    return [((i, j), part) for (i, j), part in zip(squares.tolist(), parts, strict=True)]


def _flush(held: dict[Square, list[NDArray[np.void]]], folder: Path) -> None:
    """Append the buffered points to the files of the squares."""
    for (i, j), parts in held.items():
        with (folder / f"{i}_{j}.points").open("ab") as file:
            for part in parts:
                file.write(part.tobytes())
    held.clear()


def _beside(
    clouds: Sequence[SurveyFile], frame: Frame, *, bounds: Sequence[float], covered: Sequence[float]
) -> str:
    names = ", ".join(cloud.path.name for cloud in clouds)
    if not np.isfinite(covered).all():
        return f"{names}: no point has a place on Earth; is the CRS right ({clouds[0].crs.name})?"
    return (
        f"{names}: no point within the map, which spans {_degrees(frame, bounds)};"
        f" the cloud spans {_degrees(frame, covered)}; is its CRS right ({clouds[0].crs.name})?"
    )


def _degrees(frame: Frame, bounds: Sequence[float]) -> str:
    xmin, ymin, xmax, ymax = bounds
    lon, lat = frame.to_geographic([xmin, xmax, xmax, xmin], [ymin, ymin, ymax, ymax])
    return f"W {np.min(lon):.5f} S {np.min(lat):.5f} E {np.max(lon):.5f} N {np.max(lat):.5f}"
