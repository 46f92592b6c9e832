"""Description of a sweep: a TOML file with grids of options, each combination of which is a drive."""

from __future__ import annotations

import hashlib
import itertools
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from cyclopts import App

from geoscene.errors import reading
from geoscene.scene import open_scene
from geoscene.scene.layout import SceneFiles
from geoscene.support.console import DEFAULTS, guard_numbers
from geoscene.support.storage import url_of
from geoscene.support.untrusted import read_toml
from lidar.errors import InputError
from lidar.geometry.time_scales import check_start
from lidar.motion.vehicle import load_vehicle
from lidar.options import AccuracyOptions, DriveOptions
from lidar.sensors.rig.specs import load_rig
from lidar.simulation.plan import sensors_of
from lidar.tools.sweep.maps import MapScene, map_of_file, read_maps
from lidar.tools.sweep.words import naming, text_of, words_of
from lidar.traffic.fcd import TrafficFile

_OF_THE_SWEEP = ("out", "workers", "scheduler", "overwrite", "json", "quiet")
"""Options of the command, not of a drive."""

_LONGEST = 32
"""Characters of a value in the name of a folder."""


@dataclass(frozen=True, slots=True)
class GridDrive:
    """One drive of a sweep.

    name    : of its folder: the values of the grid's options
    scene   : directory or URL of a scene, or the first file of its map
    values  : options of the grid as text, by name
    options : of the drive; their paths are absolute, as workers may have another current folder
    wanted  : accuracy and budget of the drive
    map     : that the scene is built of, if it is not built yet
    """

    name: str
    scene: Path
    values: dict[str, str]
    options: DriveOptions
    wanted: AccuracyOptions = AccuracyOptions()
    map: MapScene | None = None

    @property
    def inputs(self) -> list[Path]:
        """Input files of the grid, except those within scenes."""
        options = self.options
        named: list[object] = [options.route, options.survey, options.rig, options.vehicle]
        if isinstance(options.traffic, TrafficFile):
            named += [options.traffic.path, options.traffic.net]
        paths = [Path(name) for name in named if isinstance(name, str | Path)]
        local = self.map is None and not url_of(self.scene)
        manifest = [SceneFiles(self.scene).manifest] if local else []
        return [*manifest, *(path for path in paths if path.is_file())]


def read_grid(path: Path) -> list[GridDrive]:
    """The drives that a file describes, in its order.

    Table ``drive`` holds options of all drives. Table ``grid``, or each table ``[[grid]]``, holds lists,
    whose combinations are the drives. Names are those of the flags of ``lidar drive``, and ``scene``.
    Tables ``[[map]]`` name maps that scenes are built of; see `read_maps`.

    Raises InputError, which names the drive, for anything that can be known before the drive starts.
    """
    with reading(path, InputError, remedy="give a TOML file with a table [grid]", known=InputError):
        document = read_toml(path.read_text("utf-8"))
    return drives_of(document, path)


def drives_of(document: Mapping[str, Any], path: Path) -> list[GridDrive]:
    """The drives of a file's tables; see `read_grid`.

    path : of the file, for messages
    """
    if unknown := sorted(set(document) - {"drive", "grid", "map"}):
        raise InputError(f"{path}: unknown {unknown[0]}; there are the tables drive, grid and map")
    common, grids = document.get("drive", {}), document.get("grid", {})
    grids = grids if isinstance(grids, list) else [grids]
    if not isinstance(common, dict) or not all(isinstance(grid, dict) for grid in grids):
        raise InputError(f"{path}: drive and grid are tables, as in [grid]")
    if not grids:
        raise InputError(f"{path}: no drives; add a table [grid]")
    maps = read_maps(path, document.get("map", []))
    drives: dict[str, GridDrive] = {}
    for grid in grids:
        _check_keys(path, common, grid=grid)
        for values in itertools.product(*grid.values()):
            drive = _drive(path, common, grid=dict(zip(grid, values, strict=True)), maps=maps)
            if drive.name in drives:
                raise InputError(f"{path}: drive {drive.name} is in it twice")
            drives[drive.name] = drive
    named: dict[str, MapScene] = {}
    for one in (drive.map for drive in drives.values() if drive.map):
        if named.setdefault(one.name, one) != one:
            raise InputError(f"{path}: scene: two maps are named {one.name}; rename one of them")
    for scene in dict.fromkeys(drive.scene for drive in drives.values() if drive.map is None):
        with naming(path, "scene"):
            open_scene(scene)
    return list(drives.values())


