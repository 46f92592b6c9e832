"""Measures a place in point clouds: the ground as a raster, buildings and trees as tags of the map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np

from geoscene.buildings import read_buildings
from geoscene.clouds.apply import with_measurements
from geoscene.clouds.ground import MARGIN, CloudGrid, bridged_by_blocks
from geoscene.clouds.measure import GroundOf, Work, best_shift, burnt, grounds_of, is_classified, measure
from geoscene.clouds.read import SIDE, Spool, SurveyFile, open_cloud, spool_clouds
from geoscene.errors import InputError
from geoscene.geometry.frames import Frame, extent_of, wrap_longitude
from geoscene.ground.terrain import open_terrain
from geoscene.options import BuildOptions, CloudOptions
from geoscene.sources.data import Credit, OsmData
from geoscene.support.digests import digest, file_digest, value_digest
from geoscene.support.files import atomic_path, temporary_folder
from geoscene.support.problems import Problem
from geoscene.support.progress import Progress, silent

_FAR = 100.0  # metres from a ground return beyond which the ground is not known
_MOST_CELLS = 36_000_000  # of the raster of the ground
_PER_CELL = 2.0  # points, at least, in a mean cell of it
_TOLERANCE = 0.05  # metres by which bare ground may differ from that raster, by default
_SHIFTED = 0.1  # metres of shift that are worth a correction
_CACHE_VERSION = 2


def with_clouds(
    osm: OsmData,
    options: BuildOptions,
    *,
    cloud: CloudOptions,
    cache_dir: Path,
    workers: int = 1,
    progress: Progress = silent,
) -> tuple[OsmData, BuildOptions]:
    """The map with heights, roofs and trees of point clouds, and options with the raster of their ground.

    Without clouds both are returned as they are. The result does not depend on ``workers``.

    cache_dir : folder for the raster of the ground, and for temporary files of about 14 bytes a point

    Raises SourceNotFoundError and InputError for clouds that cannot be read, lie beside the map, have no
    known CRS or unit, mix vertical datums, or leave ground without heights that no elevation file covers.
    """
    if not cloud.cloud:
        return osm, options
    files = [open_cloud(Path(p), crs=cloud.cloud_crs, unit=cloud.cloud_unit) for p in cloud.cloud]
    _check_datums(files)
    west, south, east, north = osm.bounds
    frame = Frame.at(wrap_longitude((west + east) / 2), (south + north) / 2, crs=options.crs)
    buildings, _ = read_buildings(osm, frame)
    footprints = buildings.footprint[: buildings.count]
    extent = extent_of(frame, osm.bounds, footprints=footprints)
    reach = (extent[0] - MARGIN, extent[1] - MARGIN, extent[2] + MARGIN, extent[3] + MARGIN)
    with temporary_folder(cache_dir / "cloud", "points") as folder:
        spool = spool_clouds(files, frame, bounds=reach, folder=folder, progress=progress)
        work = Work(spool, footprints, _cell(spool, extent, reach=reach), (0.0, 0.0))
        grounds = grounds_of(work, workers=workers, progress=progress)
        east_m, north_m, gain = best_shift(sum((g.agreement for g in grounds), np.zeros(())))
        moved = cloud.cloud_align and np.hypot(east_m, north_m) > _SHIFTED
        if moved:
            work = work._replace(shift=(east_m, north_m))
            grounds = grounds_of(work, workers=workers, progress=progress)
        keys = [file_digest(file.path) for file in files]
        raster, bridged = _ground_file(
            grounds, work, frame=frame, extent=extent, files=files, keys=keys, cloud=cloud,
            options=options, cache_dir=cache_dir, footprints=footprints,
        )  # fmt: skip
        dem = (str(raster), *options.dem)
        gaps = cast("Literal['error', 'nearest']", options.dem_gaps)
        terrain = open_terrain(dem, frame, bounds=extent, outside=gaps)
        measured = measure(work, buildings, terrain=terrain, frame=frame, workers=workers, progress=progress)
    attribution = cloud.cloud_attribution or f"point cloud {', '.join(f.path.name for f in files)}" + (
        "" if cloud.cloud_licence else ", licence unknown"
    )
    inside = ((measured.trees.xy >= extent[:2]) & (measured.trees.xy < extent[2:])).all(axis=1)
    measured = replace(measured, trees=measured.trees.take(inside))
    credit = Credit(
        "cloud",
        ", ".join(file.path.name for file in files),
        "",
        cloud.cloud_licence or "unknown",
        attribution,
    )
    known = sum(int(np.isfinite(g.heights).sum()) for g in grounds)
    about = {
        "files": [
            {"name": f.path.name, "digest": key, "points": f.count, "within": many, "crs": f.crs.name,
             "datum": f.datum}
            for f, key, many in zip(files, keys, spool.within, strict=True)
        ],
        "points": {
            "read": spool.read,
            "beside_the_map": spool.outside,
            "noise": spool.noise,
            "outliers": sum(g.outliers for g in grounds),
        },
        "shift_m": {"east": round(east_m, 3), "north": round(north_m, 3), "applied": bool(moved),
                    "gain": round(gain, 4)},
        "ground": {
            "from": "class ground" if is_classified(spool) else "filter",
            "cell_m": work.cell,
            "cells": known,
            "cells_bridged": bridged,
        },
    }  # fmt: skip
    osm, found = with_measurements(osm, measured, prefer_tags=cloud.prefer == "tags")
    about |= found
    beside = [
        Problem("", "cloud", "dropped", "beside-the-map", f"{f.path.name}: no point within the map")
        for f, many in zip(files, spool.within, strict=True)
        if not many
    ]
    tolerance = _TOLERANCE if options.dem_tolerance is None else options.dem_tolerance
    return (
        replace(osm, added=(*osm.added, credit), cloud=about, problems=osm.problems + beside),
        replace(options, dem=dem, dem_tolerance=tolerance),
    )


def _check_datums(files: Sequence[SurveyFile]) -> None:
    if len({file.vertical for file in files}) > 1:
        raise InputError(
            "the clouds differ in the reference of heights: "
            + "; ".join(f"{file.path.name}: {file.vertical}" for file in files)
        )


def _cell(spool: Spool, extent: Sequence[float], *, reach: Sequence[float]) -> float:
    """Metres of a cell of the ground: a power of two from 1, by the density of points and the extent.

    reach : bounds within which points were taken, beyond which squares at the rim are empty
    """
    low = np.array(spool.squares) * SIDE
    sides = np.maximum(np.minimum(low + SIDE, reach[2:]) - np.maximum(low, reach[:2]), 0.0)
    density = (spool.read - spool.outside) / sides.prod(axis=1).sum()
    area = (extent[2] - extent[0]) * (extent[3] - extent[1])
    least = max(1.0, np.sqrt(_PER_CELL / density), np.sqrt(area / _MOST_CELLS))
    return float(min(2.0 ** np.ceil(np.log2(least)), SIDE / 4))


def _ground_file(
    grounds: Sequence[GroundOf],
    work: Work,
    *,
    frame: Frame,
    extent: Sequence[float],
    files: Sequence[SurveyFile],
    keys: Sequence[str],
    cloud: CloudOptions,
    options: BuildOptions,
    cache_dir: Path,
    footprints: Any,
) -> tuple[Path, int]:
    """The GeoTIFF of the ground within the extent, in the scene's CRS, and the cells that were bridged.

    Cells without ground returns, as under buildings, are bridged by triangles between those around. Cells
    over 100 m from any ground return, buildings aside, take the height of the elevation files. Others, as at
    the rim, stay empty.
    """
    from scipy.ndimage import distance_transform_edt  # noqa: PLC0415 - slow to import

    cell = work.cell
    low = np.floor(np.array(extent[:2]) / cell).astype(int) - 1
    high = np.ceil(np.array(extent[2:]) / cell).astype(int) + 1
    many = round(SIDE / cell)
    columns, rows = (high - low).tolist()
    heights = np.full((rows, columns), np.nan, np.float32)
    for ground in grounds:
        first = np.array(ground.square) * many - low
        begin, end = np.maximum(first, 0), np.minimum(first + many, (columns, rows))
        if (begin < end).all():
            (c0, r0), (c1, r1) = begin - first, end - first
            heights[begin[1] : end[1], begin[0] : end[0]] = ground.heights[r0:r1, c0:c1]
    if np.isnan(heights).all():
        raise InputError(f"{files[0].path.name}: no ground returns within the map")
    grid = CloudGrid(float(low[0] * cell), float(low[1] * cell), columns, rows, cell)
    gap = np.isnan(heights) & (distance_transform_edt(np.isnan(heights)) * cell > _FAR)
    gap &= ~burnt(footprints, grid)
    if gap.any() and options.dem:
        gaps = cast("Literal['error', 'nearest']", options.dem_gaps)
        other = open_terrain(options.dem, frame, bounds=extent, outside=gaps)
        east, north = grid.centres()
        heights[gap] = other.height(east[gap], north[gap])
        gap[:] = False
    elif gap.any() and options.dem_gaps == "error":
        share = gap.mean()
        raise InputError(
            f"{', '.join(f.path.name for f in files)}: {100 * share:.1f} % of the scene is over {_FAR:.0f} m"
            " from any ground return; cut the map (`bbox`), add an elevation file (`dem` FILE), or let it"
            " take the nearest height (`dem_gaps` nearest)"
        )
    void = np.isnan(heights)
    heights = np.where(gap, np.nan, bridged_by_blocks(heights))
    about = [_CACHE_VERSION, frame.to_json(), list(extent), list(keys), work.shift, cloud.cloud_crs,
             cloud.cloud_unit, digest(heights.tobytes())]  # fmt: skip
    path = cache_dir / f"cloud-ground-{value_digest(about)}.tif"
    if not path.exists():
        _write_raster(
            path, heights, grid=grid, frame=frame, file=files[0], attribution=cloud.cloud_attribution
        )
    return path, int((void & ~np.isnan(heights)).sum())


def _write_raster(
    path: Path, heights: Any, *, grid: CloudGrid, frame: Frame, file: SurveyFile, attribution: str
) -> None:
    import rasterio  # noqa: PLC0415 - slow to import

    crs = frame.crs.to_3d() if file.vertical == "ellipsoidal" else frame.crs
    north = grid.y + grid.rows * grid.cell + frame.origin[1]
    place = rasterio.Affine(grid.cell, 0.0, grid.x + frame.origin[0], 0.0, -grid.cell, north)
    with (
        atomic_path(path, keep_suffix=True) as part,
        rasterio.open(
            part, "w", driver="GTiff", width=grid.columns, height=grid.rows, count=1, dtype="float32",
            crs=crs.to_wkt(), transform=place, nodata=float("nan"), compress="deflate", predictor=3,
        ) as target,
    ):  # fmt: skip
        target.write(heights[::-1], 1)
        target.update_tags(VERTICAL_DATUM=file.datum)
        if attribution:
            target.update_tags(TIFFTAG_COPYRIGHT=attribution)
