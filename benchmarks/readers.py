"""The functions that read the files of `damaged_inputs.py`, without the commands around them."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from pathlib import Path

from damaged_inputs import PLACE

from geoscene.frames import Frame
from geoscene.roadgraph import read_graphml
from geoscene.scene.geopackage import read_layer
from geoscene.scene.layout import SceneFiles, open_scene
from geoscene.scene.tile_files import read_shapes, read_tile
from geoscene.sources import read_osm, read_source
from lidar.dataset.boxes import read_boxes
from lidar.dataset.formats import FORMATS, read_table
from lidar.dataset.layout import Paths, open_dataset, read_rows, read_sensors
from lidar.dataset.recorded import cloud_points
from lidar.planning.replay import read_replay
from lidar.planning.waypoints import read_track
from lidar.rig.devices import cameras, scanners
from lidar.rig.scanner import load_sensor
from lidar.rig.specs import load_rig, rig_digest
from lidar.rig.vehicle import load_vehicle
from lidar.signal.registry import read_stages
from lidar.traffic.fcd import read_fcd

_FRAME = Frame.at(*PLACE)


def _whole_rig(path: Path) -> None:
    rig = load_rig(path)
    rig_digest(path)
    scanners(rig), cameras(rig)


def _layers(path: Path) -> None:
    for name in open_scene(path.parent).layers:
        read_layer(path, name, frame=_FRAME)


_MAPS: dict[str, Callable[[Path], object]] = {
    "*.osm": read_osm,
    "*.osm.gz": read_osm,
    "*.osm.pbf": read_osm,
    "a.json": read_osm,
    "*.parquet": functools.partial(read_source, "overture"),
}
_FILES = SceneFiles(Path())
_SCENES: dict[str, Callable[[Path], object]] = {
    _FILES.manifest.name: lambda path: open_scene(path.parent),
    "*_*.npz": read_tile,
    _FILES.shapes.name: read_shapes,
    _FILES.features.name: _layers,
    _FILES.road_graph.name: lambda path: read_graphml(path, _FRAME),
}
_DATASETS: dict[str, Callable[[Path], object]] = {
    "dataset.json": lambda path: open_dataset(path.parent),
    "calibration.json": lambda path: read_sensors(Paths(path.parent)),
    "trajectory.csv": lambda path: read_replay(path, _FRAME),
    "poses.csv": lambda path: read_replay(path, _FRAME),
    "timestamps.csv": read_rows,
    "boxes.csv": lambda path: read_boxes(path, ("frame", "id")),
    **{
        f"0*{form.suffix}": cloud_points if form.frame == "sensor" else read_table
        for form in FORMATS.values()
    },
}
_CONFIGURATIONS: dict[str, Callable[[Path], object]] = {
    "rig*.toml": _whole_rig,
    "sensor*.toml": load_sensor,
    "car.toml": load_vehicle,
    "drone.toml": load_vehicle,
    "stages.toml": lambda path: read_stages([str(path)]),
    "a.gpx": lambda path: read_track(path, _FRAME),
    "a.geojson": lambda path: read_track(path, _FRAME),
    "fcd.xml": read_fcd,
}
READERS = {"maps": _MAPS, "scenes": _SCENES, "datasets": _DATASETS, "configurations": _CONFIGURATIONS}


def reader_of(kind: str, path: Path) -> Callable[[Path], object] | None:
    """The function that reads a file; None if there is none of its own."""
    found = (read for pattern, read in READERS[kind].items() if path.match(pattern))
    return next(found, None) if path.parent.name not in ("boxes", "lidarseg", "deskewed", "truth") else None


@functools.cache
def readable(kind: str, folder: Path) -> list[Path]:
    """The files of a kind that functions read."""
    return [path for path in _files(kind, folder) if reader_of(kind, path)]


def _files(kind: str, folder: Path) -> Iterator[Path]:
    if kind == "scenes":
        yield from sorted((folder / "scene").rglob("*.*"))
    elif kind == "datasets":
        for data in sorted(folder.glob("data-*")):
            yield from sorted(data.rglob("*.*"))
    else:
        yield from sorted(folder.glob("*.*"))
