"""Compare two scanners on the same drive: how many returns they have of road users at which distance.

Writes a table to the folder given. Both scanners meet the same traffic from the same poses, so that what
differs is the scanner.
"""

import csv
import itertools
import sys
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import geoscene
import lidar

out = Path(sys.argv[1] if len(sys.argv) > 1 else "compared")
centre = geoscene.read_osm(geoscene.demo_path(), bounds=(24.9405, 60.1655, 24.9475, 60.1690))
scene = geoscene.build(centre, out / "scene", options=geoscene.BuildOptions(use="lidar"), overwrite=True)

RIG = """
name = "{0}"
vehicle = "car"

[[lidar]]
name = "roof"
preset = "{0}"
translation = [1.2, 0.0, 1.9]
"""
SCANNERS = ("vlp16", "xt32")
EDGES = (0, 10, 20, 30, 40, 60, 80)
"""Limits of the classes of distance, metres."""

options = lidar.DriveOptions(
    route="random",
    duration=0.8,
    seed=3,
    traffic=lidar.TrafficOptions(vehicles=30, cyclists=8, pedestrians=60, parked=0.8),
    fidelity="survey",  # beams with a size, several echoes, lost and false returns
)
seen: dict[str, dict[int, list[int]]] = {}
for scanner in SCANNERS:
    rig = out / f"{scanner}.toml"
    rig.write_text(RIG.format(scanner))
    points = seen[scanner] = defaultdict[int, list[int]](list)
    for frame in lidar.simulate(scene, replace(options, rig=str(rig))):
        boxes = frame.boxes["roof"]
        distance = (boxes["ego_x"] ** 2 + boxes["ego_y"] ** 2) ** 0.5
        for k in (boxes["visibility"] > 0.5).nonzero()[0]:  # what hides a road user hides it from both
            near = max(edge for edge in EDGES if edge <= distance[k])
            points[near].append(int(boxes["points"][k]))
    print(f"{scanner}: {len(frame.clouds['roof']):,} returns in the last sweep")

with (out / "points_on_road_users.csv").open("w", newline="") as file:
    table = csv.writer(file)
    table.writerow(["from_m", "to_m", "road_users", *(f"{name}_points" for name in SCANNERS)])
    for low, high in itertools.pairwise(EDGES):
        counts = [seen[name][low] for name in SCANNERS]
        if not counts[0]:
            continue
        means = [round(sum(of) / max(len(of), 1), 1) for of in counts]
        table.writerow([low, high, len(counts[0]), *means])
        figures = ", ".join(f"{name} {mean:g}" for name, mean in zip(SCANNERS, means, strict=True))
        print(f"{low} to {high} m: points on a road user: {figures}")
print(f"wrote {out / 'points_on_road_users.csv'}")
