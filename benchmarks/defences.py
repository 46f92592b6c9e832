"""Drives that the thresholds of defences are calibrated on, and the calibration.

    python benchmarks/defences.py EXTRACTS [--folder DIR]

EXTRACTS is a folder with nyc_lower_east_side.osm.pbf and monaco.osm.pbf. Builds both, records six drives
with a 32-beam scanner, a camera, a receiver and an inertial unit, and writes
lidar/tools/defences/calibration.toml. Takes ten minutes on two cores.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

from geoscene.scene.layout import SceneFiles
from lidar.tools.defences.calibration import Calibration, calibration_text, read_calibration

RIG = """
name = "probe"
vehicle = "car"
source = "KITTI's scanner position and colour camera, and a scanner with half the beams"

[[lidar]]
name = "top"
preset = "hdl32e"
translation = [0.76, 0.0, 1.73]
rate_hz = 10.0
firing_jitter_ns = 10.0

[[camera]]
name = "front"
translation = [1.0301474, 0.0578801, 1.6579597]
quat_wxyz = [0.5052849274, -0.4947772518, 0.4999698183, -0.4999127864]
width = 1242
height = 375
fx = 721.5377
cx = 609.5593
cy = 172.854
rate_hz = 10.0
images = ["rgb"]

[[gnss]]
name = "gnss"
translation = [0.0, 0.0, 1.6]
rate_hz = 10.0
mode = "rtk"

[[imu]]
name = "imu"
translation = [0.0, 0.0, 0.6]
rate_hz = 100.0
"""
SPARSE = "vehicles=20,parked=0.5,pedestrians=5,cyclists=2"
DENSE = "vehicles=60,parked=1,pedestrians=10,cyclists=5"
DRIVES = {
    "nyc_lower_east_side": {3: SPARSE, 4: SPARSE, 5: DENSE},
    "monaco": {3: SPARSE, 4: SPARSE, 6: DENSE},
}
"""Traffic by extract and seed."""

OUT = Path(__file__).resolve().parents[1] / "lidar" / "defences" / "calibration.toml"


def run(program: str, *words: object) -> None:
    """Run a program of this package; raises CalledProcessError if it fails."""
    subprocess.run([sys.executable, "-m", program, *map(str, words)], check=True)


def main() -> None:
    """Build, drive and calibrate."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("extracts", type=Path)
    parser.add_argument("--folder", type=Path, default=Path("calibration"))
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    rig = given.folder / "rig.toml"
    rig.write_text(RIG, "utf-8")
    drives = []
    for name, seeds in DRIVES.items():
        scene = given.folder / name
        if not SceneFiles(scene).manifest.exists():
            run("geoscene", "build", "--osm", given.extracts / f"{name}.osm.pbf", "-o", scene)
        for seed, traffic in seeds.items():
            drives.append(given.folder / f"{name}_{seed}")
            words = ("--route", "random", "--duration", 6, "--seed", seed, "--rig", rig, "--traffic", traffic)
            run("lidar", "drive", scene, *words, "--fidelity", "survey", "--format", "pcd", "-o", drives[-1])
    shared = given.folder / "all.toml"
    run("lidar", "defend", *drives, "--defence", "all", "--calibrate", "-o", shared, "--overwrite")
    OUT.write_text(calibration_text(joined(shared, watermark_calibration(drives))), "utf-8")


def watermark_calibration(drives: list[Path]) -> Path:
    """The calibration of the watermark on signed copies of drives, which the other defences cannot share."""
    key = drives[0].with_name("secret.key")
    key.write_text("00" * 16, "utf-8")
    signed = [drive.with_name(f"{drive.name}_signed") for drive in drives]
    for drive, copy in zip(drives, signed, strict=True):
        run("lidar", "sign", drive, "--watermark", key, "-o", copy, "--overwrite")
    out = key.with_name("watermark.toml")
    run(
        "lidar",
        "defend",
        *signed,
        "--defence",
        f"watermark:key={key}",
        "--calibrate",
        "-o",
        out,
        "--overwrite",
    )
    return out


def joined(*files: Path) -> Calibration:
    """One calibration of several files; what defences have in common is that of the first."""
    parts = [read_calibration(file) for file in files]
    tails = {key: tail for part in parts for key, tail in part.tails.items()}
    joint = {level: joint for part in reversed(parts) for level, joint in part.joint.items()}
    return Calibration(dict(sorted(tails.items())), "; ".join(part.note for part in parts), joint)


if __name__ == "__main__":
    main()
