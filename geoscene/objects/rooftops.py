"""Rooftop objects in scenes with full relief: chimneys, dormers, plant, tanks; and parapets."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.buildings import Buildings
from geoscene.buildings.footprints import groups
from geoscene.buildings.guesses import guess_looks, region_at, seeds
from geoscene.geometry.mesh import FLOOR, ROOF, Mesh, ShapeInstances
from geoscene.geometry.polylines import cross
from geoscene.objects.shapes import DORMER_DEPTH, place
from geoscene.support.columns import Columns
from geoscene.support.splitmix import uniform_at
from geoscene.typing import Bools, Float, Ints

_CHIMNEYS = {"north_america": 0.5, "mediterranean": 0.5, "oceania": 0.3, "east_asia": 0.05}
_DORMERS = {"central_europe": 0.3, "british_isles": 0.2, "low_countries": 0.3, "north_america": 0.2}
_COLD = ("central_europe", "british_isles", "low_countries", "nordic", "eastern_europe")
"""Shares of pitched houses with chimneys and with dormers, by region: assumed. Houses of cold regions have
chimneys at nine of ten; where a region is not named, at one of ten, and dormers at one of twenty."""

_NEW_YORK = (-74.26, 40.49, -73.69, 40.92)
"""Degrees. Buildings of more than six storeys there have their own water tanks, as the pressure of the mains
does not reach further."""
_ABOVE_MAINS = 20.5

_EDGE = 0.9
"""Metres between the edge of a flat roof and what stands on it: behind the parapet, with room to walk."""

_STEEPEST, _FLATTEST = np.tan(np.radians(54.0)), np.tan(np.radians(24.0))
"""Slopes of roofs between which dormers are built."""

_PLANT: dict[str, tuple[tuple[str, float, float], ...]] = {
    # shape, share of the roofs that have some, square metres of roof for each (0: only one)
    "tall": (
        ("roof_stairs", 0.6, 0.0),
        ("vent", 0.8, 60.0),
        ("air_conditioner", 0.4, 150.0),
        ("skylight", 0.3, 120.0),
        ("antenna", 0.2, 0.0),
    ),
    "office": (
        ("lift_housing", 0.9, 0.0),
        ("air_handler", 0.7, 400.0),
        ("air_conditioner", 0.8, 120.0),
        ("vent", 0.8, 80.0),
        ("antenna", 0.3, 0.0),
    ),
    "hall": (
        ("air_handler", 0.6, 900.0),
        ("skylight", 0.7, 90.0),
        ("vent", 0.8, 120.0),
        ("air_conditioner", 0.4, 400.0),
    ),
    "low": (("vent", 0.6, 60.0), ("antenna", 0.2, 0.0), ("skylight", 0.2, 0.0)),
}
"""Plant on flat roofs by kind of building: assumed."""

_MOST = 12
"""Pieces of one kind on a roof."""

_ROOM = {
    "roof_stairs": 2.3,
    "lift_housing": 2.4,
    "air_handler": 2.8,
    "air_conditioner": 1.1,
    "water_tank": 2.0,
}
"""Radius in metres that shapes need; others half a metre, skylights one."""


@dataclass(frozen=True, slots=True)
class Rooftops(Columns):
    """Inferred rooftop objects of buildings, one row per row of `Buildings`.

    kind    : (n,) str, of `geoscene.buildings.guesses.KINDS`
    parapet : (n,) metres above a flat roof, 0 for none
    chimney : (n,) bool, on its pitched roof
    dormers : (n,) bool, on its pitched roof
    tank    : (n,) bool, a water tank
    seed    : (n,) int64, of the OSM id
    """

    kind: NDArray[np.object_]
    parapet: Float
    chimney: Bools
    dormers: Bools
    tank: Bools
    seed: Ints


def plan_rooftops(buildings: Buildings, *, centre: tuple[float, float]) -> Rooftops:
    """Inferred rooftop objects of buildings by use, size and region.

    Parapets are on flat roofs of 30 m2 and more, 3 m above the ground; chimneys and dormers on pitched roofs
    of houses.

    centre : longitude and latitude of the map's middle, degrees
    """
    region = region_at(*centre)
    area = shapely.area(buildings.footprint)
    walls = buildings.height - buildings.min_height - buildings.roof_height
    looks = guess_looks(
        buildings.osm_id,
        buildings.use,
        area=area,
        walls=walls,
        levels=buildings.levels,
        roof_height=buildings.roof_height,
        region=region,
    )
    seed = seeds(buildings.osm_id)
    draw = uniform_at(seed, np.full(len(seed), 7), count=5)
    house = np.isin(looks.kind, ("low", "tall"))
    flat = ~looks.pitched & ~np.isin(looks.kind, ("small", "sacred"))
    high = np.where(looks.kind == "low", 0.3 + 0.3 * draw[0], 0.5 + 0.5 * draw[0])
    sloped = buildings.roof_height > 0
    west, south, east, north = _NEW_YORK
    tanks = west < centre[0] < east and south < centre[1] < north
    usual = 0.9 if region in _COLD else 0.1
    return Rooftops(
        looks.kind,
        np.where(flat & (area >= 30.0) & (buildings.height >= 3.0), np.round(high, 2), 0.0),
        house & sloped & (draw[1] < _CHIMNEYS.get(region, usual)),
        house & sloped & (draw[2] < _DORMERS.get(region, 0.05)),
        tanks & (walls > _ABOVE_MAINS) & (area > 100.0) & (draw[3] < 0.7),
        seed,
    )


def roof_objects(solids: Mesh, rooftops: Rooftops) -> tuple[ShapeInstances, dict[str, int]]:
    """Copies of shapes on the roofs of buildings, and their number by shape.

    Each stands within one plane of a roof, half a metre or more from its edges (dormers less), and clear of
    what the building has above; chimneys reach 0.7 m above the highest point of their roof.

    solids : faces of buildings, scene metres, with rows of the table as features
    """
    face = np.flatnonzero((solids.surface == ROOF) | (solids.surface == FLOOR))
    corners, normals = solids.vertices[solids.faces[face]], solids.normals()[face]
    feature, roof = solids.feature[face], solids.surface[face] == ROOF
    found: list[tuple[str, float, float, float, float, float, float, int]] = []
    for mine in groups(feature.astype(np.int64)):
        row = int(feature[mine[0]])
        up = mine[roof[mine] & (normals[mine, 2] > 0)]
        under = corners[mine[normals[mine, 2] < 0]]
        items = _on_building(corners[up], normals[up], under=under, rooftops=rooftops, row=row)
        found += [(*item, row) for item in items]
    if not found:
        return ShapeInstances.empty(), {}
    names, x, y, z, across, upwards, heading, rows = (list(column) for column in zip(*found, strict=True))
    copies = place(
        np.array(names, np.str_),
        np.column_stack([x, y, z]).astype(float),
        size=np.column_stack([across, across, upwards]),
        heading=np.array(heading, float),
        feature=np.array(rows, np.int32),
    )
    return copies, dict(sorted(Counter(str(name) for name in names).items()))


_Item = tuple[str, float, float, float, float, float, float]
"""(shape, x, y, z, scale across, scale upwards, heading)."""


def _on_building(
    corners: Float, normals: Float, *, under: Float, rooftops: Rooftops, row: int
) -> Iterator[_Item]:
    """Rooftop objects of one building; ``under`` are the undersides of its parts."""
    flat = normals[:, 2] > 0.9995
    draw = uniform_at(np.full(64, rooftops.seed[row]), np.arange(64), count=3)
    kind = str(rooftops.kind[row])
    if kind in _PLANT:
        level = np.round(corners[flat, :, 2].mean(axis=1), 2).astype(float)
        for k, z in enumerate(np.unique(level)):
            roof = _clear(corners[flat][level == z], under, above=float(z))
            yield from _plant(
                roof, float(z), kind=kind, tank=bool(rooftops.tank[row]), draw=np.roll(draw, 7 * k)
            )
    if rooftops.chimney[row] or rooftops.dormers[row]:
        sloped = (normals[:, 2] > 0.3) & (normals[:, 2] < 0.985)
        facets = list(_facets(corners[sloped], normals[sloped], under=under))
        boxes: list[Any] = []
        if rooftops.dormers[row]:
            for facet in facets:
                for item, box in _dormers(facet, width=1.5 + 0.4 * float(draw[0, 0])):
                    boxes.append(box)
                    yield item
        if rooftops.chimney[row] and facets:
            largest = max(range(len(facets)), key=lambda k: (facets[k].area, -k))
            yield from _chimney(
                facets[largest], top=float(corners[:, :, 2].max()), others=boxes, draw=draw[:, 1]
            )


def _clear(corners: Float, under: Float, *, above: float) -> Any:
    """The union in plan of faces (m, 3, 3), without what lies below undersides higher than a height."""
    area = shapely.union_all(shapely.polygons(corners[:, :, :2]), grid_size=1e-4)
    over = under[under[:, :, 2].min(axis=1) > above + 0.05]
    return (
        area
        if not len(over)
        else shapely.difference(area, shapely.union_all(shapely.polygons(over[:, :, :2])))
    )


def _plant(roof: Any, z: float, *, kind: str, tank: bool, draw: Float) -> Iterator[_Item]:
    """Plant on a flat roof, the largest first, none of which overlap."""
    room = shapely.buffer(roof, -_EDGE, join_style="mitre")
    if room.area < 8.0:
        return
    frame = shapely.get_coordinates(shapely.minimum_rotated_rectangle(room))
    along = frame[1] - frame[0]
    heading = float(np.arctan2(along[1], along[0]))
    wanted = [("water_tank", 1)] if tank and room.area > 60.0 else []
    for k, (shape, share, each) in enumerate(_PLANT[kind]):
        if draw[0, k] < share:
            wanted.append((shape, 1 if each == 0 else min(int(room.area / each + draw[1, k]), _MOST)))
    places, taken = _lattice(room, heading, draw=draw[2]), np.empty((0, 3))
    for shape, count in wanted:
        radius = _ROOM.get(shape, 1.0 if shape == "skylight" else 0.5)
        inner = shapely.buffer(room, -radius + 0.5, join_style="mitre")
        left = places[shapely.contains_xy(inner, *places.T)] if not inner.is_empty else places[:0]
        for _ in range(count):
            if len(taken):
                away = np.hypot(*(left[:, None] - taken[None, :, :2]).transpose(2, 0, 1))
                left = left[(away > taken[:, 2] + radius + 0.4).all(axis=1)]
            if not len(left):
                break
            taken = np.vstack([taken, [*left[0], radius]])
            yield shape, float(left[0, 0]), float(left[0, 1]), z, 1.0, 1.0, heading


def _lattice(room: Any, heading: float, *, draw: Float) -> Float:
    """Points (n, 2) inside a polygon on a lattice with a heading, in an order that is drawn."""
    turn = np.array([[np.cos(heading), np.sin(heading)], [-np.sin(heading), np.cos(heading)]])
    low, high = (
        (shapely.get_coordinates(room) @ turn.T).min(axis=0),
        (shapely.get_coordinates(room) @ turn.T).max(axis=0),
    )
    step = max(1.0, float(np.sqrt((high - low).prod() / 1500.0)))
    u, v = np.meshgrid(
        np.arange(low[0], high[0], step) + step / 2, np.arange(low[1], high[1], step) + step / 2
    )
    points: Float = np.column_stack([u.ravel(), v.ravel()]) @ turn
    points = points[shapely.contains_xy(room, *points.T)]
    order = np.argsort(
        uniform_at(np.arange(len(points)), np.full(len(points), int(draw[0] * 1e9)), count=1)[0]
    )
    return points[order]


@dataclass(frozen=True, slots=True)
class _Facet:
    """A plane of a pitched roof.

    polygon : in plan
    origin, normal : (3,) a point on the plane, and its unit normal
    """

    polygon: Any
    origin: Float
    normal: Float

    @property
    def area(self) -> float:
        """Square metres in plan."""
        return float(self.polygon.area)

    @property
    def upslope(self) -> Float:
        """Horizontal unit vector (2,) up the slope."""
        up: Float = -self.normal[:2] / np.hypot(*self.normal[:2])
        return up

    @property
    def slope(self) -> float:
        """Metres upwards for a metre along `upslope`."""
        return float(np.hypot(*self.normal[:2]) / self.normal[2])

    def height(self, xy: Float) -> Float:
        """Z of the plane at points (n, 2)."""
        z: Float = self.origin[2] - (xy - self.origin[:2]) @ self.normal[:2] / self.normal[2]
        return z


def _facets(corners: Float, normals: Float, *, under: Float) -> Iterator[_Facet]:
    """The planes of a pitched roof: connected faces with one normal and distance from the origin."""
    if not len(corners):
        return
    middle = corners.reshape(-1, 3).mean(axis=0)
    offset = ((corners.mean(axis=1) - middle) * normals).sum(axis=1)
    keys = np.column_stack([np.round(normals, 2), np.round(offset, 1)])
    for key in np.unique(keys, axis=0):
        rows = np.flatnonzero((keys == key).all(axis=1))
        a, b, c = corners[rows].transpose(1, 0, 2)
        largest = rows[np.argmax(np.abs(cross(b - a, c - a)))]
        area = _clear(corners[rows], under, above=float(corners[rows, :, 2].min()))
        for polygon in shapely.get_parts(area):
            if polygon.area > 4.0:
                yield _Facet(polygon, corners[largest, 0], normals[largest])


def _dormers(facet: _Facet, *, width: float) -> Iterator[tuple[_Item, Any]]:
    """Dormers in a row along the eaves, where they fit, with their outlines in plan."""
    if not _FLATTEST < facet.slope < _STEEPEST:
        return
    up = facet.upslope
    aside = np.array([-up[1], up[0]])
    along = shapely.get_coordinates(facet.polygon) @ np.stack([up, aside], axis=1)
    (low, left), right = along.min(axis=0), along[:, 1].max()
    depth = DORMER_DEPTH * width
    count = int((right - left - 1.0) / 4.0)
    heading = float(np.arctan2(up[1], up[0]))
    for k in range(count):
        middle = left + (right - left) * (k + 0.5) / count
        front = (low + 0.6) * up + middle * aside
        ends = [front - 0.1 * up, front + (depth + 0.2) * up]
        half = (width / 2 + 0.15) * aside
        outline = shapely.Polygon([ends[0] - half, ends[1] - half, ends[1] + half, ends[0] + half])
        if facet.polygon.contains(outline):
            z = float(facet.height(front[None])[0])
            yield (
                ("dormer", float(front[0]), float(front[1]), z, width, depth * facet.slope, heading),
                outline,
            )


def _chimney(facet: _Facet, *, top: float, others: Sequence[Any], draw: Float) -> Iterator[_Item]:
    """A chimney as far up a plane as it goes, clear of others."""
    room = shapely.buffer(facet.polygon, -0.5, join_style="mitre")
    if others:
        room = shapely.difference(room, shapely.buffer(shapely.union_all(others), 0.5))
    if room.is_empty:
        return
    heading = float(np.arctan2(*facet.upslope[::-1]))
    points = _lattice(room, heading, draw=draw)
    if not len(points):
        return
    z = facet.height(points)
    upper = points[z > z.max() - 0.6 * facet.slope]
    x, y = upper[0]
    foot = float(facet.height(upper[:1])[0]) - 0.4 * facet.slope - 0.1
    yield "chimney", float(x), float(y), foot, 1.0, top + 0.7 - foot, heading
