"""Registry of export formats, the function that exports a scene, and the summary that all return."""

from __future__ import annotations

import json
from contextlib import nullcontext
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from geoscene.errors import InputError
from geoscene.options import ExportOptions
from geoscene.scene import Scene, SceneLike, open_scene
from geoscene.support.files import exclusive
from geoscene.support.progress import Progress, displayed, shows_progress
from geoscene.support.registry import Registry, load


@dataclass(frozen=True, slots=True)
class ExportFormat:
    """A row of the registry.

    title    : name for messages
    writer   : ``module:function`` within this package
    suffixes : of file names, the usual one first; none for a folder
    options  : fields of `ExportOptions` that it uses
    beside   : suffix of a second file that is written beside the first
    roofs    : ``guess`` or ``flat``: guessed roofs, if the options do not choose
    """

    title: str
    writer: str
    suffixes: tuple[str, ...]
    options: frozenset[str]
    beside: str = ""
    roofs: str = "guess"


def _kind(
    title: str, writer: str, *, suffixes: str, options: str = "", beside: str = "", roofs: str = "guess"
) -> ExportFormat:
    return ExportFormat(title, writer, tuple(suffixes.split()), frozenset(options.split()), beside, roofs)


KINDS: Registry[ExportFormat] = Registry(
    "`kind`",
    {
        "cityjson": _kind(
            "CityJSON 2.0",
            "cityjson:write_cityjson",
            suffixes=".city.json .cityjson",
            options="crs layers relief roofs",
            roofs="flat",
        ),
        "glb": _kind("binary glTF 2.0", "glb:write_glb", suffixes=".glb", options="layers relief roofs"),
        "3dtiles": _kind(
            "3D Tiles 1.1", "tiles3d:write_3dtiles", suffixes="", options="layers height_offset relief roofs"
        ),
        "obj": _kind(
            "Wavefront OBJ and MTL",
            "triangles:write_obj",
            suffixes=".obj",
            options="layers relief roofs size_limit",
            beside=".mtl",
        ),
        "ply": _kind("PLY", "triangles:write_ply", suffixes=".ply", options="layers relief roofs"),
        "stl": _kind(
            "STL, solids only", "triangles:write_stl", suffixes=".stl", options="layers relief roofs"
        ),
        "gpkg": _kind(
            "GeoPackage", "vector:write_gpkg", suffixes=".gpkg", options="crs layers roofs", roofs="flat"
        ),
        "geojson": _kind(
            "GeoJSON", "vector:write_geojson", suffixes=".geojson", options="layers roofs", roofs="flat"
        ),
        "geoparquet": _kind(
            "GeoParquet",
            "vector:write_geoparquet",
            suffixes=".parquet .geoparquet",
            options="crs layers roofs",
            roofs="flat",
        ),
        "geotiff": _kind(
            "GeoTIFF",
            "raster:write_geotiff",
            suffixes=".tif .tiff",
            options="layers model resolution roofs",
            roofs="flat",
        ),
        "opendrive": _kind("OpenDRIVE 1.7", "opendrive:write_opendrive", suffixes=".xodr"),
        "sumo": _kind("SUMO network", "opendrive:write_sumo", suffixes=".net.xml"),
    },
    error=InputError,
)
"""All formats by name."""


def kind_of(out: Path) -> str:
    """Name of the format of a file name's suffix; raises InputError for an unknown suffix."""
    file_name = out.name.lower()
    for name, kind in KINDS.items():
        if kind.suffixes and file_name.endswith(kind.suffixes):
            return name
    known = " ".join(kind.suffixes[0] for kind in KINDS.values() if kind.suffixes)
    raise InputError(f"{out}: unknown suffix; give `kind` ({', '.join(KINDS)}) or {known}")


