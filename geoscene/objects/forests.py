"""Trees of forests: stored as the ground below them, and placed when a tile is read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely

from geoscene.classes import Class
from geoscene.geometry.mesh import Mesh, ShapeInstances
from geoscene.objects.vegetation import CROWN, HEIGHT, TRUNK, Trees, tree_instances
from geoscene.support.splitmix import uniform_at
from geoscene.typing import Bools, Float, Ints

if TYPE_CHECKING:
    from geoscene.ground.layers import Layers
    from geoscene.sources.data import OsmData

_ROOM = 0.5
"""Metres of forest floor that a trunk needs on all sides."""

_SHARES = {"needleleaved": 1.0, "coniferous": 1.0, "mixed": 0.5}
"""Share of needle-leaved trees by ``leaf_type`` or ``wood``; 0 for other values and without."""


@dataclass(frozen=True, slots=True)
class Forests:
    """Parameters from which forest trees are generated on their ground.

    feature : (k,) int64, forests with needle-leaved trees, by feature number, ascending
    needles : (k,) float64, their share of needle-leaved trees
    with_relief : trees have habits
    density : trees per m2; 0.02 (200 to the hectare) is a closed stand of grown trees
    seed    : of places, sizes and forms
    """

    feature: Ints
    needles: Float
    with_relief: bool = False
    density: float = 0.02
    seed: int = 0

    @classmethod
    def of(cls, layers: Layers, osm: OsmData, *, with_relief: bool = False) -> Forests:
        """The forests among the layers of a ground."""
        kinds = {area.osm_id: area.tags.get("leaf_type", area.tags.get("wood", "")) for area in osm.areas}
        share = np.array([_SHARES.get(kinds.get(name, ""), 0.0) for name in layers.osm_id.tolist()], float)
        rows = np.flatnonzero((layers.klass == Class.FOREST_FLOOR) & (share > 0))
        return cls(layers.feature[rows].astype(np.int64), share[rows], with_relief)

    @classmethod
    def from_json(cls, document: Mapping[str, Any]) -> Forests:
        """The inverse of `to_json`."""
        shares = document["needleleaved_share"]
        feature = np.array([int(name) for name in shares], np.int64)
        needles = np.array(list(shares.values()), float)
        with_relief = bool(document.get("relief", False))
        return cls(feature, needles, with_relief, float(document["trees_per_m2"]), int(document["seed"]))

    def to_json(self) -> dict[str, Any]:
        """The document that a scene's manifest contains."""
        shares = dict(zip(map(str, self.feature.tolist()), self.needles.tolist(), strict=True))
        document = {"trees_per_m2": self.density, "seed": self.seed, "needleleaved_share": shares}
        return document | ({"relief": True} if self.with_relief else {})


def forest_trees(ground: Mesh, forests: Forests, *, box: Sequence[float]) -> tuple[Trees, Float]:
    """Trees of forests on a tile's ground, and the height z (n,) of the ground below them.

    One in each square of 1 / density m2 where its trunk is on forest floor, half a metre or more from any
    other ground of the tile. Place, size and form are drawn from (seed, column, row) of a lattice over the
    plane, so that a tree depends neither on tiles nor on other forests. Its feature is that of its forest.

    ground : faces in scene coordinates; those that are no forest floor are left out
    box    : (xmin, ymin, xmax, ymax) of the tile, scene metres; trees beyond are left out
    """
    floor = ground.take(ground.klass == Class.FOREST_FLOOR)
    xy, draw, face = _places(floor, forests, box=box)
    feature = floor.feature[face].astype(np.int64)
    share, widest = _needle_shares(forests, feature), 1.2 * _spacing(forests)
    trees = _sample(xy, draw, feature=feature, share=share, widest=widest, with_relief=forests.with_relief)
    return trees, _heights(floor.vertices[floor.faces[face]], xy)


def forest_tree_count(ground: Mesh, forests: Forests, *, box: Sequence[float]) -> int:
    """The number of `forest_trees`, which are not made."""
    is_floor = ground.klass == Class.FOREST_FLOOR
    return len(_places(ground.take(is_floor), forests, box=box)[0]) if is_floor.any() else 0


def forest_instances(ground: Mesh, forests: Forests, *, box: Sequence[float]) -> ShapeInstances:
    """The trees of `forest_trees` as copies of shapes, scene coordinates."""
    trees, z = forest_trees(ground, forests, box=box)
    return tree_instances(trees, height=lambda *_: z)


def _spacing(forests: Forests) -> float:
    """Side in metres of the squares with one tree each."""
    return float(1.0 / np.sqrt(forests.density))


