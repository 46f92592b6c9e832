"""Heights, roofs, ground and trees that a point cloud gives back, against the scene it was simulated from.

    python benchmarks/clouds.py scene MAP SCENE [--bbox W,S,E,N] [--dem FILE ...] [--draw]
    lidar drive SCENE --survey all --altitude 350 --rig aircraft -o FLIGHT; lidar map FLIGHT -o CLOUD
    python benchmarks/clouds.py spoil CLOUD SPOILT [--seed N]
    python benchmarks/clouds.py measure MAP SPOILT [--bbox W,S,E,N] [--dem FILE ...] [--draw] [--align]

``scene`` builds the truth; with ``--draw`` it gives buildings of the map without heights some, and roofs, at
random by OSM id. ``spoil`` takes the classes from a cloud, moves it by 0.6 m east and 0.4 m south, and adds
noise of 5 cm in plan and 4 cm in height. ``measure`` withholds heights, roofs and trees of the map, measures
them in the cloud, plans the scene and the truth, and compares their tables.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import resource
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import shapely
from scipy.spatial import cKDTree

from geoscene.clouds.survey import with_clouds
from geoscene.ground.terrain import base_heights
from geoscene.options import BuildOptions, CloudOptions
from geoscene.pipeline.build import build
from geoscene.pipeline.plan import BuildPlan, make_plan
from geoscene.sources import OsmData, read_osm
from geoscene.sources.data import Tags
from geoscene.support.progress import silent

WITHHELD = ("height", "building:height", "est_height", "building:levels", "roof:")
SHIFT = (0.6, -0.4)
NOISE = (0.05, 0.05, 0.04)
SHAPES = ("flat", "gabled", "hipped", "pyramidal", "skillion", "half-hipped", "saltbox", "gambrel", "mansard")
NEAR = 0.1  # metres of a height that counts as recovered


def drawn(osm: OsmData) -> OsmData:
    """The map with heights and roofs of buildings that have none, by OSM id."""
    areas = []
    for area in osm.areas:
        tags = area.tags
        if "building" in tags and not any(key.startswith(WITHHELD) for key in tags):
            digest = hashlib.blake2b(area.osm_id.encode(), digest_size=8).digest()
            rng = np.random.default_rng(int.from_bytes(digest, "little"))
            size = np.sqrt(area.geometry.area) * 111_000
            shape = str(rng.choice(SHAPES)) if size < 40 else "flat"
            roof = 0.0 if shape == "flat" else float(rng.uniform(1.5, 4.0))
            tags = tags | {"height": f"{roof + rng.uniform(2.5, 15.0):.2f}", "roof:shape": shape}
            tags |= {} if shape == "flat" else {"roof:height": f"{roof:.2f}"}
        areas.append(replace(area, tags=tags))
    return replace(osm, areas=areas)


def withheld(osm: OsmData) -> OsmData:
    """The map without heights, storeys, roofs and trees."""

    def rest(tags: Tags) -> Tags:
        return {k: v for k, v in tags.items() if not k.startswith(WITHHELD)}

    areas = [replace(a, tags=rest(a.tags)) for a in osm.areas]
    points = [p for p in osm.points if p.tags.get("natural") != "tree"]
    ways = [w for w in osm.ways if w.tags.get("natural") != "tree_row"]
    return replace(osm, areas=areas, points=points, ways=ways)


def spoil(given: argparse.Namespace) -> None:
    """Write a cloud without classes, moved and with noise."""
    import laspy  # noqa: PLC0415

    rng = np.random.default_rng(given.seed)
    with laspy.open(given.cloud) as source, laspy.open(given.out, "w", header=source.header) as target:
        for points in source.chunk_iterator(1_000_000):
            off = rng.normal((*SHIFT, 0.0), NOISE, (len(points), 3))
            for k, axis in enumerate("xyz"):
                setattr(points, axis, np.asarray(getattr(points, axis)) + off[:, k])
            points.classification[:] = 0
            target.write_points(points)


def table(plan: BuildPlan) -> Any:
    """Buildings of a scene by OSM id: base, height, top, roof, area, and slope of the ground.

    slope  : rise of the ground along the outline over the diagonal of its box
    buried : the ground reaches the eaves somewhere along the outline, as drawn heights on steep slopes allow
    """
    buildings, height = plan.buildings, plan.height
    rows = pd.DataFrame({
        name: getattr(buildings, name)[: buildings.count]
        for name in ("height", "roof_height", "roof_shape", "height_source", "drawn", "footprint")
    }, index=buildings.osm_id[: buildings.count])  # fmt: skip
    rows["base"], rows["area"] = plan.base, shapely.area(rows["footprint"])
    rows["top"] = rows["base"] + rows["height"]
    highest = rows["base"]
    if height is not None:
        highest = -base_heights(rows["footprint"].to_numpy(), lambda x, y: -height(x, y))
    low, high = np.split(shapely.bounds(rows["footprint"].to_numpy()), 2, axis=1)
    rows["slope"] = (highest - rows["base"]) / np.hypot(*(high - low).T)
    rows["buried"] = highest > rows["top"] - rows["roof_height"]
    return rows[~rows.index.duplicated()]


def compare_buildings(truth: Any, made: Any) -> None:
    """Print errors of tops, heights and bases by slope of the ground, and the confusion of roof shapes."""
    both = truth.join(made.add_suffix("_made"), how="inner")
    both = both[both["height_source_made"] == "cloud"]
    buried = both["buried"].sum()
    print(f"buildings {len(truth)}, measured {len(both)}, of these {buried} in the ground up to their eaves")
    both = both[~both["buried"]]
    for low, high in ((0.0, np.inf), (0.0, 0.05), (0.05, 0.15), (0.15, np.inf)):
        some = both[(both["slope"] >= low) & (both["slope"] < high)]
        print(f"ground slopes by {low} to {high}: {len(some)} buildings")
        for name in ("top", "height", "base") if len(some) else ():
            error = (some[f"{name}_made"] - some[name]).to_numpy(float)
            size = np.abs(error)
            print(
                f"  {name}: median {np.median(error):+.3f} m; absolute 50 % {np.median(size):.3f},"
                f" 95 % {np.percentile(size, 95):.3f}, largest {size.max():.2f} m;"
                f" within 10 cm {100 * (size < NEAR).mean():.1f} %"
            )
    pairs = Counter(zip(both["roof_shape"], both["roof_shape_made"], strict=True))
    right = sum(n for (one, two), n in pairs.items() if one == two)
    print(f"roof shapes: {100 * right / len(both):.1f} % right;", sorted(pairs.items()))
    worst = both.assign(error=(both["height_made"] - both["height"]).abs()).nlargest(8, "error")
    for row in worst.itertuples():
        print(
            f"  {row.Index}: {row.area:.0f} m2, top {row.top_made - row.top:+.2f}, base"
            f" {row.base_made - row.base:+.2f} m, slope {row.slope:.2f},"
            f" {row.roof_shape} {row.roof_shape_made}"
        )


def compare_trees(truth: BuildPlan, made: BuildPlan, *, bounds: Sequence[float]) -> None:
    """Print trees that were found, missed and false within the map's bounds in degrees, and their errors."""
    corners = truth.frame.from_geographic(np.array(bounds[::2]), np.array(bounds[1::2]))
    low, high = np.column_stack(corners)
    mapped, found = (
        trees.take(((trees.xy > low) & (trees.xy < high)).all(axis=1)) for trees in (truth.trees, made.trees)
    )
    print(f"trees: {len(mapped)} in the scene, {len(found)} found")
    if not len(mapped) or not len(found):
        return
    distance, near = cKDTree(found.xy).query(mapped.xy)
    close = distance < 2.5
    false = len(found) - len(set(near[close].tolist()))
    print(f"  {close.sum()} of those in the scene, {false} false")
    if not close.any():
        return
    print(f"  place: 50 % {np.median(distance[close]):.2f}, 95 % {np.percentile(distance[close], 95):.2f} m")
    for name in ("height", "crown"):
        error = (getattr(found, name)[near] - getattr(mapped, name))[close]
        size = np.abs(error)
        print(
            f"  {name}: median {np.median(error):+.2f}, absolute 50 % {np.median(size):.2f},"
            f" 95 % {np.percentile(size, 95):.2f} m"
        )


