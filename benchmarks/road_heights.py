"""Heights of drivable streets, measured by rays: off their graph, blocked, with steps, without ground.

    python benchmarks/road_heights.py SCENE_OR_MAP [...] [--dem FILE ...] [--bbox W,S,E,N] [--worst 5]

A map is built without relief: on level ground, and again on terrain if some elevation files overlap it.
Samples lie 0.25 m apart on the centre lines of the road graph, each street once. A sample is

    height  if the first surface below 2 m over the graph is more than 5 cm from the graph's height (with the
            camber of a scene with relief, if it is not between the edge and the crown),
    road    if that surface is not a street's (a sidewalk, soil, a building ...),
    blocked if something stands between it and 2.5 m over it (or the mapped height of a lower passage), or
            between it and the next one 0.5 m above them,
    step    if that surface is more than 12 cm higher or lower than at the next sample,
    hole    if there is no surface below it.

For each kind of edge (ground, bridge, tunnel) the counts; of each fault the classes of the surface below, and
the places where it is greatest.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import shapely
from numpy.typing import NDArray
from rasterio.warp import transform_bounds

from geoscene import BuildOptions, Scene, build, open_scene, read_osm
from geoscene.classes import Class
from geoscene.geometry import polylines
from geoscene.geometry.mesh import concatenate
from geoscene.ground.relief import CAMBER
from geoscene.ground.terrain import gdal_name
from geoscene.roadgraph import RoadGraph, read_graphml
from geoscene.sources import OsmData
from geoscene.typing import Bools, Float, Ints
from lidar.raycast import Caster

SPACING, ABOVE, FREE, AMID = 0.25, 2.0, 2.5, 0.5
OFF, STEP = 0.05, 0.12
DEEP = 30.0
DRIVEN = (Class.ROAD, Class.LANE_MARKING, Class.CROSSING, Class.RAIL)
FAULTS = ("height", "road", "blocked", "step", "hole")
KINDS = ("ground", "bridge", "tunnel")
MAPPED = ("height", "maxheight:physical", "maxheight")
SEED = 1e-3


@dataclass(frozen=True)
class Samples:
    """Samples along edges: place (n, 3), edge (n,), whether the next one is on the same edge (n,)."""

    xyz: Float
    edge: Ints
    followed: Bools


def samples(graph: RoadGraph) -> Samples:
    """Samples of all streets, of two-way streets once, at the heights of the graph."""
    places, edges = [np.empty((0, 3))], [np.empty(0, np.int64)]
    for edge in np.flatnonzero(graph.once).tolist():
        line = graph.geometry[edge]
        along = polylines.stations(line)
        count = max(int(along[-1] / SPACING), 1)
        places.append(polylines.points_at(line, (np.arange(count) + 0.5) * along[-1] / count, along=along))
        edges.append(np.full(count, edge))
    edge = np.concatenate(edges)
    return Samples(np.concatenate(places), edge, np.append(edge[1:] == edge[:-1], False))


def mesh_of(scene: Scene) -> tuple[Caster, NDArray[np.uint8]]:
    """The ground and all solids of a scene, and the classes of their faces."""
    tiles = (scene.tile(i, j, forests=False) for i, j in scene.tile_indices)
    mesh = concatenate([tile.mesh.shifted(tile.origin) for tile in tiles])
    return Caster(mesh.vertices, mesh.faces), mesh.klass


def measure(scene: Scene) -> tuple[Samples, RoadGraph, dict[str, Float], NDArray[np.int64]]:
    """Samples, their graph, by fault how great it is at each sample, NaN where it is none; classes below."""
    graph = read_graphml(scene.files.road_graph, scene.frame)
    points = samples(graph)
    caster, klass = mesh_of(scene)
    xyz, up = points.xyz, np.array([0.0, 0.0, 1.0])
    # Off the vertices and edges of faces by a millimetre, which rays may miss.
    at = xyz + np.append(
        np.random.default_rng(0).uniform(-SEED, SEED, (len(xyz), 2)), np.zeros((len(xyz), 1)), 1
    )
    free = free_heights(scene, at)
    above = np.minimum(ABOVE, free - AMID)
    down = caster.cast(at + above[:, None] * up, np.broadcast_to(-up, at.shape), far=ABOVE + DEEP)
    rise = np.where(np.isinf(down.range), np.nan, above - down.range)
    crown = CAMBER * graph.width[points.edge] / 2 if scene.manifest["options"]["relief"] != "off" else 0.0
    off = np.where(rise > 0, np.maximum(rise - crown, 0.0), rise)
    over = caster.cast(at + OFF * up, np.broadcast_to(up, at.shape), far=FREE - OFF)
    low = over.range + OFF < np.minimum(FREE, free - OFF)
    # A face that is seen from its back closes a body, or the ground, around the sample.
    within = caster.cast(at + 2 * OFF * up, np.broadcast_to(up, at.shape), far=1e3)
    next_one = np.flatnonzero(points.followed)
    run = at[next_one + 1] - at[next_one]
    ahead = caster.cast(at[next_one] + AMID * up, run, far=1.0)
    blocked = np.where(low, over.range + OFF, np.nan)
    inside = np.isfinite(within.range) & (within.cosine < 0) & ~(rise > OFF)
    blocked[inside] = 0.0
    blocked[next_one[np.isfinite(ahead.range)]] = AMID
    step = np.full(len(xyz), np.nan)
    z = xyz[:, 2] + rise
    step[next_one] = z[next_one + 1] - z[next_one]
    hole = np.where(np.isnan(rise) & ~inside, 1.0, np.nan)
    below = np.where(np.isfinite(rise), klass[down.face], Class.UNLABELED).astype(np.int64)
    on_road = np.isin(below, DRIVEN)
    return (
        points,
        graph,
        {
            "height": np.where(np.abs(off) > OFF, off, np.nan),
            "road": np.where(np.isfinite(rise) & ~on_road, below.astype(float), np.nan),
            "blocked": blocked,
            "step": np.where(np.abs(step) > STEP, step, np.nan),
            "hole": hole,
        },
        below,
    )


def free_heights(scene: Scene, places: Float) -> Float:
    """Mapped free heights of passages of buildings over places (n, 3) in metres, infinite elsewhere."""
    free = np.full(len(places), np.inf)
    if scene.table_length("passages"):
        passages = scene.features("passages")
        height = np.asarray(passages.columns["height"], float)
        height[~np.isin(passages.columns["height_source"], MAPPED)] = np.inf
        points = shapely.points(places[:, :2])
        place, passage = shapely.STRtree(passages.geometry).query(points, predicate="within")
        np.minimum.at(free, place, height[passage])
    return free


def report(scene: Scene, *, worst: int) -> dict[str, Any]:
    """Counts of samples and faults by kind of edge, and the worst places of each fault."""
    points, graph, faults, below = measure(scene)
    kind = np.where(graph.tunnel, 2, np.where(graph.bridge, 1, 0))[points.edge]
    counts = {
        name: {"samples": int((kind == k).sum())}
        | {fault: int((np.isfinite(size) & (kind == k)).sum()) for fault, size in faults.items()}
        for k, name in enumerate(KINDS)
    }
    return {
        "counts": counts,
        "below": {
            fault: {Class(k).name: n for k, n in Counter(below[np.isfinite(size)].tolist()).most_common()}
            for fault, size in faults.items()
        },
        "worst": {
            fault: [
                describe(scene, graph, points, row, float(size[row])) for row in spread(points, size, worst)
            ]
            for fault, size in faults.items()
        },
    }


def spread(points: Samples, size: Float, worst: int) -> list[int]:
    """The samples of the greatest faults, one of each edge."""
    rows = np.flatnonzero(np.isfinite(size))
    rows = rows[np.argsort(-np.abs(size[rows]), kind="stable")]
    _, first = np.unique(points.edge[rows], return_index=True)
    return rows[np.sort(first)][:worst].tolist()


def describe(scene: Scene, graph: RoadGraph, points: Samples, row: int, size: float) -> dict[str, Any]:
    """Way, place and size of a fault."""
    x, y, z = points.xyz[row].tolist()
    lon, lat = (float(v[0]) for v in scene.frame.to_geographic(np.array([x]), np.array([y])))
    return {
        "way": str(graph.osm_id[points.edge[row]]),
        "lat": round(lat, 6), "lon": round(lon, 6), "x": round(x, 2), "y": round(y, 2), "z": round(z, 2),
        "size": round(size, 3),
    }  # fmt: skip


def terrain_of(osm: OsmData, files: Sequence[Path]) -> tuple[str, ...]:
    """The elevation files that overlap a map."""
    box, found = shapely.box(*osm.bounds), []
    for path in files:
        with rasterio.open(gdal_name(path)) as raster:
            if shapely.box(*transform_bounds(raster.crs, "EPSG:4326", *raster.bounds)).intersects(box):
                found.append(str(path))
    return tuple(found)


def scenes_of(path: Path, given: argparse.Namespace, folder: Path) -> Iterator[tuple[str, Scene]]:
    """A scene, or those of a map on level ground and on terrain."""
    if path.is_dir():
        yield path.name, open_scene(path)
        return
    osm, name = read_osm(path, bounds=given.bbox), path.name.split(".")[0]
    grounds = {"level": (), "terrain": terrain_of(osm, given.dem)}
    for ground, dem in grounds.items():
        if (ground == "level" and given.only != "terrain") or (dem and given.only != "level"):
            options = BuildOptions(
                relief="off",
                lod=1,
                dem=dem,
                dem_gaps="nearest",
                only=("buildings", "roads", "landcover", "barriers"),
            )
            yield f"{name} {ground}", build(osm, folder / ground, options=options, overwrite=True)


def text_of(name: str, found: dict[str, Any]) -> str:
    """A report as lines."""
    lines = []
    for kind, row in found["counts"].items():
        if row["samples"]:
            lines.append(f"{name:40} {kind:6} " + " ".join(f"{what} {n:7}" for what, n in row.items()))
    for fault, places in found["worst"].items():
        if found["below"][fault]:
            below = ", ".join(f"{name} {n}" for name, n in found["below"][fault].items())
            lines.append(f"    {fault} on {below}")
        lines += [
            f"    {fault:8}{p['size']:9.3f}  {p['way']:34.34} {p['lat']},{p['lon']}"
            f"  ({p['x']}, {p['y']}, {p['z']})"
            for p in places
        ]
    return "\n".join(lines)


def box_of(text: str) -> tuple[float, ...]:
    """West, south, east and north in degrees."""
    return tuple(float(part) for part in text.split(","))


def main() -> None:
    """Measure the scenes and maps of the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("path", type=Path, nargs="+")
    parser.add_argument("--dem", type=Path, nargs="+", default=[])
    parser.add_argument("--bbox", type=box_of)
    parser.add_argument("--only", choices=("level", "terrain"), help="build maps on this ground alone")
    parser.add_argument("--worst", type=int, default=5)
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    for path in given.path:
        with tempfile.TemporaryDirectory() as folder:
            for name, scene in scenes_of(path, given, Path(folder)):
                found = report(scene, worst=given.worst)
                print(json.dumps({"scene": name} | found) if given.json else text_of(name, found), flush=True)


if __name__ == "__main__":
    main()
