"""Demo on the bundled extract of Helsinki: build the scene, drive in traffic, make a map, draw pictures.

Writes to ``demo/`` (or the folder given as the first argument) and lists the files at the end.
"""

import csv
import os
import sys
import time
from collections import Counter
from pathlib import Path

import numpy as np

from geoscene.classes import Class, class_codes
from geoscene.options import BuildOptions
from geoscene.pipeline.build import build
from geoscene.scene import SceneFiles
from geoscene.scene.validate import check_scene
from geoscene.sources import demo_path, read_osm
from geoscene.support.kernels import compile_ahead
from geoscene.support.progress import progress_bar
from geoscene.view import view_scene
from lidar.dataset.formats import read_table
from lidar.dataset.layout import open_dataset
from lidar.dataset.png import counts_to_depth, read_png, write_png
from lidar.motion.vehicle import load_vehicle
from lidar.options.drive import DriveOptions
from lidar.options.maps import MapOptions
from lidar.sensors.rig.specs import load_rig
from lidar.simulation.drive import drive
from lidar.tools.maps.aggregate import aggregate
from lidar.tools.maps.picture import (
    class_colors,
    cloud_picture,
    depth_picture,
    sweep_picture,
    with_legend,
)
from lidar.tools.plots.scene_picture import scene_picture
from lidar.traffic.options import TrafficOptions
from lidar.world.world import World

ROUTE = ((60.16765, 24.94750), (60.16640, 24.94350))
"""Latitude and longitude of start and end: westwards along Pohjoisesplanadi, with the sun behind."""

RIG = Path(__file__).with_name("demo_rig.toml")

out = Path(sys.argv[1] if len(sys.argv) > 1 else "demo")
pictures = out / "pictures"
pictures.mkdir(parents=True, exist_ok=True)
began = time.perf_counter()


def say(text: str) -> None:
    """Print a line with the seconds since the start."""
    print(f"[{time.perf_counter() - began:5.1f} s] {text}", flush=True)


def find_busiest_frame(boxes: Path) -> int:
    """The camera frame with the most road users that are mostly visible and not too small."""
    with boxes.open(newline="") as file:
        seen = Counter(
            int(row["frame"])
            for row in csv.DictReader(file)
            if float(row["visibility"]) > 0.5 and int(row["pixels"]) > 800
        )
    return max(seen, key=lambda frame: (seen[frame], -frame))


def main() -> None:
    """Build, drive, draw; worker processes import this module without doing so."""
    compile_ahead("build", "drive", "cameras", "traffic")
    with progress_bar() as progress:
        # 1. OpenStreetMap becomes a scene.
        say("building the scene of the bundled extract")
        scene = build(
            read_osm(demo_path()),
            out / "scene",
            options=BuildOptions(name="Helsinki"),
            overwrite=True,
            workers=os.cpu_count() or 1,
            progress=progress,
        )
        counts, report = scene.manifest["counts"], check_scene(scene)
        broken = len(report["broken"])
        say(f"{counts['solids']} buildings, {broken} solids broken; {counts['road_km']} km of road")

        # 2. The scene as a web page, and pictures of it from above and obliquely.
        view_scene(scene, out / "scene.html", overwrite=True, progress=progress)
        world = World.load(scene)
        write_png(pictures / "scene_top.png", scene_picture(world, view="top", size=(1400, 1400)))
        write_png(pictures / "scene_oblique.png", scene_picture(world, view="oblique", size=(1600, 1000)))

        # 3. A drive with a 3D scanner, a 2D scanner, a camera and a satellite receiver in busy traffic.
        say("driving for 25 seconds among cars, cyclists and pedestrians")
        traffic = TrafficOptions(vehicles=30.0, cyclists=8.0, pedestrians=100.0, parked=0.9)
        options = DriveOptions(route=ROUTE, rig=str(RIG), duration=25.0, seed=3, traffic=traffic)
        summary = drive(scene, out / "drive", options=options, overwrite=True, progress=progress)
        say(f"{summary.length:.0f} m, {summary.frames} frames, {summary.written:,} returns")

        # 4. The camera frame with most road users, and the sweep of that moment by class.
        rig, camera = load_rig(str(RIG)), out / "drive" / "camera_front"
        frame = find_busiest_frame(camera / "boxes.csv")
        scanner, sweeps_per_image = rig.lidars[0], rig.lidars[0].rate_hz / rig.cameras[0].rate_hz
        sweep = read_table(
            out / "drive" / scanner.name / "pcd" / f"{round(frame * sweeps_per_image):06d}.pcd"
        )
        mount = scanner.mount
        xyz = np.column_stack([sweep[axis] for axis in "xyz"]) @ mount.rotation.T + mount.translation
        label = sweep["label"].astype(np.uint8)
        image = sweep_picture(xyz, class_colors(label), vehicle=load_vehicle("car"))
        write_png(pictures / "sweep_class.png", with_legend(image, label))
        write_png(pictures / "camera_rgb.png", read_png(camera / "rgb" / f"{frame:06d}.png"))
        depth = counts_to_depth(read_png(camera / "depth" / f"{frame:06d}.png"))
        write_png(pictures / "camera_depth.png", depth_picture(depth))

        # 5. All sweeps as one georeferenced map.
        say("putting all sweeps together")
        dataset = open_dataset(out / "drive")
        options = MapOptions(voxel=0.1, sensors=("lidar_top",))
        aggregate(dataset, out / "map.laz", options=options, progress=progress)
        points = read_table(out / "map.laz")
        static = points["label"] < Class.CAR  # moving road users leave trails
        label = points["label"][static]
        world_xyz = np.column_stack([points[axis][static] for axis in "xyz"])
        image = cloud_picture(world_xyz, class_codes().color[label], size=(1600, 1000), point=0.15)
        write_png(pictures / "map_class.png", with_legend(image, label))

    say("done; open these:")
    for path, what in {
        out / "scene.html": "the scene as an interactive page (any browser, no network)",
        pictures: "pictures of each step",
        SceneFiles(out / "scene").features: "buildings, land cover, roads (QGIS)",
        out / "map.laz": "the map, in UTM (CloudCompare, QGIS)",
        out / "drive" / "lidar_top": "sweeps as PCD and LAZ (lidar drive --format writes others)",
        out / "drive" / "camera_front": "RGB and depth images",
        out / "drive" / "boxes.csv": "3D bounding boxes of the other road users",
        out / "drive" / "poses.csv": "pose of the vehicle at each frame",
    }.items():
        print(f"  {path}  -  {what}")


if __name__ == "__main__":
    main()
