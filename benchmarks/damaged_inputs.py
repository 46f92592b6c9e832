"""Small valid inputs of every kind, and the commands that use them: what `robustness.py` damages."""

from __future__ import annotations

import gzip
import json
import random
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import forked
from mutations import WORDS

from lidar.dataset.formats import FORMATS
from lidar.dataset.layouts import EXPORTERS

Words = list[str]
Line = list[tuple[float, float]]
Case = tuple[Path | None, Words]
"""A file to damage, and the command that uses it; without a file, the command's own words are damaged."""

_RIG_FOLDER = Path(__file__).resolve().parents[1] / "lidar" / "rig"

PLACE = 24.944, 60.167
"""Longitude and latitude of the small map, in the bundled country."""

_RIG = """name = "small"
vehicle = "car"
[[lidar]]
name = "top"
preset = "{}"
translation = [1.2, 0.0, 1.9]
rpy_deg = [0.0, 1.0, 2.0]
[[camera]]
name = "front"
translation = [1.6, 0.0, 1.5]
width = 32
height = 24
fov_deg = 90.0
distortion = [0.0, 0.0, 0.0, 0.0, 0.0]
far = 100.0
rate_hz = 10.0
images = ["rgb", "depth", "semantic", "instance", "flow"]
exposure_ns = 1000000
row_ns = 10000
[[camera]]
name = "round"
model = "fisheye"
width = 24
height = 24
fov_deg = 180.0
distortion = [0.01, 0.0, 0.0, 0.0]
[[gnss]]
name = "gnss"
translation = [0.6, 0.0, 1.6]
rate_hz = 10.0
mode = "single"
mask_deg = 10.0
constellations = ["gps", "galileo"]
[[imu]]
name = "imu"
model = "adis16448"
rate_hz = 100.0
gyro_noise = 1e-4
"""
_STAGES = """[[stage]]
name = "dropped_packets"
loss = 0.1
burst = 4
columns = 12
[[stage]]
name = "cover_glass"
transmission = 0.7
azimuth = 10.0
width = 90.0
sensor = "top"
[[stage]]
name = "lost_rows"
loss = 0.2
rows = 4
seed = 5
"""


_SWEEP = """[drive]
duration = 0.1
rig = "{0}/rig0.toml"
route = "random"
[grid]
scene = ["{0}/scene"]
seed = [1, 2]
format = ["pcd", "laz"]
"""
_REDTEAM = """[drive]
duration = 0.1
rig = "{0}/rig0.toml"
route = "random"
[grid]
scene = ["{0}/scene"]
seed = [1]
[[attack]]
name = "wall"
attack = "inject:shape=wall"
goal = "forge"
[defences]
use = ["shadow", "temporal"]
[measure]
score = 0.3
false_alarms = 0.05
block = 0.5
detector = ["rules"]
"""
_WEATHER = """[[weather]]
kind = "rain"
amount = "10mm/h"
start = 1.0
end = 8.0
centre = [24.944, 60.167]
radius = 200.0
[[weather]]
kind = "fog"
amount = "200m"
amount_to = "50m"
start = 0.0
end = 5.0
polygon = [[24.9, 60.1], [25.0, 60.1], [25.0, 60.2]]
"""


