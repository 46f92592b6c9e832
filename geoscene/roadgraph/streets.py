"""The streets of a map: attributes of its ways, and where their carriageways lie beside the mapped lines."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, cast

import numpy as np
import shapely

from geoscene.geometry.frames import Frame
from geoscene.roadgraph.chains import RoadChain
from geoscene.roadgraph.lanes import street_lanes
from geoscene.roadgraph.tags import Street, drivable, read_street
from geoscene.roadgraph.values import Remarks, remark_several, remark_unreadable
from geoscene.roadgraph.walls import IN_CARRIAGEWAY, Walls, yield_to_walls
from geoscene.sources.data import OsmData, Tags, Way
from geoscene.typing import Float

_PLACE = re.compile(r"(left_of|middle_of|right_of):(\d+)")
_TRANSITION = "transition"


@dataclass(frozen=True, slots=True)
class _Place:
    """What of the lanes the line of a way marks (OSM wiki, Key:placement).

    lane : number from left to right, from 1, as seen in the direction ``side``: 0 along the way, 1 against it
    """

    edge: Literal["left_of", "middle_of", "right_of"]
    lane: int
    side: int


@dataclass(frozen=True, slots=True)
class _Placement:
    """Places at the start and at the end of a way, None for the middle of the carriageway or unknown ones.

    transition : unknown places are those of the ways before and after
    """

    places: tuple[_Place | None, _Place | None]
    transition: bool


def read_streets(
    osm: OsmData, frame: Frame, *, private: bool, left_hand: bool, walls: Walls | None = None
) -> tuple[list[Way], list[Street], list[tuple[str, Remarks]]]:
    """The ways of a map that carry vehicles, their streets, and remarks on tags by id of the way.

    private   : also the ways that are closed to the public
    left_hand : traffic keeps left
    walls     : of buildings that streets of unknown width yield to, which cuts their ways
    """
    ways = [way for way in osm.ways if drivable(way.tags, private=True)]
    found = [read_street(way.tags, left_hand=left_hand) for way in ways]
    streets, remarks = [street for street, _ in found], [remark for _, remark in found]
    for way, remark in zip(ways, remarks, strict=True):
        surface = way.tags.get("surface", "")
        if ";" in surface:
            remark_several(remark, "surface", text=surface, taken=surface.split(";", maxsplit=1)[0].strip())
    _set_aside(ways, streets, remarks=remarks, left_hand=left_hand)
    if walls is not None:
        ways, streets, remarks = yield_to_walls(ways, streets, remarks=remarks, walls=walls, frame=frame)
    kept = np.array([private or drivable(way.tags) for way in ways], np.bool_)
    own = [
        # A scene has the carriageways of private ways, too.
        remark if keep else [(reason, text) for reason, text in remark if reason == IN_CARRIAGEWAY]
        for remark, keep in zip(remarks, kept, strict=True)
    ]
    rows = np.flatnonzero(kept).tolist()
    reported = [(way.osm_id, remark) for way, remark in zip(ways, own, strict=True) if remark]
    return [ways[k] for k in rows], [streets[k] for k in rows], reported


def _set_aside(
    ways: Sequence[Way], streets: list[Street], *, remarks: Sequence[Remarks], left_hand: bool
) -> None:
    """Write the offsets of carriageways from the lines of their ways into the streets."""
    placed = {
        k: placement
        for k, way in enumerate(ways)
        if any(key.startswith("placement") for key in way.tags)
        and (placement := _read_placement(way.tags, streets[k], remarks=remarks[k])) is not None
    }
    at_node: dict[int, list[tuple[int, int]]] = {}
    for k in placed:
        for end in (0, 1):
            at_node.setdefault(int(ways[k].nodes[-end]), []).append((k, end))
    for k, placement in placed.items():
        aside = []
        for end, own in enumerate(placement.places):
            place = own
            if own is None and placement.transition:
                place = _place_beyond(at_node[int(ways[k].nodes[-end])], placed, way=k, end=end)
            metres = 0.0 if place is None else _aside(streets[k], place, left_hand=left_hand)
            if metres is None and own is not None:
                tag = f"{own.edge}:{own.lane}"
                remark_unreadable(remarks[k], "placement", text=tag, why="there is no such lane")
            aside.append(metres or 0.0)
        remarks[k][:] = dict.fromkeys(remarks[k])  # both ends may be wrong for one reason
        streets[k] = replace(streets[k], aside=(aside[0], aside[1]))


def _place_beyond(
    meeting: Sequence[tuple[int, int]], placed: dict[int, _Placement], *, way: int, end: int
) -> _Place | None:
    """The place of the way that a transition comes from or leads to, at one of its ends."""
    for other, other_end in meeting:
        place = placed[other].places[other_end]
        if other != way and place is not None:
            # Ways that both end or both begin here run against each other.
            return replace(place, side=1 - place.side) if other_end == end else place
    return None


def _read_placement(tags: Tags, street: Street, *, remarks: Remarks) -> _Placement | None:
    """The placement of a way, the first that can be read; None without one."""
    sides = ((0, ":forward"), (1, ":backward"))
    driven = [(side, suffix) for side, suffix in sides if street.direction != (-1 if side == 0 else 1)]
    # Without a direction, it is that of a one-way street, or along the way.
    keys = [*((side, f"placement{suffix}") for side, suffix in driven), (driven[0][0], "placement")]
    for side, key in keys:
        whole, start, end = (tags.get(f"{key}{part}", "") for part in ("", ":start", ":end"))
        if not (whole or start or end):
            continue
        own = _read_place(whole, side)
        places = [_read_place(text, side) if text else own for text in (start, end)]
        for name, text in ((key, whole), (f"{key}:start", start), (f"{key}:end", end)):
            if text not in ("", _TRANSITION) and _read_place(text, side) is None:
                remark_unreadable(remarks, name, text=text)
        return _Placement((places[0], places[1]), transition=whole == _TRANSITION)
    return None


def _read_place(text: str, side: int) -> _Place | None:
    match = _PLACE.fullmatch(text.strip())
    if match is None:
        return None
    edge = cast("Literal['left_of', 'middle_of', 'right_of']", match[1])
    return _Place(edge, int(match[2]), side)


def _aside(street: Street, place: _Place, *, left_hand: bool) -> float | None:
    """Metres that the middle of the carriageway is left of the way's line; None without the lane."""
    layout = street_lanes([street], np.array([street.width]), left_hand=left_hand)
    own, other, count = int(layout.own[0]), int(layout.other[0]), int(layout.count[0])
    lanes = own if place.side == 0 else other
    if not 1 <= place.lane <= lanes:
        return None
    from_kerb = place.lane - 1 if left_hand else lanes - place.lane
    borders: Float = layout.borders[0, : count + 1]
    if place.side == 1:
        borders = -borders[::-1]
    outer, inner = borders[from_kerb], borders[from_kerb + 1]  # towards the side that traffic keeps to
    right, left = (inner, outer) if left_hand else (outer, inner)
    at = {"left_of": left, "right_of": right, "middle_of": (left + right) / 2}[place.edge]
    # The line is ``at`` metres from the middle, towards the side that traffic keeps to.
    to_left = -at if left_hand else at  # as driven
    return float(to_left if place.side == 0 else -to_left)


