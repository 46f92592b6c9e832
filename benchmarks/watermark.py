"""What the watermark and the hash chain make of noise, other encodings and tampering, on a recorded drive.

python benchmarks/watermark.py DRIVE prints tables as in docs/measurements/integrity.md; DRIVE has
PCD clouds of a scanner.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np

from lidar.dataset.formats import read_cloud
from lidar.dataset.layout import open_dataset
from lidar.tools.integrity.tampering import FrameVerdict, Place, frame_verdict
from lidar.tools.integrity.watermark import WatermarkCells, WatermarkKey

MARK = WatermarkKey(b"key of a benchmark")
TRIALS = 40
SIZE = np.array([4.0, 2.0, 2.0])
"""Metres of the box that is tampered with."""

Marked = tuple[np.ndarray, WatermarkCells]


def clouds(folder: Path) -> Iterator[Marked]:
    """Marked clouds in turn, as often as there are trials."""
    dataset = open_dataset(folder)
    name = next(iter(dataset.sensors("lidar")))
    files = sorted((folder / name / "pcd").glob("*.pcd"))
    for trial in range(TRIALS):
        cloud = read_cloud(files[trial % len(files)])
        cells = WatermarkCells(name, trial, cloud.ring, cloud.column, cloud.echo)
        yield MARK.embedded(cloud.xyz, cells), cells


def inside(xyz: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Returns (n,) in a box around a random one 6 to 20 m away."""
    away = np.linalg.norm(xyz, axis=1)
    middle = xyz[rng.choice(np.flatnonzero((away > 6) & (away < 20)))]
    return (np.abs(xyz - middle) < SIZE / 2).all(axis=1)


def voxels(xyz: np.ndarray, cells: WatermarkCells, *, size: float) -> Marked:
    """One return of each cube."""
    _, first = np.unique(np.floor(xyz / size).astype(np.int64), axis=0, return_index=True)
    keep = np.isin(np.arange(len(xyz)), first)
    return xyz[keep], cells.where(keep)


def distance(place: Place, xyz: np.ndarray) -> float:
    """Hausdorff distance between the corners of a box and of that of points, metres."""
    found = np.array(list(product(*zip(place.low, place.high, strict=True))))
    true = np.array(list(product(*zip(xyz.min(axis=0), xyz.max(axis=0), strict=True))))
    apart = np.linalg.norm(found[:, None] - true, axis=2)
    return float(max(apart.min(axis=0).max(), apart.min(axis=1).max()))


def removed(
    xyz: np.ndarray, cells: WatermarkCells, near: np.ndarray
) -> tuple[Marked, np.ndarray | None, np.ndarray]:
    """Returns are deleted."""
    return (xyz[~near], cells.where(~near)), None, xyz[near]


def added(
    xyz: np.ndarray, cells: WatermarkCells, near: np.ndarray
) -> tuple[Marked, np.ndarray | None, np.ndarray]:
    """Returns are copied to a direction 40 degrees to the left."""
    c, s = np.cos(np.radians(40)), np.sin(np.radians(40))
    new = xyz[near] @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    turn = int(cells.column.max()) + 1
    column = np.append(cells.column, (cells.column[near].astype(np.int64) - round(turn / 9)) % turn)
    rings, echoes = np.append(cells.ring, cells.ring[near]), np.append(cells.echo, cells.echo[near])
    forged = np.arange(len(column)) >= len(xyz)
    return (np.concatenate([xyz, new]), replace(cells, ring=rings, column=column, echo=echoes)), forged, new


def moved(
    xyz: np.ndarray, cells: WatermarkCells, near: np.ndarray
) -> tuple[Marked, np.ndarray | None, np.ndarray]:
    """Returns go 2 to 3 m outwards along their beams."""
    rng, out = np.random.default_rng(len(xyz)), xyz.copy()
    away = np.linalg.norm(xyz[near], axis=1)
    out[near] *= (1 + rng.uniform(2, 3, len(away)) / away)[:, None]
    return (out, cells), near, out[near]


