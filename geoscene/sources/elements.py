"""Nodes, ways and relations of a map as columns, before features are built from them."""

from __future__ import annotations

from array import array
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from geoscene.sources.data import Tags
from geoscene.typing import Bools, Float, Ints

Members = tuple[tuple[str, int, str], ...]

UNITS = 10_000_000
"""Coordinate units per degree: OpenStreetMap stores integers of 1e-7 degrees."""

UNKNOWN = 2**31 - 1
"""Value of a missing coordinate."""


@dataclass(frozen=True, slots=True)
class Elements:
    """Nodes, ways and relations, each sorted by unique id, independent of the order in the file.

    node_id   : (n,) int64
    node_xy   : (n, 2) int32, longitude and latitude in 1e-7 degrees, within range
    node_tags : tags of tagged nodes, by id
    way_id    : (w,) int64
    way_start : (w + 1,) int64, way i refers to ``ref[way_start[i] : way_start[i + 1]]``
    way_closed : (w,) bool, whether the first and last reference are the same node, even if it is missing
    way_tags  : tags of each way
    ref       : (r,) int64, node index, or -1 for a missing node
    relations : (id, tags, members)
    bounds    : (west, south, east, north) degrees as stated by the source, or None
    timestamp : ISO 8601 or ""
    misplaced : ids of nodes whose coordinates were missing or out of range
    """

    node_id: Ints
    node_xy: NDArray[np.int32]
    node_tags: dict[int, Tags]
    way_id: Ints
    way_start: Ints
    way_closed: Bools
    way_tags: list[Tags]
    ref: Ints
    relations: list[tuple[int, Tags, Members]]
    bounds: tuple[float, float, float, float] | None
    timestamp: str
    misplaced: Ints

    def chain(self, way: int) -> Ints:
        """(k,) node indices of the way in row ``way``, -1 for missing nodes."""
        return self.ref[self.way_start[way] : self.way_start[way + 1]]

    def lonlat(self, nodes: Ints) -> Float:
        """Longitude and latitude (k, 2) of nodes by index, degrees."""
        return self.node_xy[nodes] / UNITS


def _last_of_each(ids: Ints) -> Ints:
    """Indices that sort ``ids``; of equal ids only the last."""
    order = np.argsort(ids, kind="stable")
    ordered = ids[order]
    last = np.ones(len(ids), bool)
    last[:-1] = ordered[1:] != ordered[:-1]
    return order[last]