@dataclass(frozen=True)
class Inputs:
    """Valid inputs in a folder, made once; workers damage copies."""

    folder: Path

    def __post_init__(self) -> None:
        """Write all inputs."""
        self.folder.mkdir(parents=True)
        _write_maps(self.folder)
        _run("geoscene", "build", "--osm", self.folder / "a.osm", "-o", self.folder / "scene", "--workers=1")
        _write_configurations(self.folder)
        for name, more in _DATASETS.items():
            _run(
                *self.drive(f"data-{name}"),
                *more,
                "--traffic=on",
                f"--rig={self.folder}/rig0.toml",
            )
        _write_derived(self.folder)

    def drive(self, out: str) -> Words:
        """A short drive through the scene."""
        words = ["lidar", "drive", f"{self.folder}/scene", "-o", f"{self.folder}/{out}", "--duration=0.1"]
        return [*words, "--route=random", "--workers=1"]

    def damaged_map(self, rng: random.Random) -> Case:
        """A map, elevation file or table of buildings, and a build."""
        f = self.folder
        build = ["geoscene", "build", "-o", f"{f}/built", "--overwrite", "--workers=1"]
        name = rng.choices(list(_MAPS), list(_MAPS.values()))[0]
        if name == "a.tif":
            return f / name, [*build, "--osm", f"{f}/a.osm", "--dem", f"{f}/a.tif", "--dem-gaps=nearest"]
        if name == "a.parquet":
            more = ["--osm", f"{f}/a.osm"] if rng.random() < 0.5 else []
            return f / name, [*build, *more, "--source", f"overture={f}/a.parquet"]
        more = ["--dem", f"{f}/b.tif"] if rng.random() < 0.2 else []
        return f / name, [*build, "--osm", f"{f}/{name}", *more]

    def damaged_scene(self, rng: random.Random) -> Case:
        """A file of a scene, and a command that reads it."""
        f = self.folder
        scene = f / "scene"
        files = [path for path in sorted(scene.rglob("*")) if path.is_file() and path.suffix != ".lock"]
        path = rng.choice([file for file in files if file.parent == scene or rng.random() < 0.5])
        kind = rng.randrange(20)
        if kind < 12:
            return path, ["geoscene", "info", str(scene)]
        if kind < 17:
            return path, ["geoscene", "validate", str(scene)]
        if kind < 18:
            return path, ["geoscene", "view", str(scene), "-o", f"{f}/x.html", "--overwrite"]
        if kind < 19 and rng.random() < 0.5:
            words = ["geoscene", "build", "--osm", f"{f}/a.osm", "-o", str(scene)]
            return path, [*words, "--overwrite", "--workers=1"]
        if kind < 19:
            return path, [*self.drive("out"), "--overwrite", "--rig", f"{f}/rig0.toml", "--traffic=on"]
        suffix = rng.choice(
            ("glb", "city.json", "geojson", "gpkg", "tif", "xodr", "obj", "ply", "stl", "parquet")
        )
        to = ["--to", "3dtiles", "-o", f"{f}/tiles"] if rng.random() < 0.1 else ["-o", f"{f}/x.{suffix}"]
        return path, ["geoscene", "export", str(scene), *to, "--overwrite"]

    def damaged_dataset(self, rng: random.Random) -> Case:
        """A file of a dataset, and a command that reads it."""
        f = self.folder
        kind = rng.randrange(30)
        if kind >= 26:
            return self._damaged_folder(rng)
        name = rng.choice([name for name in _DATASETS if kind >= 16 or name not in ("kitti", "nuscenes")])
        data = f / f"data-{name}"
        files = [path for path in sorted(data.rglob("*")) if path.is_file()]
        path = rng.choice(
            [f for f in files if f.parent == data or f.parent.name in FORMATS or rng.random() < 0.3]
        )
        if kind < 6:
            end = rng.choice((".laz", ".ply", ".pcd"))
            more = rng.choice(
                (
                    [],
                    ["--voxel=0.2"],
                    ["--color=intensity", "--noise"],
                    ["--raster=dsm", f"--compare={f}/scene"],
                )
            )
            return path, ["lidar", "map", str(data), "-o", f"{f}/m{end}", "--overwrite", *more]
        if kind < 16:
            to = rng.choice(list(EXPORTERS))
            return path, ["lidar", "convert", str(data), "--to", to, "-o", f"{f}/to-{to}", "--overwrite"]
        if kind < 17:
            rig = ["--rig", f"{f}/rig0.toml", "--traffic=on"]
            return path, [*self.drive(data.name), *_DATASETS[name], *rig]
        if kind < 18:
            path = data / rng.choice(("poses.csv", "trajectory.csv", "dataset.json"))
            route = data / "trajectory.csv" if path.suffix == ".json" else path
            words = [word for word in self.drive("out") if word != "--route=random"]
            return path, [*words, "--overwrite", f"--rig={f}/rig0.toml", "--route", str(route)]
        stage = rng.choice(("dropped_packets", "cover_glass", "lost_rows"))
        again = rng.choice(
            (
                ["apply", str(data), "--stage", stage, "-o", f"{f}/applied", "--overwrite"],
                ["info", str(data)],
                ["info", str(data), "--full"],
                ["verify", str(data)],
                ["view", str(data), "-o", f"{f}/play.html", "--overwrite"],
                ["denoise", str(data), "--method=dror", "-o", f"{f}/clean", "--overwrite"],
                ["sign", str(data), "--chain", f"{f}/key", "-o", f"{f}/signed", "--overwrite"],
            )
        )
        return path, ["lidar", *again]

    def _damaged_folder(self, rng: random.Random) -> Case:
        """A file of signed data, or of a folder in the layout of KITTI or nuScenes, and a command on them."""
        f = self.folder
        data = f / rng.choice(("signed-data", "to-kitti", "to-nuscenes"))
        path = rng.choice([path for path in sorted(data.rglob("*")) if path.is_file()])
        keys = [f"--chain={f}/key", f"--watermark={f}/key"] if data.name == "signed-data" else []
        commands = (
            ["verify", str(data), *keys],
            ["info", str(data), "--full"],
            ["apply", str(data), "--stage", "dropped_packets", "-o", f"{f}/applied", "--overwrite"],
            ["denoise", str(data), "--method=dror"],
        )
        return path, ["lidar", *rng.choice(commands)]

    def damaged_configuration(self, rng: random.Random) -> Case:
        """A rig, sensor, vehicle, stage, route or traffic file, or the words of a command."""
        f = self.folder
        drive = [*self.drive("out")[:-2], "--workers=1", "--overwrite", "--format=pcd"]
        # most are planned no further than the route, which the scene does not have
        way = ["--route=random"] if rng.random() < 0.3 else ["--route", "9,9", "9,9.1"]
        kind = rng.randrange(20)
        if kind < 8:
            k = rng.randrange(_SENSORS)
            rig, own = f / f"rig{k}.toml", f / f"sensor{k}.toml"
            return (own if k and rng.random() < 0.7 else rig), [*drive, "--rig", str(rig), *way]
        drive += ["--rig", f"{f}/rig0.toml"]
        if kind < 10:
            return (path := f / rng.choice(("car.toml", "drone.toml"))), [
                *drive,
                "--vehicle",
                str(path),
                *way,
            ]
        if kind < 12:
            return f / "stages.toml", [*drive, "--stage", f"{f}/stages.toml", *way]
        route = f / rng.choice(("a.gpx", "a.geojson", "a.csv"))
        if kind < 15:
            return route, [*drive, "--route", str(route), *rng.choice(([], ["--vehicle=drone"]))]
        if kind < 16:
            words = ["geoscene", "build", "--osm", f"{f}/a.osm", "-o", f"{f}/built"]
            return route, [*words, "--overwrite", "--workers=1", "--only=roads", "--along", str(route)]
        if kind < 17:
            return (path := f / "fcd.xml"), [*drive, "--route=random", "--traffic", str(path)]
        if kind < 19:
            path = f / "field.geojson"
            return path, [*drive, "--vehicle=drone", "--altitude=30", "--survey", str(path)]
        return None, self._damaged_words(rng)

    def _damaged_words(self, rng: random.Random) -> Words:
        """A command with one to three options of random values."""
        f = self.folder
        commands = (
            (
                _BUILD,
                [
                    "geoscene",
                    "build",
                    "--osm",
                    f"{f}/a.osm",
                    "-o",
                    f"{f}/built",
                    "--overwrite",
                    "--workers=1",
                ],
            ),
            (_DRIVE, [*self.drive("out"), "--overwrite", "--format=pcd", f"--rig={f}/rig0.toml"]),
            (_MAP, ["lidar", "map", f"{f}/data-pcd", "-o", f"{f}/m.laz", "--overwrite"]),
            (_EXPORT, ["geoscene", "export", f"{f}/scene", "-o", f"{f}/x.tif", "--overwrite"]),
        )
        options, words = rng.choice(commands)
        for _ in range(rng.randint(1, 3)):
            name, values = rng.choice(list(options.items()))
            own = name == "--duration" or rng.random() < 0.6
            value = rng.choice(values if own else WORDS)
            words = [word for word in words if not word.startswith(f"{name}=")]
            if name == "--out":
                words = (
                    [*words[: words.index("-o")], *words[words.index("-o") + 2 :]] if "-o" in words else words
                )
            value = value.replace("FOLDER", str(f))
            words += [name, *value.split()] if name in _SEVERAL else [f"{name}={value}"]
        return words


