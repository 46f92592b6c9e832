"""Cost of a drive through a map, twice, compared with building the whole map and driving in its scene.

    python benchmarks/map_drives.py EXTRACT --route LAT,LON LAT,LON [...] [--rig vlp16] [--duration SECONDS]
                                    [--workers 2] [--folder DIR] [--json]

All drives must have the same files but for ``dataset.json``, which names the scene. ``first_s`` is the wall
time to the first point cloud, of a drive through a scene with the build. Costs as of `bench.measure.command`.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import Any

from bench.extract import measure_extract
from bench.maps import build_command
from bench.measure import command

from geoscene.scene import open_scene


def compared(given: argparse.Namespace, folder: Path) -> list[dict[str, Any]]:
    """Costs of the build, of the drive in its scene, and of two drives through the map."""
    whole, cache = folder / "whole", folder / "cache"
    cost = command(build_command(given.extract, whole, "--workers", str(given.workers)))
    rows = [{"what": "build of the whole map", **_scene(whole), **cost.row()}]
    drives = []
    for what, scene in (
        ("drive in its scene", whole),
        ("drive through the map", given.extract),
        ("the same again", given.extract),
    ):
        out = folder / f"drive_{len(drives)}"
        words = [sys.executable, "-m", "lidar", "drive", str(scene), "--route", *given.route]
        words += ["--rig", given.rig, "--format", "pcd", "--workers", str(given.workers), "--out", str(out)]
        words += ["--overwrite", "--quiet"]
        words += ["--duration", str(given.duration)] if given.duration else []
        words += ["--scene-cache", str(cache)] if scene == given.extract else []
        began = time.time()
        cost = command(words)
        first = min(path.stat().st_mtime for path in out.rglob("*.pcd")) - began
        drives.append(_files(out))
        (cached,) = cache.glob("*/scene") if scene == given.extract else [whole]
        before = rows[0]["wall_s"] if scene == whole else 0.0
        rows.append({"what": what, **_scene(cached), **cost.row(), "first_s": round(before + first, 1)})
        rows[-1] |= {
            "clouds": sum(name.suffix == ".pcd" for name in drives[-1]),
            "same": drives[-1] == drives[0],
        }
    return rows


def _scene(folder: Path) -> dict[str, Any]:
    size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    return {"tiles": len(open_scene(folder).tile_indices), "scene_mib": round(size / 2**20, 1)}


def _files(folder: Path) -> dict[Path, bytes]:
    """Files of a dataset by their relative path, but its manifest."""
    found = (path for path in sorted(folder.rglob("*")) if path.is_file() and path.name != "dataset.json")
    return {path.relative_to(folder): path.read_bytes() for path in found}


def main() -> None:
    """Measure the extract of the command line."""
    measure_extract(__doc__, compared, {"rig": "vlp16", "duration": None})


if __name__ == "__main__":
    main()