@dataclass(slots=True)
class Collector:
    """Collects map objects one by one, in any order; `finish` returns them as `Elements`.

    Of objects with the same id the last counts.
    """

    bounds: tuple[float, float, float, float] | None = None
    timestamp: str = ""
    _node_id: array[int] = field(default_factory=lambda: array("q"))
    _node_x: array[int] = field(default_factory=lambda: array("i"))
    _node_y: array[int] = field(default_factory=lambda: array("i"))
    _node_tags: dict[int, Tags] = field(default_factory=dict)
    _way_id: array[int] = field(default_factory=lambda: array("q"))
    _way_size: array[int] = field(default_factory=lambda: array("q"))
    _way_tags: list[Tags] = field(default_factory=list)
    _refs: array[int] = field(default_factory=lambda: array("q"))
    _relations: dict[int, tuple[Tags, Members]] = field(default_factory=dict)

    def __len__(self) -> int:
        """Number of objects added."""
        return len(self._node_id) + len(self._way_id) + len(self._relations)

    def node(self, osm_id: int, x: int, *, y: int, tags: Tags | None) -> None:
        """Add a node at ``x``, ``y`` (longitude, latitude in 1e-7 degrees, `UNKNOWN` if missing)."""
        self._node_id.append(osm_id)
        self._node_x.append(x)
        self._node_y.append(y)
        if tags:
            self._node_tags[osm_id] = tags

    def nodes(self, ids: Ints, *, x: NDArray[np.int32], y: NDArray[np.int32]) -> None:
        """Add nodes (n,) as `node`, without tags."""
        self._node_id.frombytes(np.ascontiguousarray(ids, np.int64).tobytes())
        self._node_x.frombytes(np.ascontiguousarray(x, np.int32).tobytes())
        self._node_y.frombytes(np.ascontiguousarray(y, np.int32).tobytes())

    def node_tags(self, osm_id: int, tags: Tags) -> None:
        """Add the tags of a node."""
        self._node_tags[osm_id] = tags

    def way(self, osm_id: int, refs: Iterable[int], *, tags: Tags) -> None:
        """Add a way by its node ids."""
        before = len(self._refs)
        self._refs.extend(refs)
        self._way_id.append(osm_id)
        self._way_size.append(len(self._refs) - before)
        self._way_tags.append(tags)

    def relation(self, osm_id: int, tags: Tags, *, members: Members) -> None:
        """Add a relation."""
        self._relations[osm_id] = (tags, members)

    def has_drawn_nodes(self) -> bool:
        """Whether tags or ways refer to nodes with negative ids, which are not in OpenStreetMap yet."""
        refs = np.array(self._refs, np.int64)
        return bool((refs < 0).any()) or min(self._node_tags, default=0) < 0

    def clashing(self, other: Collector) -> str:
        """A node or way with a negative id that differs between both, such as ``node/-3``; "" if none does.

        Editors number objects that are not in OpenStreetMap yet by negative ids, each file by itself.
        """
        for kind in ("node", "way"):
            mine, theirs = self._drawn(kind), other._drawn(kind)
            for osm_id in sorted(mine.keys() & theirs.keys()):
                if mine[osm_id] != theirs[osm_id]:
                    return f"{kind}/{osm_id}"
        return ""

    def _drawn(self, kind: str) -> dict[int, object]:
        """Positions of nodes or tags of ways with negative ids, by id."""
        if kind == "way":
            return {i: tags for i, tags in zip(self._way_id, self._way_tags, strict=True) if i < 0}
        places = zip(self._node_id, self._node_x, self._node_y, strict=True)
        return {i: (x, y) for i, x, y in places if i < 0}

    def joined(self, other: Collector) -> Collector:
        """Objects of both; of objects with the same id those of ``other``."""
        boxes = [bounds for bounds in (self.bounds, other.bounds) if bounds is not None]
        edges = list(zip(*boxes, strict=True))
        return Collector(
            (min(edges[0]), min(edges[1]), max(edges[2]), max(edges[3])) if boxes else None,
            max(self.timestamp, other.timestamp),
            self._node_id + other._node_id,
            self._node_x + other._node_x,
            self._node_y + other._node_y,
            self._node_tags | other._node_tags,
            self._way_id + other._way_id,
            self._way_size + other._way_size,
            self._way_tags + other._way_tags,
            self._refs + other._refs,
            self._relations | other._relations,
        )

    def finish(self) -> Elements:
        """All objects, sorted by id, with resolved node references."""
        ids = np.frombuffer(self._node_id, np.int64) if self._node_id else np.empty(0, np.int64)
        keep = _last_of_each(ids)
        ids = ids[keep]
        xy = np.empty((len(ids), 2), np.int32)
        for column, values in enumerate((self._node_x, self._node_y)):
            xy[:, column] = np.frombuffer(values, np.int32)[keep] if values else 0
        placed = (np.abs(xy.astype(np.int64)) <= (180 * UNITS, 90 * UNITS)).all(axis=1)
        misplaced, ids, xy = ids[~placed], ids[placed], xy[placed]

        way_id = np.array(self._way_id, np.int64)
        rows = _last_of_each(way_id)
        sizes = np.array(self._way_size, np.int64)
        starts = np.concatenate([[0], np.cumsum(sizes)])
        new_starts = np.concatenate([[0], np.cumsum(sizes[rows])])
        picked = np.arange(new_starts[-1]) + np.repeat(starts[rows] - new_starts[:-1], sizes[rows])
        refs = np.array(self._refs, np.int64)[picked]
        closed = sizes[rows] > 1
        closed[closed] = refs[new_starts[:-1][closed]] == refs[new_starts[1:][closed] - 1]
        if len(ids):
            place = np.minimum(np.searchsorted(ids, refs), len(ids) - 1)
            index = np.where(ids[place] == refs, place, -1)
        else:
            index = np.full(len(refs), -1)
        gone = set(misplaced.tolist())
        return Elements(
            node_id=ids,
            node_xy=xy,
            node_tags={i: self._node_tags[i] for i in sorted(self._node_tags) if i not in gone},
            way_id=way_id[rows],
            way_start=new_starts,
            way_closed=closed,
            way_tags=[self._way_tags[i] for i in rows.tolist()],
            ref=index.astype(np.int64),
            relations=[(i, *self._relations[i]) for i in sorted(self._relations)],
            bounds=self.bounds,
            timestamp=self.timestamp,
            misplaced=misplaced,
        )