KINDS: dict[str, Callable[[Inputs, random.Random], Case]] = {
    "maps": Inputs.damaged_map,
    "scenes": Inputs.damaged_scene,
    "datasets": Inputs.damaged_dataset,
    "configurations": Inputs.damaged_configuration,
}

_MAPS = {"a.osm": 10, "a.osm.gz": 1, "a.osm.pbf": 1, "a.json": 2, "a.tif": 1, "a.parquet": 1}
"""Maps with their shares."""

_DATASETS: dict[str, Words] = {
    "pcd": ["--format=pcd", "--labels=semantickitti,nuscenes", "--deskew=middle", "--stage=dropped_packets"],
    "kitti": ["--format=kitti", "--labels=semantickitti"],
    "nuscenes": ["--format=nuscenes", "--labels=nuscenes"],
    "ply": ["--format=ply", "--set=rays=7"],
    "others": [f"--format={','.join(FORMATS.keys() - {'pcd', 'kitti', 'nuscenes', 'ply'})}"],
}
"""Options of the drives of the datasets."""

_SENSORS = 1 + len(list(_RIG_FOLDER.glob("sensors/*.toml")))
"""Number of rigs: one with cameras, and one for each built-in scanner."""


_SEVERAL = ("--route", "--along")
"""Options that take several values."""

