"""Closed solids from which bodies are composed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geoscene.classes import Class, materials
from geoscene.geometry.mesh import Mesh, concatenate
from geoscene.objects.solids import lathe
from geoscene.typing import Float

Rgb = tuple[int, int, int]

GLASS: Rgb = (52, 60, 68)
"""Colour of tinted panes."""
DARK: Rgb = (28, 28, 30)
RED: Rgb = (170, 20, 20)
WHITE: Rgb = (238, 238, 232)


def paint(points: Float, faces: NDArray[np.integer], *, material: str, color: Rgb | None = None) -> Mesh:
    """A closed mesh of one material, without a class; in the material's colour by default.

    Faces that all point inwards are flipped.
    """
    of = materials()[material]
    mesh = Mesh.of(points, faces, material=of.code, color=color or of.color, closed=True)
    return mesh if volume(mesh) > 0 else replace(mesh, faces=mesh.faces[:, ::-1].copy())


def repaint(mesh: Mesh, faces: NDArray[np.bool_], *, material: str, color: Rgb | None = None) -> Mesh:
    """The mesh with another material on some of its faces."""
    of = materials()[material]
    return replace(
        mesh,
        material=np.where(faces, of.code, mesh.material).astype(np.uint8),
        color=np.where(faces[:, None], color or of.color, mesh.color).astype(np.uint8),
    )


def body(parts: Sequence[Mesh], klass: Class) -> Mesh:
    """One mesh of all parts, of one class."""
    whole = concatenate(parts)
    return replace(whole, klass=np.full(len(whole), klass, np.uint8))


def loft(rings: ArrayLike, material: str = "car_paint", *, color: Rgb | None = None) -> Mesh:
    """The closed solid through rings (k, n, 3) of corners, all in the same sense.

    Faces are in the order: two for each side of each span between rings, then the lids at the first and the
    last ring.
    """
    points = np.asarray(rings, float)
    k, n, _ = points.shape
    ring = np.arange(n)
    ahead = np.roll(ring, -1)
    low = n * np.arange(k - 1)[:, None]
    side = np.stack(
        [
            np.stack([low + ring, low + ring + n, low + ahead + n], axis=-1),
            np.stack([low + ring, low + ahead + n, low + ahead], axis=-1),
        ],
        axis=2,
    ).reshape(-1, 3)
    fan = np.column_stack([np.zeros(n - 2, int), ring[1:-1], ring[2:]])
    return paint(
        points.reshape(-1, 3),
        np.vstack([side, fan, fan[:, ::-1] + n * (k - 1)]),
        material=material,
        color=color,
    )


def sides(spans: int, corners: int) -> NDArray[np.int64]:
    """Span and side (m, 2) of each face of a loft; -1 and -2 for the lids at its first and last ring."""
    span, side = np.divmod(np.arange(spans * corners).repeat(2), corners)
    lids = np.repeat([-1, -2], corners - 2)
    return np.column_stack([np.concatenate([span, lids]), np.concatenate([side, lids])])


def box(
    low: Sequence[float],
    high: Sequence[float],
    *,
    material: str = "car_paint",
    color: Rgb | None = None,
    taper: tuple[float, float] = (1.0, 1.0),
) -> Mesh:
    """A box between two corners; ``taper`` is the ratio of the top's size to the bottom's along x and y."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    floor = np.array([[x0, y0, z0], [x1, y0, z0], [x1, y1, z0], [x0, y1, z0]])
    middle = np.array([(x0 + x1) / 2, (y0 + y1) / 2, 0.0])
    lid = (floor - middle) * [*taper, 1.0] + middle + [0.0, 0.0, z1 - z0]
    return loft(np.stack([floor, lid])[:, ::-1], material, color=color)


def mirror(mesh: Mesh) -> list[Mesh]:
    """A part on the left and its mirror image on the right."""
    other = replace(mesh, vertices=mesh.vertices * [1.0, -1.0, 1.0], faces=mesh.faces[:, ::-1].copy())
    return [mesh, other]


def wheel(x: float, y: float, *, radius: float, width: float, corners: int = 10) -> Mesh:
    """A wheel about (x, y) on the ground: a tyre with a metal disc on both sides."""
    turn = 2 * np.pi * np.arange(corners) / corners
    rings = []
    for side, share in ((-1, 0.64), (-1, 1.0), (1, 1.0), (1, 0.64)):
        r = share * radius
        rings.append(
            np.column_stack(
                [x + r * np.cos(turn), np.full(corners, y + side * width / 2), radius + r * np.sin(turn)]
            )
        )
    tyre = loft(np.array(rings), "tyre")
    return repaint(tyre, sides(3, corners)[:, 0] < 0, material="metal")


def hoop(x: float, radius: float, *, width: float, corners: int = 12) -> Mesh:
    """A bicycle wheel in the plane y = 0 on the ground at x: a tyre without spokes."""
    turn = 2 * np.pi * np.arange(corners) / corners
    ring = np.column_stack([np.cos(turn), np.zeros(corners), np.sin(turn)])
    side = np.array([0.0, width / 2, 0.0])
    tubes = np.stack(
        [
            radius * ring - side,
            radius * ring + side,
            (radius - width) * ring + side,
            (radius - width) * ring - side,
        ]
    )
    ahead = np.roll(np.arange(corners), -1)
    faces = []
    for a in range(4):
        p, q = a * corners, (a + 1) % 4 * corners
        here = np.arange(corners)
        faces += [
            np.column_stack([p + here, q + ahead, q + here]),
            np.column_stack([p + here, p + ahead, q + ahead]),
        ]
    return paint(tubes.reshape(-1, 3) + np.array([x, 0.0, radius]), np.vstack(faces), material="tyre")


def limb(
    start: ArrayLike,
    end: ArrayLike,
    *,
    thick: tuple[float, float],
    material: str = "clothing",
    color: Rgb | None = None,
    flat: float = 1.0,
    corners: int = 6,
) -> Mesh:
    """A tapering bar between two points; ``thick`` is its width at each, ``flat`` its depth against that."""
    a, b = np.asarray(start, float), np.asarray(end, float)
    along = (b - a) / np.linalg.norm(b - a)
    aside = np.array([0.0, 1.0, 0.0]) if abs(along[1]) < 0.9 else np.array([1.0, 0.0, 0.0])
    u = np.cross(aside, along)
    u /= np.linalg.norm(u)
    v = np.cross(along, u)
    turn = -2 * np.pi * np.arange(corners) / corners
    ring = np.outer(np.cos(turn), u) * flat + np.outer(np.sin(turn), v)
    return loft(np.stack([a + ring * thick[0] / 2, b + ring * thick[1] / 2]), material, color=color)


def ball(centre: ArrayLike, size: Sequence[float], *, material: str, color: Rgb | None = None) -> Mesh:
    """An ellipsoid of 48 faces of the given sizes along x, y and z."""
    points, faces = lathe([(0, -0.5), (0.7, -0.35), (1.0, 0.0), (0.7, 0.35), (0, 0.5)], sides=8)
    return paint(points * size + np.asarray(centre, float), faces, material=material, color=color)


def volume(mesh: Mesh) -> float:
    """Signed volume in cubic metres; positive where closed parts face outwards."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)
