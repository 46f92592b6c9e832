"""Extremes of scale: triangles, buildings, road users."""

from __future__ import annotations

import numpy as np
import shapely

from geoscene.typing import Float, Ints
from lidar.raycast import Caster, MeshInstances
from lidar.tools.selftest.case import ExtremeCase
from lidar.tools.selftest.footprints import built, house
from lidar.tools.selftest.meshes import cuboid

_SLOPE = np.array([0.031, -0.017])


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
    place = np.column_stack([number % side, number // side, 0 * number]) * [
        10.0,
        10,
        0,
    ] - side * 5.0 * np.array([1, 1, 0])
    moves[:, 0, :, 3], moves[:, 1, :, 3] = place, place + rng.uniform(-2, 2, (count, 3)) * [1, 1, 0]
    caster = Caster(instances=[MeshInstances((shape,), np.zeros(count, np.int32), moves)], origin=np.zeros(3))
    who, time = rng.integers(0, count, 10 * count), rng.random(10 * count).astype(np.float32)
    share = time[:, None].astype(float)
    aim = (1 - share) * moves[who, 0, :, 3] + share * moves[who, 1, :, 3] + [0, 0, 1.5]
    start = aim + rng.uniform([-1, -1, 20], [1, 1, 40], (len(who), 3))
    hits = caster.cast(start, aim - start, time=time)
    return float(((hits.instance != who) | (np.abs(hits.range - 1) > 1e-6)).sum())


CASES = (
    ExtremeCase(
        "scale",
        "range among 1e7 triangles, at their vertices",
        1e-9,
        "m",
        many_triangles,
        "triangles",
        200_000,
        10**7,
        "float64 plane of the face",
    ),
    ExtremeCase(
        "scale",
        "buildings of a town, no solids of the right volume",
        0,
        "buildings",
        many_buildings,
        "buildings",
        300,
        100_000,
        "",
    ),
    ExtremeCase(
        "scale",
        "road users, moving, that a ray misses",
        0,
        "rays",
        many_road_users,
        "road users",
        1000,
        10_000,
        "",
    ),
)
"""Extremes of scale."""