_COMMON = {
    "--duration": ("0.1", "0.3", "20", "nan", "-1", "1e308"),
    "--seed": ("0", "7"),
    "--crs": ("utm", "scene", "EPSG:4326", "EPSG:3067"),
}
_BUILD = {
    "--crs": ("local", "utm", "EPSG:3067", "EPSG:4326", "EPSG:9", "EPSG:3857", "EPSG:5041"),
    "--lod": ("0", "1", "2"),
    "--tile-size": ("50", "100", "2000"),
    "--reach": ("1", "100"),
    "--only": ("buildings", "roads", "trees,barriers", ""),
    "--along": ("60.1669,24.9438 60.167,24.9442", "FOLDER/a.gpx"),
    "--bbox": ("24.9435,60.1665,24.9445,60.1675", "24,60,25,61"),
    "--driving-side": ("left", "right"),
    "--name": ("x",),
    "--dem": ("FOLDER/a.tif", "FOLDER/a.osm"),
    "--source": ("overture=FOLDER/a.parquet", "overture=FOLDER/a.osm"),
}
_DRIVE = _COMMON | {
    "--rig": ("seed", "vlp16", "drone", "FOLDER/rig1.toml", "FOLDER/a.osm"),
    "--route": ("random", "60.1669,24.9438 60.1669,24.9442", "60.1669,24.9438", "FOLDER/a.gpx",
                "FOLDER/data-pcd/poses.csv", "FOLDER/a.osm"),
    "--survey": ("all", "24.9435,60.1665,24.9445,60.1675", "FOLDER/field.geojson"),
    "--vehicle": ("car", "drone", "backpack", "aircraft", "FOLDER/car.toml"),
    "--altitude": ("30", "0.01", "20000"),
    "--overlap": ("0", "0.9", "0.999", "0.9999999"),
    "--turns": ("true", "false"),
    "--start": ("2026-06-21T08:00:00", "2016-12-31T23:59:60", "1980-01-06", "2261-12-31", "0001-01-01"),
    "--format": ("pcd", "pcd,laz,kitti", "csv"),
    "--labels": ("nuscenes", "semantickitti"),
    "--deskew": ("start", "end"),
    "--fidelity": ("standard", "survey"),
    "--set": ("rays=7", "rays=61", "extinction=0.01", "interference=3", "supersample=2", "haze=1",
              "blur=9", "mirrors=on", "daylight_lux=1e5",
              "spread=nan", "rays=-1", "extinction=1e308", "interference=1e9"),
    "--stage": ("dropped_packets:loss=0.5", "cover_glass:width=nan", "lost_rows", "FOLDER/stages.toml"),
    "--traffic": ("on", "off", "vehicles=100,parked=1", "pedestrians=1e9", "radius=1e9", "FOLDER/fcd.xml",
                  "cyclists=nan", "FOLDER/fcd.xml,begin=1", "FOLDER/fcd.xml,parked=-1"),
    "--side": ("left", "right"),
    "--workers": ("1", "3"),
    "--exact": ("true",),
    "--from-rest": ("true",),
}  # fmt: skip
_MAP = {
    "--voxel": ("0.1", "1e-9", "1e9", "1e-300"),
    "--color": ("class", "height", "intensity", "sensor"),
    "--sensor": ("top", "front", "x"),
    "--noise": ("true",),
    "--out": ("FOLDER/m.laz", "FOLDER/m.ply", "FOLDER/m.pcd", "FOLDER/m.las", "FOLDER/m.txt", "FOLDER"),
}
_EXPORT = {
    "--resolution": ("0.5", "10", "1e-9", "1e9", "0.001"),
    "--model": ("surface", "terrain", "classes"),
    "--crs": ("EPSG:3067", "EPSG:4326", "EPSG:2056", "EPSG:9"),
    "--layers": ("buildings", "terrain,roads", "x"),
    "--to": (
        "cityjson",
        "glb",
        "obj",
        "ply",
        "stl",
        "gpkg",
        "geojson",
        "geoparquet",
        "geotiff",
        "opendrive",
        "sumo",
    ),
    "--height-offset": ("17", "-1e9"),
    "--out": ("FOLDER/y.city.json", "FOLDER/y.glb", "FOLDER/y.gpkg", "FOLDER/y.geojson", "FOLDER/y"),
}


