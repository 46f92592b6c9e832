"""Rays aimed at vertices and edges of a scene, compared with a float64 intersection of all faces.

For each distance of the caster's origin from the scene, rays from 1 to 60 m away are aimed at vertices and
points of edges: exactly, and with 10 micrometres of jitter. The reference is a tree of boxes in float64. A
face whose edges the ray passes within `TOLERANCE` may count as hit or as missed; all others may not.

    python benchmarks/exactness.py SCENE --rays 10_000_000 --jittered 1_000_000 --distances 0 1000 10000

leaks    rays through a vertex or an edge all of whose faces face the ray, to another surface behind
others   other hits on another surface than in float64, hits that are misses in float64, and the reverse
inside   the same for rays that start inside a solid or below the ground: they hit the back of a face first
close    hits on another surface within the stated limit of the first one, measured at right angles to it, and
         rays that start within this limit of a surface
limit    three margins of `lidar.raycast.hull`, millimetres
worst    greatest difference of a range from the hit face's plane in 80-bit arithmetic, metres, at cosines of
         incidence above 0.001
"""

from __future__ import annotations

import argparse
from typing import Any, NamedTuple

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from geoscene.scene import open_scene
from geoscene.typing import Float
from lidar.raycast import Caster, Hits
from lidar.raycast.hull import margins_of

TOLERANCE = 1e-9
"""Metres between a ray and an edge, seen along the ray."""
DIFFERENT = 1e-8
"""Metres between the ranges of different surfaces, at least."""
GRAZING = 1e-3
"""Cosine of incidence from which ranges are compared."""
JITTER = 1e-5
_LEAF = 4
_BATCH = 200_000


class Tree(NamedTuple):
    """Boxes of a binary tree, left child first: bounds (b, 6), end of the subtree, and leaves' faces."""

    bounds: Float
    skip: NDArray[np.int64]
    first: NDArray[np.int64]
    count: NDArray[np.int64]
    corners: Float


