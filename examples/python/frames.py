"""Simulate a drive without files: look at each frame, and write only what is wanted of it.

Writes to the folder given: a table of the road users around the vehicle, and a picture of the last sweep.
"""

import csv
import sys
from pathlib import Path

import geoscene
import lidar
from geoscene.classes import Class

out = Path(sys.argv[1] if len(sys.argv) > 1 else "frames")
centre = geoscene.read_osm(geoscene.demo_path(), bounds=(24.9405, 60.1655, 24.9475, 60.1690))
scene = geoscene.build(centre, out / "scene", options=geoscene.BuildOptions(use="lidar"), overwrite=True)

options = lidar.DriveOptions(
    route="random",
    rig="vlp16",
    duration=2.0,
    seed=5,
    traffic=lidar.TrafficOptions(vehicles=30, cyclists=8, pedestrians=60, parked=0.8),
)
simulation = lidar.simulate(scene, options)
print(f"{len(simulation)} frames along {simulation.plan.length:.0f} m")

with (out / "road_users.csv").open("w", newline="") as file:
    table = csv.writer(file)
    table.writerow(["utc", "lon", "lat", "class", "id", "distance_m", "points"])
    for frame in simulation:
        cloud, boxes = frame.clouds["lidar_top"], frame.boxes["lidar_top"]
        lon, lat, _ = frame.lonlath
        for k in (boxes["points"] > 0).nonzero()[0]:
            distance = (boxes["ego_x"][k] ** 2 + boxes["ego_y"][k] ** 2) ** 0.5
            row = [boxes["class"][k], boxes["id"][k], round(distance, 2), boxes["points"][k]]
            table.writerow([frame.utc.isoformat(), round(lon, 7), round(lat, 7), *row])
        people = int((cloud.klass == Class.PEDESTRIAN).sum())
        print(f"{frame.utc:%H:%M:%S.%f}: {len(cloud):,} returns, {people} of them from pedestrians")

(out / "last_sweep.png").write_bytes(cloud._repr_png_())
print(f"wrote {out / 'road_users.csv'} and {out / 'last_sweep.png'}")
