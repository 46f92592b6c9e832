"""Published de-weathering filters, each with the parameters of its paper."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass
from math import radians

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from geoscene.support.registry import Registry
from geoscene.typing import Float
from lidar.errors import InputError
from lidar.parameters import Parameters, build, item_text, parameter, read_items

Bools = NDArray[np.bool_]

# DDIOR: distances in metres, and the factors between them.
_DISTANCES = np.arange(10.0, 100.0, 10.0)
_FACTORS = np.linspace(0.016, 0.034, 10)


@dataclass(frozen=True)
class Filter(Parameters):
    """Base of all filters."""

    @abstractmethod
    def kept(self, xyz: Float, intensity: Float) -> Bools:
        """Whether each return (n,) is of a surface, as far as the filter tells.

        xyz       : (n, 3) metres, sensor frame
        intensity : (n,) codes, 0 to 255; 100 is a white diffuse target
        """


@dataclass(frozen=True)
class StatisticalFilter(Filter):
    """Mean distance to neighbours below the cloud's mean plus a deviation (Rusu and Cousins 2011)."""

    neighbours: int = parameter(50, "nearest returns", low=1, high=500)
    deviations: float = parameter(1.0, "standard deviations above the mean", low=0, high=100)

    def kept(self, xyz: Float, intensity: Float) -> Bools:
        """Returns near enough to their neighbours."""
        del intensity
        spacing = _spacing(xyz, self.neighbours)
        kept: Bools = spacing < _mean(spacing) + self.deviations * _deviation(spacing)
        return kept


@dataclass(frozen=True)
class Dror(Filter):
    """Dynamic radius: neighbours within a radius that grows with the distance (Charron et al. 2018)."""

    neighbours: int = parameter(3, "least number of returns within the radius", low=1, high=100)
    multiplier: float = parameter(3.0, "radius over the spacing of columns", low=0.1, high=100)
    angle: float = parameter(0.16, "spacing of columns", unit="degrees", low=0.001, high=10)
    radius: float = parameter(0.04, "least radius", unit="m", low=0, high=10)

    def kept(self, xyz: Float, intensity: Float) -> Bools:
        """Returns with enough neighbours."""
        del intensity
        level = np.hypot(xyz[:, 0], xyz[:, 1])
        radius = np.maximum(self.multiplier * radians(self.angle) * level, self.radius)
        kept: Bools = _farthest(xyz, self.neighbours) <= radius
        return kept


@dataclass(frozen=True)
class Dsor(Filter):
    """Dynamic statistical: the limit of the mean distance grows with the distance (Kurup and Bos 2021)."""

    neighbours: int = parameter(5, "nearest returns", low=1, high=500)
    deviations: float = parameter(0.01, "standard deviations above the mean", low=0, high=100)
    factor: float = parameter(0.05, "growth of the limit with the distance", unit="1/m", low=1e-4, high=10)

    def kept(self, xyz: Float, intensity: Float) -> Bools:
        """Returns near enough to their neighbours for their distance."""
        del intensity
        spacing = _spacing(xyz, self.neighbours)
        limit = _mean(spacing) + self.deviations * _deviation(spacing)
        kept: Bools = spacing < limit * self.factor * np.linalg.norm(xyz, axis=1)
        return kept


@dataclass(frozen=True)
class Lior(Filter):
    """Low intensity: dim returns without neighbours, within the range of snow (Park et al. 2020)."""

    intensity: float = parameter(5.0, "greatest code of a dim return", low=0, high=255)
    range: float = parameter(71.2, "range up to which snow is detected", unit="m", low=0, high=1e4)
    radius: float = parameter(
        0.1, "radius within which neighbours save a dim return", unit="m", low=0, high=10
    )
    neighbours: int = parameter(3, "number of them", low=1, high=100)

    def kept(self, xyz: Float, intensity: Float) -> Bools:
        """Returns that are bright, far, or among neighbours."""
        dim = (intensity <= self.intensity) & (np.linalg.norm(xyz, axis=1) <= self.range)
        kept: Bools = ~dim
        if dim.any():
            kept[dim] = _farthest(xyz, self.neighbours, of=dim) < self.radius
        return kept


@dataclass(frozen=True)
class Ddior(Filter):
    """Dynamic distance-intensity: the limit grows with distance and intensity (Wang et al. 2022)."""

    neighbours: int = parameter(5, "nearest returns", low=1, high=500)
    weight: float = parameter(0.1, "of the intensity code", low=0, high=100)

    def kept(self, xyz: Float, intensity: Float) -> Bools:
        """Returns near enough to their neighbours for their distance and intensity."""
        spacing, distance = _spacing(xyz, self.neighbours), np.linalg.norm(xyz, axis=1)
        factor = _FACTORS[np.searchsorted(_DISTANCES, distance)] + self.weight * intensity
        kept: Bools = spacing < factor * _mean(spacing) * distance
        return kept


METHODS: Registry[type[Filter]] = Registry(
    "method",
    {"statistical": StatisticalFilter, "dror": Dror, "dsor": Dsor, "lior": Lior, "ddior": Ddior},
    error=InputError,
)
"""Filters by name."""


def read_methods(texts: Iterable[str]) -> dict[str, Filter]:
    """Filters by their text ``NAME:KEY=VALUE,KEY=VALUE``; several are separated by commas.

    texts : also files ``FILE.toml`` with tables ``[[method]]``

    Raises InputError for a filter or parameter that is unknown or given twice, a value out of its bounds, or
    no text.
    """
    found: dict[str, Filter] = {}
    for item in read_items(texts, METHODS, table="method"):
        text = item_text(item)
        if text in found:
            raise InputError(f"method {text}: given twice")
        found[text] = build(METHODS, item)
    if not found:
        raise InputError(f"`method`: give one or more of {', '.join(METHODS)}")
    return found


def _nearest(xyz: Float, count: int, *, of: Bools | None = None) -> Float:
    """Distances (n, count) in metres to the nearest other returns, ascending; inf where there are fewer."""
    own = xyz if of is None else xyz[of]
    if not len(own):
        return np.empty((0, count))
    away: Float = cKDTree(xyz).query(own, k=count + 1)[0]
    return away[:, 1:]


def _spacing(xyz: Float, count: int) -> Float:
    """Mean distance (n,) to a number of neighbours; inf for a cloud with fewer."""
    spacing: Float = _nearest(xyz, count).mean(axis=1)
    return spacing


def _farthest(xyz: Float, count: int, *, of: Bools | None = None) -> Float:
    """Distance (n,) within which a number of neighbours lie."""
    return _nearest(xyz, count, of=of)[:, -1]


def _mean(spacing: Float) -> float:
    """Mean of the finite values."""
    known = spacing[np.isfinite(spacing)]
    return float(known.mean()) if len(known) else 0.0


def _deviation(spacing: Float) -> float:
    """Sample standard deviation of the finite values."""
    known = spacing[np.isfinite(spacing)]
    return float(known.std(ddof=1)) if len(known) > 1 else 0.0
