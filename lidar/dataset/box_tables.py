"""Boxes of all frames put together once a drive is done."""

from __future__ import annotations

import json
from pathlib import Path

from geoscene.files import write_atomically


def gather_boxes(out: Path) -> None:
    """Write all boxes of each sensor as one file, and ``boxes.csv``: those of the first scanner.

    ``<sensor>/boxes.csv`` holds a sensor's frames in order. ``boxes.csv`` adds a column ``points_<scanner>``
    for each scanner: its points on the box in frames that start from the row's time until the next row's.
    """
    calibration = json.loads((out / "calibration.json").read_text("utf-8"))["sensors"]
    scanners = [name for name, sensor in calibration.items() if sensor["kind"] == "lidar"]
    gathered = {
        name: _gathered(out / name) for name, s in calibration.items() if s["kind"] in ("lidar", "camera")
    }
    if not scanners or not gathered[scanners[0]]:
        return
    header, *rows = gathered[scanners[0]]
    step = 10**9 / calibration[scanners[0]]["rate_hz"]
    first = calibration[scanners[0]]["time_offset_ns"]
    counts = [_points_by_step(gathered[name], first, step_ns=step) for name in scanners]
    names = header.split(",")
    frame, number = names.index("frame"), names.index("id")
    lines = [",".join([header, *(f"points_{name}" for name in scanners)])]
    for row in rows:
        cells = row.split(",")
        key = int(cells[frame]), int(cells[number])
        lines.append(",".join([row, *(str(count.get(key, 0)) for count in counts)]))
    write_atomically(out / "boxes.csv", ("\n".join(lines) + "\n").encode("utf-8"))


def _gathered(folder: Path) -> list[str]:
    """The lines of all files of a sensor's boxes under one header, written to ``boxes.csv`` too."""
    lines: list[str] = []
    for part in sorted((folder / "boxes").glob("*.csv")):
        header, *rows = part.read_text("utf-8").splitlines()
        lines += rows if lines else [header, *rows]
    if lines:
        write_atomically(folder / "boxes.csv", ("\n".join(lines) + "\n").encode("utf-8"))
    return lines


def _points_by_step(lines: list[str], first_ns: int, *, step_ns: float) -> dict[tuple[int, int], int]:
    """Points by (frame of a scanner that starts then and has such a step, id)."""
    if not lines:
        return {}
    names = lines[0].split(",")
    time, number, points = (names.index(name) for name in ("time_ns", "id", "points"))
    total: dict[tuple[int, int], int] = {}
    for line in lines[1:]:
        cells = line.split(",")
        # a nanosecond's grace: starts are rounded down
        key = int((int(cells[time]) - first_ns + 1) // step_ns), int(cells[number])
        total[key] = total.get(key, 0) + int(cells[points])
    return total
