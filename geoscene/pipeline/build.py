"""The pipeline: from a map extract to a scene directory, and the contents of its scene.json."""

from __future__ import annotations

import glob
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from geoscene import __version__
from geoscene.errors import InputError, SourceNotFoundError
from geoscene.geometry.frames import wrap_longitude
from geoscene.ground import tile_span
from geoscene.ground.kerbs import count_covers, count_kerbs
from geoscene.objects.shapes import leaf_area_density, shapes
from geoscene.options import BuildOptions
from geoscene.pipeline.features import with_built_shapes
from geoscene.pipeline.limits import height_limit, places, scale_limit
from geoscene.pipeline.plan import BuildPlan, make_plan
from geoscene.pipeline.reach import AreaOf
from geoscene.pipeline.tiles import Keys, TileReport, build_tiles, tiles_document
from geoscene.roadgraph import find_components
from geoscene.roadgraph.graph import RoadGraph
from geoscene.scene import Scene, open_scene
from geoscene.scene.layout import SCHEMA
from geoscene.scene.writer import SceneWriter
from geoscene.sources import SOURCES, OsmData, credits_of, read_osm
from geoscene.support.cluster import DaskCluster
from geoscene.support.digests import file_digest, sources_digest, value_digest
from geoscene.support.option_values import expect
from geoscene.support.problems import Problem, summarise
from geoscene.support.progress import Progress, displayed, shows_progress
from geoscene.uses import USES

_NOT_IN_TILES = frozenset({"name", "along", "reach", "use"})
"""Options on which no tile depends; some select the tiles to build."""

_NOT_IN_GROUND = frozenset({"lod", "roofs"})
"""Options on which only the solids of buildings depend."""

STEEP = 0.2
"""Gradient above which roads are counted as steep; few streets exceed it."""


@shows_progress
def build(
    osm: OsmData | str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    out: str | Path,
    *,
    options: BuildOptions = BuildOptions(),
    overwrite: bool = False,
    workers: int = 1,
    cluster: DaskCluster | None = None,
    needed: AreaOf | None = None,
    former: Path | None = None,
    progress: Progress = displayed,
) -> Scene:
    """Build a scene of a map extract and write it to a directory.

    An interrupted build resumes when repeated. A build that overwrites a scene reuses its unchanged tiles.
    The bytes depend neither on ``workers`` or ``cluster`` nor on earlier builds.

    osm     : a map that was read, or files of one, as for `read_osm`
    workers : processes that build tiles
    cluster : whose workers build the tiles instead, see `geoscene.support.cluster.connect`

    needed : chooses the area to build, once the roads and buildings of the map are known
    former : another scene whose unchanged tiles are reused

    Raises SourceNotFoundError for an empty extract, FrameError for an unsuitable CRS and SceneFormatError for
    a directory that must not be overwritten.
    """
    expect(options, BuildOptions, name="options", error=InputError)
    if not isinstance(osm, OsmData):
        progress("reading the map", 0, total=0)
        osm = read_osm(osm)
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
        problems += [p for r in sorted(reports, key=lambda r: (r.i, r.j)) for p in r.problems]
        plan = replace(plan, layers=with_built_shapes(plan.layers, problems))
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
    """Digests of elevation files and of the files beside them, which may hold their georeference."""
    found = []
    for path in map(Path, dem):
        beside = set(path.parent.glob(f"{glob.escape(path.stem)}.*")) - {path}
        found += [file_digest(file) for file in (path, *sorted(beside))]
    return found