def _check_keys(path: Path, common: Mapping[str, Any], *, grid: Mapping[str, Any]) -> None:
    """Raise InputError for options in the wrong place."""
    for name, values in grid.items():
        if not isinstance(values, list) or not values:
            example = '["city", "town.osm.pbf"]' if name == "scene" else "[1, 2]"
            raise InputError(f"{path}: {name} in the grid: give a list of values, as in {name} = {example}")
        if name in common:
            raise InputError(f"{path}: {name} is in both drive and grid; keep one of them")
    for name in (*common, *grid):
        if name in _OF_THE_SWEEP:
            raise InputError(f"{path}: {name} is an option of lidar sweep, not of its drives")
    if "scene" not in common and "scene" not in grid:
        raise InputError(f'{path}: no scene; add scene = ["DIRECTORY"] to the grid')


def _drive(
    path: Path, common: Mapping[str, Any], *, grid: Mapping[str, Any], maps: Mapping[str, MapScene]
) -> GridDrive:
    """The drive of one combination of values."""
    texts = {name: text_of(value) for name, value in grid.items()}
    name = "_".join(f"{key}-{_slug(text)}" if key != "scene" else _slug(text) for key, text in texts.items())
    name = name or "drive"
    with naming(path, f"drive {name}"):
        values = {**common, **grid}
        scene = values.pop("scene")
        if not isinstance(scene, str):
            raise InputError("scene: give the directory of a scene, a map, or the name of a table [[map]]")
        words = [word for key, value in values.items() for word in words_of(key, value)]
        options, wanted = _parse(words)
        _check(options)
        options = _with_absolute_paths(options)
        place = Path(scene) if url_of(scene) else Path(scene).absolute()
        source = maps.get(scene) or (map_of_file(place) if place.is_file() else None)
    return GridDrive(name, source.osm[0] if source else place, texts, options, wanted, source)


def _slug(text: str) -> str:
    """A text as part of a folder's name; with a digest if characters are replaced or cut off."""
    if not text:
        return "none"
    plain = re.sub(r"[^\w.=+-]+", "-", text.rsplit("/", 1)[-1]).lstrip(".")[:_LONGEST]
    if plain == text:
        return plain
    return f"{plain}-{hashlib.blake2b(text.encode(), digest_size=3).hexdigest()}"


def _parse(words: list[str]) -> tuple[DriveOptions, AccuracyOptions]:
    """Options from words of a command line."""
    app = App(default_parameter=DEFAULTS, help_flags=(), version_flags=())

    @app.default
    def options_of(
        *, options: DriveOptions | None = None, wanted: AccuracyOptions = AccuracyOptions()
    ) -> tuple[DriveOptions, AccuracyOptions]:
        return options or DriveOptions(), wanted

    parsed: tuple[DriveOptions, AccuracyOptions] = app(
        guard_numbers(words), result_action="return_value", exit_on_error=False, print_error=False
    )
    return parsed


def _check(options: DriveOptions) -> None:
    """Raise InputError for what the drive would refuse, but for the route's course."""
    options.check_course()
    rig = load_rig(options.rig)
    sensors_of(rig, options)
    load_vehicle(options.vehicle or rig.vehicle)
    if options.start is not None:
        check_start(options.start, 0)
    files = [options.route] if isinstance(options.route, Path) else []
    files += [options.traffic.path] if isinstance(options.traffic, TrafficFile) else []
    for file in files:
        if not file.is_file():
            raise InputError(f"{file}: no such file")


def _with_absolute_paths(options: DriveOptions) -> DriveOptions:
    """Options in which files are named by absolute paths."""
    changed: dict[str, Any] = {}
    for name in ("route", "survey", "rig", "vehicle"):
        value = getattr(options, name)
        if isinstance(value, str | Path) and str(value) and Path(value).is_file():
            changed[name] = type(value)(Path(value).absolute())
    if isinstance(options.traffic, TrafficFile):
        net = options.traffic.net
        changed["traffic"] = replace(
            options.traffic, path=options.traffic.path.absolute(), net=net and net.absolute()
        )
    return replace(options, **changed)
