"""Roads and tracks with relief: the camber of carriageways, beds of ballast, ends of raised sidewalks."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely

from geoscene.ground.ballast import Beds
from geoscene.ground.nearby import shapes_near
from geoscene.typing import Float

CAMBER = 0.025
"""Fall from the middle of a carriageway to its edges, m/m (RASt 06, RAL: the least crossfall is 2.5 %)."""


@dataclass(frozen=True, slots=True)
class Kerbs:
    """Raised sidewalks beside carriageways.

    ends : STRtree of lines across roads at which they come down, as bridges and tunnels are level
    """

    ends: shapely.STRtree

    @classmethod
    def of(cls, ends: Iterable[Any] = ()) -> Kerbs:
        """Kerbs along given lines."""
        return cls(shapely.STRtree(np.fromiter(ends, object)))


@dataclass(frozen=True, slots=True)
class Camber:
    """Gable roofs over straight pieces of centre lines; where several overlap the highest counts.

    start, end : (m, 2) float64 scene metres, ends of the pieces
    half  : (m,) float64 metres, half the width of the carriageway
    crown : (m, 2) float64 metres by which the middle stands above the edges at start and end
    tree  : STRtree of the pieces
    """

    start: Float
    end: Float
    half: Float
    crown: Float
    tree: shapely.STRtree

    @classmethod
    def of(cls, start: Float, end: Float, *, half: Float, crown: Float) -> Camber:
        """The camber of pieces; columns as above."""
        pieces = shapely.linestrings(np.stack([start, end], axis=1)) if len(start) else np.empty(0, object)
        return cls(start, end, half, crown, shapely.STRtree(pieces))

    def metres(self, box: Sequence[float]) -> float:
        """Length of the pieces whose middle lies in a box (xmin, ymin, xmax, ymax)."""
        middle = (self.start + self.end) / 2
        within = ((middle >= box[:2]) & (middle <= box[2:])).all(axis=1)
        return float(np.hypot(*(self.end - self.start)[within].T).sum())

    def height(self, xy: Float) -> Float:
        """Height (n,) in metres of the surface above the edges of its carriageway at points (n, 2).

        0 on edges and outside. It depends on the place alone and has no steps.
        """
        z = np.zeros(len(xy))
        if not len(self.start):
            return z
        point, piece = shapes_near(self.tree, xy, reach=self.half)
        along = self.end[piece] - self.start[piece]
        square = np.maximum((along**2).sum(axis=1), 1e-12)
        share = np.clip(((xy[point] - self.start[piece]) * along).sum(axis=1) / square, 0.0, 1.0)
        away = np.hypot(*(xy[point] - self.start[piece] - share[:, None] * along).T)
        crown = self.crown[piece, 0] * (1.0 - share) + self.crown[piece, 1] * share
        np.maximum.at(z, point, crown * np.maximum(1.0 - away / self.half[piece], 0.0))
        return z


@dataclass(frozen=True, slots=True)
class Raised:
    """Surfaces above the planned height of the ground: cambered carriageways and ballast beds.

    They do not overlap.
    """

    camber: Camber
    beds: Beds

    def height(self, xy: Float) -> Float:
        """Metres (n,) above the planned height at points (n, 2)."""
        return self.camber.height(xy) + self.beds.height(xy)