def scene_manifest(
    osm: OsmData,
    options: Mapping[str, Any],
    *,
    digest: str,
    plan: BuildPlan,
    reports: Sequence[TileReport],
    problems: Sequence[Problem],
    fingerprint: str,
) -> dict[str, Any]:
    """The JSON object: sources, options, counts, sources of heights, repaired and dropped features.

    digest : of the map
    """
    xmin, ymin, xmax, ymax = plan.extent
    west, south, east, north = osm.bounds
    terrain = plan.terrain
    sources = _sources(osm, plan)
    return {
        "generator": f"geoscene {__version__}",
        "name": options["name"],
        "attribution": "; ".join(dict.fromkeys(s["attribution"] for s in sources if "attribution" in s)),
        "fingerprint": fingerprint,
        "sources": sources,
        "geographic_bounds": [west, south, wrap_longitude(east), north],
        "bounds": [xmin, ymin, xmax, ymax],
        "tile_size": options["tile_size"],
        "tiles": sorted((r.i, r.j, tile_span(plan.ground, r.i, j=r.j)) for r in reports),
        "options": dict(options),
        **({} if plan.area is None else {"area": shapely.to_wkt(plan.area, rounding_precision=3)}),
        **({} if plan.route is None else {"route": shapely.to_wkt(plan.route, rounding_precision=3)}),
        "map": digest,
        "left_out": {"tiles": len(plan.chosen) - len(reports)},
        "terrain": {
            "vertical": terrain.vertical,
            "datum": terrain.datum,
            "spacing_m": terrain.spacing,
            "posts": terrain.posts,
            "voids_filled": terrain.voids,
            "uncovered_share": terrain.uncovered,
            "rivers_turned": list(plan.levels.reversed),
        },
        "ground": {
            "area": sum(r.area for r in sorted(reports, key=lambda r: (r.i, r.j))),
            "water_area": sum(r.water for r in sorted(reports, key=lambda r: (r.i, r.j))),
            "extent_area": (xmax - xmin) * (ymax - ymin),
            "open_area": _open_area(plan),
        },
        "roads": {"driving_side": plan.side[0], "driving_side_source": plan.side[1]},
        "counts": _counts(plan, reports, problems=problems),
        **({} if plan.relief == "off" else {"relief": _relief(plan, reports)}),
        "heights": _tally(plan.layers[0].columns["height_source"]),
        "leaf_area_density": leaf_area_density(with_relief=plan.relief != "off"),
        "forests": plan.forests.to_json() if plan.forests else None,
        "roofs": _tally(plan.buildings.roof_shape[plan.buildings.drawn]),
        **({} if osm.cloud is None else {"cloud": osm.cloud}),
        "problems": summarise(problems),
        "limits": [
            limit.to_json()
            for limit in (
                *scale_limit(plan.frame, plan.extent),
                *height_limit(plan.terrain.height(*places(plan.extent).T)),
            )
        ],
    }


def _sources(osm: OsmData, plan: BuildPlan) -> list[dict[str, str]]:
    """All sources of the scene, with licence and attribution if known."""
    licences = {source.attribution: source.licence for source in SOURCES.values()}
    maps = [
        {
            "kind": credit.kind,
            "from": credit.origin,
            "timestamp": credit.timestamp,
            "licence": credit.licence,
            "attribution": credit.attribution,
        }
        for credit in credits_of(osm)
    ]
    terrain = [
        {"kind": "terrain", "from": name}
        | ({"licence": licences[credit]} if credit in licences else {})
        | ({"attribution": credit} if credit else {})
        for name, credit in zip(plan.terrain.sources, plan.terrain.credits, strict=True)
    ]
    return maps + terrain


def _open_area(plan: BuildPlan) -> float:
    """Square metres of the extent without ground, at tunnel mouths."""
    openings = [shape for shape in plan.openings if shape is not None]
    return float(shapely.intersection(shapely.union_all(openings), shapely.box(*plan.extent)).area)


