"""The whole way on the bundled piece of Helsinki: build the scene, drive through it, map it, look at it.

Writes to ``demo/`` (or the folder given as the first argument) and prints what is where.
"""

import sys
import time
from pathlib import Path

import numpy as np

from geoscene.build import build
from geoscene.classes import class_codes
from geoscene.console import progress_bar
from geoscene.options import BuildOptions
from geoscene.scene import SceneFiles
from geoscene.scene.validate import check_scene
from geoscene.sources import demo_path, read_osm
from geoscene.view import view_scene
from lidar.camera.png import counts_to_depth, read_png, write_png
from lidar.dataset.formats import read_table
from lidar.dataset.layout import open_dataset
from lidar.drive import drive
from lidar.maps.aggregate import aggregate
from lidar.maps.picture import (
    class_colors,
    cloud_picture,
    depth_picture,
    scene_picture,
    sweep_picture,
    with_legend,
)
from lidar.options import DriveOptions
from lidar.rig.specs import load_rig
from lidar.rig.vehicle import load_vehicle
from lidar.world.world import World

out = Path(sys.argv[1] if len(sys.argv) > 1 else "demo")
pictures = out / "pictures"
pictures.mkdir(parents=True, exist_ok=True)
began = time.perf_counter()


def say(text: str) -> None:
    """Print a line with the time it took to get there."""
    print(f"[{time.perf_counter() - began:5.1f} s] {text}", flush=True)


with progress_bar() as progress:
    # 1. OpenStreetMap becomes a scene.
    say("building the scene of the bundled extract")
    scene = build(
        read_osm(demo_path()),
        out / "scene",
        options=BuildOptions(name="Helsinki"),
        overwrite=True,
        progress=progress,
    )
    counts, report = scene.manifest["counts"], check_scene(scene)
    broken = len(report["broken"])
    say(f"{counts['solids']} buildings, {broken} solids broken; {counts['road_km']} km of road")

    # 2. The scene as a page to turn and click, from above and obliquely.
    view_scene(scene, out / "scene.html", overwrite=True, progress=progress)
    world = World.load(scene)
    write_png(pictures / "scene_top.png", scene_picture(world, view="top", size=(1400, 1400)))
    write_png(pictures / "scene_oblique.png", scene_picture(world, view="oblique", size=(1600, 1000)))

    # 3. A drive with a 3D scanner, a 2D scanner, a camera and a satellite receiver.
    say("driving for 20 seconds")
    options = DriveOptions(route="random", duration=20.0, seed=4, formats=("pcd", "ply", "csv", "laz"))
    summary = drive(scene, out / "drive", options=options, overwrite=True, progress=progress)
    say(f"{summary.length:.0f} m, {summary.frames} frames, {summary.written:,} returns")

    # 4. One sweep by class, one camera frame.
    middle = f"{summary.frames // 2:06d}"
    sweep = read_table(out / "drive" / "lidar_top" / "pcd" / f"{middle}.pcd")
    mount = load_rig("seed").lidars[0].mount
    xyz = np.column_stack([sweep[axis] for axis in "xyz"]) @ mount.rotation.T + mount.translation
    label = sweep["label"].astype(np.uint8)
    image = sweep_picture(xyz, class_colors(label), vehicle=load_vehicle("car"))
    write_png(pictures / "sweep_class.png", with_legend(image, label))
    camera = out / "drive" / "camera_front"
    write_png(pictures / "camera_rgb.png", read_png(camera / "rgb" / f"{middle}.png"))
    depth = counts_to_depth(read_png(camera / "depth" / f"{middle}.png"))
    write_png(pictures / "camera_depth.png", depth_picture(depth))

    # 5. All sweeps as one georeferenced map.
    say("putting all sweeps together")
    dataset = open_dataset(out / "drive")
    aggregate(dataset, out / "map.laz", voxel=0.1, sensors=("lidar_top",), progress=progress)
    points = read_table(out / "map.laz")
    world_xyz = np.column_stack([points[axis] for axis in "xyz"])
    colors = class_codes().color[points["label"]]
    write_png(
        pictures / "map_class.png",
        with_legend(cloud_picture(world_xyz, colors, size=(1600, 1000), point=0.15), points["label"]),
    )

say("done; open these:")
for path, what in {
    out / "scene.html": "the scene, to turn and click (any browser, no network)",
    pictures: "pictures of all of it",
    SceneFiles(out / "scene").features: "buildings, land cover, roads (QGIS)",
    out / "map.laz": "the map, in UTM (CloudCompare, QGIS)",
    out / "drive" / "lidar_top": "sweeps as PCD, PLY, CSV and LAZ",
    out / "drive" / "camera_front": "RGB and depth images",
    out / "drive" / "poses.csv": "where the vehicle was",
}.items():
    print(f"  {path}  -  {what}")
