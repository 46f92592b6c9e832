"""Walls, fences, hedges and rails as closed solids that follow the ground."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.classes import Class, materials
from geoscene.geometry.frames import Frame
from geoscene.geometry.mesh import Mesh, concatenate
from geoscene.ground.kinds import is_underground
from geoscene.ground.partition import PRECISION, GroundPlan
from geoscene.sources.data import OsmData, Tags
from geoscene.support.columns import Columns
from geoscene.support.problems import Problem
from geoscene.tags import parse_length
from geoscene.typing import Bools, Float, Height

_BELOW = 0.3
"""Metres by which a barrier extends below the ground, so that no gap opens on a slope."""

_MERGED = 2e-3
"""Metres by which outlines may change in plan, so that no two of their vertices lie within a millimetre."""

_STATION = 5.0
"""Metres between samples of the ground's height along a barrier."""

_LEAST, _HIGHEST, _WIDEST = 0.01, 30.0, 20.0
"""Metres; smaller and larger values are taken for typing errors."""


@dataclass(frozen=True, slots=True)
class BarrierKind:
    """Class, material and default sizes in metres (assumed: common values in towns)."""

    klass: Class
    material: str
    height: float
    width: float


KINDS: dict[str, BarrierKind] = {
    "wall": BarrierKind(Class.WALL, "stone", 1.8, 0.25),
    "retaining_wall": BarrierKind(Class.WALL, "concrete", 1.0, 0.4),
    "city_wall": BarrierKind(Class.WALL, "stone", 6.0, 1.5),
    "jersey_barrier": BarrierKind(Class.WALL, "concrete", 0.8, 0.6),
    "fence": BarrierKind(Class.FENCE, "metal", 1.5, 0.05),
    "railing": BarrierKind(Class.FENCE, "metal", 1.0, 0.05),
    "handrail": BarrierKind(Class.FENCE, "metal", 0.9, 0.05),
    "guard_rail": BarrierKind(Class.FENCE, "metal", 0.75, 0.1),
    "hedge": BarrierKind(Class.HEDGE, "foliage", 1.5, 0.8),
    "hedge_bank": BarrierKind(Class.HEDGE, "foliage", 2.0, 1.5),
}
"""Kinds by value of ``barrier``; others (kerbs, chains, gates) do not become solids."""

_MATERIALS = {
    "wood": "wood", "metal": "metal", "chain_link": "metal", "wire": "metal", "concrete": "concrete",
    "brick": "brick", "stone": "stone", "dry_stone": "stone", "glass": "glass", "plaster": "plaster",
    "bars": "metal", "railing": "metal", "picket": "wood", "paling": "wood",
}  # fmt: skip
"""Materials by value of ``material``, ``wall`` or ``fence_type``."""

_OPENINGS = {"gate": 3.0, "lift_gate": 4.0, "swing_gate": 4.0, "sliding_gate": 4.0, "entrance": 1.5,
             "kissing_gate": 1.2, "turnstile": 1.0, "bollard": 3.0, "cycle_barrier": 2.0, "stile": 1.0,
             "toll_booth": 4.0, "wicket_gate": 1.2}  # fmt: skip
"""Default width in metres of a gate on a node of a barrier."""

_APART = 0.005
"""Metres by which bands that touch themselves in a point are narrowed on each side."""
_PASSABLE = (Class.ROAD, Class.LANE_MARKING, Class.CROSSING, Class.RAIL, Class.TUNNEL)
"""Classes of ground that leave a barrier open."""


@dataclass(frozen=True, slots=True)
class Barriers(Columns):
    """Barriers as columns, one row a map object.

    polygon  : (n,) object, shapely Polygon or MultiPolygon, what it covers in plan, scene metres
    klass, material : (n,) uint8
    height   : (n,) float64, metres above the ground
    height_source, width_source : (n,) str: ``height``, ``width`` or ``default``; ``area`` where its shape is
               drawn
    osm_id   : (n,) str
    feature  : (n,) int32: as read, consecutive
    """

    polygon: NDArray[np.object_]
    klass: NDArray[np.uint8]
    material: NDArray[np.uint8]
    height: Float
    height_source: NDArray[np.str_]
    width_source: NDArray[np.str_]
    osm_id: NDArray[np.str_]
    feature: NDArray[np.int32]


