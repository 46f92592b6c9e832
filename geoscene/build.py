"""The pipeline: from a map extract to a scene directory."""

from __future__ import annotations

import hashlib
import itertools
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal, cast

import numpy as np
import shapely

from geoscene import __version__
from geoscene.errors import InputError, SourceNotFoundError
from geoscene.manifest import scene_manifest
from geoscene.objects.shapes import shapes
from geoscene.plan import KINDS, Plan, make_plan
from geoscene.progress import Progress, silent
from geoscene.report import Problem
from geoscene.roadgraph.reach import route_line
from geoscene.scene import Scene, open_scene
from geoscene.scene.writer import SceneWriter
from geoscene.sources import OsmData
from geoscene.tiles import Keys, TileReport, build_tiles, tiles_document

_BESIDE = 15.0
"""Metres from a road's middle to its outermost lane and to a sensor there, at most."""

_CROWN, _ARM = 5.0, 10.0
"""Metres by which the crown of a forest's tree and the arm of a lamp or a signal reach beyond their feet."""


@dataclass(frozen=True, slots=True)
class BuildOptions:
    """How a scene is built.

    crs       : ``local``, ``utm`` or a CRS that pyproj knows
    lod       : of buildings: 0 blocks, 1 parts with flat roofs, 2 roofs
    dem       : elevation files; level ground without
    dem_gaps  : what to do where they do not cover the scene: ``error``, or ``nearest`` height and say so
    only      : what is built besides the ground, of `geoscene.plan.KINDS`; all by default
    along     : waypoints (LAT,LON words) or one file (GPX, GeoJSON, or CSV with lon and lat): only tiles are
                built that a sensor of that reach can see from there
    reach     : metres, with ``along``
    driving_side : ``left`` or ``right``; by default the map's ``driving_side`` tags, else the country's
    tile_size : metres, side of a tile
    name      : of the scene, for people
    """

    crs: str = "local"
    lod: int = 2
    dem: tuple[str, ...] = ()
    dem_gaps: str = "error"
    only: tuple[str, ...] = KINDS
    along: tuple[str, ...] = ()
    reach: float = 120.0
    driving_side: str = ""
    tile_size: float = 250.0
    name: str = ""

    def __post_init__(self) -> None:
        """Refuse options that cannot be meant."""
        if self.lod not in (0, 1, 2):
            raise InputError(f"`lod` {self.lod}: 0 (blocks), 1 (parts, flat roofs) or 2 (roofs)")
        if self.dem_gaps not in ("error", "nearest"):
            raise InputError(f"`dem_gaps` {self.dem_gaps}: error or nearest")
        if unknown := sorted(set(self.only) - set(KINDS)):
            raise InputError(f"`only` {','.join(unknown)}: of {','.join(KINDS)}")
        if self.driving_side not in ("", "left", "right"):
            raise InputError(f"`driving_side` {self.driving_side}: left or right")
        if not 0 < self.reach < 1e6:
            raise InputError(f"`reach` {self.reach:g}: give metres, more than 0 and less than a million")
        if not 50 <= self.tile_size <= 2000 or self.tile_size != int(self.tile_size):
            raise InputError(f"`tile_size` {self.tile_size}: give whole metres from 50 to 2000")


def build(
    osm: OsmData,
    out: Path,
    *,
    options: BuildOptions | None = None,
    overwrite: bool = False,
    workers: int = 1,
    progress: Progress = silent,
) -> Scene:
    """Build a scene of a map extract and write it to a directory.

    A build that was killed goes on where it stopped; one that replaces a scene takes over what its options
    leave the same. The bytes do not depend on ``workers``, nor on what was there before.

    Raises SourceNotFoundError for an extract without anything to build, FrameError for a CRS that cannot
    serve and SceneFormatError for a directory that may not be used.
    """
    options = options or BuildOptions()
    if not (osm.areas or osm.ways):
        raise SourceNotFoundError(f"{osm.source or 'the extract'}: nothing in it to build from")
    with SceneWriter(out, overwrite=overwrite) as writer:
        plan, problems = make_plan(
            osm,
            options.crs,
            dem=options.dem,
            dem_gaps=cast("Literal['error', 'nearest']", options.dem_gaps),
            tile_size=options.tile_size,
            only=options.only,
            driving_side=options.driving_side,
            progress=progress,
        )
        keys = _keys(osm, options)
        tiles = _tiles_along(plan, options)
        reports: list[TileReport] = []
        for report in build_tiles(
            plan,
            writer.folder,
            tiles=tiles,
            lod=options.lod,
            keys=keys,
            workers=workers,
            former=writer.former,
        ):
            reports.append(report)
            progress("tiles", len(reports), total=len(tiles))
        problems += _tile_problems(reports)
        writer.finish(
            frame=plan.frame,
            layers=plan.layers,
            graph=plan.graph,
            shapes=shapes(),
            problems=problems,
            tiles=tiles_document(keys, reports),
            manifest=scene_manifest(
                osm, asdict(options), plan=plan, reports=reports, problems=problems, fingerprint=_digest(keys)
            ),
        )
    return open_scene(out)


def _tile_problems(reports: Sequence[TileReport]) -> list[Problem]:
    return [problem for report in sorted(reports, key=lambda r: (r.i, r.j)) for problem in report.problems]


def _tiles_along(plan: Plan, options: BuildOptions) -> list[tuple[int, int]]:
    """Tiles to build: all, or those of which anything lies within reach of the route."""
    tiles = plan.tiles()
    if not options.along:
        return tiles
    line = route_line(options.along, plan.graph, frame=plan.frame)
    shapely.prepare(line)
    reach = options.reach + _BESIDE
    size = options.tile_size
    squares = shapely.box(*(np.array(tiles) * size).T, *((np.array(tiles) + 1) * size).T)
    seen = set(itertools.compress(tiles, shapely.dwithin(line, squares, reach + _CROWN)))
    # What stands in a tile may stick out of it, a long wall or bridge by far.
    buildings = shapely.dwithin(line, plan.buildings.footprint, reach)
    near = {
        "buildings": buildings,
        "parts": buildings,
        "trees": shapely.dwithin(line, shapely.points(plan.trees.xy), reach + plan.trees.crown / 2),
        "furniture": shapely.dwithin(line, shapely.points(plan.furniture.xy), reach + _ARM),
        "barriers": shapely.dwithin(line, plan.barriers.polygon, reach),
        "structures": shapely.dwithin(line, plan.structures.polygon, reach),
    }
    for kind, by_tile in plan.rows.items():
        seen |= {tile for tile, rows in by_tile.items() if near[kind][rows].any()}
    return sorted(seen)


def _keys(osm: OsmData, options: BuildOptions) -> Keys:
    """Digests of what ground and solids of a tile depend on."""
    dem = [(str(p), Path(p).stat().st_size, Path(p).stat().st_mtime_ns) for p in options.dem]
    common = [
        __version__,
        osm.source,
        osm.digest,
        list(osm.bounds),
        options.crs,
        dem,
        options.dem_gaps,
        sorted(options.only),
        options.tile_size,
    ]
    return Keys(ground=_digest(common), solids=_digest([*common, options.lod]))


def _digest(value: object) -> str:
    plain = asdict(value) if isinstance(value, Keys) else value
    return hashlib.sha256(json.dumps(plain).encode()).hexdigest()[:20]