def road_metres(graph: RoadGraph, extent: Sequence[float]) -> tuple[float, float]:
    """True metres of the roads' centre lines within an extent, and of those with a gradient above `STEEP`.

    A carriageway of two directions counts once.
    """
    once = np.flatnonzero(graph.once)
    if not len(once):
        return 0.0, 0.0
    lines = graph.geometry[once]
    segments = np.concatenate([np.stack([line[:-1], line[1:]], axis=1) for line in lines])
    edge = np.repeat(once, [len(line) - 1 for line in lines])
    plan = np.hypot(*(segments[:, 1, :2] - segments[:, 0, :2]).T)
    steep = np.abs(segments[:, 1, 2] - segments[:, 0, 2]) > STEEP * plan
    inside = shapely.length(shapely.clip_by_rect(shapely.linestrings(segments[:, :, :2]), *extent))
    whole = np.bincount(edge, plan, minlength=len(graph))[edge]
    metres = inside * graph.length[edge] / np.where(whole > 0, whole, 1.0)
    return float(metres.sum()), float(metres[steep].sum())


def _counts(plan: BuildPlan, reports: Sequence[TileReport], *, problems: Sequence[Problem]) -> dict[str, Any]:
    count = plan.buildings.count
    summary = summarise(problems)
    dropped = summary["dropped"].get("building", {})
    components = find_components(plan.graph)
    metres, steep = road_metres(plan.graph, plan.extent)
    return {
        "buildings": count + sum(dropped.values()) - dropped.get("no-solid", 0),
        "solids": sum(r.buildings for r in reports),
        "dropped": sum(dropped.values()),
        "repaired": sum(summary["repaired"].get("building", {}).values()),
        "building_parts": len(plan.buildings) - count,
        "closed_objects": sum(r.solids for r in reports),
        "watertight": sum(r.watertight for r in reports),
        "faces": sum(r.faces for r in reports),
        "road_edges": len(plan.graph),
        "road_km": round(metres / 1000, 3),
        "road_km_steep": round(steep / 1000, 3),
        "road_components": int(components.strong.max(initial=-1)) + 1,
        "road_largest_component_share": round(components.largest_strong_share, 4),
        "trees": len(plan.trees),
        "forest_trees": sum(r.forest_trees for r in reports),
        "furniture": len(plan.furniture),
        "barriers": len(plan.barriers),
        "bridge_pieces": int((~plan.structures.tunnel).sum()),
        "tunnel_pieces": int(plan.structures.tunnel.sum()),
        "instances": sum(r.instances for r in reports),
    }


def _relief(plan: BuildPlan, reports: Sequence[TileReport]) -> dict[str, Any]:
    """Relief of the scene, by kind and source."""
    furniture, raised = plan.furniture, plan.ground.raised
    parts, roofs, facades = Counter[str](), Counter[str](), Counter[str]()
    for report in reports:
        facades.update(report.facades)
        parts.update(report.guessed)
        roofs.update(report.roofs)
    if plan.rooftops is not None:
        roofs["parapet"] = int((plan.rooftops.parapet > 0).sum())
    return {
        "habits": _tally(plan.trees.habit),
        "habit_source": _tally(plan.trees.habit_source),
        "furniture": _tally(furniture.shape[furniture.source == "mapped"]),
        "furniture_guessed": _tally(furniture.shape[furniture.source != "mapped"]),
        "camber_km": 0.0 if raised is None else round(raised.camber.metres(plan.extent) / 1000, 3),
        "ballast_m2": 0.0 if raised is None else round(raised.beds.square_metres(plan.extent), 1),
        **count_kerbs(plan.ground.layers),
        **count_covers(plan.ground.layers),
        "parts_guessed": dict(sorted(parts.items())),
        "wires": _tally(plan.wires.kind),
        "roofs_guessed": dict(sorted(roofs.items())),
        "facades": dict(sorted(facades.items())),
        **_facade_tallies(plan),
    }


def _facade_tallies(plan: BuildPlan) -> dict[str, dict[str, int]]:
    """Buildings by the type of their facades and its source."""
    count, setting = plan.buildings.count, plan.facades
    if setting is None:
        return {}
    return {
        "facade_types": _tally(setting.styles.names[:count]),
        "facade_source": _tally(setting.source[:count]),
    }


def _tally(values: Any) -> dict[str, int]:
    return dict(sorted(Counter(values.tolist()).items()))
