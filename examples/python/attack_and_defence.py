"""Spoof a car in front of a vehicle, and let defences judge the drive.

Writes to the folder given: the drive as it was, the same one under attack, and the verdicts.
"""

import sys
from dataclasses import replace
from pathlib import Path

import geoscene
import lidar
from lidar.sensors.physics.echoes import Origin
from lidar.tools.defences.calibration import read_calibration
from lidar.tools.defences.defend import defend, score_table
from lidar.tools.defences.registry import read_defences

out = Path(sys.argv[1] if len(sys.argv) > 1 else "attacked")
centre = geoscene.read_osm(geoscene.demo_path(), bounds=(24.9405, 60.1655, 24.9475, 60.1690))
scene = geoscene.build(centre, out / "scene", options=geoscene.BuildOptions(use="lidar"), overwrite=True)

genuine = lidar.DriveOptions(route="random", rig="vlp16", duration=2.0, seed=3, formats=("pcd",))
attacks = lidar.read_attacks(["inject:shape=object,kind=sedan,range=7,distance=10,start=1"])
attacked = replace(genuine, attacks=attacks)

# What the attack does to each frame, without files: every return has its origin.
for frame in lidar.simulate(scene, attacked):
    cloud = frame.clouds["lidar_top"]
    injected = cloud.origin == Origin.INJECTED
    hidden = int((cloud.hidden[injected] >= 0).sum())
    print(f"{frame.time_ns / 1e9:.1f} s: {injected.sum()} injected returns, which hide {hidden} genuine ones")

# Defences read recorded drives, and see nothing of the truth. Their thresholds are those of another scanner.
drives = [
    lidar.open_dataset(lidar.drive(scene, out / name, options=options, overwrite=True).path)
    for name, options in (("genuine", genuine), ("spoofed", attacked))
]
found = defend(
    drives,
    read_defences(["temporal", "shadow", "occlusion"]),
    calibration=read_calibration(),
    out=out / "verdicts",
    overwrite=True,
)
print(score_table(found).to_text())
print(f"wrote {out / 'verdicts' / 'defend.json'}")