def _run(*words: object) -> None:
    ended = forked.run(words, within=Path())
    if ended.code:
        raise SystemExit(f"{words}: {ended.errors}")


def _degrees(x: float, y: float) -> tuple[float, float]:
    """Longitude and latitude of a point east and north of `PLACE`, in metres."""
    return round(PLACE[0] + x / 55_400, 7), round(PLACE[1] + y / 111_200, 7)


def _box(x: float, y: float, width: float, depth: float) -> Line:
    """The closed ring of a rectangle, in metres from `PLACE`."""
    return [(x, y), (x + width, y), (x + width, y + depth), (x, y + depth), (x, y)]


_WAYS: list[tuple[Line, dict[str, str]]] = [
    (_box(0, 0, 12, 10), {"building": "house", "roof:shape": "gabled", "building:levels": "2"}),
    (_box(20, 0, 12, 10), {"building": "yes", "height": "9"}),
    (_box(20, 0, 6, 10), {"building:part": "yes", "height": "12", "min_height": "3", "roof:shape": "hipped"}),
    (_box(26, 0, 6, 10), {"building:part": "yes", "height": "7", "roof:shape": "skillion"}),
    (_box(-30, 2, 10, 9), {"building": "church", "roof:shape": "dome", "height": "20", "roof:height": "8"}),
    ([(-60, -6), (0, -8), (60, -6)], {"highway": "residential", "lanes": "2", "sidewalk": "both"}),
    ([(0, -8), (-2, -40)], {"highway": "tertiary", "oneway": "yes", "bridge": "yes", "layer": "1"}),
    ([(-2, -40), (30, -45)], {"highway": "footway", "tunnel": "yes", "layer": "-1"}),
    (_box(-20, 20, 12, 12), {"landuse": "forest"}),
    (_box(10, 20, 12, 8), {"natural": "water"}),
    ([(-10, 14), (10, 14)], {"barrier": "wall", "height": "2"}),
]  # fmt: skip
_POINTS = [
    ((-12, -3), {"natural": "tree", "height": "7"}),
    ((15, -3), {"highway": "street_lamp"}),
    ((8, 12), {"natural": "tree", "leaf_type": "needleleaved"}),
]


