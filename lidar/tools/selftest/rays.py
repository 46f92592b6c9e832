"""Extremes of rays: distances, incidence, shapes of faces, edges, starts, numbers that are none."""

from __future__ import annotations

import numpy as np

from geoscene.typing import Float, Ints
from lidar.errors import InputError
from lidar.raycast import Caster
from lidar.tools.selftest.case import ExtremeCase
from lidar.tools.selftest.meshes import ball, batches, cuboid, directions, prism_of_slivers, sheet

_FAR = np.array([0.001, 0.01, 0.1, 1.0, 10.0, 100.0])
_FARTHER = np.array([1e3, 1e4, 1e5])
_ORIGINS = (0.0, 1e3, 1e4)
"""Metres from the caster's origin to the place of a case."""


def _plane_errors(count: int, distances: Float) -> Float:
    """Largest error in metres of ranges to planes at each distance (k,), incidence up to 60 degrees."""
    worst = np.zeros(len(distances))
    for row, distance in enumerate(distances):
        for k, size in batches(count // len(distances)):
            rng = np.random.default_rng([row, k])
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
            worst[row] = max(worst[row], float(np.abs(hits.range - expected).max()))
    return worst


def near_ranges(count: int) -> float:
    """Largest error in metres of ranges of 1 mm to 100 m."""
    return float(_plane_errors(count, _FAR).max())


def far_ranges(count: int) -> float:
    """Largest error of ranges of 1 to 100 km, relative to the range."""
    return float((_plane_errors(count, _FARTHER) / _FARTHER).max())


def grazing(count: int) -> float:
    """Largest relative error of ranges at incidences of 89.9 to 89.999 degrees."""
    height, worst = 12.345678, 0.0
    vertices, faces = sheet(np.array([0.0, 0, 1]), np.zeros(3), size=2e6)
    caster = Caster(vertices, faces)
    for k, size in batches(count):
        rng = np.random.default_rng([1, k])
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
    for k, size in batches(count):
        rng = np.random.default_rng([2, k])
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
    for k, size in batches(count):
        rng = np.random.default_rng([3, k])
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


def leaks(count: int) -> float:
    """Rays from within a ball, at its vertices and edges, that leave it; at three distances of the origin."""
    vertices, faces = ball(5, radius=10.0)
    lost = 0
    for row, distance in enumerate(_ORIGINS):
        caster = Caster(vertices, faces, origin=np.array([distance, 0, 0]))
        for k, size in batches(count // len(_ORIGINS)):
            rng = np.random.default_rng([4, row, k])
            start = rng.uniform(-2, 2, (size, 3))
            hits = caster.cast(start, _aims(rng, (vertices, faces), count=size) - start)
            lost += int((~np.isfinite(hits.range)).sum())
    return lost


def pierce(count: int) -> float:
    """Rays from outside, at vertices and edges of a ball, that hit a second ball 0.5 m within."""
    vertices, faces = ball(5, radius=10.0)
    inner, more = ball(5, radius=9.5)
    whole, both = np.concatenate([vertices, inner]), np.concatenate([faces, more + len(vertices)])
    lost = 0
    for row, distance in enumerate(_ORIGINS):
        caster = Caster(whole, both, origin=np.array([distance, 0, 0]))
        for k, size in batches(count // len(_ORIGINS)):
            rng = np.random.default_rng([5, row, k])
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
    for k, size in batches(count):
        rng = np.random.default_rng([6, k])
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
    for k, size in batches(count):
        rng = np.random.default_rng([7, k])
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


CASES = (
    ExtremeCase(
        "rays",
        "range of 1 mm to 100 m, incidence to 60°",
        1e-9,
        "m",
        near_ranges,
        "rays",
        60_000,
        10**7,
        "float64 plane of the face",
    ),
    ExtremeCase(
        "rays",
        "range of 1 to 100 km, incidence to 60°",
        1e-12,
        "of the range",
        far_ranges,
        "rays",
        60_000,
        10**7,
        "float64 plane of the face",
    ),
    ExtremeCase(
        "rays",
        "range at incidence of 89.9° to 89.999°",
        1e-11,
        "of the range",
        grazing,
        "rays",
        50_000,
        10**7,
        "rounding of the ray's direction, divided by the cosine",
    ),
    ExtremeCase(
        "rays",
        "leaks through slivers of 1e-5 × 100 m",
        0,
        "rays",
        slivers,
        "rays",
        20_000,
        10**7,
        "triangles below 4 mm are covered by patches",
    ),
    ExtremeCase(
        "rays",
        "faces of 1 mm on a ground of 100 km, missed",
        0,
        "rays",
        small_beside_large,
        "rays",
        50_000,
        10**7,
        "0.06 mm margin of the float32 surfaces",
    ),
    ExtremeCase(
        "rays",
        "leaks out of a solid at edges and vertices, origin 0 to 10 km away",
        0,
        "rays",
        leaks,
        "rays",
        90_000,
        10**7,
        "margin of 0.06 mm, 0.24 mm per km from the origin",
    ),
    ExtremeCase(
        "rays",
        "leaks into a solid at edges and vertices, origin 0 to 10 km away",
        0,
        "rays",
        pierce,
        "rays",
        90_000,
        10**7,
        "margin of 0.06 mm, 0.24 mm per km from the origin",
    ),
    ExtremeCase(
        "rays",
        "starts on a face that hit it again",
        0,
        "rays",
        starts_on_a_surface,
        "rays",
        50_000,
        10**7,
        "starts within 1e-9 m of the plane",
    ),
    ExtremeCase(
        "rays",
        "identical faces in one place, missed or displaced",
        0,
        "rays",
        coplanar,
        "rays",
        50_000,
        10**7,
        "either face is reported",
    ),
    ExtremeCase(
        "rays",
        "NaN, infinite and zero rays that are cast",
        0,
        "calls",
        unusable,
        "calls",
        96,
        4096,
        "refused with one line",
    ),
)
"""Extremes of rays."""