def move_aside(
    lines: Sequence[Float],
    chains: Sequence[RoadChain],
    *,
    ways: Sequence[Way],
    streets: Sequence[Street],
    frame: Frame,
) -> list[Float]:
    """Lines (k, 2 or 3) of chains, moved from those of the map to the middles of carriageways; scene metres.

    A line keeps its vertices; its ends leave their nodes.

    streets : of the ways
    """
    moved = []
    for line, chain in zip(lines, chains, strict=True):
        if not any(any(streets[way].aside) for way in chain.way.tolist()):
            moved.append(line)
            continue
        metres = np.zeros(len(line))
        for way in dict.fromkeys(chain.way.tolist()):
            segments = np.flatnonzero(chain.way == way)
            rows = np.append(segments, segments[-1] + 1)
            metres[rows] = _metres_aside(line[rows, :2], ways[way], aside=streets[way].aside, frame=frame)
        moved.append(_moved(line, metres * frame.scale_at(line[:, 0], line[:, 1])))
    return moved


def _metres_aside(xy: Float, way: Way, *, aside: tuple[float, float], frame: Frame) -> Float:
    """Metres (k,) that points along a way move to the left, as seen from the first point to the last one."""
    mapped = shapely.linestrings(np.stack(frame.from_geographic(*way.lonlat.T), axis=1))
    share = shapely.line_locate_point(mapped, shapely.points(xy), normalized=True)
    metres: Float = aside[0] + (aside[1] - aside[0]) * share
    return metres if np.median(np.diff(share)) >= 0 else -metres


def _moved(line: Float, metres: Float) -> Float:
    """The line with every vertex moved to its left by metres (k,), with mitred corners."""
    step = np.diff(line[:, :2], axis=0)
    size = np.hypot(*step.T)
    drawn = np.flatnonzero(size > 1e-9)
    if not len(drawn):
        return line
    # Segments without length have the direction of the one before.
    which = drawn[np.maximum(np.searchsorted(drawn, np.arange(len(size)), side="right") - 1, 0)]
    unit = step[which] / size[which, None]
    normal = np.column_stack([-unit[:, 1], unit[:, 0]])
    before, after = np.vstack([normal[:1], normal]), np.vstack([normal, normal[-1:]])
    mitre = (before + after) / np.maximum(1 + (before * after).sum(axis=1), 0.5)[:, None]
    moved: Float = line.copy()
    moved[:, :2] += metres[:, None] * mitre
    return moved