def measure(given: argparse.Namespace) -> None:
    """Measure the map without heights in the cloud, build it, and compare with the truth."""
    osm = read_osm(given.map, bounds=given.bbox)
    osm = drawn(osm) if given.draw else osm
    started = time.perf_counter(), time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        cloud = CloudOptions((given.cloud,), cloud_align=given.align)
        measured, options = with_clouds(
            withheld(osm), BuildOptions(dem_gaps="nearest", use="gis"), cloud=cloud, cache_dir=Path(folder)
        )
        spent = time.perf_counter() - started[0], time.process_time() - started[1]
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        print(f"{spent[0]:.0f} s, {spent[1]:.0f} s of CPU, at most {peak:.0f} MiB, one process")
        print(json.dumps(measured.cloud))
        made, _ = make_plan(measured, options, progress=silent)
        truth, _ = make_plan(osm, BuildOptions(dem=tuple(given.dem), use="gis"), progress=silent)
    rows = table(truth)
    compare_buildings(rows[rows["drawn"]], table(made))
    compare_trees(truth, made, bounds=osm.bounds)


def main() -> None:
    """Run one of the steps."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    steps = parser.add_subparsers(dest="step", required=True)
    box = {"type": lambda text: tuple(float(v) for v in text.split(",")), "default": None}
    for name, second in (("scene", "scene"), ("measure", "cloud")):
        step = steps.add_parser(name)
        step.add_argument("map")
        step.add_argument(second)
        step.add_argument("--bbox", **box)
        step.add_argument("--dem", nargs="*", default=[])
        step.add_argument("--draw", action="store_true")
    step.add_argument("--align", action="store_true")
    step = steps.add_parser("spoil")
    step.add_argument("cloud")
    step.add_argument("out")
    step.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    if given.step == "spoil":
        spoil(given)
    elif given.step == "measure":
        measure(given)
    else:
        osm = read_osm(given.map, bounds=given.bbox)
        osm = drawn(osm) if given.draw else osm
        options = BuildOptions(dem=tuple(given.dem), use="lidar")
        build(osm, given.scene, options=options)


if __name__ == "__main__":
    main()
