"""Heights, roofs, ground and trees that a point cloud gives back, against the map that it was simulated from.

    python benchmarks/clouds.py MAP CLOUD [--bbox W,S,E,N] [--dem FILE ...] [--align]

MAP has the true heights and roofs, and CLOUD is a map (`lidar map`) of a survey flight over its scene. The
tags are withheld, measured in the cloud, and compared. Residuals of the ground are against the elevation
files, or level ground, without the roads that scenes grade into them.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import shapely
from scipy.spatial import cKDTree

from geoscene.buildings import Buildings, read_buildings
from geoscene.clouds.survey import with_clouds
from geoscene.frames import Frame, extent_of, wrapped
from geoscene.ground.terrain import Terrain, open_terrain
from geoscene.objects.vegetation import read_trees
from geoscene.options import BuildOptions, CloudOptions
from geoscene.sources import OsmData, read_osm

WITHHELD = ("height", "building:height", "est_height", "building:levels", "roof:")


def withheld(osm: OsmData) -> OsmData:
    """The map without heights, storeys, roofs and trees."""
    areas = [
        replace(a, tags={k: v for k, v in a.tags.items() if not k.startswith(WITHHELD)}) for a in osm.areas
    ]
    points = [p for p in osm.points if p.tags.get("natural") != "tree"]
    ways = [w for w in osm.ways if w.tags.get("natural") != "tree_row"]
    return replace(osm, areas=areas, points=points, ways=ways)


def compare_buildings(truth: Buildings, made: Buildings) -> None:
    """Print errors of heights and eaves, and the confusion of roof shapes, where heights are tagged."""
    row = {(i, part): k for k, (i, part) in enumerate(zip(made.osm_id, made.is_part, strict=True))}
    tagged = np.flatnonzero(truth.drawn & (truth.height_source == "tag"))
    pairs = [(k, row[truth.osm_id[k], truth.is_part[k]]) for k in tagged.tolist()]
    a, b = np.array([(k, m) for k, m in pairs if made.height_source[m] == "cloud"]).T
    print(f"tagged and drawn {len(tagged)}, measured {len(a)}")
    for name, error in (
        ("height", made.height[b] - truth.height[a]),
        ("eaves", (made.height - made.roof_height)[b] - (truth.height - truth.roof_height)[a]),
    ):
        within = (np.abs(error) < 0.1).sum()
        print(
            f"{name}: median {np.median(error):.3f} m, |error| 50 % {np.median(np.abs(error)):.3f},"
            f" 95 % {np.percentile(np.abs(error), 95):.3f}, largest {np.abs(error).max():.2f} m;"
            f" within 10 cm {100 * within / len(a):.1f} % of measured,"
            f" {100 * within / len(tagged):.1f} % of all"
        )
    confusion = Counter(zip(truth.roof_shape[a].tolist(), made.roof_shape[b].tolist(), strict=True))
    right = sum(n for (one, two), n in confusion.items() if one == two)
    print(f"roof shapes: {100 * right / len(a):.1f} % right;", sorted(confusion.items()))


def compare_ground(
    truth: Terrain, made: Terrain, *, footprints: np.ndarray, extent: tuple[float, ...]
) -> None:
    """Print errors of the ground at random places outside buildings and below them."""
    x, y = np.random.default_rng(0).uniform((extent[:2],) * 20000, (extent[2:],) * 20000).T
    below = np.zeros(len(x), np.bool_)
    below[shapely.STRtree(footprints).query(shapely.points(x, y), predicate="intersects")[0]] = True
    error = np.abs(made.height(x, y) - truth.height(x, y))
    for name, some in (("outside", error[~below]), ("below buildings", error[below])):
        print(f"ground {name}: 50 % {np.median(some):.3f} m, 95 % {np.percentile(some, 95):.3f} m")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("map")
    parser.add_argument("cloud")
    parser.add_argument("--bbox")
    parser.add_argument("--dem", nargs="*", default=[])
    parser.add_argument("--align", action="store_true")
    given = parser.parse_args()
    bounds = tuple(float(v) for v in given.bbox.split(",")) if given.bbox else None
    osm = read_osm(given.map, bounds=bounds)
    west, south, east, north = osm.bounds
    frame = Frame.at(wrapped((west + east) / 2), (south + north) / 2)
    with tempfile.TemporaryDirectory() as folder:
        started = time.perf_counter()
        measured, options = with_clouds(
            withheld(osm),
            BuildOptions(dem_gaps="nearest"),
            cloud=CloudOptions((given.cloud,), cloud_align=given.align),
            cache_dir=Path(folder),
        )
        print(f"{time.perf_counter() - started:.0f} s, one process;", json.dumps(measured.cloud))
        truth, _ = read_buildings(osm, frame)
        made, _ = read_buildings(measured, frame)
        compare_buildings(truth, made)
        footprints = truth.footprint[: truth.count]
        extent = extent_of(frame, osm.bounds, footprints=footprints)
        ground = Terrain(frame)
        if given.dem:
            ground = open_terrain(given.dem, frame, bounds=extent)
        found = open_terrain(options.dem, frame, bounds=extent, outside="nearest")
        compare_ground(ground, found, footprints=footprints, extent=extent)
    mapped, trees = read_trees(osm, frame)[0], read_trees(measured, frame)[0]
    inside = ((mapped.xy > extent[:2]) & (mapped.xy < extent[2:])).all(axis=1)
    mapped = mapped.take(inside)
    if len(mapped) and len(trees):
        distance, near = cKDTree(trees.xy).query(mapped.xy)
        close = distance < 2.5
        error = np.abs(trees.height[near] - mapped.height)[close]
        false = len(trees) - len(set(near[close].tolist()))
        print(
            f"trees: {close.sum()} of {len(mapped)} found, {false} false;"
            f" height 95 % {np.percentile(error, 95):.2f} m"
        )


if __name__ == "__main__":
    main()