def read_barriers(osm: OsmData, frame: Frame, *, extent: Sequence[float]) -> tuple[Barriers, list[Problem]]:
    """Mapped barriers within an extent, and changed or dropped ones as problems.

    A line has its ``width`` or the default of its kind. It is open at gates on its nodes.
    """
    box = shapely.box(*extent)
    gates = _gates(osm)
    problems: list[Problem] = []
    rows: list[tuple[object, BarrierKind, str, float, str, str, str]] = []
    for way in osm.ways:
        kind = _kind(way.tags)
        if kind is None or len(way.lonlat) < 2:
            continue
        xy = np.column_stack(frame.from_geographic(*way.lonlat.T))
        line = shapely.LineString(xy)
        if not line.intersects(box):
            continue
        width, width_source = _size(
            way.tags, way.osm_id, key="width", usual=kind.width, most=_WIDEST, problems=problems
        )
        height, height_source = _size(
            way.tags, way.osm_id, key="height", usual=kind.height, most=_HIGHEST, problems=problems
        )
        open_at = [
            shapely.Point(p).buffer(gates[int(node)] / 2)
            for node, p in zip(way.nodes, xy, strict=True)
            if int(node) in gates
        ]
        if open_at:
            line = line.difference(shapely.union_all(open_at))
        band = line.buffer(width / 2, cap_style="flat", join_style="mitre", mitre_limit=3.0)
        rows.append((band, kind, _material(way.tags, kind), height, height_source, width_source, way.osm_id))
    for area in osm.areas:
        kind = _kind(area.tags)
        if kind is None:
            continue
        shape = shapely.transform(area.geometry, lambda c: np.column_stack(frame.from_geographic(*c.T)))
        if shape.intersects(box):
            height, height_source = _size(
                area.tags, area.osm_id, key="height", usual=kind.height, most=_HIGHEST, problems=problems
            )
            rows.append((shape, kind, _material(area.tags, kind), height, height_source, "area", area.osm_id))
    return _table(rows), problems


def open_barriers(table: Barriers, plan: GroundPlan) -> tuple[Barriers, list[Problem]]:
    """The barriers open on roads, crossings, tracks and in buildings; those of no area are left out."""
    polygon, opened = _with_openings(table.polygon, plan)
    problems = [
        Problem(str(osm_id), "barrier", "repaired", "across-road", "open where a road passes")
        for osm_id in table.osm_id[opened]
    ]
    table = replace(table, polygon=polygon)
    return table.take(shapely.area(table.polygon) > 0.01), problems


def barrier_meshes(barriers: Barriers, *, height: Height | None = None) -> list[Mesh]:
    """One mesh of closed solids for each barrier, in scene coordinates.

    The bottom lies 0.3 m below the ground, the top the barrier's height above it; both follow the terrain,
    sampled at most every 5 m.
    """
    return [_solid(barriers, row, height=height) for row in range(len(barriers))]


def _solid(barriers: Barriers, row: int, *, height: Height | None) -> Mesh:
    """The closed solids of one barrier."""
    material = next(m for m in materials().values() if m.code == barriers.material[row])
    parts = []
    shape = shapely.set_precision(
        shapely.segmentize(shapely.simplify(barriers.polygon[row], _MERGED), _STATION), PRECISION
    )
    if _touches_itself(shape):
        shape = shapely.set_precision(shapely.buffer(shape, -_APART, join_style="mitre"), PRECISION)
    for part in shapely.get_parts(shape):
        # In whole steps of the grid, so that what lies on one line does so exactly.
        steps = shapely.transform(part, lambda c: np.rint(c / PRECISION))
        triangles = shapely.get_parts(shapely.constrained_delaunay_triangles(steps))
        corners = shapely.get_coordinates(triangles).reshape(-1, 4, 2)[:, :3]
        grid, faces = np.unique(corners.reshape(-1, 2), axis=0, return_inverse=True)
        xy = grid * PRECISION
        faces = faces.reshape(-1, 3)
        (ux, uy), (vx, vy) = ((xy[faces[:, k]] - xy[faces[:, 0]]).T for k in (1, 2))
        faces = np.where((ux * vy < uy * vx)[:, None], faces[:, ::-1], faces)
        ground = np.zeros(len(xy)) if height is None else np.asarray(height(*xy.T), float)
        n = len(xy)
        edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
        key, back = edges[:, 0] * n + edges[:, 1], edges[:, 1] * n + edges[:, 0]
        a, b = edges[~np.isin(key, back)].T
        parts.append(
            Mesh.of(
                np.concatenate(
                    [
                        np.column_stack([xy, ground - _BELOW]),
                        np.column_stack([xy, ground + barriers.height[row]]),
                    ]
                ),
                np.concatenate(
                    [
                        faces[:, ::-1],
                        faces + n,
                        np.column_stack([a, b, b + n]),
                        np.column_stack([a, b + n, a + n]),
                    ]
                ),
                feature=int(barriers.feature[row]),
                klass=int(barriers.klass[row]),
                material=material.code,
                color=material.color,
                closed=True,
            )
        )
    return concatenate(parts)