def _write_maps(folder: Path) -> None:
    import osmium  # noqa: PLC0415

    elements: list[dict[str, Any]] = []
    numbers: dict[tuple[float, float], int] = {}

    def node(place: tuple[float, float], tags: dict[str, str] | None = None) -> int:
        if place not in numbers:
            numbers[place] = len(numbers) + 1
            lon, lat = _degrees(*place)
            elements.append(
                {"type": "node", "id": numbers[place], "lat": lat, "lon": lon, "tags": tags or {}}
            )
        return numbers[place]

    for place, tags in _POINTS:
        node(place, tags)
    node((0, -8), {"highway": "traffic_signals"})
    ways = [
        {"type": "way", "id": k + 1, "nodes": [node(p) for p in line], "tags": tags}
        for k, (line, tags) in enumerate(_WAYS)
    ]
    ring = [node(place) for place in _box(40, 0, 12, 10)], [node(place) for place in _box(44, 3, 4, 4)]
    ways += [{"type": "way", "id": 90 + k, "nodes": line, "tags": {}} for k, line in enumerate(ring)]
    members = [{"type": "way", "ref": 90 + k, "role": role} for k, role in enumerate(("outer", "inner"))]
    relation = {
        "type": "relation",
        "id": 1,
        "members": members,
        "tags": {"type": "multipolygon", "building": "yes"},
    }
    elements += [*ways, relation]
    (folder / "a.json").write_text(json.dumps({"version": 0.6, "elements": elements}))
    rows = ['<?xml version="1.0" encoding="UTF-8"?>', '<osm version="0.6">']
    for item in elements:
        place = f' lat="{item["lat"]}" lon="{item["lon"]}"' if item["type"] == "node" else ""
        rows.append(f'<{item["type"]} id="{item["id"]}" version="1"{place}>')
        rows += [f'<nd ref="{ref}"/>' for ref in item.get("nodes", ())]
        rows += [f'<member type="way" ref="{m["ref"]}" role="{m["role"]}"/>' for m in item.get("members", ())]
        rows += [f'<tag k="{key}" v="{value}"/>' for key, value in item["tags"].items()]
        rows.append(f"</{item['type']}>")
    (folder / "a.osm").write_text("\n".join([*rows, "</osm>"]))
    for name in ("a.osm.pbf", "a.osm.gz"):
        with osmium.SimpleWriter(str(folder / name)) as out:
            for item in osmium.FileProcessor(str(folder / "a.osm")):
                out.add(item)
    _write_elevation(folder)
    _write_overture(folder / "a.parquet")


def _write_elevation(folder: Path) -> None:
    import numpy as np  # noqa: PLC0415
    import rasterio  # noqa: PLC0415

    west, north = _degrees(-150, 150)
    heights = np.add.outer(np.arange(20.0), np.arange(20.0)).astype("f4") / 8
    profile = {
        "driver": "GTiff",
        "width": 20,
        "height": 20,
        "count": 1,
        "dtype": "float32",
        "crs": "EPSG:4326",
    }
    transform = rasterio.Affine(300 / 55_400 / 20, 0, west, 0, -300 / 111_200 / 20, north)
    for name in ("a.tif", "b.tif"):
        with rasterio.open(folder / name, "w", **profile, transform=transform, nodata=-999) as out:
            out.write(heights, 1)


def _write_overture(path: Path) -> None:
    import pyarrow as pa  # noqa: PLC0415
    import pyarrow.parquet as pq  # noqa: PLC0415
    import shapely  # noqa: PLC0415

    boxes = [_box(-60, 20, 10, 8), _box(-60, 40, 12, 9)]
    shapes = [shapely.Polygon([_degrees(*place) for place in line]) for line in boxes]
    columns = {"id": ["a", "b"], "geometry": [shape.wkb for shape in shapes], "height": [8.0, None]}
    columns |= {"class": ["house", None], "roof_shape": ["gabled", "flat"], "num_floors": [2, 3]}
    geo = {"version": "1.1.0", "primary_column": "geometry"}
    geo |= {"columns": {"geometry": {"encoding": "WKB", "geometry_types": ["Polygon"]}}}
    pq.write_table(
        pa.table(columns).replace_schema_metadata({"geo": json.dumps(geo)}), path, compression="none"
    )


