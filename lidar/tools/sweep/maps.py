"""Maps of a sweep: each is built once into a scene that its drives share."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from cyclopts import App

from geoscene.errors import SceneFormatError
from geoscene.options import BuildOptions, Degrees
from geoscene.pipeline.build import build
from geoscene.scene import open_scene
from geoscene.scene.layout import changed_files
from geoscene.sources import read_osm, with_elevation
from geoscene.support.cluster import DaskCluster
from geoscene.support.console import DEFAULTS, guard_numbers
from geoscene.support.digests import file_digest, sources_digest
from geoscene.support.files import write_json
from geoscene.support.progress import Progress, silent
from geoscene.support.storage import cache_folder
from lidar.errors import InputError
from lidar.tools.sweep.words import naming, words_of


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


def _is_made_of(target: Path, stamp: Path, *, made_of: Mapping[str, Any]) -> bool:
    """Whether a scene is there, undamaged, of the files and options of a stamp."""
    with suppress(OSError, ValueError, LookupError, SceneFormatError):
        document, scene = json.loads(stamp.read_text("utf-8")), open_scene(target)
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
    options = _parse(words)
    along = options.along if len(options.along) == 1 else ()  # several are waypoints
    dem = () if options.elevation_tiles else options.dem
    for file in (*files, *dem, *along):
        if not Path(file).is_file():
            raise InputError(f"{file}: no such file")
    if dem:
        options = replace(options, dem=tuple(str(Path(file).absolute()) for file in dem))
    options = replace(options, name=name)
    return MapScene(name, tuple(Path(file).absolute() for file in files), bounds, options)


def _parse(words: list[str]) -> BuildOptions:
    """Options of a build from words of a command line."""
    app = App(default_parameter=DEFAULTS, help_flags=(), version_flags=())

    @app.default
    def options_of(*, options: BuildOptions = BuildOptions()) -> BuildOptions:
        return options

    parsed: BuildOptions = app(
        guard_numbers(words), result_action="return_value", exit_on_error=False, print_error=False
    )
    return parsed
