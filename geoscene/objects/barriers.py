"""Walls, fences, hedges and rails as closed solids that follow the ground."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.buildings.heights import HIGHEST
from geoscene.classes import Class, materials
from geoscene.geometry.frames import Frame
from geoscene.geometry.mesh import Mesh, concatenate
from geoscene.ground.kinds import is_underground, storey_tag
from geoscene.ground.partition import PRECISION, GroundPlan
from geoscene.sources.data import Area, OsmData, Tags, Way, area_tags, is_building
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

_ROOF = 1.0
"""Metres, ``min_height`` from which a barrier stands on a roof: level, not cut by roads and buildings."""

_SAME = 0.1
"""Metres within which a barrier mapped as a line is that around an area, and a gate is in it."""


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
    min_height : (n,) float64, metres from the ground to the underside; 0 on the ground
    height   : (n,) float64, metres from the ground to the top
    height_source, width_source : (n,) str: ``height``, ``width``, ``est_height``, ``est_width`` or
               ``default``; ``area`` where its shape is drawn
    osm_id   : (n,) str
    feature  : (n,) int32: as read, consecutive
    """

    polygon: NDArray[np.object_]
    klass: NDArray[np.uint8]
    material: NDArray[np.uint8]
    min_height: Float
    height: Float
    height_source: NDArray[np.str_]
    width_source: NDArray[np.str_]
    osm_id: NDArray[np.str_]
    feature: NDArray[np.int32]


def read_barriers(osm: OsmData, frame: Frame, *, extent: Sequence[float]) -> tuple[Barriers, list[Problem]]:
    """Mapped barriers within an extent, and changed or dropped ones as problems.

    A line has its ``width`` or the default of its kind. It is open at gates on its nodes. An area is filled
    if it is one for its barrier alone (``area=yes``, or a multipolygon without another area tag); a barrier
    around an area of another kind follows its outline.
    """
    box = shapely.box(*extent)
    problems: list[Problem] = []
    rows: list[_Row] = []
    drawn: list[Any] = []
    gates = _gates(osm)
    for way in osm.ways:
        kind = KINDS.get(way.tags.get("barrier", ""))
        if kind is None or len(way.lonlat) < 2:
            continue
        xy = np.column_stack(frame.from_geographic(*way.lonlat.T))
        line = shapely.LineString(xy)
        if not line.intersects(box) or not _on_ground(way, problems=problems):
            continue
        drawn.append(line)
        open_at = [
            shapely.Point(p).buffer(gates[int(node)] / 2)
            for node, p in zip(way.nodes, xy, strict=True)
            if int(node) in gates
        ]
        rows.append(_band_row(way, kind, line=line, open_at=open_at, problems=problems))
    lines = {way.osm_id for way in osm.ways}
    rings: list[tuple[Area, BarrierKind, Any]] = []
    for area in osm.areas:
        kind = KINDS.get(area.tags.get("barrier", ""))
        if kind is None:
            continue
        shape = shapely.transform(area.geometry, lambda c: np.column_stack(frame.from_geographic(*c.T)))
        filled = _is_filled(area.tags, kind)
        if not shape.intersects(box) or (area.osm_id in lines and not filled):
            continue
        if not _on_ground(area, problems=problems):
            continue
        if filled:
            rows.append(_row(area, kind, shape=shape, width_source="area", problems=problems))
        else:
            rings.append((area, kind, shape.boundary))
    if rings:
        mapped, centres = shapely.union_all(shapely.buffer(drawn, _SAME)), _gate_places(osm, frame)
        for area, kind, ring in rings:
            open_at = [place.buffer(width / 2) for place, width in centres if place.distance(ring) < _SAME]
            line = shapely.difference(ring, mapped)  # ways of the ring may be barriers themselves
            if not line.is_empty:
                rows.append(_band_row(area, kind, line=line, open_at=open_at, problems=problems))
    return _table(rows), problems


_Row = tuple[object, BarrierKind, str, float, float, str, str, str]


def _band_row(
    feature: Way | Area, kind: BarrierKind, *, line: Any, open_at: Sequence[Any], problems: list[Problem]
) -> _Row:
    """The row of a barrier along a line, open at some places."""
    width, width_source = _size(
        feature.tags, feature.osm_id, key="width", usual=kind.width, most=_WIDEST, problems=problems
    )
    if open_at:
        line = line.difference(shapely.union_all(open_at))
    band = line.buffer(width / 2, cap_style="flat", join_style="mitre", mitre_limit=3.0)
    return _row(feature, kind, shape=band, width_source=width_source, problems=problems)


