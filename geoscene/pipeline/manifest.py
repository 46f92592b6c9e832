"""The contents of ``scene.json`` for a build."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import shapely

from geoscene import __version__
from geoscene.geometry.frames import wrap_longitude
from geoscene.ground import tile_span
from geoscene.ground.kerbs import count_covers, count_kerbs
from geoscene.objects.shapes import leaf_area_density
from geoscene.pipeline.limits import height_limit, places, scale_limit
from geoscene.pipeline.plan import BuildPlan
from geoscene.pipeline.tiles import TileReport
from geoscene.roadgraph import find_components
from geoscene.roadgraph.graph import RoadGraph
from geoscene.sources import SOURCES, OsmData, credits_of
from geoscene.support.problems import Problem, summarise

STEEP = 0.2
"""Gradient above which roads are counted as steep; few streets exceed it."""


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
        "heights": _tally(plan.buildings.height_source[: plan.buildings.count]),
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
    once = np.flatnonzero((graph.twin < 0) | (np.arange(len(graph)) < graph.twin))
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
    furniture = plan.furniture
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
        "camber_km": _camber_km(plan),
        "ballast_m2": _ballast_m2(plan),
        **count_kerbs(plan.ground.layers),
        **count_covers(plan.ground.layers),
        "parts_guessed": dict(sorted(parts.items())),
        "wires": _tally(plan.wires.kind),
        "roofs_guessed": dict(sorted(roofs.items())),
        "facades": dict(sorted(facades.items())),
        **_facade_tallies(plan),
    }


def _camber_km(plan: BuildPlan) -> float:
    """Kilometres of carriageway in the extent that have a camber."""
    raised = plan.ground.raised
    return 0.0 if raised is None else round(raised.camber.metres(plan.extent) / 1000, 3)


def _ballast_m2(plan: BuildPlan) -> float:
    """Square metres of raised ballast in the extent."""
    raised = plan.ground.raised
    return 0.0 if raised is None else round(raised.beds.square_metres(plan.extent), 1)


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
