"""Extremes of scale: triangles, buildings, road users; wide scenes with next to nothing on them."""

from __future__ import annotations

import tempfile
import time
from functools import partial
from pathlib import Path

import numpy as np
import shapely

from geoscene.geometry.frames import Frame
from geoscene.options import BuildOptions
from geoscene.pipeline.build import build
from geoscene.scene import Scene
from geoscene.sources import read_osm
from geoscene.typing import Float, Ints
from lidar.raycast import Caster, MeshInstances
from lidar.tools.selftest.case import ExtremeCase
from lidar.tools.selftest.footprints import built, house, street
from lidar.tools.selftest.places import write_raster
from lidar.tools.selftest.rays import cuboid

_SLOPE = np.array([0.031, -0.017])
_PLACE = (10.0, 47.0)
_POST = 1 / 1200
"""Degrees between the posts of the elevation models, as of SRTM (90 m)."""


def _slope(side: int) -> tuple[Float, Ints]:
    """Vertices and faces of a tilted square of ``side`` x ``side`` cells of 1 m."""
    x, y = np.meshgrid(np.arange(side + 1.0) - side / 2, np.arange(side + 1.0) - side / 2, indexing="ij")
    xy = np.column_stack([x.ravel(), y.ravel()])
    corner = (np.arange(side)[:, None] * (side + 1) + np.arange(side)).ravel()
    right, above, across = corner + side + 1, corner + 1, corner + side + 2
    lower, upper = np.column_stack([corner, right, across]), np.column_stack([corner, across, above])
    return np.column_stack([xy, xy @ _SLOPE]), np.concatenate([lower, upper])


