"""Builds with other settings, and their errors and costs against the full scene."""

from __future__ import annotations

import multiprocessing
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.classes import Class
from geoscene.errors import InputError
from geoscene.export.objects import expand, parts
from geoscene.export.raster import RasterGrid, draw, grid_of
from geoscene.geometry.mesh import concatenate
from geoscene.geometry.watertight import volumes
from geoscene.options import KINDS, BuildOptions
from geoscene.scene import Scene, open_scene
from geoscene.sources import OsmData
from geoscene.support.processes import peak_memory
from geoscene.support.progress import Progress, silent
from geoscene.support.registry import unknown_name
from geoscene.uses import RELIEFS, USES

SETTINGS = ("lod", "relief", "only", "terrain", "for")
"""Names of the settings that are compared."""

FULL = "full scene"
"""Label of the reference."""

_KINDS = {
    "only=buildings": ("buildings",),
    "only=buildings,roads": ("buildings", "roads"),
    "without trees": tuple(kind for kind in KINDS if kind != "trees"),
    "without furniture, barriers": tuple(kind for kind in KINDS if kind not in ("furniture", "barriers")),
    "without landcover": tuple(kind for kind in KINDS if kind != "landcover"),
}
_COARSER = (2, 4, 8)
"""Posts of the elevation model along each side of which one is made."""
MOST_CELLS = 16_000_000
"""Cells of the surface models that are compared; larger scenes have larger cells."""

_SAME = 1e-3
"""Metres of difference in height that do not count as different: the grid of solids."""

_OBJECTS = {
    "solids": "solids of buildings",
    "trees": "mapped trees",
    "forest_trees": "trees of forests",
    "furniture": "furniture",
    "barriers": "barriers",
    "bridge_pieces": "pieces of bridges",
    "tunnel_pieces": "pieces of tunnels",
    "road_edges": "edges of the road graph",
}
"""Counts of `scene.json` that are compared, in words."""


@dataclass(frozen=True, slots=True)
class BuildVariant:
    """A build with a setting changed.

    coarser : posts of the elevation files along each side of which one is made; 1 for the files as they are
    """

    label: str
    options: BuildOptions
    coarser: int = 1


def full(options: BuildOptions) -> BuildVariant:
    """The reference: everything, at the highest level of detail, with the relief of the options."""
    return BuildVariant(FULL, replace(options, lod=2, only=KINDS, use="all"))


def variants(options: BuildOptions, settings: Sequence[str]) -> list[BuildVariant]:
    """Builds to compare with the full scene, one setting changed in each, and a combination of cheap ones.

    Raises InputError for unknown settings, ``terrain`` without elevation files, and options that are
    compared.
    """
    if unknown := sorted(set(settings) - set(SETTINGS)):
        raise InputError(unknown_name("`settings`", unknown[0], known=SETTINGS))
    if "terrain" in settings and not options.dem:
        raise InputError("`settings` terrain: needs `dem`")
    if options.lod != 2 or set(options.only) != set(KINDS) or options.use != "all":
        raise InputError("`lod`, `only` and `use` are compared, all values of them; leave them out")
    chosen, base = settings or SETTINGS, full(options).options
    found: list[BuildVariant] = []
    if "lod" in chosen:
        found += [BuildVariant(f"lod={lod}", replace(base, lod=lod)) for lod in (1, 0)]
    if "relief" in chosen:
        others = (relief for relief in RELIEFS if relief != base.relief)
        found += [BuildVariant(f"relief={relief}", replace(base, relief=relief)) for relief in others]
    if "only" in chosen:
        found += [BuildVariant(label, replace(base, only=kinds)) for label, kinds in _KINDS.items()]
    if "terrain" in chosen and base.dem:
        found += [BuildVariant(f"terrain={n} x {n} posts", base, coarser=n) for n in _COARSER]
        found.append(BuildVariant("terrain=level", replace(base, dem=(), dem_tolerance=None)))
    if "for" in chosen:
        found += [BuildVariant(f"for={use}", replace(base, use=use)) for use in USES if use != "all"]
    if {"lod", "only"} <= set(chosen):
        cheap = replace(base, lod=0, only=("buildings",))
        found.append(BuildVariant("lod=0 only=buildings", cheap))
    return found


