"""Contents of a page: layers with inferred appearance, tables of attributes, grid of degrees, boxes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import Class, class_codes, materials
from geoscene.errors import InputError
from geoscene.export.kinds import compact_json, plain
from geoscene.export.objects import FeatureAttributes, read_features
from geoscene.geometry.frames import Frame
from geoscene.geometry.mesh import Mesh
from geoscene.options import Degrees
from geoscene.scene import Scene
from geoscene.scene.tile_files import Tile
from geoscene.typing import Bools, Float, Ints
from geoscene.view.assembly import gzip
from geoscene.view.looks import read_looks
from geoscene.view.tiles import Groups, groups_of, only, pack_shapes, pack_tile

Rows = Ints
ACCURACY = 0.01
"""Largest error of the interpolation in metres."""

_MOST = 129

_BOX_STEP = 0.01
"""Quantisation step of boxes of features in metres, outwards."""

_BUSY = 0.9
"""Share of the things along each axis that the first view shows."""


def tables(features: FeatureAttributes, present: Bools) -> list[dict[str, Any]]:
    """One table per layer with the features in the page, in the layers' order, empty ones left out.

    present : (n,) bool by feature number: it has faces or copies in the page

    Parts come with their building, road edges with the surfaces made from the same OSM ways. A table has
    ``layer``, ``feature`` numbers and ``columns``: a list of values (null for none) or, for text,
    ``words`` and the index of each row's among them (-1 for none).
    """
    out = []
    for number, layer in enumerate(features.layers):
        columns = features.columns[number]
        own = features.numbers[number]
        rows = _chosen(layer, columns, own=present[own], features=features, present=present)
        if len(rows):
            encoded = {name: _column(values[rows]) for name, values in columns.items()}
            out.append({"layer": layer, "feature": own[rows].tolist(), "columns": encoded})
    return out


def _chosen(
    layer: str, columns: dict[str, NDArray[Any]], *, own: Bools, features: FeatureAttributes, present: Bools
) -> Rows:
    """Rows of a layer that are in the page, or belong to a feature that is."""
    keep = own.copy()
    if layer == "building_parts" and "buildings" in features.layers:
        start = int(features.starts[features.layers.index("buildings")])
        keep |= present[start + columns["building"].astype(np.int64)]
    if layer == "roads" and "road_surfaces" in features.layers:
        number = features.layers.index("road_surfaces")
        ids = _text(features.columns[number]["osm_id"])
        known = {way for text in ids[present[features.numbers[number]]] for way in text.split(";")}
        keep |= np.array([not known.isdisjoint(text.split(";")) for text in _text(columns["osm_id"])])
    return np.flatnonzero(keep)


def _text(values: NDArray[Any]) -> NDArray[np.object_]:
    """Text of a column, "" for none."""
    return np.array(["" if v is None else str(v) for v in values], object)


def _column(values: NDArray[Any]) -> Any:
    if values.dtype.kind in "OU":
        words, index = np.unique(_text(values).astype(str), return_inverse=True)
        empty = int(words[0] == "")
        return {"words": words[empty:].tolist(), "index": (index.ravel() - empty).tolist()}
    if values.dtype.kind == "f":
        values = np.round(values, 4) + 0.0  # no minus zero
    return [plain(value) for value in values]


@dataclass(frozen=True, slots=True)
class LonLatGrid:
    """Degrees at the nodes of a grid over a rectangle; bilinear between them.

    bounds : (xmin, ymin, xmax, ymax) in scene metres
    lon, lat : (n, n) degrees, rows from south to north
    error  : metres, the largest found between nodes
    """

    bounds: tuple[float, float, float, float]
    lon: Float
    lat: Float
    error: float

    def at(self, x: Float, y: Float) -> tuple[Float, Float]:
        """Longitude and latitude in degrees of scene coordinates."""
        xmin, ymin, xmax, ymax = self.bounds
        last = len(self.lon) - 1
        u, v = (x - xmin) / (xmax - xmin) * last, (y - ymin) / (ymax - ymin) * last
        i, j = (np.clip(np.floor(w), 0, last - 1).astype(int) for w in (u, v))
        u, v = u - i, v - j
        weights = ((1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v)
        nodes = ((j, i), (j, i + 1), (j + 1, i), (j + 1, i + 1))
        lon, lat = (
            sum(w * grid[n] for w, n in zip(weights, nodes, strict=True)) for grid in (self.lon, self.lat)
        )
        return lon, lat


def lonlat_grid(frame: Frame, bounds: tuple[float, float, float, float]) -> LonLatGrid:
    """The coarsest grid of 2^k + 1 nodes a side that is within `ACCURACY`, or one of 129, with its error.

    The error is taken at the middles of cells and of their sides, where a bilinear patch is furthest from a
    quadratic one.
    """
    xmin, ymin, xmax, ymax = bounds
    n = 2
    while True:
        fine = np.linspace(0, 1, 2 * n - 1)
        x, y = np.meshgrid(xmin + (xmax - xmin) * fine, ymin + (ymax - ymin) * fine)
        lon, lat = (np.asarray(v, float) for v in frame.to_geographic(x, y))
        # Nine decimals of a degree are 0.1 mm; across the date line degrees must not jump.
        lon, lat = np.round(lon[0, 0] + (lon - lon[0, 0] + 180) % 360 - 180, 9), np.round(lat, 9)
        grid = LonLatGrid(bounds, lon[::2, ::2], lat[::2, ::2], 0.0)
        there = frame.from_geographic(*grid.at(x, y))
        error = float(np.hypot(there[0] - x, there[1] - y).max())
        if error <= ACCURACY or n >= _MOST:
            return LonLatGrid(bounds, grid.lon, grid.lat, error)
        n = 2 * n - 1


class PageContents:
    """The chosen layers of a scene as a page shows them; tiles are read one by one, and counted meanwhile.

    Raises InputError for an unknown layer.
    """

    def __init__(self, scene: Scene, layers: Sequence[str]) -> None:
        self.scene = scene
        self.groups = groups_of(scene)
        self.kept = _kept(self.groups, layers)
        self.looks = read_looks(scene)
        self.shapes = list(scene.shapes().values())
        self.faces = 0
        self.tiles: list[tuple[tuple[int, int], Float, Float, float]] = []
        count = len(self.groups.of) - 1
        self._low = np.full((count, 3), np.inf)
        self._high = np.full((count, 3), -np.inf)
        self._corners = np.array([_corners(mesh) for mesh in self.shapes]).reshape(-1, 8, 3)

    def tile(self, i: int, j: int) -> Tile:
        """A tile as the page shows it."""
        tile = self.looks.dressed(only(self.scene.tile(i, j), self.groups, kept=self.kept))
        mesh, copies = tile.mesh, tile.instances
        self._grow(mesh.feature, mesh.vertices[mesh.faces] + tile.origin)
        corners = self._corners[copies.shape]
        moved = np.einsum("kij,kcj->kci", copies.transform[:, :, :3], corners)
        self._grow(copies.feature, moved + (copies.transform[:, :, 3] + tile.origin)[:, None])
        self.faces += len(mesh)
        points = np.concatenate([mesh.vertices, copies.transform[:, :, 3]]) + tile.origin
        low, high = (points.min(axis=0), points.max(axis=0)) if len(points) else (tile.origin, tile.origin)
        bare = np.count_nonzero(self.groups.faces(mesh) == 0) + np.count_nonzero(
            self.groups.of[copies.feature] == 0
        )
        self.tiles.append(((i, j), np.floor(low), np.ceil(high), float(len(mesh) + len(copies) - bare)))
        return tile

    def pack(self, tile: Tile) -> tuple[dict[str, Any], bytes]:
        """Header and bytes of a tile; see `pack_tile`."""
        return pack_tile(tile, self.groups, facades=self.looks.facades_of(tile.mesh))

    @property
    def present(self) -> Bools:
        """(n,) bool by feature number: it has faces or copies in the tiles that were read."""
        return self._low[:, 0] <= self._high[:, 0]

    @property
    def left_out(self) -> list[str]:
        """Names of the groups that are not shown."""
        return [name for name, keep in zip(self.groups.names, self.kept, strict=True) if not keep]

    def attributes(self) -> bytes:
        """The tables of the features that are present, compressed."""
        return gzip(compact_json(tables(self.looks.told(read_features(self.scene)), self.present)))

    def boxes(self) -> bytes:
        """Boxes of the features that are present, compressed.

        Columns of int32: feature numbers, then x, y, z of the low corners and of the high ones in cm.
        """
        feature = np.flatnonzero(self.present)
        low = np.floor(self._low[feature] / _BOX_STEP - 1e-6)
        high = np.ceil(self._high[feature] / _BOX_STEP + 1e-6)
        return gzip(b"".join(c.astype("<i4").tobytes() for c in (feature, *low.T, *high.T)))

    def head(self, **more: Any) -> tuple[dict[str, Any], bytes]:
        """Header that the viewer needs, and the bytes of the shapes that are copied."""
        scene = self.scene
        low = np.min([low for _, low, _, _ in self.tiles], axis=0).tolist()
        high = np.max([high for _, _, high, _ in self.tiles], axis=0).tolist()
        bounds = (low[0], low[1], high[0], high[1])
        grid = lonlat_grid(scene.frame, bounds)
        middle = scene.frame.to_geographic((bounds[0] + bounds[2]) / 2, (bounds[1] + bounds[3]) / 2)
        colors = class_codes().color.tolist()
        shapes, data = pack_shapes(self.shapes)
        return {
            "name": scene.manifest.get("name") or scene.path.name,
            "frame": scene.frame.name,
            "vertical": scene.frame.vertical,
            "low": low,
            "high": high,
            "busy": self._busy(),
            "convergence": round(float(scene.frame.convergence(*middle)), 9),
            "lonlat": {
                "bounds": bounds,
                "lon": grid.lon.tolist(),
                "lat": grid.lat.tolist(),
                "error": float(f"{grid.error:.2g}"),
            },
            "region": self.looks.region,
            "groups": self.groups.names,
            "features": len(self.groups.of) - 1,
            "classes": {int(code): [code.name.lower(), colors[code]] for code in Class},
            "materials": {
                material.code: [material.name, material.color, material.reflectance]
                for material in materials().values()
            },
            "shapes": shapes,
            **more,
        }, data

    def _busy(self) -> dict[str, list[float]]:
        """Bounding box of the tiles with objects: the middle of all but bare ground, along either axis."""
        weight = np.array([w for *_, w in self.tiles])
        low, high = (np.array([tile[k] for tile in self.tiles], float) for k in (1, 2))
        box = [low.min(axis=0), high.max(axis=0)]
        if weight.any():
            index = np.array([tile[0] for tile in self.tiles])
            for axis in (0, 1):
                order = np.argsort(index[:, axis], kind="stable")
                for side, rows, corner in ((0, order, low), (1, order[::-1], high)):
                    reached = np.cumsum(weight[rows]) >= (1.0 - _BUSY) / 2 * weight.sum()
                    box[side][axis] = corner[rows[int(np.argmax(reached))], axis]
        return {"low": box[0].tolist(), "high": box[1].tolist()}

    def _grow(self, feature: NDArray[np.int32], points: Float) -> None:
        """Extend the boxes of features (k,) by their points (k, p, 3)."""
        own = np.flatnonzero(feature >= 0)
        if not len(own):
            return
        order = own[np.argsort(feature[own], kind="stable")]
        numbers, start = np.unique(feature[order], return_index=True)
        low = np.minimum.reduceat(points[order].min(axis=1), start)
        high = np.maximum.reduceat(points[order].max(axis=1), start)
        self._low[numbers] = np.minimum(self._low[numbers], low)
        self._high[numbers] = np.maximum(self._high[numbers], high)


def _kept(groups: Groups, layers: Sequence[str]) -> Bools:
    """Groups (n,) to include in the page."""
    if unknown := sorted(set(layers) - set(groups.names)):
        raise InputError(f"`layers`: no {', '.join(unknown)} in the scene; it has {', '.join(groups.names)}")
    return np.array([not layers or name in layers for name in groups.names])


def _corners(mesh: Mesh) -> Float:
    """Corners (8, 3) of the box of a mesh."""
    box = np.array([mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)])
    pick = np.array(list(np.ndindex(2, 2, 2)))
    corners: Float = np.take_along_axis(box, pick, axis=0)
    return corners


def tiles_within(scene: Scene, bounds_deg: Degrees | None) -> Ints:
    """(i, j, span) of the tiles (n, 3) that intersect the bounds.

    Raises InputError for bounds without a tile.
    """
    tiles = np.column_stack([np.array(scene.tile_indices, np.int64).reshape(-1, 2), scene.tile_spans])
    if bounds_deg is None:
        return tiles
    west, south, east, north = bounds_deg
    if not (west < east and south < north):
        raise InputError(f"bounds {bounds_deg}: give west, south, east, north in degrees, in this order")
    x, y = scene.frame.from_geographic([west, west, east, east], [south, north, south, north])
    low, high = scene.tile_boxes[:, :2], scene.tile_boxes[:, 2:]
    inside = (low[:, 0] < x.max()) & (high[:, 0] > x.min()) & (low[:, 1] < y.max()) & (high[:, 1] > y.min())
    if not inside.any():
        xmin, ymin, xmax, ymax = scene.bounds
        lon, lat = scene.frame.to_geographic([xmin, xmax], [ymin, ymax])
        raise InputError(
            f"bounds {bounds_deg}: the scene has nothing there; it covers "
            f"{lon[0]:.5f},{lat[0]:.5f},{lon[1]:.5f},{lat[1]:.5f}"
        )
    chosen: Ints = tiles[inside]
    return chosen