def _places(floor: Mesh, forests: Forests, *, box: Sequence[float]) -> tuple[Float, Float, Ints]:
    """Places (n, 2) of trees, random numbers (4, n) of each, and the face of the floor (n,) below."""
    side, corners = _spacing(forests), floor.vertices[floor.faces]
    column, row = _squares(corners, side, box=box)
    draw = uniform_at(column, row, count=4, seed=forests.seed)
    xy = np.column_stack([(column + 0.1 + 0.8 * draw[0]) * side, (row + 0.1 + 0.8 * draw[1]) * side])
    face = _faces_under(corners, xy, box=box)
    face[_near_an_edge(floor, xy, box=box)] = -1
    stands = face >= 0
    return xy[stands], draw[:, stands], face[stands]


def _squares(corners: Float, side: float, *, box: Sequence[float]) -> tuple[Ints, Ints]:
    """Column and row (n,) of the lattice's squares within the bounds of faces and a box."""
    low = np.maximum(corners[:, :, :2].min(axis=(0, 1), initial=np.inf), box[:2])
    high = np.minimum(corners[:, :, :2].max(axis=(0, 1), initial=-np.inf), box[2:])
    if not (low < high).all():
        return np.empty(0, np.int64), np.empty(0, np.int64)
    ranges = [np.arange(a, b) for a, b in zip(np.floor(low / side), np.ceil(high / side), strict=True)]
    column, row = (grid.ravel().astype(np.int64) for grid in np.meshgrid(*ranges))
    return column, row


def _faces_under(corners: Float, xy: Float, *, box: Sequence[float]) -> Ints:
    """The face (n,) under each point (n, 2) in the box, the first of several; -1 without."""
    face = np.full(len(xy), -1, np.int64)
    inside = np.flatnonzero(((xy >= box[:2]) & (xy < box[2:])).all(axis=1))
    tree = shapely.STRtree(shapely.polygons(corners[:, :, :2]))
    point, under = tree.query(shapely.points(xy[inside]), predicate="intersects")
    order = np.lexsort((-under, point))
    face[inside[point[order]]] = under[order]  # of equal points the last one stays
    return face


def _near_an_edge(floor: Mesh, xy: Float, *, box: Sequence[float]) -> Bools:
    """Whether points (n, 2) are too near to where the forest floor ends, other than at the tile's sides."""
    edges = np.sort(floor.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2).astype(np.int64))
    _, first, uses = np.unique(edges @ (len(floor.vertices), 1), return_index=True, return_counts=True)
    ends = floor.vertices[edges[first[uses == 1]], :2]
    low, high = ((ends == side).all(axis=1).any(axis=1) for side in (np.array(box[:2]), np.array(box[2:])))
    tree = shapely.STRtree(shapely.linestrings(ends[~(low | high)]))
    near = np.zeros(len(xy), np.bool_)
    near[tree.query(shapely.points(xy), predicate="dwithin", distance=_ROOM)[0]] = True
    return near


def _needle_shares(forests: Forests, feature: Ints) -> Float:
    """Share (n,) of needle-leaved trees in the forests of features (n,)."""
    known, share = np.append(forests.feature, np.iinfo(np.int64).max), np.append(forests.needles, 0.0)
    place = np.searchsorted(known, feature)
    return np.where(known[place] == feature, share[place], 0.0)


def _sample(
    xy: Float, draw: Float, *, feature: Ints, share: Float, widest: float, with_relief: bool
) -> Trees:
    """Trees at places (n, 2) with size and form by random numbers (4, n)."""
    n, needled = len(xy), draw[3] < share
    height = np.where(needled, HEIGHT["needleleaved"], HEIGHT["broadleaved"]) * (0.8 + 0.4 * draw[2])
    crown = height * np.where(needled, CROWN["needleleaved"], CROWN["broadleaved"])
    return Trees(
        xy,
        height,
        np.minimum(crown, widest),  # the spacing limits the crown
        height * TRUNK,
        np.where(needled, "needleleaved", "broadleaved"),
        np.where(needled, "conical", "ovoid") if with_relief else np.full(n, ""),
        np.full(n, "sampled"),
        np.full(n, "height"),
        np.where(share > 0, "leaf_type", "default"),
        np.full(n, "form" if with_relief else ""),
        np.full(n, "sampled"),
        np.zeros(n),
        np.full(n, ""),
        feature.astype(np.int32),
    )


def _heights(corners: Float, xy: Float) -> Float:
    """Height (n,) of each face (n, 3, 3) at a point (n, 2)."""
    a = corners[:, 0]
    u, v = corners[:, 1] - a, corners[:, 2] - a
    p = xy - a[:, :2]
    area = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
    along = (p[:, 0] * v[:, 1] - p[:, 1] * v[:, 0]) / area
    across = (u[:, 0] * p[:, 1] - u[:, 1] * p[:, 0]) / area
    z: Float = a[:, 2] + along * u[:, 2] + across * v[:, 2]
    return z
