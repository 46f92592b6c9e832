"""Extremes of rays: distances, incidence, shapes of faces, edges, starts, numbers that are none; meshes."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

from geoscene.typing import Float, Ints
from lidar.errors import InputError
from lidar.raycast import Caster
from lidar.tools.selftest.case import ExtremeCase, drawn_batches

_FAR = np.array([0.001, 0.01, 0.1, 1.0, 10.0, 100.0])
_FARTHER = np.array([1e3, 1e4, 1e5])
_ORIGINS = (0.0, 1e3, 1e4)
"""Metres from the caster's origin to the place of a case."""


def directions(rng: np.random.Generator, count: int) -> Float:
    """Unit vectors (n, 3), uniformly distributed."""
    out = rng.normal(size=(count, 3))
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    return out


def sheet(normal: Float, point: Float, *, size: float) -> tuple[Float, Ints]:
    """Vertices and faces of a square of four triangles about a point, its front on the normal's side."""
    n = np.asarray(normal) / np.linalg.norm(normal)
    u = np.cross(n, np.eye(3)[np.argmin(np.abs(n))])
    u /= np.linalg.norm(u)
    v = np.cross(n, u)
    vertices = np.array([np.zeros(3), *(size * w for w in (u, v, -u, -v))]) + point
    return vertices, np.array([[0, k + 1, (k + 1) % 4 + 1] for k in range(4)])


def cuboid(low: Float, high: Float) -> tuple[Float, Ints]:
    """Vertices and faces of a box, facing outwards."""
    bits = np.arange(8)[:, None] >> np.array([2, 1, 0]) & 1
    corners = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    faces = [[q[0], q[k], q[k + 1]] for q in corners for k in (1, 2)]
    return np.where(bits == 1, high, low).astype(float), np.array(faces)


def ball(levels: int, *, radius: float) -> tuple[Float, Ints]:
    """Vertices and faces of an octahedron divided ``levels`` times and moved to a sphere, facing outwards."""
    vertices = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], float)
    faces = np.array([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]])
    for _ in range(levels):
        edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        unique, number = np.unique(edges, axis=0, return_inverse=True)
        middle = number.reshape(-1, 3) + len(vertices)
        vertices = np.concatenate([vertices, vertices[unique].mean(axis=1)])
        vertices /= np.linalg.norm(vertices, axis=1, keepdims=True)
        a, b, c = faces.T
        ab, bc, ca = middle.T
        rows = ((a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca))
        faces = np.concatenate([np.column_stack(row) for row in rows])
    return vertices * radius, faces


def prism_of_slivers(width: float, height: float, *, count: int) -> tuple[Float, Ints]:
    """A closed box of which one wall has ``count`` pairs of triangles ``width`` wide and ``height`` high."""
    x = np.arange(count + 1) * width
    front = np.array([[v, 0.0, z] for v in x for z in (0.0, height)])
    back = np.array([[v, 5.0, z] for v in (x[0], x[-1]) for z in (0.0, height)])
    k = 2 * np.arange(count)
    walls = np.concatenate([np.column_stack([k, k + 2, k + 3]), np.column_stack([k, k + 3, k + 1])])
    m, n = 2 * count, 2 * count + 2  # lower front corner at the other end, first corner at the back
    ends = [[0, 1, n + 1], [0, n + 1, n], [m, n + 2, n + 3], [m, n + 3, m + 1], [n, n + 1, n + 3]]
    bottom = [[2 * j, n, 2 * j + 2] for j in range(count)] + [[m, n, n + 2]]
    top = [[2 * j + 1, 2 * j + 3, n + 1] for j in range(count)] + [[m + 1, n + 3, n + 1]]
    faces = np.concatenate([walls, ends, [[n, n + 3, n + 2]], bottom, top])
    return np.concatenate([front, back]), faces


