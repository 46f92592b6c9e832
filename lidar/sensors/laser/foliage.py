"""Rays through foliage: tree crowns and hedges let part of them pass."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoscene.typing import Float
from lidar.geometry.random_streams import uniform_of
from lidar.raycast import Caster, Hits
from lidar.sensors.laser.rays import PulseRays
from lidar.world.surfaces import SurfaceFaces

PROJECTION = 0.5
"""Projected area per leaf area, for leaves of uniformly distributed orientation (Ross 1981)."""

_MAX_CROSSINGS = 24  # crown surfaces that a ray may cross; after that it ends on a leaf
_CLEAR = 2e-4  # metres beyond a surface at which the next ray starts


@dataclass(frozen=True, slots=True)
class Foliage:
    """Extinction of rays in crowns and hedges.

    caster, faces : of the world
    far           : maximum range, metres
    seed          : of the random optical depths
    """

    caster: Caster
    faces: SurfaceFaces
    far: float
    seed: int

    def pierce(
        self, hits: Hits, rays: PulseRays, *, first: int, time: NDArray[np.float32] | None
    ) -> NDArray[np.int64]:
        """Move hits on foliage to the leaf hit or to the surface behind, in place; return their rows.

        first : number of the first ray; the same number and seed give the same leaf
        time  : (n,) ray times, or None

        Beer-Lambert law: a share exp(-G a L) of rays passes L metres of foliage with leaf area density a,
        where G is `PROJECTION`. Each ray draws the optical depth at which it ends on a leaf. The orientation
        of leaves is uniformly distributed, so that the cosine c of the incidence has the density 2c.
        """
        rows = np.flatnonzero(self._kind(hits))
        if not len(rows):
            return rows
        through = rays.take(rows)
        poses = through.poses.take(through.index)
        start, direction = poses.place(through.origin), poses.directions(through.direction)
        depth = -np.log(uniform_of(first + rows, self.seed))
        cosine = np.sqrt(uniform_of(first + rows, ~self.seed)).astype(np.float32)
        passage = _Passage(hits, rows, depth=depth, cosine=cosine)
        found = Hits(hits.range[rows], hits.face[rows], hits.instance[rows], hits.cosine[rows], hits.normal)
        active = np.arange(len(rows))
        for _ in range(_MAX_CROSSINGS):
            active, at = passage.advance(active, found, kind=self._kind(found), leaves=self.faces.leaves)
            if not len(active):
                break
            ray_time = None if time is None else time[rows[active]]
            begin = at + _CLEAR
            origin, ahead = start[active] + begin[:, None] * direction[active], direction[active]
            found = self.caster.cast(origin, ahead, time=ray_time)
            found.range[:] += begin
        passage.end(active)
        lost = rows[hits.range[rows] > self.far]
        hits.range[lost], hits.face[lost], hits.instance[lost], hits.cosine[lost] = np.inf, -1, -1, 0.0
        return rows

    def _kind(self, hits: Hits) -> NDArray[np.int64]:
        """Kind of foliage (n,) of the surfaces hit; 0 for none."""
        attributes: NDArray[np.int64] = self.faces.packed[hits.face + self.faces.start[hits.instance]]
        return (attributes >> 16) & 255


class _Passage:
    """Passage of rays through foliage; their end points are written to ``hits``.

    rows   : (k,) rows of the hits
    depth  : (k,) optical depth at which each ray ends on a leaf
    cosine : (k,) of the incidence on that leaf
    """

    def __init__(
        self, hits: Hits, rows: NDArray[np.int64], *, depth: Float, cosine: NDArray[np.float32]
    ) -> None:
        self._hits, self._rows, self._left, self._cosine = hits, rows, depth, cosine
        self._dense, self._at = np.zeros(len(rows)), np.zeros(len(rows))
        self._crown = np.full((2, len(rows)), -1, np.int32)

    def advance(
        self, active: NDArray[np.int64], found: Hits, *, kind: NDArray[np.int64], leaves: Float
    ) -> tuple[NDArray[np.int64], Float]:
        """Advance rays to the surfaces they hit; return those that cross them, and the ranges there.

        kind   : kind of foliage of each surface
        leaves : leaf area density by kind, m2/m3
        """
        own = PROJECTION * leaves[kind]
        enters = found.cosine > 0
        # A ray that leaves a crown has been inside, even if it started there.
        dense = np.maximum(self._dense[active], np.where(enters, 0.0, own))
        dense[found.face < 0] = 0.0  # crowns are closed: a ray that never leaves one has grazed its edge
        lost = np.where(
            dense > 0, dense * (np.where(found.face < 0, 0.0, found.range) - self._at[active]), 0.0
        )
        leaf = lost > self._left[active]
        inside = ~enters & (self._crown[0, active] < 0) & (own > 0)
        self._crown[:, active[inside]] = found.face[inside], found.instance[inside]
        ended = active[leaf]
        self._write(ended, self._at[ended] + self._left[ended] / dense[leaf])
        solid = ~leaf & (kind == 0)
        rows, hits = self._rows[active[solid]], self._hits
        hits.range[rows], hits.cosine[rows] = found.range[solid], found.cosine[solid]
        hits.face[rows], hits.instance[rows] = found.face[solid], found.instance[solid]
        cross = ~leaf & (kind > 0)
        crossing = active[cross]
        self._left[crossing] -= lost[cross]
        self._dense[crossing] = np.maximum(dense[cross] + np.where(enters, own, -own)[cross], 0.0)
        self._at[crossing] = found.range[cross]
        entered = active[cross & enters]
        self._crown[:, entered] = found.face[cross & enters], found.instance[cross & enters]
        return crossing, found.range[cross]

    def end(self, active: NDArray[np.int64]) -> None:
        """End rays on a leaf at their present range."""
        self._write(active, self._at[active])

    def _write(self, ended: NDArray[np.int64], distance: Float) -> None:
        """Write hits on leaves of the crown that was entered last."""
        rows, hits = self._rows[ended], self._hits
        hits.range[rows], hits.cosine[rows] = distance, self._cosine[ended]
        hits.face[rows], hits.instance[rows] = self._crown[:, ended]