def tree_of(corners: Float) -> Tree:
    """The tree of triangles (m, 3, 3), split at the median of the widest axis."""
    low, high = corners.min(axis=1), corners.max(axis=1)
    middle = (low + high) / 2
    order: list[NDArray[np.int64]] = []
    bounds, skip, first, count, placed = [], [], [], [], 0
    todo: list[Any] = [np.arange(len(corners))]
    while todo:
        rows = todo.pop()
        if isinstance(rows, int):  # the subtree of a box ends here
            skip[rows] = len(bounds)
            continue
        box = len(bounds)
        bounds.append([*low[rows].min(axis=0), *high[rows].max(axis=0)])
        skip.append(0)
        todo.append(box)
        if len(rows) <= _LEAF:
            first.append(placed)
            count.append(len(rows))
            order.append(rows)
            placed += len(rows)
            continue
        first.append(0)
        count.append(0)
        axis = int(np.argmax(np.ptp(middle[rows], axis=0)))
        halves = np.argpartition(middle[rows, axis], len(rows) // 2)
        todo += [rows[halves[len(rows) // 2 :]], rows[halves[: len(rows) // 2]]]
    columns = (np.array(column, np.int64) for column in (skip, first, count))
    return Tree(np.array(bounds), *columns, np.ascontiguousarray(corners[np.concatenate(order)]))


@njit(inline="always")
def _cross(a: Float, b: Float, c: Float, d: Float) -> Any:
    """The cross product of b - a and d - c."""
    x, y, z, p, q, r = b[0] - a[0], b[1] - a[1], b[2] - a[2], d[0] - c[0], d[1] - c[1], d[2] - c[2]
    return y * r - z * q, z * p - x * r, x * q - y * p


@njit(parallel=True, cache=True, error_model="numpy")
def first_hits(tree: Tree, origins: Float, way: Float, reach: Float) -> Any:
    """Ranges (n,) of the first hit for certain and of the first possible one, and cosines (n, 3).

    Cosines of both, negative where a ray hits the back of a face, and the least one of all faces that may
    be hit at the first possible range. Ranges beyond ``reach`` (n,) are infinite.
    """
    n = len(way)
    sure, possible, cosines = np.full(n, np.inf), np.full(n, np.inf), np.ones((n, 3))
    for i in prange(n):
        o, d = origins[i], way[i]
        length = np.sqrt((d * d).sum())
        box = 0
        while box < len(tree.bounds):
            enter, leave = 0.0, min(sure[i], reach[i])
            for k in range(3):
                a, b = (
                    (tree.bounds[box, k] - 1e-6 - o[k]) / d[k],
                    (tree.bounds[box, k + 3] + 1e-6 - o[k]) / d[k],
                )
                if d[k] != 0.0:
                    enter, leave = max(enter, min(a, b)), min(leave, max(a, b))
                elif a > 0 or b < 0:
                    leave = -1.0
            if not enter <= leave:
                box = tree.skip[box]
                continue
            for face in range(tree.first[box], tree.first[box] + tree.count[box]):
                p = tree.corners[face]
                nx, ny, nz = _cross(p[0], p[1], p[0], p[2])
                along = nx * d[0] + ny * d[1] + nz * d[2]
                t = (nx * (p[0, 0] - o[0]) + ny * (p[0, 1] - o[1]) + nz * (p[0, 2] - o[2])) / along
                if not 0.0 < t < sure[i]:
                    continue
                low, high = np.inf, -np.inf
                for k in range(3):
                    a, b = p[k], p[(k + 1) % 3]
                    x, y, z = _cross(o, b, o, a)
                    size = np.sqrt((b[0] - a[0]) ** 2 + (b[1] - a[1]) ** 2 + (b[2] - a[2]) ** 2)
                    passed = (d[0] * x + d[1] * y + d[2] * z) / (length * size)
                    low, high = min(low, passed), max(high, passed)
                passed = min(-low, high)
                cosine = -along / (length * np.sqrt(nx * nx + ny * ny + nz * nz))
                if passed < -TOLERANCE and t < sure[i]:
                    sure[i], cosines[i, 0] = t, cosine
                if passed < TOLERANCE and t < possible[i] + DIFFERENT:
                    same = t > possible[i] - DIFFERENT
                    cosines[i, 2] = min(cosines[i, 2], abs(cosine)) if same else abs(cosine)
                    if t < possible[i]:
                        possible[i], cosines[i, 1] = t, cosine
            box += 1
    return sure, possible, cosines


LEAK, OTHER, INSIDE, CLOSE = 1, 2, 3, 4
"""Verdicts on rays; 0 if a ray hits what it hits in float64."""


def verdicts(
    hits: Hits, sure: Float, possible: Float, cosines: Float, *, aimed: Float, limit: float
) -> NDArray[np.int64]:
    """Verdicts (n,) on rays; ``aimed`` (n,) is where rays have to hit at the latest, or inf."""
    latest = np.minimum(sure, aimed)
    steepest = np.minimum(np.abs(hits.cosine), np.abs(cosines[:, :2]).min(axis=1))
    with np.errstate(invalid="ignore"):
        apart = np.maximum(np.maximum(possible - hits.range, hits.range - latest), 0.0)
        apart[np.isinf(hits.range) & np.isinf(latest)] = 0.0
        close = (apart * steepest <= limit) | (possible * cosines[:, 2] <= limit)
    inside, leaks = cosines[:, 1] < 0, hits.range > aimed + DIFFERENT
    return np.select([apart <= DIFFERENT, close, inside, leaks], [0, CLOSE, INSIDE, LEAK], OTHER)


def worst_range(hits: Hits, corners: Float, origins: Float, way: Float) -> float:
    """Metres between a range and the plane of the hit face, at most; corners (m, 3, 3) of all faces."""
    rows = np.flatnonzero(np.abs(hits.cosine) > GRAZING)
    p = corners[hits.face[rows]].astype(np.longdouble) - origins[rows, None]
    normal = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    ranges = (normal * p[:, 0]).sum(axis=1) / (normal * way[rows]).sum(axis=1)
    return float(np.abs(ranges - hits.range[rows]).max(initial=0.0))


class Targets(NamedTuple):
    """Points to aim at: ends (k, 2, 3) of edges, equal for vertices, and normals (k, j, 3) of faces."""

    ends: Float
    normals: Float


def surrounded(vertices: Float, faces: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Whether each vertex (n,) is surrounded by faces, and not at a border of the mesh."""
    balance = np.zeros(len(vertices), np.int64)
    code = np.random.default_rng(0).integers(0, 2**40, len(vertices))
    for k in range(3):
        np.add.at(balance, faces[:, k], code[faces[:, k - 2]] - code[faces[:, k - 1]])
    return balance == 0


def vertices_of(vertices: Float, faces: NDArray[np.int32], normal: Float) -> Targets:
    """The vertices with at most eight faces that surround them."""
    order = np.argsort(faces.ravel(), kind="stable")
    used, start, number = np.unique(faces.ravel()[order], return_index=True, return_counts=True)
    kept = (number <= 8) & surrounded(vertices, faces)[used]
    used, start, number = used[kept], start[kept], number[kept]
    slots = start[:, None] + np.minimum(np.arange(8), number[:, None] - 1)
    return Targets(np.repeat(vertices[used][:, None], 2, axis=1), normal[order[slots] // 3])


def edges_of(vertices: Float, faces: NDArray[np.int32], normal: Float) -> Targets:
    """The edges of two faces between surrounded vertices."""
    edges = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    ascending = edges[:, 0] < edges[:, 1]
    ends = np.sort(edges, axis=1)
    _, number, counts = np.unique(ends, axis=0, return_inverse=True, return_counts=True)
    order = np.lexsort((ascending, number))
    order = order[counts[number[order]] == 2].reshape(-1, 2)
    order = order[ascending[order[:, 0]] != ascending[order[:, 1]]]
    order = order[surrounded(vertices, faces)[edges[order[:, 0]]].all(axis=1)]
    return Targets(vertices[edges[order[:, 0]]], normal[order // 3])


def rays_at(
    targets: Targets, count: int, *, rng: np.random.Generator
) -> tuple[Float, Float, NDArray[np.bool_]]:
    """Origins 1 to 60 m away, the points aimed at, and whether all faces there face the ray."""
    rows = rng.integers(0, len(targets.ends), count)
    ends = targets.ends[rows]
    aim = ends[:, 0] + rng.random((count, 1)) * (ends[:, 1] - ends[:, 0])
    towards = rng.normal(size=(count, 3))
    normals = targets.normals[rows]
    lean = (
        rng.integers(0, 2, count) == 0
    )  # every other ray in front of all faces, where there is such a place
    towards[lean] += 2 * normals[lean].mean(axis=1)
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    origins = aim + towards * rng.uniform(1, 60, (count, 1))
    facing = np.einsum("nji,ni->nj", normals, towards).min(axis=1) > 0
    return origins, aim, facing


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene")
    parser.add_argument("--rays", type=int, default=400_000, help="aimed exactly, for each kind of target")
    parser.add_argument("--jittered", type=int, default=400_000, help="aimed with jitter")
    parser.add_argument("--distances", type=float, nargs="+", default=[0, 1000, 10_000], help="metres")
    parser.add_argument(
        "--radius", type=float, default=250.0, help="metres around the scene's middle to load"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", help="CSV file of the rays counted as leaks and others, to write")
    options = parser.parse_args()
    vertices, faces, joined = mesh_of(options.scene, options.radius)
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normal, axis=1)
    tree = tree_of(corners[length > 0])
    normal /= np.where(length > 0, length, 1.0)[:, None]
    print(f"{options.scene}: {len(faces):,} faces")
    print(
        f"{'origin m':>9} {'target':8} {'jitter':>8} {'rays':>10} {'facing':>10}"
        f" leaks others inside  close limit   worst m"
    )
    kept = []
    for distance in options.distances:
        origin = np.array([-0.8, 0.6, 0.0]) * distance
        caster = Caster(vertices, faces, origin=np.round(origin))
        limit = 3 * float(margins_of(vertices - caster.origin).max())
        for name, targets in (("vertices", vertices_of), ("edges", edges_of)):
            for jitter, rays in ((0.0, options.rays), (JITTER, options.jittered)):
                rng, total, facing_rays, worst = np.random.default_rng(options.seed), np.zeros(5, int), 0, 0.0
                places = targets(vertices, joined, normal)
                for done in range(0, rays, _BATCH):
                    count = min(_BATCH, rays - done)
                    origins, aim, facing = rays_at(places, count, rng=rng)
                    way = aim + rng.uniform(-jitter, jitter, (count, 3)) - origins
                    way /= np.linalg.norm(way, axis=1, keepdims=True)
                    hits = caster.cast(origins, way)
                    far = np.linalg.norm(aim - origins, axis=1)
                    aimed = np.where(facing & (jitter == 0.0), far, np.inf)
                    found = first_hits(tree, origins, way, hits.range + 1e-3)
                    verdict = verdicts(hits, *found, aimed=aimed, limit=limit)
                    total += np.bincount(verdict, minlength=5)
                    facing_rays += int(facing.sum())
                    worst = max(worst, worst_range(hits, corners, origins, way))
                    columns = distance + 0 * far, verdict, origins, way, far, hits.range, hits.face
                    kept.append(np.column_stack(columns)[(verdict == LEAK) | (verdict == OTHER)])
                print(
                    f"{distance:9.0f} {name:8} {jitter:8.0e} {total.sum():10,} {facing_rays:10,}"
                    f" {total[LEAK]:5} {total[OTHER]:6} {total[INSIDE]:6} {total[CLOSE]:6}"
                    f" {1000 * limit:5.2f} {worst:9.1e}",
                    flush=True,
                )
    if options.keep:
        head = "distance,verdict,ox,oy,oz,dx,dy,dz,aim,range,face"
        np.savetxt(options.keep, np.concatenate(kept), "%.17g", ",", header=head, comments="")


def mesh_of(path: str, radius: float) -> tuple[Float, NDArray[np.int32], NDArray[np.int32]]:
    """Vertices, faces, and faces of joined vertices of the tiles around a scene's middle."""
    scene = open_scene(path)
    xmin, ymin, xmax, ymax = scene.bounds
    middle = np.round([(xmin + xmax) / 2, (ymin + ymax) / 2, 0.0])
    vertices, faces, count = [np.empty((0, 3))], [np.empty((0, 3), np.int32)], 0
    for i, j in scene.tile_indices:
        place = (np.array([i, j]) + 0.5) * scene.tile_size - middle[:2]
        if np.abs(place).max() > radius:
            continue
        tile = scene.tile(i, j, forests=False)
        vertices.append(tile.mesh.vertices + tile.origin - middle)
        faces.append(tile.mesh.faces + np.int32(count))
        count += len(tile.mesh.vertices)
    joined, corners = np.concatenate(vertices), np.concatenate(faces)
    # Tiles meet at vertices of their own: targets are surrounded by faces of all tiles.
    _, first, same = np.unique(np.round(joined, 6), axis=0, return_index=True, return_inverse=True)
    return joined, corners, first[same.reshape(-1)][corners].astype(np.int32)


if __name__ == "__main__":
    main()