def many_triangles(count: int) -> float:
    """Largest error in metres of ranges to vertices of a slope, a hundredth as many as its triangles."""
    side = int(np.sqrt(count / 2))
    caster, rng = Caster(*_slope(side)), np.random.default_rng(1)
    n = max(count // 100, 1000)
    aim = np.column_stack([np.floor(rng.uniform(-0.45, 0.45, (n, 2)) * side), np.zeros(n)])
    aim[:, 2] = aim[:, :2] @ _SLOPE
    start = aim + np.column_stack([rng.uniform(-9, 9, (n, 2)), rng.uniform(5, 90, n)])
    length = np.linalg.norm(aim - start, axis=1)
    found = caster.cast(start, (aim - start) / length[:, None]).range
    return float(np.abs(found - length).max())


def many_buildings(count: int) -> float:
    """Buildings of a regular town that are not valid solids of the right volume."""
    side = int(np.ceil(np.sqrt(count)))
    houses = []
    for k in range(count):
        x, y = k % side * 15.0 - side * 7.5, k // side * 15.0 - side * 7.5
        houses.append(house(k + 1, shapely.box(x, y, x + 10, y + 8 + k % 5), height=f"{5 + k % 40}"))
    _, verdict, lost = built(houses)
    true = np.array([10 * (8 + k % 5) * (5 + k % 40) for k in range(count)], float)
    right = len(verdict) == count and np.abs(np.sort(verdict.volume) / np.sort(true) - 1) < 1e-4
    return float(lost + count - np.count_nonzero(verdict.ok & right))


def many_road_users(count: int) -> float:
    """Rays at instances of a box, moving and turned, that do not hit the one aimed at where it is then."""
    shape = Caster(*cuboid(np.array([-2.0, -1, 0]), np.array([2.0, 1, 1.5])))
    side = int(np.ceil(np.sqrt(count)))
    rng, number = np.random.default_rng(2), np.arange(count)
    angle = rng.uniform(0, 2 * np.pi, count)
    moves = np.zeros((count, 2, 3, 4))
    moves[..., 0, 0] = moves[..., 1, 1] = np.cos(angle)[:, None]
    moves[..., 1, 0] = np.sin(angle)[:, None]
    moves[..., 0, 1] = -moves[..., 1, 0]
    moves[..., 2, 2] = 1
    place = np.column_stack([number % side, number // side, 0 * number]) * 10.0 - [side * 5, side * 5, 0]
    moves[:, 0, :, 3], moves[:, 1, :, 3] = place, place + rng.uniform(-2, 2, (count, 3)) * [1, 1, 0]
    caster = Caster(instances=[MeshInstances((shape,), np.zeros(count, np.int32), moves)], origin=np.zeros(3))
    who, time = rng.integers(0, count, 10 * count), rng.random(10 * count).astype(np.float32)
    share = time[:, None].astype(float)
    aim = (1 - share) * moves[who, 0, :, 3] + share * moves[who, 1, :, 3] + [0, 0, 1.5]
    start = aim + rng.uniform([-1, -1, 20], [1, 1, 40], (len(who), 3))
    hits = caster.cast(start, aim - start, time=time)
    return float(((hits.instance != who) | (np.abs(hits.range - 1) > 1e-6)).sum())


def empty_scene(count: int, *, roughness: float) -> tuple[float, float]:
    """CPU seconds of building an empty scene of ``count`` km, and the number of gaps in its ground."""
    frame, half = Frame.at(*_PLACE), count * 500.0
    lon, lat = frame.to_geographic(np.array([-half, half]), np.array([-half, half]))
    with tempfile.TemporaryDirectory() as folder:
        path, raster = Path(folder) / "map.osm", Path(folder) / "dem.tif"
        path.write_text(f'<osm version="0.6">{street(*_PLACE, step=0.001)}</osm>')
        _write_mountains(raster, reach=half + 5000, roughness=roughness)
        osm = read_osm(path, bounds=(float(lon[0]), float(lat[0]), float(lon[1]), float(lat[1])))
        start = time.process_time()
        scene = build(osm, Path(folder) / "scene", options=BuildOptions(dem=(str(raster),)))
        return time.process_time() - start, float(_open_edges(scene))


def _write_mountains(path: Path, *, reach: float, roughness: float) -> None:
    """Write a raster that reaches some metres from the place: 1,500 m high, and as rough as the Alps if 1."""
    from scipy.ndimage import map_coordinates  # noqa: PLC0415

    columns, rows = (int(reach / m / _POST) * 2 for m in (111_000 * np.cos(np.radians(_PLACE[1])), 111_000))
    heights, rng = np.full((rows, columns), 1500.0), np.random.default_rng(6)
    for octave in range(10):
        waves = 4 * 2.0**octave  # knots of noise along 100 km
        knots = rng.normal(0, 500 * 0.55**octave, (round(waves) + 4, round(waves) + 4))
        at = np.meshgrid(*(np.arange(n) / 1200 * waves % waves for n in (rows, columns)), indexing="ij")
        heights += roughness * map_coordinates(knots, at, order=1)
    write_raster(path, heights, lonlat=_PLACE, step=_POST)


def _open_edges(scene: Scene) -> int:
    """Edges of the ground that do not join two faces, those along the extent's border aside."""
    vertices: list[Float] = []
    faces: list[Ints] = []
    first = 0
    for i, j in scene.tile_indices:
        tile = scene.tile(i, j=j)
        ground = tile.mesh.take(~tile.mesh.closed)
        vertices.append(ground.vertices + tile.origin)
        faces.append(ground.faces.astype(np.int64) + first)
        first += len(ground.vertices)
    points, number = np.unique(np.concatenate(vertices), axis=0, return_inverse=True)
    corners = number.ravel()[np.concatenate(faces)]
    ends = np.sort(np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]]), axis=1)
    edge, joined = np.unique(ends[:, 0] * len(points) + ends[:, 1], return_counts=True)
    a, b = (points[n, :2] for n in np.divmod(edge, len(points)))
    xmin, ymin, xmax, ymax = scene.bounds
    border = ((a == b) & ((a == (xmin, ymin)) | (a == (xmax, ymax)))).any(axis=1)
    return int(np.count_nonzero(joined[~border] != 2) + np.count_nonzero(joined[border] != 1))


def empty_seconds(count: int, *, roughness: float) -> float:
    """CPU seconds in which an empty scene is built, on a level elevation model or in mountains."""
    return empty_scene(count, roughness=roughness)[0]


def gaps(count: int) -> float:
    """Edges within the ground of an empty scene in mountains that do not join two faces."""
    return empty_scene(count, roughness=1.0)[1]


_TERRAIN = "triangles where the terrain needs them"

_case = partial(ExtremeCase, group="scale")
_empty = partial(_case, of="km wide", quick=5, full=100)
_seconds = partial(_empty, bound=60, unit="CPU s")

CASES = (
    _case(
        "range among 1e7 triangles, at their vertices",
        many_triangles,
        "float64 plane of the face",
        bound=1e-9,
        unit="m",
        of="triangles",
        quick=200_000,
        full=10**7,
    ),
    _case(
        "buildings of a town, no solids of the right volume",
        many_buildings,
        unit="buildings",
        of="buildings",
        quick=300,
        full=100_000,
    ),
    _case(
        "road users, moving, that a ray misses",
        many_road_users,
        unit="rays",
        of="road users",
        quick=1000,
        full=10_000,
    ),
    _seconds("empty scene, level elevation model", partial(empty_seconds, roughness=0.0), _TERRAIN),
    _seconds("empty scene in mountains", partial(empty_seconds, roughness=1.0), _TERRAIN),
    _empty("gaps in the ground of an empty scene in mountains", gaps, unit="edges"),
)
"""Extremes of scale."""
