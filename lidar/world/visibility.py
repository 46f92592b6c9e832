"""Visible share of each road user from a point in the scene."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geoscene.geometry.mesh import Mesh
from geoscene.typing import Float
from lidar.world.actors import Actors, poses_of, rotations, states
from lidar.world.world import World

_SAMPLES = 192  # sample points on a body: half face away, so the error of a share is about 1 / sqrt(96)
_R2 = np.array([0.7548776662466927, 0.5698402909980532])
"""Steps of a low-discrepancy sequence in the square (Roberts, R2, 2018)."""
_TOUCH = 1e-3  # relative distance by which a hit may precede its sample point


class Visibility:
    """Sample points on the bodies of actors, for visibility tests by shadow rays.

    actors : the road users; `World.actors` must be their bodies
    """

    def __init__(self, actors: Actors) -> None:
        self._actors = actors
        places = [_spread(shape.mesh) for shape in actors.shapes]
        self._place = np.stack([p for p, _ in places]) if places else np.empty((0, _SAMPLES, 3))
        self._normal = np.stack([n for _, n in places]) if places else np.empty((0, _SAMPLES, 3))

    def seen_from(self, eye: ArrayLike, world: World, *, rows: NDArray[np.int64], time_ns: int) -> Float:
        """Visible share (k,) of each of the actors ``rows`` from ``eye``, 0 to 1.

        It is the unoccluded share, by solid angle, of the side facing the eye. Ray time 0 of ``world``
        must be ``time_ns``.

        eye : (3,) scene metres
        """
        actors = self._actors
        k = len(rows)
        if not k:
            return np.empty(0)
        at = states(actors, rows, time_ns=time_ns)
        body = poses_of(actors, rows, at=at)
        turn, stretch = rotations(at.angles), actors.stretch[rows][:, None]
        across = np.array([actors.scale, actors.scale, 1.0])
        place = np.einsum("kij,knj->kni", turn, self._place[body] * stretch) * across + at.position[:, None]
        normal = np.einsum("kij,knj->kni", turn, self._normal[body] / stretch)
        way = place - np.asarray(eye, float)
        far = np.linalg.norm(way, axis=2)
        facing = -np.einsum("kni,kni->kn", normal, way) / np.linalg.norm(normal, axis=2) / far
        angle = np.maximum(facing, 0.0) / far**2
        row, sample = np.nonzero(angle > 0)
        hits = world.caster.cast(np.asarray(eye, float), way[row, sample], far=1.0 - _TOUCH)
        hidden = np.isfinite(hits.range) & (world.lookup(hits).feature != actors.feature[rows][row])
        seen = np.bincount(row, weights=np.where(hidden, 0.0, angle[row, sample]), minlength=k)
        share: Float = seen / np.maximum(angle.sum(axis=1), 1e-300)
        return share


def _spread(mesh: Mesh) -> tuple[Float, Float]:
    """Points (n, 3) spread evenly over a mesh, and the unit normals (n, 3) there."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces].astype(np.float64), 1, 0)
    cross = np.cross(b - a, c - a)
    area = np.linalg.norm(cross, axis=1)
    step = np.arange(_SAMPLES)
    total = np.cumsum(area)
    face = np.minimum(np.searchsorted(total, (step + 0.5) / _SAMPLES * total[-1]), len(area) - 1)
    u, v = ((step[:, None] + 1) * _R2 % 1.0).T
    over = u + v > 1
    u, v = np.where(over, 1 - u, u), np.where(over, 1 - v, v)
    place = a[face] + u[:, None] * (b - a)[face] + v[:, None] * (c - a)[face]
    normal = cross[face] / np.maximum(area[face], 1e-300)[:, None]
    return place, normal
