"""The detectors on drives that none of them was made with, and the model that comes with the program.

    python benchmarks/detector.py EXTRACTS [--folder DIR] [--write]

EXTRACTS is a folder with the extracts of `PLACES`. Builds them, records 8 drives to train with and 12 to
measure on, trains a model, and prints the tables of docs/measurements/security.md for the rules, for the
model, and for one that was trained without the two places that are measured on. ``--write`` writes the
model to lidar/tools/detection/learned.npz.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
from pathlib import Path

from geoscene.scene.layout import SceneFiles
from lidar.dataset.layout import Paths
from lidar.tools.detection.learned import MODEL
from lidar.tools.redteam.evaluate import accuracies
from lidar.tools.redteam.matrix import DetectorAccuracy
from lidar.tools.redteam.measure import AttackCase, measure_drive
from lidar.tools.redteam.plan import Measure

PLACES = {
    "nyc_lower_east_side": ".osm.pbf",
    "monaco": ".osm.pbf",
    "berlin_neukoelln": ".osm.gz",
    "helsinki_center": ".osm.pbf",
    "heidelberg_altstadt": ".osm.pbf",
}
"""Suffix of the extract by name."""

HELD_OUT = ("nyc_lower_east_side", "monaco")
"""Places of the drives that are measured on."""

SEEDS = {1: tuple(PLACES), 2: ("nyc_lower_east_side", "monaco", "berlin_neukoelln")}
"""Places of the drives to train with by seed."""
HELD_OUT_SEEDS = range(31, 34)

EVERY = 2
"""Of how many frames one is trained with."""
MEASURE = Measure()

SPARSE = "vehicles=25,parked=0.5,pedestrians=20,cyclists=15"
DENSE = "vehicles=60,parked=1,pedestrians=40,cyclists=30"
USUAL = "vehicles=25,parked=0.5,pedestrians=10,cyclists=4"

SCANNERS = {
    "vlp16": 'preset = "vlp16"\ntranslation = [1.2, 0.0, 1.9]',
    "hdl32e": 'preset = "hdl32e"\ntranslation = [0.9, 0.0, 1.84]',
    "hdl64e": 'preset = "hdl64e_s3"\ntranslation = [0.76, 0.0, 1.73]\nrate_hz = 10.0',
}


def run(program: str, *words: object) -> None:
    """Run a program of this package; raises CalledProcessError if it fails."""
    subprocess.run([sys.executable, "-m", program, *map(str, words)], check=True)


def rig(folder: Path, *names: str) -> Path:
    """File of a rig of scanners on a car."""
    path = folder / f"{'_'.join(names)}.toml"
    tables = "".join(f'\n[[lidar]]\nname = "{name}"\n{SCANNERS[name]}\n' for name in names)
    path.write_text(f'name = "probe"\nvehicle = "car"\nsource = "mounts of usual cars"\n{tables}', "utf-8")
    return path


def built(extracts: Path, folder: Path, name: str) -> Path:
    """The scene of a place."""
    scene = folder / name
    if not SceneFiles(scene).manifest.exists():
        run("geoscene", "build", "--osm", extracts / f"{name}{PLACES[name]}", "--for", "lidar", "-o", scene)
    return scene


def driven(scene: Path, out: Path, *words: object) -> Path:
    """A drive, which is recorded if it is not there."""
    if not Paths(out).manifest.exists():
        run("lidar", "drive", scene, "--route", "random", "--format", "pcd", *words, "-o", out)
    return out


def training_drives(scenes: dict[str, Path], folder: Path) -> dict[str, list[Path]]:
    """Drives to train with by place; those of seed 2 have dense traffic and the sensors' survey settings."""
    all_three = rig(folder, *SCANNERS)
    found: dict[str, list[Path]] = {name: [] for name in scenes}
    for seed, names in SEEDS.items():
        traffic, fidelity = (DENSE, "survey") if seed == 2 else (SPARSE, "standard")
        for name in names:
            words = ("--rig", all_three, "--duration", 1.5, "--traffic", traffic, "--fidelity", fidelity)
            found[name].append(driven(scenes[name], folder / f"{name}_{seed}", *words, "--seed", seed))
    return found


def held_out_drives(scenes: dict[str, Path], folder: Path) -> dict[str, list[Path]]:
    """Drives to measure on by scanner."""
    found: dict[str, list[Path]] = {}
    for scanner, duration in (("vlp16", 4), ("hdl64e", 2)):
        words = ("--rig", rig(folder, scanner), "--duration", duration, "--traffic", USUAL)
        found[scanner] = [
            driven(scenes[name], folder / f"{name}_{scanner}_{seed}", *words, "--seed", seed)
            for name in HELD_OUT
            for seed in HELD_OUT_SEEDS
        ]
    return found


def table(detectors: dict[str, str], drives: list[Path], figures: Path) -> list[list[str]]:
    """Recall, precision and false detections per frame of detectors by kind and distance."""
    columns = {name: _accuracy(detector, drives, figures / name) for name, detector in detectors.items()}
    rows = [["kind", "metres", "road users"]]
    rows[0] += [f"{name}: {what}" for name in columns for what in ("recall", "precision", "false per frame")]
    for parts in zip(*columns.values(), strict=True):
        first = parts[0]
        if first.recall.count or any(part.precision.count for part in parts):
            texts = [
                text
                for part in parts
                for text in (part.recall.to_text(), part.precision.to_text(), f"{part.false_per_frame:.2f}")
            ]
            rows.append([first.kind, f"{first.near} to {first.far}", str(first.recall.count), *texts])
    return rows


def _accuracy(detector: str, drives: list[Path], figures: Path) -> list[DetectorAccuracy]:
    frames = []
    for drive in drives:
        case = AttackCase(drive, None, figures / f"{drive.name}.json", (), MEASURE.score, detector)
        figures.mkdir(parents=True, exist_ok=True)
        rows = measure_drive(case)["frames"]
        frames += [f | {"block": (drive.name, int(f["seconds"] // MEASURE.block))} for f in rows]
    return list(accuracies(frames, measure=MEASURE, known={"setting": {}, "scene": "all"}))


def trained(drives: list[Path], out: Path) -> Path:
    """A model that is trained with drives."""
    run("lidar", "train", *drives, "--every", EVERY, "-o", out, "--overwrite")
    return out


def main() -> None:
    """Build, drive, train and measure."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("extracts", type=Path)
    parser.add_argument("--folder", type=Path, default=Path("detector"))
    parser.add_argument("--write", action="store_true", help="write the model of the program")
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    scenes = {name: built(given.extracts, given.folder, name) for name in PLACES}
    training, held_out = training_drives(scenes, given.folder), held_out_drives(scenes, given.folder)
    everywhere = trained(
        [drive for drives in training.values() for drive in drives], given.folder / "all.npz"
    )
    elsewhere = [drive for name, drives in training.items() if name not in HELD_OUT for drive in drives]
    detectors = {
        "rules": "rules",
        "learned": str(everywhere),
        "learned elsewhere": str(trained(elsewhere, given.folder / "elsewhere.npz")),
    }
    for scanner, drives in held_out.items():
        print(f"\n{scanner}")
        for row in table(detectors, drives, given.folder / "figures"):
            print(f"| {' | '.join(row)} |")
    if given.write:
        shutil.copyfile(everywhere, MODEL)


if __name__ == "__main__":
    main()
