"""The pipeline: from a map extract to a scene directory."""

from __future__ import annotations

import glob
from collections.abc import Sequence
from dataclasses import asdict, fields
from pathlib import Path

from geoscene.errors import SourceNotFoundError
from geoscene.objects.shapes import shapes
from geoscene.options import BuildOptions
from geoscene.pipeline.manifest import scene_manifest
from geoscene.pipeline.plan import make_plan
from geoscene.pipeline.reach import AreaOf
from geoscene.pipeline.tiles import Keys, TileReport, build_tiles, tiles_document
from geoscene.scene import Scene, open_scene
from geoscene.scene.layout import SCHEMA
from geoscene.scene.writer import SceneWriter
from geoscene.sources import OsmData
from geoscene.support.cluster import DaskCluster
from geoscene.support.digests import file_digest, sources_digest, value_digest
from geoscene.support.problems import Problem
from geoscene.support.progress import Progress, silent
from geoscene.uses import USES

_NOT_IN_TILES = frozenset({"name", "along", "reach", "use"})
"""Options on which no tile depends; some select the tiles to build."""

_NOT_IN_GROUND = frozenset({"lod"})
"""Options on which only the solids of buildings depend."""


def build(
    osm: OsmData,
    out: str | Path,
    *,
    options: BuildOptions = BuildOptions(),
    overwrite: bool = False,
    workers: int = 1,
    cluster: DaskCluster | None = None,
    needed: AreaOf | None = None,
    former: Path | None = None,
    progress: Progress = silent,
) -> Scene:
    """Build a scene of a map extract and write it to a directory.

    An interrupted build resumes when repeated. A build that overwrites a scene reuses its unchanged tiles.
    The bytes depend neither on ``workers`` or ``cluster`` nor on earlier builds.

    workers : processes that build tiles
    cluster : whose workers build the tiles instead, see `geoscene.support.cluster.connect`

    needed : chooses the area to build, once the roads and buildings of the map are known
    former : another scene whose unchanged tiles are reused

    Raises SourceNotFoundError for an empty extract, FrameError for an unsuitable CRS and SceneFormatError for
    a directory that must not be overwritten.
    """
    if not (osm.areas or osm.ways):
        raise SourceNotFoundError(f"{osm.source or 'the extract'}: has no features to build a scene from")
    with SceneWriter(Path(out), overwrite=overwrite) as writer:
        if cluster is not None:
            cluster.check(writer.folder)
        plan, problems = make_plan(osm, options, progress=progress, needed=needed)
        digest = osm.digest
        keys = _keys(osm, options, digest=digest)
        tiles = plan.chosen if plan.use.tiles else []
        reports: list[TileReport] = []
        for report in build_tiles(
            plan,
            writer.folder,
            tiles=tiles,
            lod=options.lod,
            keys=keys,
            workers=workers,
            former=former or writer.former,
            cluster=cluster,
        ):
            reports.append(report)
            progress("tiles", len(reports), total=len(tiles))
        problems += _tile_problems(reports)
        writer.finish(
            frame=plan.frame,
            layers=plan.layers,
            ranges=plan.ranges,
            graph=plan.graph,
            kept=plan.kept,
            shapes=shapes(with_relief=plan.relief != "off") if plan.use.tiles else {},
            use=plan.use,
            problems=problems,
            tiles=tiles_document(keys, reports),
            manifest=scene_manifest(
                osm,
                asdict(options),
                digest=digest,
                plan=plan,
                reports=reports,
                problems=problems,
                fingerprint=value_digest(asdict(keys)),
            ),
        )
    return open_scene(out)


def _tile_problems(reports: Sequence[TileReport]) -> list[Problem]:
    return [problem for report in sorted(reports, key=lambda r: (r.i, r.j)) for problem in report.problems]


def _keys(osm: OsmData, options: BuildOptions, *, digest: str) -> Keys:
    """Digests of all inputs of the ground and of the solids of tiles: program, format, map and options.

    digest : of the map
    """
    chosen = {f.name: getattr(options, f.name) for f in fields(options) if f.name not in _NOT_IN_TILES}
    common = {
        "program": sources_digest("geoscene"),
        "schema": SCHEMA,
        "map": digest,
        "bounds": osm.bounds,
        **{name: value for name, value in chosen.items() if name not in _NOT_IN_GROUND},
        "dem": elevation_digests(options.dem),
        "only": sorted(options.only),
        "colors": USES[options.use].colors,
    }
    rest = {name: chosen[name] for name in _NOT_IN_GROUND}
    return Keys(ground=value_digest(common), solids=value_digest(common | rest))


def elevation_digests(dem: Sequence[str]) -> list[str]:
    """Digests of the contents of elevation files and of the files beside them."""
    return [file_digest(path) for name in dem for path in _with_companions(Path(name))]


def _with_companions(path: Path) -> list[Path]:
    """A raster, and the files beside it from which GDAL may read its georeference."""
    return [path, *sorted(set(path.parent.glob(f"{glob.escape(path.stem)}.*")) - {path})]
