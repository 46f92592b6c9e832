"""Rays of the tables of a caster, for compiled code."""

from __future__ import annotations

from typing import Any

from lidar.raycast.memory import inline

OVER, _FARTHEST = 1e-3, 0.1
"""Metres off a plane at which a ray from behind it goes on, as far as shadow rays keep off surfaces; and
metres along the ray at most."""


@inline
def beyond_plane(leaving: float, length: float) -> Any:
    """Ray parameter beyond a plane that the ray crosses from behind.

    leaving : metres that it leaves the plane by per parameter, above 0
    length  : metres per parameter

    A ray that starts on the plane itself would meet it again in float32.
    """
    return min(OVER / leaving, _FARTHEST / length)


@inline
def direction_of(rays: Any, i: int) -> Any:
    """A ray's direction in the caster's axes."""
    x, y, z = rays.directions[i, 0], rays.directions[i, 1], rays.directions[i, 2]
    if len(rays.pose) == 0:
        return x, y, z
    m, p = rays.matrix, rays.pose[i]
    return (
        m[p, 0, 0] * x + m[p, 0, 1] * y + m[p, 0, 2] * z,
        m[p, 1, 0] * x + m[p, 1, 1] * y + m[p, 1, 2] * z,
        m[p, 2, 0] * x + m[p, 2, 1] * y + m[p, 2, 2] * z,
    )


@inline
def origin_of(rays: Any, i: int) -> Any:
    """A ray's origin in the caster's axes."""
    x, y, z = 0.0, 0.0, 0.0
    if len(rays.offsets) > 0:
        o = i if len(rays.offsets) > 1 else 0
        x, y, z = rays.offsets[o, 0], rays.offsets[o, 1], rays.offsets[o, 2]
    if len(rays.pose) == 0:
        return x, y, z
    m, p, at = rays.matrix, rays.pose[i], rays.position
    return (
        at[p, 0] + m[p, 0, 0] * x + m[p, 0, 1] * y + m[p, 0, 2] * z,
        at[p, 1] + m[p, 1, 0] * x + m[p, 1, 1] * y + m[p, 1, 2] * z,
        at[p, 2] + m[p, 2, 0] * x + m[p, 2, 1] * y + m[p, 2, 2] * z,
    )