def _write_derived(folder: Path) -> None:
    """Data that are made of others, and files that only some commands read."""
    data = folder / "data-pcd"
    (folder / "key").write_text("5f" * 32)
    keys = f"--chain={folder}/key", f"--watermark={folder}/key"
    _run("lidar", "sign", folder / "data-ply", *keys, "-o", folder / "signed-data")
    for name in ("kitti", "nuscenes"):
        _run("lidar", "convert", data, "--to", name, "-o", folder / f"to-{name}")
    _run("lidar", "convert", data, "--to", "tum", "-o", folder / "to-tum")
    shutil.copy(folder / "to-tum" / "vehicle.tum", folder)
    for end in ("laz", "las", "copc.laz", "ply", "pcd", "e57"):
        _run("lidar", "map", data, "-o", folder / f"map.{end}")
    for end in ("obj", "ply", "stl"):
        shutil.copy(_mesh(folder, end), folder / f"mesh.{end}")
    shutil.copy(data / "front" / "rgb" / "000000.png", folder / "patch.png")
    (folder / "sweep.toml").write_text(_SWEEP.format(folder))
    (folder / "redteam.toml").write_text(_REDTEAM.format(folder))
    (folder / "weather.toml").write_text(_WEATHER)
    (folder / "fcd.xml.gz").write_bytes(gzip.compress((folder / "fcd.xml").read_bytes(), 1))
    inside = Path(__file__).resolve().parents[1] / "lidar"
    shutil.copy(inside / "defences" / "calibration.toml", folder / "calibration.toml")
    shutil.copy(next((inside / "detection").glob("*.npz")), folder / "model.npz")


def _mesh(folder: Path, end: str) -> Path:
    import trimesh  # noqa: PLC0415

    path = folder / f"box.{end}"
    trimesh.creation.box().export(path)
    return path


def _write_configurations(folder: Path) -> None:
    (folder / "rig0.toml").write_text(_RIG.format("utm30lx"))
    for k, path in enumerate(sorted(_RIG_FOLDER.glob("sensors/*.toml")), 1):
        shutil.copy(path, folder / f"sensor{k}.toml")
        (folder / f"rig{k}.toml").write_text(_RIG.format(f"sensor{k}.toml").partition("[[camera]]")[0])
    for name in ("car", "drone"):
        shutil.copy(_RIG_FOLDER / "vehicles" / f"{name}.toml", folder)
    (folder / "stages.toml").write_text(_STAGES)
    (a, b), (c, d), (e, g) = (_degrees(*place) for place in ((-40, -7), (0, -8), (40, -7)))
    track = "".join(f'<trkpt lat="{y}" lon="{x}"><ele>3</ele></trkpt>\n' for x, y in ((a, b), (c, d), (e, g)))
    (folder / "a.gpx").write_text(f'<gpx version="1.1">\n<trk><trkseg>\n{track}</trkseg></trk></gpx>')
    line = {"type": "LineString", "coordinates": [[a, b], [c, d], [e, g]]}
    (folder / "a.geojson").write_text(
        json.dumps({"type": "Feature", "properties": {}, "geometry": line}, indent=1)
    )
    (folder / "a.csv").write_text(f"lon,lat\n{a},{b}\n{c},{d}\n{e},{g}\n")
    field = {"type": "Polygon", "coordinates": [[_degrees(*place) for place in _box(-20, -20, 40, 40)]]}
    (folder / "field.geojson").write_text(json.dumps(field, indent=1))
    steps = "".join(
        f'<timestep time="{k}.00">\n'
        f'<vehicle id="v" x="{a + k * 1e-5}" y="{b}" angle="90" type="car" speed="3"/>\n'
        f'<person id="p" x="{c}" y="{d}" angle="10" speed="1"/>\n</timestep>\n'
        for k in range(3)
    )
    (folder / "fcd.xml").write_text(f'<fcd-export>\n<fcd-output.geo value="true"/>\n{steps}</fcd-export>\n')
