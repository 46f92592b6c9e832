"""Closed bodies of which shapes are made: prisms, solids of revolution."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import Class, materials
from geoscene.geometry.mesh import Mesh
from geoscene.typing import Float

Body = tuple[Float, NDArray[np.int32]]
"""Vertices (n, 3) and faces (m, 3) of a closed body."""

SIDES = 8


def prism(outline: Float, bottom: float, *, top: float, taper: float = 1.0) -> Body:
    """Vertices and faces of the prism over a convex outline (n, 2), counter-clockwise, metres.

    taper : the upper outline's size against the lower's, about the origin, over 0
    """
    n = len(outline)
    ring = np.arange(n)
    ahead = np.roll(ring, -1)
    points = np.vstack(
        [np.column_stack([outline, np.full(n, bottom)]), np.column_stack([outline * taper, np.full(n, top)])]
    )
    sides = [np.column_stack([ring, ahead, ahead + n]), np.column_stack([ring, ahead + n, ring + n])]
    lid = np.column_stack([np.full(n - 2, n), ring[1:-1] + n, ring[2:] + n])
    floor = np.column_stack([np.zeros(n - 2, int), ring[2:], ring[1:-1]])
    return points, np.vstack([*sides, lid, floor]).astype(np.int32)


def lathe(profile: Sequence[tuple[float, float]], *, sides: int = SIDES) -> Body:
    """Vertices and faces of the solid of revolution of a profile of (diameter, z), from pole to pole.

    The first and last diameter are not used: the solid ends in a point there. Each ring between has the area
    of its circle.
    """
    rings = len(profile) - 2
    points = [np.array([[0.0, 0.0, profile[0][1]]])]
    for diameter, z in profile[1:-1]:
        points.append(np.column_stack([circle(diameter, sides), np.full(sides, z)]))
    points.append(np.array([[0.0, 0.0, profile[-1][1]]]))
    ring = np.arange(sides)
    ahead = np.roll(ring, -1)
    low = 1 + sides * np.arange(rings - 1)[:, None]
    top = 1 + sides * (rings - 1)
    faces = [
        np.column_stack([np.zeros(sides, int), ahead + 1, ring + 1]),
        np.stack([low + ring, low + ahead, low + ahead + sides], axis=-1).reshape(-1, 3),
        np.stack([low + ring, low + ahead + sides, low + ring + sides], axis=-1).reshape(-1, 3),
        np.column_stack([ring + top, ahead + top, np.full(sides, top + sides)]),
    ]
    return np.vstack(points), np.vstack(faces).astype(np.int32)


def circle(diameter: float, sides: int = SIDES) -> Float:
    """A regular polygon (sides, 2), counter-clockwise, with the area of the circle of that diameter."""
    turn = 2 * np.pi * np.arange(sides) / sides
    radius = diameter / 2 * np.sqrt(2 * np.pi / sides / np.sin(2 * np.pi / sides))
    outline: Float = radius * np.column_stack([np.cos(turn), np.sin(turn)])
    return outline


def rectangle(width: float, depth: float, *, x: float = 0.0, y: float = 0.0) -> Float:
    """A rectangle (4, 2) about (x, y), counter-clockwise."""
    return np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * (width / 2, depth / 2) + (x, y)


def solid(body: Body, *, klass: Class, material: str, color: tuple[int, int, int] | None = None) -> Mesh:
    """A closed mesh of (vertices, faces) of one class and material, in a colour or the material's."""
    points, faces = body
    of = materials()[material]
    return Mesh.of(points, faces, klass=klass, material=of.code, color=color or of.color, closed=True)


def box(size: tuple[float, float], z: tuple[float, float], *, at: tuple[float, float] = (0.0, 0.0)) -> Body:
    """Vertices and faces of a box of some size in x and y about a place, between two heights, metres."""
    return prism(rectangle(*size, x=at[0], y=at[1]), z[0], top=z[1])
