"""What thinning a map loses: distances between a cloud and its map with one point per voxel."""

from __future__ import annotations

import time
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from geoscene.support.progress import Progress
from lidar.dataset.formats import FORMATS
from lidar.dataset.formats.las import LasInfo
from lidar.dataset.formats.table import Table, cloud_table, records
from lidar.geometry.time_scales import gps_seconds
from lidar.sensors.rig.devices import Scanner
from lidar.tools.maps.voxels import nearest_to_centre
from lidar.tools.tradeoff.comparison import Listing, Record
from lidar.tools.tradeoff.errors import cloud_distances, percentile, rms
from lidar.tools.tradeoff.simulate import Bench, measured_frame

VOXELS = (0.05, 0.1, 0.2, 0.5)
"""Sides of voxels in metres that are compared."""

POINTS = 500_000
"""Points of the map, at least, unless the drive has fewer: consecutive frames from its middle on."""


_COLUMNS = ("x", "y", "z", "intensity", "gps_time", "label")


def voxels_listing(bench: Bench, scanner: Scanner, *, progress: Progress) -> Listing:
    """Distances, bytes and CPU time of maps of a scanner with one point per voxel."""
    cloud, frames = _map_of(bench, scanner, progress=progress)
    full = _bytes(bench, cloud)
    figures = {"share": 1.0, "bytes": float(full)}
    found = [Record("all points", figures)]
    for k, side in enumerate(VOXELS):
        progress(f"voxels of {scanner.name}", k, total=len(VOXELS))
        found.append(_record(bench, cloud, side=side))
    return Listing(
        "voxel",
        f"Map of {scanner.name}: {len(cloud):,} points of {frames} successive frames",
        "lidar map --voxel keeps the point nearest to the centre of each voxel. Distances are those of all"
        " points to the nearest one of the map; the bound is the diagonal of a voxel. The points of the map"
        " are unchanged: the way back is 0. Sizes are those of LAZ; seconds are CPU time for a million"
        " points.",
        tuple(found),
    )


def _record(bench: Bench, cloud: NDArray[np.void], *, side: float) -> Record:
    began = time.process_time()
    kept = nearest_to_centre(cloud, side)
    spent = time.process_time() - began
    there, back = cloud_distances(_xyz(cloud), _xyz(kept))
    figures = {
        "rms_m": rms(there),
        "99.9_m": percentile(there, 0.999),
        "max_m": percentile(there, 1.0),
        "back_max_m": percentile(back, 1.0),
        "bound_m": side * 3**0.5,
        "share": len(kept) / max(1, len(cloud)),
        "bytes": float(_bytes(bench, kept)),
        "thin_s": 1e6 * spent / max(1, len(cloud)),
    }
    return Record(f"voxel={side:g}", figures)


def _map_of(bench: Bench, scanner: Scanner, *, progress: Progress) -> tuple[NDArray[np.void], int]:
    """Points of successive frames, relative to the offset of LAS files, and the number of frames."""
    plan, count = bench.plan, bench.plan.frames[scanner.name]
    parts: list[NDArray[np.void]] = []
    for frame in range(count // 2, count):
        points = sum(map(len, parts))
        if points >= POINTS:
            break
        progress(f"map of {scanner.name}", points, total=POINTS)
        seen = measured_frame(bench, scanner, frame=frame)
        xyz = plan.geo.points(seen.placed) - plan.geo.offset
        table = cloud_table(seen.cloud) | dict(zip("xyz", xyz.T, strict=True))
        table["gps_time"] = gps_seconds(plan.start, seen.time_ns)
        parts.append(
            records({name: table[name] for name in ("x", "y", "z", "intensity", "gps_time", "label")})
        )
    return np.concatenate(parts), len(parts)


def _xyz(cloud: NDArray[np.void]) -> NDArray[np.float64]:
    return np.column_stack([cloud[axis] for axis in "xyz"])


def _bytes(bench: Bench, cloud: NDArray[np.void]) -> int:
    """Size of a map as LAZ."""
    geo, start = bench.plan.geo, bench.plan.start
    table: Table = {name: cloud[name] for name in cloud.dtype.names or ()}
    with TemporaryDirectory() as folder:
        path = Path(folder) / "map.laz"
        FORMATS["laz"].write(path, table, info=LasInfo(geo.crs, (0.0, 0.0, 0.0), start))
        return path.stat().st_size
