"""The functions that read the files of `damaged_inputs.py`, without the commands around them."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

from damaged_inputs import PLACE

from geoscene.geometry.frames import Frame
from geoscene.roadgraph import read_graphml
from geoscene.scene.geopackage import read_layer
from geoscene.scene.layout import SceneFiles, open_scene
from geoscene.scene.tile_files import read_shapes, read_tile
from geoscene.sources import read_osm, read_source
from lidar.dataset.checksums import differences, read_checksums
from lidar.dataset.formats import FORMATS, MAPS, format_of, read_table
from lidar.dataset.formats.table import rows
from lidar.dataset.ground_truth import read_boxes, read_truth
from lidar.dataset.journal import read_journal
from lidar.dataset.layout import Paths, open_dataset, read_rows, read_sensors
from lidar.dataset.png import read_png
from lidar.dataset.recorded import cloud_points
from lidar.errors import FormatError
from lidar.geometry.trajectory_files import read_tum
from lidar.motion.replay import read_replay
from lidar.motion.vehicle import load_vehicle
from lidar.motion.waypoints import read_track
from lidar.sensors.rig.devices import cameras, scanners
from lidar.sensors.rig.scanner import load_sensor
from lidar.sensors.rig.specs import load_rig, rig_digest
from lidar.signal.attacks.images import _picture
from lidar.signal.attacks.placed_object import _read_mesh
from lidar.signal.registry import read_stages
from lidar.signal.weather.setting import read_weather
from lidar.tools.defences.calibration import read_calibration
from lidar.tools.detection.forest import read_forest
from lidar.tools.integrity.digests import read_digests, read_links
from lidar.tools.integrity.keys import read_signer
from lidar.tools.maps.source import _polygons
from lidar.tools.redteam.plan import read_plan
from lidar.tools.sweep.grid import read_grid
from lidar.traffic.fcd import read_fcd

_FRAME = Frame.at(*PLACE)


def _cloud(path: Path) -> None:
    """Read a cloud; its header must state as many points as are read."""
    form, stated = format_of(path), None
    with suppress(FormatError):
        stated = form.count(path)
    found = rows(cloud_points(path) if form.frame == "sensor" else read_table(path))
    if stated not in (None, found):
        raise AssertionError(f"{stated} points stated, {found} read")


def _checked(path: Path) -> None:
    list(differences(path.parent, read_checksums(path)))


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
    "frames.csv": read_journal,
    "checksums.sha256": _checked,
    "*.digests": read_digests,
    "integrity/*.csv": read_links,
    "rgb/*.png": read_png,
    "depth/*.png": read_png,
    **{f"0*{s}": _cloud for s in sorted((f.suffix for f in FORMATS.values()), key=len, reverse=True)},
    **{f"map{form.suffix}": read_table for form in MAPS.values()},
}
_CONFIGURATIONS: dict[str, Callable[[Path], object]] = {
    "rig*.toml": _whole_rig,
    "sensor*.toml": load_sensor,
    "car.toml": load_vehicle,
    "drone.toml": load_vehicle,
    "stages.toml": lambda path: read_stages([str(path)]),
    "a.gpx": lambda path: read_track(path, _FRAME),
    "vehicle.tum": read_tum,
    "a.geojson": lambda path: read_track(path, _FRAME),
    "fcd.xml": read_fcd,
    "fcd.xml.gz": read_fcd,
    "sweep.toml": read_grid,
    "redteam.toml": read_plan,
    "weather.toml": lambda path: read_weather(str(path)),
    "calibration.toml": read_calibration,
    "model.npz": read_forest,
    "key": read_signer,
    "field.geojson": _polygons,
    "mesh.*": lambda path: _read_mesh.__wrapped__(str(path)),
    "patch.png": lambda path: _picture.__wrapped__(str(path)),
}
READERS = {"maps": _MAPS, "scenes": _SCENES, "datasets": _DATASETS, "configurations": _CONFIGURATIONS}


def reader_of(kind: str, path: Path) -> tuple[str, Callable[[Path], object]] | None:
    """The pattern of a file's name and the function that reads it; None if there is none of its own."""
    if path.parent.name in ("truth", "before"):
        return "truth/*.npz", read_truth
    found = ((pattern, read) for pattern, read in READERS[kind].items() if path.match(pattern))
    return next(found, None) if path.parent.name not in ("boxes", "lidarseg", "deskewed") else None


@functools.cache
def readable(kind: str, folder: Path) -> list[list[Path]]:
    """The files of a kind that functions read, by function."""
    found: dict[str, list[Path]] = {}
    for path in _files(kind, folder):
        if reader := reader_of(kind, path):
            found.setdefault(reader[0], []).append(path)
    return list(found.values())


def _files(kind: str, folder: Path) -> Iterator[Path]:
    if kind == "scenes":
        yield from sorted((folder / "scene").rglob("*.*"))
    elif kind == "datasets":
        for data in (*sorted(folder.glob("data-*")), folder / "signed-data"):
            yield from sorted(data.rglob("*.*"))
        yield from sorted(folder.glob("map.*"))
    else:
        yield from sorted(path for path in folder.iterdir() if path.is_file())
