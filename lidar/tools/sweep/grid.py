"""Description of a sweep: a TOML file with grids of options, whose combinations are drives, and maps."""

from __future__ import annotations

import hashlib
import itertools
import json
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from cyclopts import App, CycloptsError

from geoscene.errors import GeosceneError, SceneFormatError, reading
from geoscene.options import BuildOptions, Degrees
from geoscene.pipeline.build import build
from geoscene.scene import open_scene
from geoscene.scene.layout import SceneFiles, changed_files
from geoscene.sources import read_osm, with_elevation
from geoscene.support.cluster import DaskCluster
from geoscene.support.console import DEFAULTS, guard_numbers
from geoscene.support.digests import file_digest, sources_digest
from geoscene.support.files import write_json
from geoscene.support.progress import Progress, silent
from geoscene.support.storage import cache_folder, url_of
from geoscene.support.untrusted import read_toml
from lidar.errors import InputError, LidarError
from lidar.geometry.time_scales import check_start
from lidar.motion.vehicle import load_vehicle
from lidar.options.accuracy import AccuracyOptions
from lidar.options.drive import DriveOptions
from lidar.parameters import item_of, item_text, value_text
from lidar.sensors.rig.specs import load_rig
from lidar.simulation.plan import sensors_of
from lidar.traffic.options import TrafficFile

_OF_THE_SWEEP = ("out", "workers", "scheduler", "overwrite", "json", "quiet")
"""Options of the command, not of a drive."""

_LONGEST = 32
"""Characters of a value in the name of a folder."""

_REPEATED = ("set", "stage", "weather", "attack")
"""Options of which each value is given by a flag of its own."""

_JOINED = ("format", "labels", "only")
"""Options whose values are separated by commas."""


@dataclass(frozen=True, slots=True)
class MapScene:
    """A map that a scene is built of.

    name    : of the scene's folder
    osm     : files of the map; absolute paths
    bounds  : west, south, east, north in degrees of the part to build; None for all
    options : of the build
    """

    name: str
    osm: tuple[Path, ...]
    bounds: Degrees | None = None
    options: BuildOptions = BuildOptions()

    @property
    def inputs(self) -> list[Path]:
        """Files that the scene depends on."""
        dem = () if self.options.elevation_tiles else self.options.dem
        named = (*self.osm, *map(Path, dem), *map(Path, self.options.along))
        return [path for path in named if path.is_file()]

    def built(
        self,
        folder: Path,
        *,
        workers: int = 1,
        cluster: DaskCluster | None = None,
        progress: Progress = silent,
    ) -> Path:
        """The scene in a folder, built unless it is there of the same files and options."""
        target, stamp = folder / self.name, folder / f"{self.name}.json"
        made_of = {
            "program": sources_digest("geoscene"),
            "bounds": self.bounds,
            "options": asdict(self.options),
            "files": {str(path): file_digest(path) for path in self.inputs},
        }
        if not _is_made_of(target, stamp, made_of=made_of):
            data = read_osm(self.osm, bounds=self.bounds)
            options = with_elevation(self.options, data, cache_dir=cache_folder(), progress=progress)
            scene = build(
                data,
                target,
                options=options,
                overwrite=target.exists(),  # its unchanged tiles are kept
                workers=workers,
                cluster=cluster,
                progress=progress,
            )
            write_json(stamp, made_of | {"scene": scene.manifest["digest"]})
        return target


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
        document = read_toml(path.read_text("utf-8-sig"))
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
        options, wanted = _parse(words, _drive_options)
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


def _parse(words: list[str], options_of: Callable[..., Any]) -> Any:
    """Options of words of a command line, as a function takes and returns them."""
    app = App(default_parameter=DEFAULTS, help_flags=(), version_flags=())
    app.default(options_of)
    return app(guard_numbers(words), result_action="return_value", exit_on_error=False, print_error=False)


def _drive_options(
    *, options: DriveOptions | None = None, wanted: AccuracyOptions = AccuracyOptions()
) -> tuple[DriveOptions, AccuracyOptions]:
    return options or DriveOptions(), wanted


def _build_options(*, options: BuildOptions = BuildOptions()) -> BuildOptions:
    return options


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


