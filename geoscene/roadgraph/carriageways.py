"""Carriageways of a map, public or not: centre line, width, sidewalks, surface material."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Literal

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.geometry.frames import Frame
from geoscene.ground.kinds import SURFACES
from geoscene.roadgraph.build import read_runs
from geoscene.roadgraph.chains import chains_of
from geoscene.roadgraph.lane_uses import NO_USES, LaneUses, read_lane_uses
from geoscene.roadgraph.streets import move_aside, read_streets
from geoscene.roadgraph.tags import CLASSES, Street, place_of
from geoscene.roadgraph.walls import Walls
from geoscene.sources.data import OsmData, Tags, Way
from geoscene.support.problems import Problem
from geoscene.tags import parse_length
from geoscene.typing import Bools, Float, Ints

KERB = 0.15
"""Metres, plan width of a kerb stone (usual sizes are 0.12 to 0.15)."""

SIDEWALK = 2.0
"""Metres, a sidewalk of unknown width. Assumed; street design guides ask for 1.5 to 2.5."""

# Streets that have sidewalks in built-up places, and the limit above which a place is not built up.
_WALKED = ("primary", "secondary", "tertiary", "residential", "living_street")
_BUILT_UP = 61 / 3.6

MINOR = frozenset({"service", "track", "busway", "bus_guideway", "raceway", "escape"})
"""Road classes without paint, and at whose junctions that of other roads is not interrupted."""

PAVED = frozenset({"asphalt", "concrete", "paving", "brick", "stone"})
"""Materials that carry paint and kerbs."""


def surface_material(tags: Tags, default: str) -> tuple[str, str]:
    """Name of the material that ``surface`` means, and its source (``surface`` or ``default``)."""
    name = SURFACES.get(tags.get("surface", "").split(";", maxsplit=1)[0])
    return (default, "default") if name is None else (name, "surface")


@dataclass(frozen=True, slots=True)
class Carriageways:
    """Stretches of road between two nodes, one row each; a two-way street is one row.

    Left and right are as seen along the line.

    line   : (k,) shapely LineString, scene metres; the middle of the carriageway
    ends   : (k, 2) int32 node of the line's start and end
    node_xy : (n, 2) float64 scene metres
    node_id : (n,) int64 OSM ids
    street : (k,) attributes read from the tags (``speed`` and ``name`` are those of the first way)
    width  : (k,) float64 scene metres
    walk   : (k, 2) float64 scene metres, width of the sidewalk on the left and on the right, 0 for none
    walk_source : (k, 2) str: ``sidewalk`` (tag), ``default`` or "" (none)
    material, material_source : (k,) str
    marked : (k,) bool, lanes are painted, by ``lane_markings`` or by the road class
    uses   : (k,) `LaneUses`, what else is painted on lanes; nothing on roads that are not paved
    osm_id : (k,) str
    """

    line: NDArray[np.object_]
    ends: NDArray[np.int32]
    node_xy: Float
    node_id: Ints
    street: list[Street]
    width: Float
    walk: Float
    walk_source: NDArray[np.str_]
    material: NDArray[np.str_]
    material_source: NDArray[np.str_]
    marked: Bools
    uses: NDArray[np.object_]
    osm_id: NDArray[np.str_]

    def __len__(self) -> int:
        """Number of stretches."""
        return len(self.line)

    def take(self, keep: Bools) -> Carriageways:
        """The chosen stretches; nodes stay as they are."""
        columns = {
            f.name: getattr(self, f.name)[keep]
            for f in fields(self)
            if f.name not in ("node_xy", "node_id", "street")
        }
        return replace(self, **columns, street=[s for s, k in zip(self.street, keep, strict=True) if k])

    @property
    def place(self) -> NDArray[np.int8]:
        """0 on the ground, 1 on a bridge, 2 in a tunnel."""
        return np.array([place_of(bridge=s.bridge, tunnel=s.tunnel) for s in self.street], np.int8)

    @property
    def importance(self) -> Ints:
        """Rank of each stretch by its class: the higher wins where carriageways overlap."""
        ranks = {name: len(CLASSES) - k for k, name in enumerate(CLASSES)}
        return np.array([ranks.get(s.highway, 0) for s in self.street], np.int64)

    @property
    def layer(self) -> NDArray[np.int8]:
        """OSM layer of each stretch."""
        return np.array([s.layer for s in self.street], np.int8)


@dataclass(frozen=True, slots=True)
class _Kind:
    """Attributes that must be equal for two ways to be joined into one stretch."""

    street: Street
    walk: tuple[float, float]
    walk_source: tuple[str, str]
    material: tuple[str, str]
    marked: bool
    uses: LaneUses

    @property
    def symmetric(self) -> bool:
        return self.street.symmetric and self.walk[0] == self.walk[1] and self.uses.symmetric


def read_carriageways(
    osm: OsmData,
    frame: Frame,
    *,
    sidewalks: Literal["mapped", "urban"],
    left_hand: bool,
    walls: Walls | None = None,
) -> Carriageways:
    """The carriageways of a map.

    sidewalks : ``urban`` gives streets in built-up areas sidewalks where the map neither has a sidewalk tag
                nor a footway beside them
    left_hand : traffic keeps left
    walls     : of buildings that streets of unknown width yield to
    """
    ways, streets, _ = read_streets(osm, frame, private=True, left_hand=left_hand, walls=walls)
    kinds = [_read_kind(way, street, left_hand=left_hand) for way, street in zip(ways, streets, strict=True)]
    ignored: list[Problem] = []  # reported with the road graph
    runs, node_id, lonlat = read_runs(ways, ignored)
    chains = chains_of(runs, kinds, nodes=len(node_id))
    x, y = frame.from_geographic(lonlat[:, 0], lonlat[:, 1])
    xy = np.stack([x, y], axis=1)
    sizes = [len(chain.node) for chain in chains]
    lines = move_aside([xy[chain.node] for chain in chains], chains, ways=ways, streets=streets, frame=frame)
    places = np.concatenate(lines) if chains else np.empty((0, 2))
    line = shapely.linestrings(places, indices=np.repeat(np.arange(len(chains)), sizes))
    of = [kinds[chain.way[0]] for chain in chains]
    middle = shapely.get_coordinates(shapely.line_interpolate_point(line, 0.5, normalized=True))
    scale = frame.scale_at(middle[:, 0], middle[:, 1]) if chains else np.empty(0)
    table = Carriageways(
        line=np.asarray(line, object),
        ends=np.array([(c.node[0], c.node[-1]) for c in chains], np.int32).reshape(-1, 2),
        node_xy=xy,
        node_id=node_id,
        street=[kind.street for kind in of],
        width=np.array([kind.street.width for kind in of], float) * scale,
        walk=np.array([kind.walk for kind in of], float).reshape(-1, 2) * scale[:, None],
        walk_source=np.array([kind.walk_source for kind in of], "<U8").reshape(-1, 2),
        material=np.array([kind.material[0] for kind in of], "<U8"),
        material_source=np.array([kind.material[1] for kind in of], "<U8"),
        marked=np.array([kind.marked for kind in of], np.bool_),
        uses=np.fromiter((kind.uses for kind in of), object, len(of)),
        osm_id=np.array([ways[chain.way[0]].osm_id for chain in chains], np.str_),
    )
    return _guess_sidewalks(table, osm, frame=frame, urban=sidewalks == "urban", left_hand=left_hand)


def _read_kind(way: Way, street: Street, *, left_hand: bool) -> _Kind:
    walks = [_sidewalk(way.tags, side) for side in ("left", "right")]
    rough = street.highway == "track" and way.tags.get("tracktype") != "grade1"
    material = surface_material(way.tags, "gravel" if rough else "asphalt")
    markings = way.tags.get("lane_markings")
    main = street.highway.removesuffix("_link") in ("motorway", "trunk", "primary", "secondary", "tertiary")
    mapped = street.lanes_source == "lanes" and sum(street.lanes) >= 2 and street.highway != "service"
    marked = markings != "no" and (main or mapped or markings == "yes") and material[0] in PAVED
    painted = material[0] in PAVED and street.highway not in MINOR
    uses = read_lane_uses(way.tags, street, left_hand=left_hand) if painted else NO_USES
    return _Kind(street, (walks[0][0], walks[1][0]), (walks[0][1], walks[1][1]), material, marked, uses)


def _sidewalk(tags: Tags, side: str) -> tuple[float, str]:
    """Width of the sidewalk on a side and its source; ``?`` where it is not tagged."""
    value = tags.get(f"sidewalk:{side}", tags.get("sidewalk:both", tags.get("sidewalk")))
    if value is None:
        return 0.0, "?"
    if value in ("both", "yes", side):
        width = None
        for key in (f"sidewalk:{side}:width", "sidewalk:both:width", "sidewalk:width"):
            width = width or parse_length(tags.get(key))
        return (width if width and 0.5 <= width <= 15 else SIDEWALK), "sidewalk"
    return 0.0, ""


def _guess_sidewalks(
    table: Carriageways, osm: OsmData, *, frame: Frame, urban: bool, left_hand: bool
) -> Carriageways:
    """The table with widths for sidewalks that are not tagged."""
    unknown = table.walk_source == "?"
    walk, source = table.walk.copy(), np.where(unknown, "", table.walk_source)
    walked = np.array(
        [s.highway in _WALKED and max(s.speed) <= _BUILT_UP and not s.tunnel for s in table.street], np.bool_
    )
    rows = np.flatnonzero(walked & unknown.any(axis=1) & np.isin(table.material, list(PAVED)))
    if urban and len(rows):
        beside = _footway_beside(table, rows, osm=osm, frame=frame)
        # Of a divided road each half has its sidewalk on the outer side.
        divided = np.array([s.direction != 0 and s.highway in _WALKED[:2] for s in table.street], np.bool_)
        against = np.array([s.direction == -1 for s in table.street], np.bool_)
        for side in (0, 1):
            inner = divided & (((side == 0) != left_hand) ^ against)
            chosen = rows[unknown[rows, side] & ~beside[:, side] & ~inner[rows]]
            walk[chosen, side] = SIDEWALK
            source[chosen, side] = "default"
    return replace(table, walk=walk, walk_source=source)


def _footway_beside(table: Carriageways, rows: Ints, *, osm: OsmData, frame: Frame) -> Bools:
    """Whether a mapped footway runs along the left and the right of each stretch (len(rows), 2)."""
    found = np.zeros((len(rows), 2), np.bool_)
    lines = [
        np.stack(frame.from_geographic(*way.lonlat[np.isfinite(way.lonlat).all(axis=1)].T), axis=1)
        for way in osm.ways
        if way.tags.get("highway") in ("footway", "path", "pedestrian", "cycleway", "steps")
        and way.tags.get("footway") != "crossing"
    ]
    tree = shapely.STRtree([shapely.LineString(line) for line in lines if len(line) > 1])
    at = np.linspace(0.1, 0.9, 5)
    length = shapely.length(table.line[rows])
    here = shapely.get_coordinates(
        shapely.line_interpolate_point(table.line[rows][:, None], at, normalized=True)
    ).reshape(len(rows), len(at), 2)
    step = np.minimum(0.5 / np.maximum(length, 1.0), 0.05)[:, None]
    there = shapely.get_coordinates(
        shapely.line_interpolate_point(table.line[rows][:, None], at + step, normalized=True)
    ).reshape(len(rows), len(at), 2)
    way = there - here
    way /= np.maximum(np.linalg.norm(way, axis=2, keepdims=True), 1e-9)
    left = np.stack([-way[..., 1], way[..., 0]], axis=2)
    aside = (table.width[rows] / 2 + 3.0)[:, None, None]
    for side, sign in ((0, 1.0), (1, -1.0)):
        points = shapely.points((here + sign * aside * left).reshape(-1, 2))
        near = np.zeros(len(points), np.bool_)
        near[tree.query(points, predicate="dwithin", distance=5.0)[0]] = True
        found[:, side] = near.reshape(len(rows), len(at)).sum(axis=1) >= 2
    return found
