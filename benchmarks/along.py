"""Cost of a build along a route compared with the whole extract; both must give the same drive.

    python benchmarks/along.py EXTRACT --route LAT,LON LAT,LON [...] [--reach 120] [--duration 20]
                               [--workers 2] [--folder DIR] [--json]

Builds the whole extract and the part along the route, drives the route through both with a 16-beam scanner,
and compares the common tiles and the point clouds byte by byte. Costs as of `bench.measure.command`.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from bench.extract import measure_extract
from bench.maps import build_command
from bench.measure import command

from geoscene.scene import SceneFiles


def along(given: argparse.Namespace, folder: Path) -> list[dict[str, Any]]:
    """Costs of the whole build and of the build along a route, and whether tiles and clouds are equal."""
    rows, clouds, tiles = [], [], []
    extra = {"whole": [], "along": ["--along", *given.route, "--reach", str(given.reach)]}
    for name, part in extra.items():
        out, drive = folder / name, folder / f"{name}_drive"
        cost = command(build_command(given.extract, out, "--workers", str(given.workers), *part))
        words = [sys.executable, "-m", "lidar", "drive", str(out), "--route", *given.route]
        words += [
            "--rig",
            "vlp16",
            "--duration",
            str(given.duration),
            "--format",
            "pcd",
            "--out",
            str(drive),
        ]
        driven = command([*words, "--overwrite", "--quiet"])
        clouds.append(_bytes(drive, "*.pcd"))
        tiles.append(_bytes(SceneFiles(out).tiles, "*.npz"))
        rows.append(
            {"build": name, "tiles": len(tiles[-1]), "scene_mib": _mib(_bytes(out, "*")), **cost.row()}
            | {f"drive_{key}": value for key, value in driven.row().items() if key != "largest_mib"}
            | {"clouds": len(clouds[-1]), "cloud_mib": _mib(clouds[-1])}
        )
    whole, part = tiles
    rows[1] |= {
        "same_tiles": bool(part) and all(whole.get(name) == data for name, data in part.items()),
        "same_clouds": bool(clouds[0]) and clouds[0] == clouds[1],
    }
    return rows


def _bytes(folder: Path, pattern: str) -> dict[Path, bytes]:
    """Files in a folder by their relative path."""
    found = (path for path in sorted(folder.rglob(pattern)) if path.is_file())
    return {path.relative_to(folder): path.read_bytes() for path in found}


def _mib(files: dict[Path, bytes]) -> float:
    return round(sum(map(len, files.values())) / 2**20, 1)


def main() -> None:
    """Measure the extract of the command line."""
    measure_extract(__doc__, along, {"reach": 120.0, "duration": 20.0})


if __name__ == "__main__":
    main()
