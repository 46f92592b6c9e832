"""One row per extract: buildings on the map, solids built, repaired and dropped buildings, and the cost.

    python benchmarks/extracts.py FOLDER_OR_FILE [...] [--lod 2] [--workers 1] [--json]

Builds each extract with the program and checks every solid of the written scene with ``geoscene validate``.
Costs as of `bench.measure.command`. Rows are printed one by one, as Markdown or as one JSON object per line.
``ground`` is the relative difference between the area of the ground (its triangles plus the openings over
tunnel mouths) and that of the extent. ``repaired`` counts repaired buildings, ``dropped`` those not built.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from bench.maps import build_command
from bench.measure import command

from geoscene.scene import open_scene

COLUMNS = (
    "extract", "km2", "buildings", "solids", "repaired", "dropped", "watertight", "broken", "roofs", "ground",
    "wall_s", "cpu_s", "peak_mib",
)  # fmt: skip


def row_of(extract: Path, folder: Path, *, lod: int, workers: int) -> dict[str, Any]:
    """The row of one extract."""
    out = folder / "scene"
    words = ["--lod", str(lod), "--workers", str(workers)]
    with (folder / "words").open("w+b") as said:
        try:
            cost = command(build_command(extract, out, *words), errors=said)
        except subprocess.CalledProcessError:
            said.seek(0)
            return {"extract": extract.name, "error": said.read().decode().strip()}
    scene = open_scene(out).manifest
    judge = [sys.executable, "-m", "geoscene", "validate", str(out), "--json"]
    verdict = json.loads(subprocess.run(judge, stdout=subprocess.PIPE, check=False).stdout)
    counts, ground, problems = scene["counts"], scene["ground"], scene["problems"]
    missing = ground["area"] + ground["open_area"] - ground["extent_area"]
    return {
        "extract": extract.name.split(".")[0],
        "km2": round(ground["extent_area"] / 1e6, 2),
        "lod": lod,
        "buildings": counts["buildings"],
        "solids": counts["solids"],
        "repaired": problems["repaired"].get("building", {}),
        "dropped": problems["dropped"].get("building", {}),
        "closed_objects": verdict["solids"],
        "watertight": verdict["solids"] - len(verdict["broken"]),
        "broken": len(verdict["broken"]),
        "roofs": scene["roofs"],
        "ground": missing / ground["extent_area"],
        "tiles": len(scene["tiles"]),
        "faces": counts["faces"],
        "scene_mib": sum(path.stat().st_size for path in out.rglob("*") if path.is_file()) >> 20,
        **cost.row(),
    }


def markdown(row: dict[str, Any]) -> str:
    """A row as a line of a Markdown table."""
    if "error" in row:
        return f"| {row['extract']} | {row['error']} |"
    cells = []
    for name in COLUMNS:
        value = row[name]
        if isinstance(value, dict):
            most = sorted(value.items(), key=lambda item: -item[1])
            total = f"{sum(value.values())}: " if name != "roofs" and value else ""
            cells.append(total + (", ".join(f"{key} {n}" for key, n in most) or "0"))
        elif name == "ground":
            cells.append(f"{value:.0e}")
        elif name == "watertight":
            cells.append(f"{value} of {row['closed_objects']}")
        else:
            cells.append(str(value))
    return "| " + " | ".join(cells) + " |"


def main() -> None:
    """Measure the extracts of the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("extract", type=Path, nargs="+")
    parser.add_argument("--lod", type=int, default=2)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    files = [
        path for name in given.extract for path in (sorted(name.glob("*.osm.*")) if name.is_dir() else [name])
    ]
    if not given.json:
        print("| " + " | ".join(COLUMNS) + " |\n|" + "---|" * len(COLUMNS))
    for path in files:
        with tempfile.TemporaryDirectory() as folder:
            row = row_of(path, Path(folder), lod=given.lod, workers=given.workers)
        print(json.dumps(row) if given.json else markdown(row), flush=True)


if __name__ == "__main__":
    main()
