"""Maps against the true surfaces of a scene: distances of points to triangles, by class, and a picture."""

from __future__ import annotations

import csv
import io
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from pyproj import CRS

from geoscene.classes import Class
from geoscene.geometry.frames import Frame
from geoscene.scene import Scene
from geoscene.scene.layout import OVERHANG
from geoscene.support.files import atomic_path, write_atomically
from geoscene.typing import Float
from lidar.dataset.formats.table import Table
from lidar.dataset.layout import Dataset, reading_file
from lidar.errors import InputError
from lidar.geometry.box_tree import Tree, lower_to_nearest, tree_of
from lidar.geometry.georeference import Georeference
from lidar.tools.maps.colors import ramp
from lidar.tools.maps.picture import cloud_picture, with_key

_KEPT = 12
"""Tiles whose triangles are in memory: those around a place, and some of the way."""
LIMIT = 5.0
"""Metres: distances beyond it count as it."""

_STEP = 1e-4  # metres: width of the bins from which median and percentile are taken
_SHOWN = 2_000_000  # points of the picture, at most
_COLORS = (1e-3, 1.0)  # metres: ends of the logarithmic ramp of colours
_FAR = 0.1
"""Metres: distances of 5 % of the points of a class from which on reasons are given."""
_MOVING = ("all", *(klass.name.lower() for klass in Class if Class.CAR <= klass <= Class.MOTORCYCLIST))
_ROAD_USERS = (Class.CAR, Class.MOTORCYCLIST)


class _Triangles(NamedTuple):
    """Triangles of a tile: corners (n, 3, 3) less the origin (3,), and their tree."""

    corners: Float
    origin: Float
    tree: Tree


class TrueSurfaces:
    """The surfaces of a scene, with openings of walls and all copies of its shapes.

    Rough ground counts as its planes, which lie above it by the depth of the roughness at most.

    limit : metres, beyond which distances are not sought
    """

    def __init__(self, scene: Scene, *, limit: float) -> None:
        self.limit = limit
        self._scene = scene if scene.relief == "off" else scene.with_relief_mesh()
        self._shapes = [mesh.vertices[mesh.faces] for mesh in scene.shapes().values()]
        self._tiles: OrderedDict[int, _Triangles] = OrderedDict()

    def distances(self, points: Float) -> Float:
        """Distances (n,), scene metres, of points (n, 3) to the nearest triangle; beyond `limit` infinite."""
        squared = np.full(len(points), self.limit**2)
        if len(points):
            low, high = points.min(axis=0), points.max(axis=0)
            boxes, reach = self._scene.tile_boxes, self.limit + OVERHANG
            near = (boxes[:, :2] <= high[:2] + reach) & (boxes[:, 2:] >= low[:2] - reach)
            for rank in np.flatnonzero(near.all(axis=1)).tolist():
                triangles = self._of(rank)
                if len(triangles.corners):
                    lower_to_nearest(points - triangles.origin, triangles.corners, *triangles.tree, squared)
        distance: Float = np.where(squared < self.limit**2, np.sqrt(squared), np.inf)
        return distance

    def _of(self, rank: int) -> _Triangles:
        """The triangles of a tile, read if they are not in memory."""
        if rank in self._tiles:
            self._tiles.move_to_end(rank)
            return self._tiles[rank]
        tile = self._scene.tile(*self._scene.tile_indices[rank])
        parts = [tile.mesh.vertices[tile.mesh.faces]]
        for shape, corners in enumerate(self._shapes):
            placed = tile.instances.transform[tile.instances.shape == shape]
            turned = np.einsum("kij,fcj->kfci", placed[:, :, :3], corners)
            parts.append((turned + placed[:, None, None, :, 3]).reshape(-1, 3, 3))
        corners = np.ascontiguousarray(np.concatenate(parts))
        self._tiles[rank] = _Triangles(
            corners, tile.origin, tree_of(corners.min(axis=1), corners.max(axis=1))
        )
        if len(self._tiles) > _KEPT:
            self._tiles.popitem(last=False)
        return self._tiles[rank]


@dataclass(frozen=True, slots=True)
class SurfaceDistances:
    """Distances of the points of one class, in metres; median and 95 % to 0.1 mm.

    name   : of the class, ``all`` or ``all but road users``
    beyond : points farther than `LIMIT` from all surfaces
    """

    name: str
    points: int
    mean_m: float
    median_m: float
    p95_m: float
    rms_m: float
    largest_m: float
    beyond: int


def far_reasons(dataset: Dataset, scene: Scene, *, rows: Sequence[SurfaceDistances]) -> list[str]:
    """Why points of a map may lie far from the surfaces of a scene, one line each; none if they do not.

    rows : distances of the map to the scene
    """
    from lidar.settings import settings_of  # noqa: PLC0415  (loads cameras and ray casting)

    high = [row.name for row in rows if row.points and row.p95_m > _FAR and row.name not in _MOVING]
    if not high:
        return []
    recipe, reasons = dataset.manifest["recipe"], []
    if recipe.get("scene") != scene.manifest.get("fingerprint", scene.path.name):
        reasons.append(
            "the drive was in another scene: what only one of the two holds is as far as it is large"
        )
    with reading_file(dataset.paths.manifest):
        scanner, _, _ = settings_of(recipe["fidelity"], [(name, text) for name, text in recipe["settings"]])
        if scanner.traces_footprints:
            reasons.append(
                "pulses have several rays (settings rays, footprint): where one meets several surfaces, as at"
                " edges, windows with the room behind them, and leaves, echoes merge to a point between them"
            )
        if recipe.get("stages") or recipe.get("applied_stages"):
            reasons.append(
                "weather, attacks or other stages added or moved returns (--origin surface leaves them out)"
            )
    told = "; ".join(reasons) or "points of moving things and of measured poses are not where surfaces are"
    return [f"5 % or more of {', '.join(high)} lie farther than {_FAR:g} m from all surfaces: {told}"]