def _plane_error(count: int, *, distances: Float, relative: bool = False) -> float:
    """Largest error in metres, or relative, of ranges to planes at distances, incidence up to 60 degrees."""
    worst = 0.0
    for row, distance in enumerate(distances):
        for rng, size in drawn_batches(count // len(distances), row):
            normal = directions(rng, 1)[0]
            vertices, faces = sheet(normal, -distance * normal, size=10 * distance)
            way = directions(rng, size)
            way = -normal + 1.7 * (way - (way @ normal)[:, None] * normal) * rng.random((size, 1))
            way /= np.linalg.norm(way, axis=1, keepdims=True)
            hits = Caster(vertices, faces, origin=np.zeros(3)).cast(np.zeros(3), way)
            # the plane that the rounded vertices have
            a, b, c = vertices[faces[hits.face]].swapaxes(0, 1)
            true = np.cross(b - a, c - a)
            expected = np.einsum("ij,ij->i", true, a) / np.einsum("ij,ij->i", true, way)
            error = float(np.abs(hits.range - expected).max())
            worst = max(worst, error / distance if relative else error)
    return worst


def grazing(count: int) -> float:
    """Largest relative error of ranges at incidences of 89.9 to 89.999 degrees."""
    height, worst = 12.345678, 0.0
    vertices, faces = sheet(np.array([0.0, 0, 1]), np.zeros(3), size=2e6)
    caster = Caster(vertices, faces)
    for rng, size in drawn_batches(count, 1):
        azimuth, down = rng.uniform(0, 2 * np.pi, size), np.radians(10 ** rng.uniform(-3, -1, size))
        flat = np.cos(down)
        way = np.column_stack([np.cos(azimuth) * flat, np.sin(azimuth) * flat, -np.sin(down)])
        found = caster.cast(np.array([0, 0, height]), way).range
        worst = max(worst, float(np.abs(found * np.sin(down) / height - 1).max()))
    return worst


def slivers(count: int) -> float:
    """Rays that leave a closed box through a wall of slivers of 1e-5 x 100 m."""
    vertices, faces = prism_of_slivers(1e-5, 100.0, count=1000)
    caster, width, lost = Caster(vertices, faces), float(vertices[:, 0].max()), 0
    for rng, size in drawn_batches(count, 2):
        start = rng.uniform([0.2 * width, 1, 20], [0.8 * width, 4, 80], (size, 3))
        x = rng.integers(100, 900, size) * 1e-5  # on the edges between slivers
        aim = np.column_stack([x, np.zeros(size), rng.uniform(20, 80, size)])
        found = caster.cast(start, aim - start).range
        lost += int((~(np.abs(found - 1) < 1e-4)).sum())
    return lost


def small_beside_large(count: int) -> float:
    """Rays at faces of a millimetre on a ground of 100 km that miss them or hit them beside their place."""
    ground, faces = sheet(np.array([0.0, 0, 1]), np.zeros(3), size=5e4)
    parts, numbers = [ground], [faces]
    at = np.random.default_rng(3).uniform(-40, 40, (1000, 2))
    for x, y in at:
        vertices, box = cuboid(np.array([x, y, 0.5]), np.array([x + 1e-3, y + 1e-3, 0.501]))
        numbers.append(box + len(ground) + 8 * (len(parts) - 1))
        parts.append(vertices)
    caster, lost = Caster(np.concatenate(parts), np.concatenate(numbers), origin=np.zeros(3)), 0
    for rng, size in drawn_batches(count, 3):
        aim = np.column_stack([at[rng.integers(0, len(at), size)], np.full(size, 0.501)])
        aim[:, :2] += rng.uniform(2e-4, 8e-4, (size, 2))
        start = np.column_stack([aim[:, :2] + rng.uniform(-5, 5, (size, 2)), rng.uniform(3, 20, size)])
        hits = caster.cast(start, aim - start)
        lost += int(((hits.face < len(faces)) | (np.abs(hits.range - 1) > 1e-9)).sum())
    return lost


def _aims(rng: np.random.Generator, mesh: tuple[Float, Ints], *, count: int) -> Float:
    """Points (n, 3) at vertices and, every other one, on edges."""
    vertices, faces = mesh
    ends = vertices[faces[rng.integers(0, len(faces), count), :2]]
    along = rng.random((count, 1)) * (np.arange(count) % 2)[:, None]
    aims: Float = ends[:, 0] + along * (ends[:, 1] - ends[:, 0])
    return aims


def _near_and_far(
    count: int, mesh: tuple[Float, Ints], *, seed: int
) -> Iterator[tuple[Caster, np.random.Generator, int]]:
    """Caster of a mesh, generator and size of each batch, at three distances of the origin."""
    for row, distance in enumerate(_ORIGINS):
        caster = Caster(*mesh, origin=np.array([distance, 0, 0]))
        for rng, size in drawn_batches(count // len(_ORIGINS), seed, row):
            yield caster, rng, size


def leaks(count: int) -> float:
    """Rays from within a ball, at its vertices and edges, that leave it; at three distances of the origin."""
    mesh, lost = ball(5, radius=10.0), 0
    for caster, rng, size in _near_and_far(count, mesh, seed=4):
        start = rng.uniform(-2, 2, (size, 3))
        hits = caster.cast(start, _aims(rng, mesh, count=size) - start)
        lost += int((~np.isfinite(hits.range)).sum())
    return lost


def pierce(count: int) -> float:
    """Rays from outside, at vertices and edges of a ball, that hit a second ball 0.5 m within."""
    vertices, faces = ball(5, radius=10.0)
    inner, more = ball(5, radius=9.5)
    both = np.concatenate([vertices, inner]), np.concatenate([faces, more + len(vertices)])
    lost = 0
    for caster, rng, size in _near_and_far(count, both, seed=5):
        aim = _aims(rng, (vertices, faces), count=size)
        start = aim * rng.uniform(1.2, 6, (size, 1)) + rng.uniform(-0.5, 0.5, (size, 3))
        lost += int((caster.cast(start, aim - start).face >= len(faces)).sum())
    return lost


def starts_on_a_surface(count: int) -> float:
    """Rays from points on a face that hit this face again."""
    vertices, faces = sheet(np.array([0.3, 0.5, 0.8]), np.array([3.0, 4, 100]), size=1e4)
    ceiling, more = sheet(np.array([-0.3, -0.5, -0.8]), np.array([6.0, 9, 108]), size=1e4)
    caster = Caster(np.concatenate([vertices, ceiling]), np.concatenate([faces, more + 5]))
    lost = 0
    for rng, size in drawn_batches(count, 6):
        down = rng.uniform(-0.2, 0.2, (size, 3)) - [0.3, 0.5, 0.8]
        above = rng.uniform([-30, -30, 150], [30, 30, 190], (size, 3))
        on = above + caster.cast(above, down).range[:, None] * down
        again = caster.cast(on, directions(rng, size))
        lost += int((again.range < 1e-6).sum())
    return lost


def coplanar(count: int) -> float:
    """Rays at two identical faces that miss, or hit at another range than one of them."""
    vertices, faces = sheet(np.array([0.1, 0.2, 1.0]), np.zeros(3), size=50.0)
    one = Caster(vertices, faces)
    two = Caster(np.concatenate([vertices, vertices]), np.concatenate([faces, faces + 5, faces]))
    lost = 0
    for rng, size in drawn_batches(count, 7):
        start, aim = rng.uniform([-9, -9, 5], [9, 9, 30], (size, 3)), rng.uniform(-9, 9, (size, 3))
        aim[:, 2] = -aim[:, :2] @ [0.1, 0.2]
        lone, double = one.cast(start, aim - start).range, two.cast(start, aim - start).range
        lost += int((~(np.abs(lone - double) < 1e-12)).sum())
    return lost


def unusable(count: int) -> float:
    """Rays with numbers that are not finite, or a direction of length zero, that are not refused."""
    caster, lost = Caster(*sheet(np.array([0.0, 0, 1]), np.zeros(3), size=10.0)), 0
    values = (np.nan, np.inf, -np.inf, 0.0)
    for k in range(count):
        start, way = np.full((64, 3), 2.0), np.tile([0.0, 0, -1], (64, 1))
        value, row, axis = values[k % 4], k * 7 % 64, k % 3
        if value == 0:
            way[row] = 0.0
        else:
            (way if k % 8 < 4 else start)[row, axis] = value
        try:
            caster.cast(start, way)
        except InputError:
            continue
        lost += 1
    return lost


_PLANE = "float64 plane of the face"
_MARGIN = "margin of 0.06 mm, 0.24 mm per km from the origin"

_case = partial(ExtremeCase, group="rays", unit="rays", of="rays", quick=50_000, full=10**7)

CASES = (
    _case(
        "range of 1 mm to 100 m, incidence to 60°",
        partial(_plane_error, distances=_FAR),
        _PLANE,
        bound=1e-9,
        unit="m",
        quick=60_000,
    ),
    _case(
        "range of 1 to 100 km, incidence to 60°",
        partial(_plane_error, distances=_FARTHER, relative=True),
        _PLANE,
        bound=1e-12,
        unit="of the range",
        quick=60_000,
    ),
    _case(
        "range at incidence of 89.9° to 89.999°",
        grazing,
        "rounding of the ray's direction, divided by the cosine",
        bound=1e-11,
        unit="of the range",
    ),
    _case(
        "leaks through slivers of 1e-5 × 100 m",
        slivers,
        "triangles below 4 mm are covered by patches",
        quick=20_000,
    ),
    _case(
        "faces of 1 mm on a ground of 100 km, missed",
        small_beside_large,
        "0.06 mm margin of the float32 surfaces",
    ),
    _case("leaks out of a solid at edges and vertices, origin 0 to 10 km away", leaks, _MARGIN, quick=90_000),
    _case("leaks into a solid at edges and vertices, origin 0 to 10 km away", pierce, _MARGIN, quick=90_000),
    _case("starts on a face that hit it again", starts_on_a_surface, "starts within 1e-9 m of the plane"),
    _case("identical faces in one place, missed or displaced", coplanar, "either face is reported"),
    _case(
        "NaN, infinite and zero rays that are cast",
        unusable,
        "refused with one line",
        unit="calls",
        of="calls",
        quick=96,
        full=4096,
    ),
)
"""Extremes of rays."""
