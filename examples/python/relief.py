"""The same street with relief off, plain and full: image, depth and point cloud side by side.

Writes to the folder given: the scenes, a drive of two seconds through each, and relief.png, a row for each.
For another street: relief.py FOLDER MAP WEST,SOUTH,EAST,NORTH START END, the ends as LAT,LON.
"""

import sys
from pathlib import Path

import numpy as np

import geoscene
import lidar
from geoscene.classes import class_codes
from lidar.dataset.formats import read_table
from lidar.dataset.png import counts_to_depth, read_png, write_png
from lidar.tools.maps.picture import PictureView, cloud_picture, depth_picture, with_key

RIG = """
name = "street"
vehicle = "car"
[[lidar]]
name = "scanner"
preset = "os0_128"
translation = [0.8, 0.0, 2.0]
[[camera]]
name = "camera"
translation = [1.5, 0.0, 1.6]
width = 800
height = 500
fov_deg = 75.0
rate_hz = 1.0
images = ["rgb", "depth"]
"""
AHEAD, ASIDE, UP = (2.0, 34.0), 15.0, 14.0
"""Metres of the street in the picture of the cloud: ahead of the vehicle, to both sides, and above it."""

out = Path(sys.argv[1] if len(sys.argv) > 1 else "street")
source, bounds = geoscene.demo_path(), (24.9405, 60.1655, 24.9475, 60.1690)
street = [(60.16765, 24.94650), (60.16720, 24.94480)]
if len(sys.argv) > 2:
    source = Path(sys.argv[2])
    bounds, *street = (tuple(float(part) for part in word.split(",")) for word in sys.argv[3:])
out.mkdir(parents=True, exist_ok=True)
rig = out / "street.toml"
rig.write_text(RIG, encoding="utf-8")
data = geoscene.read_osm(source, bounds=bounds)

rows = []
for relief in ("off", "plain", "full"):
    built = geoscene.BuildOptions(relief=relief)
    scene = geoscene.build(data, out / relief, options=built, overwrite=True)
    options = lidar.DriveOptions(
        route=street, rig=str(rig), duration=2.0, seed=1, formats=("laz",), crs="scene", relief=relief
    )
    dataset = lidar.open_dataset(
        lidar.drive(scene, out / f"drive_{relief}", options=options, overwrite=True).path
    )
    mapped = lidar.aggregate(dataset, out / f"map_{relief}.laz", overwrite=True)

    camera = dataset.paths.sensor("camera")
    depth = counts_to_depth(read_png(camera / "depth" / "000000.png"))
    points = read_table(mapped.path)
    way = dataset.trajectory()
    forward = way.position[-1, :2] - way.position[0, :2]
    forward /= np.linalg.norm(forward)
    offset = np.column_stack([points[axis] for axis in "xyz"]) - way.position[0]
    along = offset[:, :2] @ forward
    aside = offset[:, :2] @ [forward[1], -forward[0]]
    shown = (along > AHEAD[0]) & (along < AHEAD[1]) & (np.abs(aside) < ASIDE) & (offset[:, 2] < UP)
    cloud = cloud_picture(
        np.column_stack([aside, along, offset[:, 2]])[shown],
        class_codes().color[points["label"][shown].astype(np.uint8)],
        view=PictureView(40.0, 16.0, 40.0),
        size=(800, 500),
        bounds=[(-ASIDE, AHEAD[0], 0.0), (ASIDE, AHEAD[1], UP)],
        point=0.04,
    )
    image = with_key(read_png(camera / "rgb" / "000000.png"), [(f"relief {relief}", (255, 255, 255))])
    rows.append(np.hstack([image, depth_picture(depth, far=60.0), cloud]))
    print(f"relief {relief}: {shown.sum():,} of {mapped.points:,} points shown")
write_png(out / "relief.png", np.vstack(rows))
