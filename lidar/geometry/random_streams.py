"""Random numbers that depend on seed and purpose alone, not on earlier draws."""

from __future__ import annotations

import hashlib

import numpy as np
from numpy.typing import NDArray

from geoscene.support.splitmix import GOLDEN, mix
from geoscene.typing import Float


def generator(seed: int, *words: object) -> np.random.Generator:
    """A Philox generator keyed by a seed and words such as sensor, frame and purpose."""
    text = "/".join(str(word) for word in (seed, *words))
    digest = hashlib.blake2b(text.encode(), digest_size=16).digest()
    return np.random.Generator(np.random.Philox(key=int.from_bytes(digest, "little")))


def uniform_of(number: NDArray[np.integer], seed: int) -> Float:
    """A number (n,) in the open interval 0 to 1 for each integer: a function of integer and seed."""
    with np.errstate(over="ignore"):
        x = number.astype(np.uint64) + np.uint64(seed % 2**64) * np.uint64(0xD1342543DE82EF95)
        x = mix((x + np.uint64(1)) * GOLDEN)
    return ((x >> np.uint64(11)).astype(np.float64) + 0.5) / 2.0**53


def normal_of(number: NDArray[np.integer], seed: int) -> Float:
    """A standard normal deviate (n,) for each integer: the inverse distribution function of `uniform_of`."""
    from scipy.special import ndtri  # noqa: PLC0415  (0.2 s)

    normal: Float = ndtri(uniform_of(number, seed))
    return normal