def coarse_elevation(path: Path, out: Path, *, factor: int) -> Path:
    """An elevation file of which each post is the mean of ``factor`` by ``factor`` posts of another."""
    import rasterio  # noqa: PLC0415 - slow to import
    from rasterio.enums import Resampling  # noqa: PLC0415

    from geoscene.ground.terrain import driver_of, gdal_name  # noqa: PLC0415

    name = gdal_name(path)
    with rasterio.open(name, driver=driver_of(name)) as source:
        rows, columns = (max(side // factor, 2) for side in source.shape)
        values = source.read(1, out_shape=(rows, columns), resampling=Resampling.average, masked=True)
        a, across, down = source.transform, source.width / columns, source.height / rows
        profile = {
            **{name: source.profile[name] for name in ("dtype", "crs", "nodata")},
            "driver": "GTiff",
            "count": 1,
            "width": columns,
            "height": rows,
            "transform": rasterio.Affine(a.a * across, a.b * down, a.c, a.d * across, a.e * down, a.f),
        }
        with rasterio.open(out, "w", **profile) as target:
            target.write(values.filled(source.nodata if source.nodata is not None else 0), 1)
            target.units, target.scales, target.offsets = source.units, source.scales, source.offsets
            tags = source.tags()
            tags.pop("AREA_OR_POINT", None)  # the transform is that of areas
            target.update_tags(**tags)
    return out


@dataclass(frozen=True, slots=True)
class BuildCost:
    """Cost of a build in a process of its own, with imports and reading the map; bytes of the scene."""

    cpu_s: float
    memory_bytes: int
    bytes: int


@dataclass(frozen=True, slots=True)
class BuildRow:
    """Measured error and cost of a build.

    costs   : of each repetition
    error   : of the surface model in metres (``height_rms_m``, ``height_99_m``, ``height_max_m``), the shares
              of its cells with another height (``cells``) and of another class (``classes``), relative
              errors of the buildings' volume (``volume``) and footprint area (``area``); empty without meshes
    missing : number of objects that the full scene has besides, by kind in words
    note    : what figures do not say
    """

    label: str
    costs: tuple[BuildCost, ...]
    error: dict[str, float]
    missing: dict[str, int]
    note: str = ""

    @property
    def cost(self) -> BuildCost:
        """The median of the repetitions."""
        columns = ([getattr(c, name) for c in self.costs] for name in ("cpu_s", "memory_bytes", "bytes"))
        cpu, memory, size = (float(np.median(column)) for column in columns)
        return BuildCost(cpu, int(memory), int(size))


@dataclass(frozen=True, slots=True)
class BuildTradeoff:
    """Rows of a place; the first is the full scene. ``resolution`` is that of the surface models, metres."""

    name: str
    resolution: float
    rows: tuple[BuildRow, ...]


def tradeoff(
    read: Callable[[], OsmData],
    options: BuildOptions,
    *,
    settings: Sequence[str] = (),
    resolution: float = 1.0,
    repetitions: int = 1,
    progress: Progress = silent,
) -> BuildTradeoff:
    """Errors and costs of builds of a map, each setting changed alone.

    read       : reads the map; called in the process of each build, so it must be picklable
    settings   : names of `geoscene.tradeoff.engine.SETTINGS`; all by default
    resolution : metres of the cells of the surface models, at least; larger for places of many cells

    Raises the errors of a build.
    """
    chosen = variants(options, settings)
    builds = [full(options), *chosen]
    with tempfile.TemporaryDirectory(prefix="geoscene-tradeoff-") as name:
        folder = Path(name)
        costs: list[list[BuildCost]] = [[] for _ in builds]
        for turn in range(repetitions):  # in turn, so that a busy machine troubles all alike
            for k, variant in enumerate(builds):
                progress("builds", turn * len(builds) + k, total=repetitions * len(builds))
                costs[k].append(_measure(read, variant, folder=folder / str(k)))
        scene = open_scene(folder / "0" / "scene")
        xmin, ymin, xmax, ymax = scene.bounds
        cell = max(resolution, float(np.sqrt((xmax - xmin) * (ymax - ymin) / MOST_CELLS)))
        grid = grid_of(scene, cell)
        exact = _Measures.of(scene, grid)
        rows = [BuildRow(builds[0].label, tuple(costs[0]), _errors(exact, exact), {})]
        for k, variant in enumerate(chosen, start=1):
            progress("comparisons", k - 1, total=len(chosen))
            other = open_scene(folder / str(k) / "scene")
            rows.append(_row(variant, tuple(costs[k]), scene=other, exact=exact, grid=grid))
    return BuildTradeoff(scene.manifest["name"] or scene.manifest["sources"][0]["from"], cell, tuple(rows))


def _measure(read: Callable[[], OsmData], variant: BuildVariant, *, folder: Path) -> BuildCost:
    """The cost of a build into a folder, made in a process of its own."""
    folder.mkdir(exist_ok=True)
    options = variant.options
    if variant.coarser > 1:
        files = [
            coarse_elevation(Path(path), folder / f"{n}.tif", factor=variant.coarser)
            for n, path in enumerate(options.dem)
        ]
        options = replace(options, dem=tuple(map(str, files)), dem_gaps="nearest")
    method = "forkserver" if "forkserver" in multiprocessing.get_all_start_methods() else "spawn"
    context = multiprocessing.get_context(method)
    with ProcessPoolExecutor(1, mp_context=context, max_tasks_per_child=1) as pool:
        return pool.submit(_build, read, options=options, out=folder / "scene").result()


def _build(read: Callable[[], OsmData], *, options: BuildOptions, out: Path) -> BuildCost:
    """Build a scene in this process and return its cost."""
    from geoscene.pipeline.build import build  # noqa: PLC0415 - part of the cost

    build(read(), out, options=options, overwrite=out.exists())
    size = sum(path.stat().st_size for path in out.rglob("*") if path.is_file())
    return BuildCost(time.process_time(), peak_memory(), size)


@dataclass(frozen=True, slots=True)
class _Measures:
    """Quantities of a scene that are compared.

    height : (rows, columns) of the highest face over each cell; NaN without one
    klass  : (rows, columns) class of that face
    volume : cubic metres of the solids of buildings
    area   : square metres of the footprints of buildings
    counts : of objects, by the names of `_OBJECTS`
    """

    height: NDArray[np.float32]
    klass: NDArray[np.uint8]
    volume: float
    area: float
    counts: dict[str, int]

    @classmethod
    def of(cls, scene: Scene, grid: RasterGrid) -> _Measures:
        counts = {name: int(scene.manifest["counts"][name]) for name in _OBJECTS}
        area = 0.0
        if scene.table_length("buildings"):
            area = float(shapely.area(scene.features("buildings").geometry).sum())
        height, klass = surface_model(scene, grid)
        return cls(height, klass, building_volume(scene), area, counts)


def surface_model(scene: Scene, grid: RasterGrid) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Height and class (rows, columns) of the highest face over cells' middles; NaN and 0 without one."""
    height = np.full((grid.rows, grid.columns), np.nan, np.float32)
    labels = np.zeros(height.shape, np.uint8)
    library = list(scene.shapes().values())
    for part in parts(scene, None, stage="surface", progress=silent):
        mesh = concatenate([part.mesh, expand(part.instances, library)])
        draw(mesh, part.origin, scene=scene, grid=grid, height=height, labels=labels)
    return height, labels


def building_volume(scene: Scene) -> float:
    """True cubic metres of the solids of buildings."""
    total = 0.0
    for tile in scene.tiles(forests=False):
        mesh = tile.mesh
        corners = mesh.vertices[mesh.faces[mesh.closed & (mesh.klass == Class.BUILDING)]]
        scale = float(scene.frame.scale_at(*(tile.origin[:2] + scene.tile_size / 2).tolist()))
        total += float(volumes(corners, owner=np.zeros(len(corners), np.int64), n=1)[0]) / scale**2
    return total


def _row(
    variant: BuildVariant, costs: tuple[BuildCost, ...], *, scene: Scene, exact: _Measures, grid: RasterGrid
) -> BuildRow:
    counts = scene.manifest["counts"]
    lost = {_OBJECTS[name]: n - int(counts[name]) for name, n in exact.counts.items() if n > counts[name]}
    if not scene.has_tiles:
        return BuildRow(variant.label, costs, {}, lost, "no meshes")
    error = _errors(_Measures.of(scene, grid), exact)
    note = "" if any(error.values()) or lost else "no error here"
    if variant.options.use != "all":
        lacks = [name for name in ("features", "attributes") if scene.manifest["left_out"].get(name)]
        note = "; ".join(filter(None, (note, f"no {', '.join(lacks)}")))
    return BuildRow(variant.label, costs, error, lost, note)


def _errors(found: _Measures, exact: _Measures) -> dict[str, Any]:
    """The errors of `BuildRow`."""
    known = np.isfinite(exact.height) & np.isfinite(found.height)
    off = np.abs(found.height[known].astype(float) - exact.height[known])
    off = np.where(off > _SAME, off, 0.0) if len(off) else np.zeros(1)
    return {
        "height_rms_m": float(np.sqrt((off**2).mean())),
        "height_99_m": float(np.percentile(off, 99)),
        "height_max_m": float(off.max()),
        "cells": float((off > 0).mean()),
        "classes": float((found.klass != exact.klass).mean()),
        "volume": _relative(found.volume, exact.volume),
        "area": _relative(found.area, exact.area),
    }


def _relative(found: float, exact: float) -> float:
    return (found - exact) / exact if exact else 0.0