def _touches_itself(shape: Any) -> bool:
    """Whether rings of the shape touch in a point, which would be a non-manifold edge of a solid."""
    rings = shapely.get_rings(shapely.get_parts(shape))
    coordinates = np.concatenate([np.empty((0, 2)), *(shapely.get_coordinates(ring)[:-1] for ring in rings)])
    return len(np.unique(np.rint(coordinates / PRECISION), axis=0)) < len(coordinates)


def _kind(tags: Tags) -> BarrierKind | None:
    if is_underground(tags) or tags.get("layer", "0") != "0":
        return None
    return KINDS.get(tags.get("barrier", ""))


def _material(tags: Tags, kind: BarrierKind) -> str:
    for key in ("material", "wall", "fence_type"):
        if tags.get(key) in _MATERIALS and kind.klass != Class.HEDGE:
            return _MATERIALS[tags[key]]
    return kind.material


def _size(
    tags: Tags, osm_id: str, *, key: str, usual: float, most: float, problems: list[Problem]
) -> tuple[float, str]:
    """(metres, source) of a height or width."""
    if key not in tags:
        return usual, "default"
    metres = parse_length(tags[key])
    if metres is not None and _LEAST <= metres <= most:
        return metres, key
    detail = f"{key}={tags[key]!r}; took {usual} m"
    problems.append(Problem(osm_id, "barrier", "repaired", f"unusable-{key}", detail))
    return usual, "default"


def _gates(osm: OsmData) -> dict[int, float]:
    """Width in metres of the opening at each node that is a gate."""
    gates = {}
    for point in osm.points:
        usual = _OPENINGS.get(point.tags.get("barrier", ""))
        if usual is not None:
            width = parse_length(point.tags.get("width")) or usual
            gates[int(point.osm_id.removeprefix("node/"))] = width if 0.0 < width <= _WIDEST else usual
    return gates


def _with_openings(polygons: NDArray[np.object_], plan: GroundPlan) -> tuple[NDArray[np.object_], Bools]:
    """Polygons without roads, tracks, buildings and areas outside the extent; which crossed a road."""
    out = shapely.intersection(polygons, shapely.box(*plan.extent))
    opened = np.zeros(len(polygons), bool)
    for klasses, road in ((_PASSABLE, True), ((Class.BUILDING_PAD,), False)):
        rows = np.flatnonzero(np.isin(plan.layers.klass, klasses))
        barrier, found = shapely.STRtree(plan.layers.polygon[rows]).query(out, predicate="intersects")
        for k in np.unique(barrier):
            blocked = shapely.union_all(plan.layers.polygon[rows[found[barrier == k]]])
            rest = shapely.difference(out[k], blocked)
            opened[k] |= road and rest.area < out[k].area - 0.01
            out[k] = rest
    return np.fromiter(map(_polygonal, out), object), opened


def _polygonal(geometry: Any) -> Any:
    """The polygons among a geometry's parts, without those of negligible area."""
    parts = shapely.get_parts(geometry)
    areal = (shapely.get_type_id(parts) == shapely.GeometryType.POLYGON) & (shapely.area(parts) > 0.01)
    return shapely.multipolygons(parts[areal])


def _table(rows: list[tuple[object, BarrierKind, str, float, str, str, str]]) -> Barriers:
    return Barriers(
        np.fromiter((row[0] for row in rows), object),
        np.array([row[1].klass for row in rows], np.uint8),
        np.array([materials()[row[2]].code for row in rows], np.uint8),
        np.array([row[3] for row in rows], float),
        np.array([row[4] for row in rows], np.str_),
        np.array([row[5] for row in rows], np.str_),
        np.array([row[6] for row in rows], np.str_),
        np.arange(len(rows), dtype=np.int32),
    )
