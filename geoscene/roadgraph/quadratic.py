"""Quadratic programs with soft bounds."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Any

import numpy as np

from geoscene.typing import Float

log = logging.getLogger(__name__)

_ROUNDS = 400
_CLOSE = 1e-4
_GAP, _FORCE = 5.0, 1000.0
"""Where gaps and forces start: the size of both on real roads, which halves the rounds."""


@dataclass(frozen=True, slots=True)
class Bounds:
    """Soft bounds ``a z >= b``; a violation of s costs ``weight s^2 / 2``.

    a : (k, n) scipy.sparse array
    b, weight : (k,) float64
    """

    a: Any
    b: Float
    weight: Float


def interior_point(cost: Any, linear: Float, *, bounds: Bounds, start: Float) -> Float:
    """The z (n,) that minimises ``z cost z / 2 - linear z`` plus the cost of violated bounds.

    Mehrotra's predictor-corrector method (Nocedal and Wright, Numerical Optimization, 2nd edition, 16.6),
    with one sparse factorisation per iteration; it ends when residuals and steps are under 0.1 mm. Whole
    cities need 60 to 100 iterations. A warning says so if 400 are not enough.

    cost : (n, n) scipy.sparse array, symmetric, positive definite
    """
    from scipy.sparse import diags_array  # noqa: PLC0415  (slow to import)
    from scipy.sparse.linalg import splu  # noqa: PLC0415

    a, b, give = bounds.a, bounds.b, 1.0 / bounds.weight
    across = a.T.tocsr()
    z = start.astype(float)
    gap = np.maximum(a @ z - b, _GAP)
    force = np.full(len(b), _FORCE)
    for _ in range(_ROUNDS):
        dual = cost @ z - linear - across @ force
        primal = a @ z + give * force - b - gap
        stiff = 1.0 / (give + gap / force)
        system = (cost + across @ diags_array(stiff) @ a).tocsc()
        # Positive definite: pivots stay on the diagonal, which keeps the factor sparse. On street grids of a
        # whole city minimum degree on a + a' fills five times as much as this order, elsewhere a little less.
        factor = splu(system, permc_spec="COLAMD", diag_pivot_thresh=0.0, options={"SymmetricMode": True})

        def step(complement: Float) -> tuple[Float, Float, Float]:
            short = -primal - complement / force  # noqa: B023
            move = factor.solve(across @ (stiff * short) - dual)  # noqa: B023
            more_force = stiff * (short - a @ move)  # noqa: B023
            return move, -(complement + gap * more_force) / force, more_force  # noqa: B023

        _, more_gap, more_force = step(gap * force)
        far = _reach(gap, more_gap), _reach(force, more_force)
        # Not products of vectors by BLAS: the number of its threads, which wait busily, would change sums.
        mean = float((gap * force).sum()) / max(len(b), 1)
        ahead = float(((gap + far[0] * more_gap) * (force + far[1] * more_force)).sum()) / max(len(b), 1)
        centre = (ahead / mean) ** 3 * mean
        move, more_gap, more_force = step(gap * force + more_gap * more_force - centre)
        share = 0.995 * min(_reach(gap, more_gap), _reach(force, more_force))
        z = z + share * move
        gap, force = gap + share * more_gap, force + share * more_force
        moved = share * np.abs(move).max()
        if moved < _CLOSE and np.abs(primal).max() < _CLOSE:
            break
    else:
        log.warning("heights of streets are not settled after %d iterations, last by %.3f m", _ROUNDS, moved)
    return z


def _reach(value: Float, change: Float) -> float:
    """Largest step, at most 1, along which positive values stay positive."""
    falling = change < 0
    return min(1.0, float((-value[falling] / change[falling]).min(initial=np.inf)))
