"""First picture, memory and frame time of a scene's page in headless Chromium: one file against a folder.

    python benchmarks/pages.py page.html page --repetitions 5

Both sides open in turn in a new browser with software rendering, and stand at two views: all of the scene,
and 400 m from its middle. Medians over the repetitions.

first    seconds from the request to the first picture with something of the scene in it
whole    seconds to the picture with all that the view wants; files: with the whole scene
MB       proportional set size of all processes of the browser, which hold the graphics memory, too
frame    milliseconds of a frame with shadows
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

from helpers.browser import Browser, browser  # noqa: E402

NEAR = (
    "const c = geoscene.camera; c.whole(geoscene.head.busy);"
    "c.lookAt([...c.target.slice(0, 2), c.target[2]], 400);"
)


def memory_mb() -> float:
    """Proportional set size of all descendants of this process."""
    parents = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            words = stat.read_text().rpartition(")")[2].split()
        except OSError:  # ended meanwhile
            continue
        parents[int(stat.parent.name)] = int(words[1])
    own = {int(Path("/proc/self").resolve().name)}
    while more := {pid for pid, parent in parents.items() if parent in own and pid not in own}:
        own |= more
    total = 0
    for pid in own - {int(Path("/proc/self").resolve().name)}:
        try:
            lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
        except OSError:
            continue
        total += sum(int(line.split()[1]) for line in lines if line.startswith("Pss:"))
    return total / 1e3


def settled(window: Browser, began: float, *, limit_s: float) -> float:
    """Seconds from ``began`` until all that the view wants is drawn."""
    while not window.js("return Boolean(window.geoscene && geoscene.settled())"):
        if time.monotonic() - began > limit_s:
            return float("nan")
        time.sleep(0.1)
    return time.monotonic() - began


def opened(page: Path, *, frames: int, limit_s: float) -> dict[str, float]:
    """Figures of one page, opened in a new browser."""
    path = page / "index.html" if page.is_dir() else page
    with tempfile.TemporaryDirectory(prefix="pages") as folder, browser(Path(folder)) as window:
        began = time.monotonic()
        window.open(path.resolve(), limit_s=limit_s)
        out = {
            "whole s": settled(window, began, limit_s=limit_s),
            "first s": window.js("return geoscene.first()") / 1e3,
        }
        for view, script in (("far", ""), ("near", NEAR)):
            window.js(f"{script} geoscene.redraw()")
            settled(window, time.monotonic(), limit_s=limit_s)
            out[f"{view} frame ms"] = window.js("return geoscene.benchmark(arguments[0])", frames)
            out[f"{view} triangles"] = sum(n for _, n in window.js("return geoscene.pipeline.tiles()"))
            out[f"{view} graphics MB"] = window.js("return geoscene.bytes()") / 1e6
            out[f"{view} MB"] = memory_mb()
    return out


def main() -> None:
    """Print the medians of each page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("pages", nargs="+", type=Path, help="pages to compare")
    parser.add_argument("--repetitions", type=int, default=3)
    parser.add_argument("--frames", type=int, default=5)
    parser.add_argument(
        "--limit", type=float, default=300.0, help="seconds after which a page counts as stuck"
    )
    given = parser.parse_args()
    rows: dict[Path, list[dict[str, float]]] = {page: [] for page in given.pages}
    for repetition in range(given.repetitions):
        order = given.pages if repetition % 2 == 0 else given.pages[::-1]
        for page in order:
            rows[page].append(opened(page, frames=given.frames, limit_s=given.limit))
    for page, figures in rows.items():
        size = (
            sum(f.stat().st_size for f in page.rglob("*") if f.is_file())
            if page.is_dir()
            else page.stat().st_size
        )
        print(f"{page}: {size / 1e6:.1f} MB")
        for name in figures[0]:
            print(f"  {name:18} {statistics.median(row[name] for row in figures):12.4g}")


if __name__ == "__main__":
    main()
