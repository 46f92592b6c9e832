"""Overhead lines in scenes with relief: power cables from pole to pole, and contact wires of tramways."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.geometry.frames import Frame
from geoscene.geometry.mesh import ShapeInstances
from geoscene.objects.shapes import shapes
from geoscene.roadgraph.tags import is_tunnel
from geoscene.sources.data import OsmData, Way
from geoscene.support.columns import Columns
from geoscene.typing import Bools, Float, Height

_CABLES = ((-0.35, 8.6), (0.0, 8.75), (0.35, 8.6))
"""Metres aside and above the ground of the cables of a minor line, at the top of a pole of 9 m: assumed."""

_CONTACT = 5.5
"""Metres of a contact wire above the rails: usual on streets (EN 50119 asks for 4.7 to 6.5)."""

_SAG = {"cable": 0.015, "contact": 0.003}
"""Sag in the middle of a span over its length: assumed; a cable of 40 m hangs through by 60 cm."""

_WIDTH = {"cable": 0.025, "contact": 0.014}
"""Diameters in metres: bundled low-voltage cables, a contact wire of 150 mm2."""

_SUPPORTS = 35.0
"""Metres between the supports of a contact wire: assumed."""

_SHORTEST, _LONGEST = 3.0, 150.0
"""Metres of spans; longer ones are gaps in the map's poles."""

_PIECES = 8
"""Straight pieces of a span that sags."""

_JOINT = 0.005
"""Metres by which a piece is longer at each end."""


@dataclass(frozen=True, slots=True)
class Wires(Columns):
    """Spans of overhead wires, one row each.

    start, end : (n, 3) scene metres, z above the ground
    kind    : (n,) str: ``cable`` or ``contact``
    osm_id  : (n,) str, of its way
    feature : (n,) int32: as read, consecutive
    """

    start: Float
    end: Float
    kind: NDArray[np.str_]
    osm_id: NDArray[np.str_]
    feature: NDArray[np.int32]

    @classmethod
    def of(cls, start: Float, end: Float, *, kind: str, osm_id: str) -> Wires:
        """Spans (n, 3) of one kind along one way."""
        n = len(start)
        return cls(start, end, np.full(n, kind), np.full(n, osm_id), np.zeros(n, np.int32))

    @property
    def lines(self) -> NDArray[np.object_]:
        """(n,) the spans in plan."""
        lines: NDArray[np.object_] = np.asarray(
            shapely.linestrings(np.stack([self.start, self.end], axis=1)[:, :, :2]), object
        ).reshape(-1)
        return lines


def read_wires(osm: OsmData, frame: Frame, *, extent: Sequence[float]) -> Wires:
    """The spans of minor power lines and of electrified tramways whose middle is within an extent.

    Cables run between neighbouring nodes of a line that are mapped as poles; three beside each other. A
    contact wire follows the track, with supports (which are not drawn) every 35 m. Left out are lines under
    the ground and tracks in tunnels.
    """
    poles = [
        int(point.osm_id.removeprefix("node/"))
        for point in osm.points
        if point.tags.get("power") == "pole" or point.tags.get("man_made") == "utility_pole"
    ]
    parts = []
    for way in osm.ways:
        kind = _kind(way)
        if kind is None or len(way.lonlat) < 2:
            continue
        line = np.column_stack(frame.from_geographic(*way.lonlat.T))
        if kind == "cable":
            parts += _cables(line, way.osm_id, at_pole=np.isin(way.nodes, poles))
        else:
            parts += _contact(line, way.osm_id)
    none = Wires.of(np.empty((0, 3)), np.empty((0, 3)), kind="", osm_id="")
    spans = Wires.concatenate([none, *parts])
    middle = (spans.start + spans.end)[:, :2] / 2
    length = np.hypot(*(spans.end - spans.start)[:, :2].T)
    inside = ((middle >= extent[:2]) & (middle < extent[2:])).all(axis=1)
    spans = spans.take(inside & (length <= _LONGEST))
    return replace(spans, feature=np.arange(len(spans), dtype=np.int32))


def _kind(way: Way) -> str | None:
    """Kind of the wires along a way, None without."""
    tags = way.tags
    if tags.get("power") == "minor_line":
        below = "underground" in (tags.get("location"), tags.get("position"))
        return None if below or is_tunnel(tags) else "cable"
    powered = tags.get("electrified", "contact_line" if tags.get("railway") == "tram" else "no")
    if tags.get("railway") in {"tram", "light_rail"} and powered == "contact_line" and not is_tunnel(tags):
        return "contact"
    return None


def _cables(line: Float, osm_id: str, *, at_pole: Bools) -> list[Wires]:
    """Three cables from pole to pole of a line (n, 2)."""
    course = np.diff(line, axis=0)
    length = np.hypot(*course.T)
    keep = (length >= _SHORTEST) & at_pole[:-1] & at_pole[1:]
    a, b, along = line[:-1][keep], line[1:][keep], course[keep] / length[keep, None]
    aside = along @ np.array([[0.0, 1.0], [-1.0, 0.0]])
    return [
        Wires.of(
            *(np.insert(end + shift * aside, 2, z, axis=1) for end in (a, b)), kind="cable", osm_id=osm_id
        )
        for shift, z in _CABLES
    ]


def _contact(line: Float, osm_id: str) -> list[Wires]:
    """A contact wire over a track (n, 2), straight between supports and pulled off at bends of the track."""
    track = shapely.segmentize(shapely.simplify(shapely.LineString(line), 0.3), _SUPPORTS)
    points = np.insert(shapely.get_coordinates(track), 2, _CONTACT, axis=1)
    return [Wires.of(points[:-1], points[1:], kind="contact", osm_id=osm_id)]


def wire_instances(wires: Wires, *, height: Height | None = None) -> ShapeInstances:
    """Straight pieces of the shape ``wire`` along each span, which hangs as a parabola, scene coordinates.

    Each reaches 5 mm into the next, so that they do not meet in common edges.

    height : z of the ground at x, y; None if it is 0 everywhere
    """
    start, end = wires.start.copy(), wires.end.copy()
    if height is not None:
        start[:, 2] += height(*start[:, :2].T)
        end[:, 2] += height(*end[:, :2].T)
    share = np.linspace(0.0, 1.0, _PIECES + 1)
    points = start[:, None] + share[:, None] * (end - start)[:, None]  # (n, pieces + 1, 3)
    sag = np.array([_SAG[str(kind)] for kind in wires.kind]) * np.hypot(*(end - start)[:, :2].T)
    points[:, :, 2] -= sag[:, None] * (4 * share * (1 - share))
    a, b = points[:, :-1].reshape(-1, 3), points[:, 1:].reshape(-1, 3)
    width = np.repeat([_WIDTH[str(kind)] for kind in wires.kind], _PIECES)[:, None]
    along = b - a
    aside = np.column_stack([-along[:, 1], along[:, 0], np.zeros(len(a))])
    aside /= np.hypot(*aside[:, :2].T)[:, None]
    above = np.cross(along, aside)
    above /= np.linalg.norm(above, axis=1)[:, None]
    more = _JOINT * along / np.linalg.norm(along, axis=1)[:, None]
    transform = np.stack([along + 2 * more, width * aside, width * above, a - more], axis=2)
    number = list(shapes(with_relief=True)).index("wire")
    return ShapeInstances(np.full(len(a), number, np.int32), transform, np.repeat(wires.feature, _PIECES))
