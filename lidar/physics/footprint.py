"""Sampling of a beam's cross-section by rays."""

from __future__ import annotations

import functools

import numpy as np

from geoscene.typing import Float
from lidar.errors import InputError


def ring_energy(rings: int, *, waist: float = 1.0) -> Float:
    """Share of a Gaussian beam's power in each of the equally wide rings that fill its 1/e^2 radius.

    Outer edges are at (i + 1/2) / (rings - 1/2) of that radius, so that ring 0 is a disc of half a ring's
    width, as in HELIOS++ (Winiwarter et al. 2022).

    waist : 1/e^2 radius over the outer edge; the physical value 1 leaves 13.5 % outside, HELIOS++ uses 2
    """
    edge = (np.arange(rings) + 0.5) / (rings - 0.5)
    inside = 1 - np.exp(-2 * (edge / waist) ** 2)
    return np.diff(inside, prepend=0.0)


@functools.cache
def bundle(rays: int) -> tuple[Float, Float]:
    """Positions (rays, 2) on the unit disc, the axis first, and shares (rays,) of the power, with sum 1.

    Ring i has 6 i rays at i / (rings - 1/2) of the 1/e^2 radius: 1, 7, 19, 37 or 61 in all.

    Raises InputError for another number of rays.
    """
    rings = next((k for k in range(1, 6) if 1 + 3 * k * (k - 1) == rays), 0)
    if not rings:
        raise InputError(f"`rays` {rays}: give 1, 7, 19, 37 or 61")
    if rings == 1:
        return np.zeros((1, 2)), np.ones(1)
    energy = ring_energy(rings)
    places, shares = [np.zeros((1, 2))], [energy[:1]]
    for i in range(1, rings):
        angle = 2 * np.pi * (np.arange(6 * i) + 0.5 * (i % 2)) / (6 * i)
        places.append(i / (rings - 0.5) * np.stack([np.cos(angle), np.sin(angle)], axis=1))
        shares.append(np.full(6 * i, energy[i] / (6 * i)))
    share = np.concatenate(shares)
    return np.concatenate(places), share / share.sum()
