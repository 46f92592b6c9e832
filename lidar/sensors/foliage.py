"""Rays among leaves: crowns and hedges are not walls."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoscene.typing import Float
from lidar.random_streams import uniform_of
from lidar.raycast import Caster, Hits
from lidar.sensors.motion import Rays
from lidar.world.world import Faces

PROJECTION = 0.5
"""Shadow of a unit of leaf area on a plane across the ray, where leaves face all ways alike (Ross 1981)."""

_CROSSINGS = 24  # surfaces of crowns that a ray may cross before it is taken to end on a leaf
_CLEAR = 2e-4  # metres, how far beyond a surface the next ray starts


@dataclass(frozen=True, slots=True)
class Leaves:
    """How rays go through foliage.

    caster, faces : what they are cast at
    far           : metres
    seed          : of the leaves that rays meet
    """

    caster: Caster
    faces: Faces
    far: float
    seed: int

    def pierce(
        self, hits: Hits, rays: Rays, *, first: int, time: NDArray[np.float32] | None
    ) -> NDArray[np.int64]:
        """Move the hits of rays that meet foliage to the leaf or to what lies behind, in place; their rows.

        first : number of the first ray: the same number and seed meet the same leaf
        time  : (n,) ray times, or None

        Light is lost in leaves as Beer and Lambert say: a share exp(-G a L) of rays passes L metres of a leaf
        area of a per volume, with `PROJECTION` G. Each ray draws the optical depth at which it ends. What it
        meets in a crown is a leaf, which faces all ways alike: the cosine has the density 2c.
        """
        rows = np.flatnonzero(self._kind(hits))
        if not len(rows):
            return rows
        through = rays.take(rows)
        poses = through.poses.take(through.index)
        start, way = poses.place(through.origin), poses.directions(through.direction)
        walk = _Walk(
            hits,
            rows,
            depth=-np.log(uniform_of(first + rows, self.seed)),
            share=uniform_of(first + rows, ~self.seed),
        )
        met = Hits(hits.range[rows], hits.face[rows], hits.instance[rows], hits.cosine[rows], hits.normal)
        going = np.arange(len(rows))
        for _ in range(_CROSSINGS):
            going, at = walk.on(going, met, kind=self._kind(met), leaves=self.faces.leaves)
            if not len(going):
                break
            later = None if time is None else time[rows[going]]
            begin = at + _CLEAR
            met = self.caster.cast(start[going] + begin[:, None] * way[going], way[going], time=later)
            met.range[:] += begin
        walk.end(going)
        lost = rows[hits.range[rows] > self.far]
        hits.range[lost], hits.face[lost], hits.instance[lost], hits.cosine[lost] = np.inf, -1, -1, 0.0
        return rows

    def _kind(self, hits: Hits) -> NDArray[np.int64]:
        """Kinds of leaves behind what was hit."""
        what: NDArray[np.int64] = self.faces.what[hits.face + self.faces.start[hits.instance]]
        return (what >> 16) & 255


class _Walk:
    """Rays on their way through foliage; where they end goes into ``hits``.

    rows  : (k,) of the hits
    depth : (k,) optical depth at which each ray meets a leaf
    share : (k,) of the leaves that a ray meets, those that it meets more squarely
    """

    def __init__(self, hits: Hits, rows: NDArray[np.int64], *, depth: Float, share: Float) -> None:
        self._hits, self._rows, self._left = hits, rows, depth
        self._cosine = np.sqrt(share).astype(np.float32)
        self._dense, self._at = np.zeros(len(rows)), np.zeros(len(rows))
        self._crown = np.full((2, len(rows)), -1, np.int32)

    def on(
        self, going: NDArray[np.int64], met: Hits, *, kind: NDArray[np.int64], leaves: Float
    ) -> tuple[NDArray[np.int64], Float]:
        """Go on to the surfaces that were met; the rays that cross them, and where they do."""
        own = PROJECTION * leaves[kind]
        enters = met.cosine > 0
        # Whoever leaves a crown has been in it, even if the ray began there.
        dense = np.maximum(self._dense[going], np.where(enters, 0.0, own))
        dense[met.face < 0] = 0.0  # crowns are closed: what never leaves one slipped past its rim
        lost = np.where(dense > 0, dense * (np.where(met.face < 0, 0.0, met.range) - self._at[going]), 0.0)
        leaf = lost > self._left[going]
        inside = ~enters & (self._crown[0, going] < 0) & (own > 0)
        self._crown[:, going[inside]] = met.face[inside], met.instance[inside]
        ended = going[leaf]
        self._write(ended, self._at[ended] + self._left[ended] / dense[leaf])
        solid = ~leaf & (kind == 0)
        rows, hits = self._rows[going[solid]], self._hits
        hits.range[rows], hits.cosine[rows] = met.range[solid], met.cosine[solid]
        hits.face[rows], hits.instance[rows] = met.face[solid], met.instance[solid]
        cross = ~leaf & (kind > 0)
        on = going[cross]
        self._left[on] -= lost[cross]
        self._dense[on] = np.maximum(dense[cross] + np.where(enters, own, -own)[cross], 0.0)
        self._at[on] = met.range[cross]
        entered = going[cross & enters]
        self._crown[:, entered] = met.face[cross & enters], met.instance[cross & enters]
        return on, met.range[cross]

    def end(self, going: NDArray[np.int64]) -> None:
        """End rays on a leaf where they are."""
        self._write(going, self._at[going])

    def _write(self, ended: NDArray[np.int64], distance: Float) -> None:
        """Put leaves of the crown that was entered last into the hits."""
        rows, hits = self._rows[ended], self._hits
        hits.range[rows], hits.cosine[rows] = distance, self._cosine[ended]
        hits.face[rows], hits.instance[rows] = self._crown[:, ended]