def _row(
    feature: Way | Area, kind: BarrierKind, *, shape: Any, width_source: str, problems: list[Problem]
) -> _Row:
    """The row of a barrier of a shape in plan. Its height counts from ``min_height`` unless it exceeds it."""
    tags, osm_id = feature.tags, feature.osm_id
    low, _ = _size(tags, osm_id, key="min_height", usual=0.0, most=HIGHEST, problems=problems)
    height, source = _size(
        tags, osm_id, key="height", usual=kind.height, most=_HIGHEST + low, problems=problems
    )
    top = height if height > low and source == "height" else low + height
    return shape, kind, _material(tags, kind), low, top, source, width_source, osm_id


def _is_filled(tags: Tags, kind: BarrierKind) -> bool:
    """Whether a barrier fills its area. No fence does that bounds an area of another kind."""
    for_itself = not area_tags(tags)
    return for_itself or (tags.get("area") == "yes" and kind.klass != Class.FENCE)


def open_barriers(table: Barriers, plan: GroundPlan) -> tuple[Barriers, list[Problem]]:
    """The barriers open on roads, crossings, tracks and in buildings; those of no area are left out."""
    low = table.min_height < _ROOF
    polygon, opened = shapely.intersection(table.polygon, shapely.box(*plan.extent)), np.zeros(len(low), bool)
    polygon[low], opened[low] = _with_openings(table.polygon[low], plan)
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
        low = float(barriers.min_height[row])
        if low >= _ROOF:
            ground = np.full(len(xy), ground.min())  # as a building's heights
        n = len(xy)
        edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
        key, back = edges[:, 0] * n + edges[:, 1], edges[:, 1] * n + edges[:, 0]
        a, b = edges[~np.isin(key, back)].T
        parts.append(
            Mesh.of(
                np.concatenate(
                    [
                        np.column_stack([xy, ground + (low or -_BELOW)]),
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


def _on_ground(feature: Way | Area, *, problems: list[Problem]) -> bool:
    """Whether the place of a barrier is known: on the ground, or ``min_height`` above it."""
    tags = feature.tags
    if "building" in tags and is_building(tags):  # the building is it
        return False
    where = ""
    if parse_length(tags.get("min_height")) is None:
        where = storey_tag(tags) or next(
            (f"{key}={tags[key]}" for key in ("layer",) if tags.get(key, "0") != "0"), ""
        )
    if not where and is_underground(tags):
        keys = ("tunnel", "bridge", "indoor", "covered", "building:part", "location", "parking")
        where = ", ".join(f"{key}={tags[key]}" for key in keys if key in tags)
    if where:
        problems.append(Problem(feature.osm_id, "barrier", "dropped", "off-ground", where))
    return not where


def _material(tags: Tags, kind: BarrierKind) -> str:
    for key in ("material", "wall", "fence_type"):
        if tags.get(key) in _MATERIALS and kind.klass != Class.HEDGE:
            return _MATERIALS[tags[key]]
    return kind.material


def _size(
    tags: Tags, osm_id: str, *, key: str, usual: float, most: float, problems: list[Problem]
) -> tuple[float, str]:
    """(metres, source) of a height or width."""
    least = 0.0 if key == "min_height" else _LEAST
    for name in (key, f"est_{key}"):
        if name not in tags:
            continue
        metres = parse_length(tags[name])
        if metres is not None and least <= metres <= most:
            return metres, name
        detail = f"{name}={tags[name]!r}; took {usual} m"
        problems.append(Problem(osm_id, "barrier", "repaired", f"unusable-{name}", detail))
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


def _gate_places(osm: OsmData, frame: Frame) -> list[tuple[shapely.Point, float]]:
    """Places of gates, scene metres, and the widths of their openings."""
    gates = _gates(osm)
    nodes = [p for p in osm.points if int(p.osm_id.removeprefix("node/")) in gates]
    xy = np.column_stack(frame.from_geographic([p.lon for p in nodes], [p.lat for p in nodes]))
    widths = [gates[int(p.osm_id.removeprefix("node/"))] for p in nodes]
    return list(zip(shapely.points(xy).tolist(), widths, strict=True))


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


def _table(rows: list[_Row]) -> Barriers:
    return Barriers(
        np.fromiter((row[0] for row in rows), object),
        np.array([row[1].klass for row in rows], np.uint8),
        np.array([materials()[row[2]].code for row in rows], np.uint8),
        np.array([row[3] for row in rows], float),
        np.array([row[4] for row in rows], float),
        np.array([row[5] for row in rows], np.str_),
        np.array([row[6] for row in rows], np.str_),
        np.array([row[7] for row in rows], np.str_),
        np.arange(len(rows), dtype=np.int32),
    )