class SurfaceComparison:
    """Distances of a map's points to a scene's surfaces, gathered table by table in constant memory.

    Raises InputError for a scene whose heights have another reference.
    """

    def __init__(self, scene: Scene, frame: Frame, *, crs: CRS) -> None:
        if scene.frame.vertical != frame.vertical:
            raise InputError(
                f"{scene.location}: its heights are {scene.frame.vertical}, the map's {frame.vertical};"
                " compare with the scene of the drive"
            )
        self._surfaces = TrueSurfaces(scene, limit=LIMIT)
        self._geo = Georeference(scene.frame, crs)
        self._bins: dict[int, NDArray[np.int64]] = {}
        self._sums: dict[int, Float] = {}  # of distances and of squares, greatest, and those beyond
        self._shown: list[tuple[Float, Float]] = []
        self._stride, self._waiting = 1, 0

    def measured(self, tables: Iterator[Table]) -> Iterator[Table]:
        """The tables, whose distances are added."""
        for table in tables:
            points = self._geo.scene_points(np.column_stack([table[axis] for axis in "xyz"]))
            self._add(points, self._surfaces.distances(points), label=table["label"])
            yield table

    def _add(self, points: Float, distance: Float, *, label: NDArray[np.integer]) -> None:
        beyond = np.isinf(distance)
        capped = np.minimum(distance, LIMIT)
        count = round(LIMIT / _STEP) + 1
        for code in np.unique(label).tolist():
            mine = label == code
            values = capped[mine]
            bins = self._bins.setdefault(code, np.zeros(count, np.int64))
            bins += np.bincount((values / _STEP).astype(np.int64), minlength=count)
            sums = self._sums.setdefault(code, np.zeros(4))
            sums[:2] += values.sum(), (values**2).sum()
            sums[2] = max(sums[2], values.max())
            sums[3] += np.count_nonzero(beyond & mine)
        first = -self._waiting % self._stride
        self._shown.append((points[first :: self._stride], capped[first :: self._stride]))
        self._waiting += len(points)
        if sum(len(part) for part, _ in self._shown) > _SHOWN:  # every other point, then every fourth...
            xyz, away = (np.concatenate(parts)[::2] for parts in zip(*self._shown, strict=True))
            self._shown, self._stride = [(xyz, away)], 2 * self._stride

    def rows(self) -> list[SurfaceDistances]:
        """Distances of all points, of all but road users, and of each class."""
        low, high = _ROAD_USERS
        still = [code for code in self._bins if not low <= code <= high]
        groups = {"all": list(self._bins), "all but road users": still}
        if len(still) == len(self._bins):
            del groups["all but road users"]
        groups |= {Class(code).name.lower(): [code] for code in sorted(self._bins)}
        return [self._row(name, codes) for name, codes in groups.items()]

    def _row(self, name: str, codes: list[int]) -> SurfaceDistances:
        if not codes:
            nothing = (float("nan"),) * 5
            return SurfaceDistances(name, 0, *nothing, beyond=0)
        bins = np.sum([self._bins[code] for code in codes], axis=0)
        sums = np.array([self._sums[code] for code in codes])
        count, cumulative = int(bins.sum()), np.cumsum(bins)
        median, p95 = (
            min((int(np.searchsorted(cumulative, share * count)) + 0.5) * _STEP, LIMIT)
            for share in (0.5, 0.95)
        )
        mean, square = sums[:, :2].sum(axis=0) / count
        largest = float(sums[:, 2].max())
        return SurfaceDistances(
            name, count, float(mean), median, p95, float(square) ** 0.5, largest, int(sums[:, 3].sum())
        )

    def write(self, out: Path) -> list[Path]:
        """Write the table and the picture beside a map; return their paths."""
        table, picture = out.with_suffix(".compare.csv"), out.with_suffix(".compare.png")
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(f.name for f in fields(SurfaceDistances))
        for row in self.rows():
            writer.writerow(f"{v:.6g}" if isinstance(v, float) else v for v in asdict(row).values())
        write_atomically(table, text.getvalue().encode())
        if not self._waiting:
            return [table]
        with atomic_path(picture, keep_suffix=True) as part:
            Image.fromarray(self._picture()).save(part)
        return [table, picture]

    def _picture(self) -> NDArray[np.uint8]:
        """The map from above, coloured by distance: violet up to 1 mm, yellow from 1 m."""
        xyz, away = (np.concatenate(parts) for parts in zip(*self._shown, strict=True))
        low, high = np.log(_COLORS)
        order = np.argsort(away, kind="stable")  # where points share a pixel the topmost is shown
        logarithm = np.log(np.maximum(away[order], _COLORS[0]))
        image = cloud_picture(xyz[order], ramp(logarithm, low, high=high), view="top", depth=False)
        marks = (1e-3, 3e-3, 1e-2, 3e-2, 0.1, 0.3, 1.0)
        key = [
            (f"{v:g} m" if v >= 0.1 else f"{1000 * v:g} mm", ramp(np.log(v), low, high=high)) for v in marks
        ]
        return with_key(image, key)