def harmless(folder: Path) -> None:
    """Print what is made of data that nobody tampered with."""
    print("| data | bits wrong | clouds reported | blocks reported, of a cloud |")
    print("|---|---|---|---|")
    rng = np.random.default_rng(0)
    cases: dict[str, tuple[float, Callable[[np.ndarray, WatermarkCells], Marked]]] = {
        "as signed, float32": (0.001, lambda x, c: (x.astype(np.float32), c)),
        "rounded to 1 mm": (0.001, lambda x, c: (np.round(x, 3), c)),
        "rounded to 1 cm (`--noise 0.003`)": (0.003, lambda x, c: (np.round(x, 2), c)),
        "half precision": (0.001, lambda x, c: (x.astype(np.float16).astype(float), c)),
        "noise of 2 mm (`--noise 0.002`)": (0.002, lambda x, c: (x + rng.normal(0, 0.002, x.shape), c)),
        "noise of 4 mm (`--noise 0.004`)": (0.004, lambda x, c: (x + rng.normal(0, 0.004, x.shape), c)),
        "one return of each cube of 10 cm": (0.001, lambda x, c: voxels(x, c, size=0.1)),
    }
    for name, (noise, change) in cases.items():
        found = []
        for xyz, cells in clouds(folder):
            changed, left = change(xyz, cells)
            found.append(frame_verdict(MARK, changed, cells=left, noise=noise))
        wrong = sum(v.wrong for v in found) / sum(v.bits for v in found)
        alarms = [len(v.blocks.tampered) for v in found]
        print(f"| {name} | {wrong:.2g} | {sum(map(bool, alarms))} of {TRIALS} | {np.mean(alarms):.2g} |")


def tampered(folder: Path) -> None:
    """Print where tampering is found."""
    print("| | noise | clouds found | distance, median | mean | largest | returns found | others reported |")
    print("|---|---|---|---|---|---|---|---|")
    for change, noise in product((removed, added, moved), (0.0, 0.001, 0.004)):
        apart, recall, others, alarms = [], [], [], 0
        for trial, (xyz, cells) in enumerate(clouds(folder)):
            rng = np.random.default_rng(trial)
            noisy = xyz + rng.normal(0, noise, xyz.shape)
            (data, left), forged, true = change(noisy, cells, inside(xyz, rng))
            verdict: FrameVerdict = frame_verdict(MARK, data, cells=left, noise=noise)
            alarms += bool(len(verdict.blocks.tampered))
            kind = "removed" if forged is None else "added or moved"
            places = [place for place in verdict.places if place.kind == kind]
            apart += [distance(places[0], true)] if places else []
            own = np.zeros(len(data), bool) if forged is None else forged
            recall += [verdict.forged[own].mean()] if own.any() else []
            others.append(verdict.forged[~own].mean())
        share = f"{100 * np.mean(recall):.1f} %" if recall else ""
        figures = " | ".join(f"{f(apart):.2f} m" for f in (np.median, np.mean, np.max))
        print(
            f"| {change.__name__} | {1000 * noise:.0f} mm | {alarms} of {TRIALS} | {figures} | {share}"
            f" | {100 * np.mean(others):.2f} % |"
        )


def costs(folder: Path) -> None:
    """Print seconds a cloud."""
    marked = list(clouds(folder))
    began = time.perf_counter()
    for xyz, cells in marked:
        MARK.embedded(xyz, cells)
    embedded = time.perf_counter()
    for xyz, cells in marked:
        frame_verdict(MARK, xyz, cells=cells)
    done = time.perf_counter()
    points = np.mean([len(xyz) for xyz, _ in marked])
    print(f"{points:,.0f} returns: {1000 * (embedded - began) / TRIALS:.1f} ms to embed,", end=" ")
    print(f"{1000 * (done - embedded) / TRIALS:.1f} ms to verify")


if __name__ == "__main__":
    for table in (harmless, tampered, costs):
        table(Path(sys.argv[1]))
        print()