@shows_progress
def export_scene(
    scene: SceneLike,
    out: str | Path,
    *,
    options: ExportOptions = ExportOptions(),
    overwrite: bool = False,
    progress: Progress = displayed,
) -> Summary:
    """Write a scene to a file, or to a folder for 3D Tiles, and return a summary.

    Raises InputError for an unknown kind, a suffix of another kind, an option that the kind does not take,
    layers without contents, and if a file exists and may not be overwritten; MissingExtraError where an
    optional package is needed.
    """
    scene = open_scene(scene)
    out = Path(out)
    name = kind_of(out) if options.kind is None else options.kind
    kind = KINDS.find(name)
    others = [suffix for other in KINDS.values() for suffix in other.suffixes if suffix not in kind.suffixes]
    if out.name.lower().endswith(tuple(others)):
        known = " or ".join(kind.suffixes) or "a folder"
        raise InputError(f"{out}: the suffix is of another format than `kind` {name}, which is {known}")
    given = {key: value for key, value in asdict(options).items() if key != "kind" and value is not None}
    foreign = sorted(set(given) - kind.options)
    if foreign:
        names = ", ".join(f"`{key}`" for key in foreign)
        takes = ", ".join(f"`{key}`" for key in sorted(kind.options)) or "none"
        raise InputError(f"{names} does not go with {kind.title}, which takes {takes}")
    modelled = bool(given.pop("relief", None))
    if modelled:
        scene = scene.with_relief_mesh()
    leveled = (given.pop("roofs", None) or kind.roofs) == "flat"
    if leveled:
        scene = scene.with_level_roofs()
    for path in (out, out.with_suffix(kind.beside)) if kind.beside else (out,):
        if path.exists() and not overwrite:
            raise InputError(f"{path}: exists; set `overwrite` to replace it")
    if out.is_dir() and kind.suffixes:
        raise InputError(f"{out}: is a folder; {kind.title} needs a file name")
    if scene.has_tiles:
        scene.require("tables")
    write = load(f"geoscene.export.{kind.writer}")
    with exclusive(out) if kind.suffixes else nullcontext():  # writers of folders see to that
        summary: Summary = write(scene, out, **given, progress=progress)
    notes = [_relief_note(scene)] if modelled else []
    if leveled and (count := scene.count_guessed_roofs()):
        notes.append(f"{count} roofs that the build guessed are flat here; `roofs` guess keeps them")
    return replace(summary, notes=(*summary.notes, *notes))


def _relief_note(scene: Scene) -> str:
    """Number of walls with openings as geometry, and why others have none."""
    counts = scene.manifest.get("relief", {}).get("facades", {})
    causes = {
        "small": "are too small for openings",
        "blank": "are blank (their type has no openings, or none fits)",
        "touching": "have an outline that touches itself",
    }
    planes = [f"{counts.get(f'walls_{why}', 0)} {text}" for why, text in causes.items()]
    return (
        f"openings of {counts.get('walls', 0)} walls are geometry; planes are walls that {', '.join(planes)}"
    )


@dataclass(frozen=True, slots=True)
class Summary:
    """Summary of an export.

    path    : the file, or the folder
    kind    : name of the format
    files   : number of files
    bytes   : of all files together
    objects : objects, features, roads or pixels, whichever the format counts in
    solids  : closed solids among them
    faces   : triangles
    crs     : name of the coordinate reference system of the coordinates in it
    notes   : what a user must know of it, one line each
    """

    path: Path
    kind: str
    files: int
    bytes: int
    objects: int
    solids: int = 0
    faces: int = 0
    crs: str = ""
    notes: tuple[str, ...] = ()

    @classmethod
    def of(cls, path: Path, kind: str, **fields: Any) -> Summary:
        """Summary of an export to a path, with the number and size of its files."""
        return cls(path, kind, *size_of(path), **fields)


def size_of(path: Path) -> tuple[int, int]:
    """Number of files and of bytes at a path."""
    files = [path] if path.is_file() else [p for p in path.rglob("*") if p.is_file()]
    return len(files), sum(p.stat().st_size for p in files)


def plain(value: Any) -> Any:
    """A value of a column as JSON has it; None for NaN, infinity and empty text."""
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or value == "" or (isinstance(value, float) and not np.isfinite(value)):
        return None
    return value


def compact_json(value: Any) -> bytes:
    """A value as JSON without spaces."""
    return json.dumps(value, ensure_ascii=False, separators=(",", ":"), allow_nan=False).encode()