def _is_made_of(target: Path, stamp: Path, *, made_of: Mapping[str, Any]) -> bool:
    """Whether a scene is there, undamaged, of the files and options of a stamp."""
    with suppress(OSError, ValueError, LookupError, SceneFormatError):
        document, scene = json.loads(stamp.read_text("utf-8-sig")), open_scene(target)
        wanted = json.loads(json.dumps(made_of)) | {"scene": scene.manifest["digest"]}
        return bool(document == wanted) and not changed_files(scene)
    return False


def map_of_file(file: Path) -> MapScene:
    """A map that is named by its file, built with default options."""
    name = file.name.split(".")[0]
    return MapScene(name, (file,), options=BuildOptions(name=name))


def read_maps(path: Path, tables: Any) -> dict[str, MapScene]:
    """Maps by name, of the tables ``[[map]]`` of a sweep's file.

    Each has a ``name``, ``osm`` (a file or a list of files), ``bbox`` ([W, S, E, N] in degrees) and options
    of ``geoscene build``, named as its flags.

    Raises InputError, which names the map.
    """
    if not isinstance(tables, list) or not all(isinstance(table, dict) for table in tables):
        raise InputError(f"{path}: maps are tables, as in [[map]]")
    maps: dict[str, MapScene] = {}
    for number, table in enumerate(tables, 1):
        name = table.get("name", "")
        if not isinstance(name, str) or not re.fullmatch(r"\w[\w.=+-]*", name):
            raise InputError(f'{path}: map {number}: give it a name, such as name = "city"')
        if name in maps:
            raise InputError(f"{path}: two maps are named {name}; rename one of them")
        with naming(path, f"map {name}"):
            maps[name] = _map(name, {key: value for key, value in table.items() if key != "name"})
    return maps


def _map(name: str, table: dict[str, Any]) -> MapScene:
    osm, bounds = table.pop("osm", []), table.pop("bbox", None)
    files = [osm] if isinstance(osm, str) else osm
    if not isinstance(files, list) or not files or not all(isinstance(file, str) for file in files):
        instead = f" (there is {next(iter(table))})" if table and osm == [] else ""
        raise InputError(f'give it a map: osm = "city.osm.pbf"{instead}')
    if bounds is not None:
        if not isinstance(bounds, list) or [type(v) in (int, float) for v in bounds] != [True] * 4:
            raise InputError("bbox: give [W, S, E, N] in degrees")
        bounds = (float(bounds[0]), float(bounds[1]), float(bounds[2]), float(bounds[3]))
    words = [word for key, value in table.items() for word in words_of(key, value)]
    options: BuildOptions = _parse(words, _build_options)
    along = options.along if len(options.along) == 1 else ()  # several are waypoints
    dem = () if options.elevation_tiles else options.dem
    for file in (*files, *dem, *along):
        if not Path(file).is_file():
            raise InputError(f"{file}: no such file")
    if dem:
        options = replace(options, dem=tuple(str(Path(file).absolute()) for file in dem))
    options = replace(options, name=name)
    return MapScene(name, tuple(Path(file).absolute() for file in files), bounds, options)


@contextmanager
def naming(path: Path, what: str) -> Iterator[None]:
    """Raise errors of the block as InputErrors that name the file and what in it has the error."""
    try:
        yield
    except (CycloptsError, LidarError, GeosceneError, OSError) as error:
        raise InputError(f"{path}: {what}: {str(error).rstrip('.')}") from error


def text_of(value: Any) -> str:
    """A value of the grid as one text; a table with a name as ``NAME:KEY=VALUE,KEY=VALUE``."""
    if isinstance(value, dict):
        return item_text(item_of(value))
    return " ".join(map(text_of, value)) if isinstance(value, list) else value_text(value)


def words_of(key: str, value: Any) -> list[str]:
    """An option and its value as on the command line."""
    flag = f"--{key.replace('_', '-')}"
    if isinstance(value, bool) and key != "traffic":
        return [flag] * value
    if not isinstance(value, list):
        return [flag, text_of(value)] if value != "" else []
    if key in _REPEATED:
        return [word for item in value for word in (flag, text_of(item))]
    if key in _JOINED:
        return [flag, ",".join(map(str, value))] if value else []
    return [flag, *map(str, value)]
