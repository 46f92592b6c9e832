"""Cost of builds by city size, and speed of building reconstruction.

    python benchmarks/scale.py sizes [1000 10000 100000] [--workers 2] [--lod 2] [--folder DIR] [--json]
    python benchmarks/scale.py stages EXTRACT [EXTRACT ...] [--dem FILE [FILE ...]] [--json]

``sizes`` generates cities (benchmarks/make_osm.py) and builds them with the program, one after another.
``stages`` times the stages of buildings in one process, tile by tile as in a build, without parsing and
without the ground; with elevation files also on terrain, including the base height of every building.

CPU time is that of all processes. ``peak_mib`` is the greatest sum of proportional set sizes of the process
and its children (pages shared by forked workers count once), sampled twice per second; ``largest_mib`` is the
greatest resident set of one of them, shared pages included. Linux only.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
import shapely
from make_osm import make_city, write_city

from geoscene.buildings import build_solids, read_buildings
from geoscene.frames import Frame
from geoscene.ground.terrain import Terrain, base_heights, open_terrain
from geoscene.plan import take_buildings
from geoscene.scene import open_scene
from geoscene.sources import read_osm


@dataclass(frozen=True)
class Cost:
    """Cost of one command: wall and CPU seconds, peak MiB of all processes and of the largest one."""

    wall_s: float
    cpu_s: float
    peak_mib: int
    largest_mib: int


def run(command: list[str], *, errors: IO[bytes] | None = None) -> Cost:
    """The cost of a command whose stderr goes to a file; raises CalledProcessError if it fails."""
    began = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=errors)
    peak = 0
    while True:
        pid, status, usage = os.wait4(process.pid, os.WNOHANG)
        if pid:
            break
        peak = max(peak, sum(map(_proportional_kib, _family(process.pid))))
        time.sleep(0.5)
    wall = time.perf_counter() - began
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, command)
    cpu = usage.ru_utime + usage.ru_stime
    return Cost(round(wall, 2), round(cpu, 2), peak // 1024, usage.ru_maxrss // 1024)


def _family(root: int) -> list[int]:
    """A process and all its descendants."""
    children: dict[int, list[int]] = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                parent = int((entry / "stat").read_text().rsplit(")", 1)[1].split()[1])
            except OSError:  # the process has ended
                continue
            children.setdefault(parent, []).append(int(entry.name))
    family = [root]
    for pid in family:
        family += children.get(pid, [])
    return family


def _proportional_kib(pid: int) -> int:
    try:
        text = Path(f"/proc/{pid}/smaps_rollup").read_text()
    except OSError:  # the process has ended
        return 0
    found = [line.split()[1] for line in text.splitlines() if line.startswith("Pss:")]
    return int(found[0]) if found else 0


def build_command(osm: Path, out: Path, *extra: str) -> list[str]:
    """Command line that builds a scene of an extract."""
    words = [sys.executable, "-m", "geoscene.cli", "build", "--osm", str(osm), "--out", str(out)]
    return [*words, "--overwrite", "--quiet", *extra]


def sizes(given: argparse.Namespace, folder: Path) -> list[dict[str, Any]]:
    """Cost of building cities, one row per size."""
    rows = []
    for count in given.buildings:
        osm, out = folder / f"city_{count}.osm.pbf", folder / f"city_{count}"
        write_city(make_city(count, seed=0), osm)
        words = build_command(osm, out, "--lod", str(given.lod), "--workers", str(given.workers))
        cost = run(words)
        scene = open_scene(out).manifest
        counts = scene["counts"]
        xmin, ymin, xmax, ymax = scene["bounds"]
        rows.append(
            {
                "buildings": counts["buildings"],
                "km2": round((xmax - xmin) * (ymax - ymin) / 1e6, 1),
                "tiles": len(scene["tiles"]),
                "faces": counts["faces"],
                "watertight": f"{counts['watertight']}/{counts['closed_objects']}",
                **asdict(cost),
                "ms_cpu_per_building": round(1000 * cost.cpu_s / counts["buildings"], 2),
                "scene_mib": sum(f.stat().st_size for f in out.rglob("*") if f.is_file()) >> 20,
            }
        )
    return rows


def stages(given: argparse.Namespace) -> list[dict[str, Any]]:
    """Buildings per CPU second: reading footprints, heights and colours, and making solids."""
    rows = []
    for path in given.extract:
        began = time.process_time()
        osm = read_osm(path)
        parse = time.process_time() - began
        west, south, east, north = osm.bounds
        frame = Frame.at((west + east) / 2, (south + north) / 2)
        read_buildings(osm, frame)  # imports of the first call are not counted
        parsed = time.process_time()
        table, _ = read_buildings(osm, frame)
        read = time.process_time()
        count, footprints = table.count, table.footprint[: table.count]
        row: dict[str, Any] = {"extract": path.name, "buildings": count, "parse_s": round(parse, 2)}
        row["read_s"] = round(read - parsed, 2)
        _solids(table, np.zeros(count), 2, _tiles(table)[:1])  # imports, not counted
        terrains = {"level": Terrain(frame)}
        if given.dem:
            bounds = tuple(shapely.total_bounds(footprints).tolist())
            terrains["dem"] = open_terrain(given.dem, frame, bounds=bounds, outside="nearest")
        for ground, terrain in terrains.items():
            for lod in (1, 2):
                start = time.process_time()
                base = base_heights(footprints, terrain.height)
                _solids(table, base, lod, _tiles(table))
                spent = time.process_time() - start
                row[f"lod{lod}_{ground}_per_s"] = round(count / (spent + read - parsed))
        rows.append(row)
    return rows


def _solids(table: Any, base: Any, lod: int, tiles: list[tuple[Any, Any]]) -> None:
    """Make the solids of tiles and discard them."""
    for chosen, parts in tiles:
        build_solids(take_buildings(table, chosen, parts=parts), base=base[chosen], lod=lod)


def _tiles(table: Any) -> list[tuple[Any, Any]]:
    """Rows of buildings and of their parts by tiles of 250 m."""
    boxes = shapely.bounds(table.footprint[: table.count])
    home = np.floor((boxes[:, :2] + boxes[:, 2:]) / 500.0).astype(int)
    _, tile = np.unique(home, axis=0, return_inverse=True)
    tile = tile.ravel()
    parts = np.flatnonzero(table.is_part)
    order, of_part = np.argsort(tile, kind="stable"), tile[table.outline[parts]]
    cuts = np.searchsorted(tile[order], np.arange(tile.max(initial=-1) + 2))
    by_tile = np.argsort(of_part, kind="stable")
    part_cuts = np.searchsorted(of_part[by_tile], np.arange(tile.max(initial=-1) + 2))
    return [
        (order[a:b], parts[by_tile[c:d]])
        for a, b, c, d in zip(cuts[:-1], cuts[1:], part_cuts[:-1], part_cuts[1:], strict=True)
    ]


def show(rows: list[dict[str, Any]], *, as_json: bool) -> None:
    """Print rows as JSON or as a table."""
    if as_json:
        print(json.dumps(rows, indent=1))
        return
    names = list(dict.fromkeys(name for row in rows for name in row))
    cells = [names, *([str(row.get(name, "")) for name in names] for row in rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    for line in cells:
        print("  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True)))


def main() -> None:
    """Run the measurement of the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    kinds = parser.add_subparsers(dest="kind", required=True)
    one = kinds.add_parser("sizes")
    one.add_argument("buildings", type=int, nargs="*", default=[1000, 10_000, 100_000])
    one.add_argument("--lod", type=int, default=2)
    two = kinds.add_parser("stages")
    two.add_argument("extract", type=Path, nargs="+")
    two.add_argument("--dem", nargs="+", default=[])
    for kind in (one, two):
        kind.add_argument("--workers", type=int, default=2)
        kind.add_argument("--folder", type=Path)
        kind.add_argument("--json", action="store_true")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = given.folder or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        show(stages(given) if given.kind == "stages" else sizes(given, folder), as_json=given.json)


if __name__ == "__main__":
    main()
