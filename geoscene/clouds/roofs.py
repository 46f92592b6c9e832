"""Fits the roof shapes of `geoscene.buildings.roofs` to the points above a footprint."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from shapely.errors import GEOSException

from geoscene.buildings.roofs import SECTIONS, RoofSpec, roof_shell
from geoscene.geometry.mesh import ROOF
from geoscene.geometry.polylines import cross
from geoscene.typing import Bools, Float

FEWEST = 15
"""Points on a roof with which it is measured."""

COVERED = {"flat": 0.4, "pitched": 0.65}
"""Least share of the points, and of the footprint, that a fit explains: a plane through one side of a gabled
roof explains half of it. Flat roofs carry more plant, and may have further levels."""

_AT_MOST = 1200  # points that are fitted
_PAIRS = 60  # hypotheses of two points for each shape
_OFF = 0.3  # metres from which a point does not count: chimneys, dormers, trees
_NOISE = 0.03  # metres of noise that are always assumed, so that no shape wins by fitting noise
_INDEPENDENT = 150  # points that count as independent at most: neighbours have their errors in common
_BLOCK = 70.0  # percentile of the points on a roof without a shape that is its height
_LEAST_ROOF, _MOST_ROOF = 0.4, 40.0  # metres of a pitched roof
_STEEPEST = 3.0  # height of a roof over the radius of the footprint, at most

_PARAMETERS = {
    "flat": 1, "gabled": 3, "hipped": 3, "pyramidal": 3, "skillion": 3, "half-hipped": 4, "saltbox": 5,
    "gambrel": 5, "mansard": 5, "round": 5, "dome": 5, "cone": 4,
}  # fmt: skip
"""Shapes that are tried; eaves, height, direction and breaks of slope count in the choice (BIC)."""

_DIRECTED = ("skillion", "saltbox")


@dataclass(frozen=True, slots=True)
class Roof:
    """A measured roof.

    top       : z of its highest point, metres
    height    : metres of the roof alone, 0 if flat
    shape     : one of `geoscene.buildings.table.SHAPES`; "" if no shape explains the points (`block_of`)
    direction : radians counter-clockwise from x, downslope; NaN for shapes without a direction
    across    : the ridge runs across the longer side
    sigma     : metres, standard deviation of the points about the fit
    share     : of the points that the fit explains within 0.3 m
    levels    : z of further flat levels with at least a fifth of the points each; empty for most
    """

    top: float
    height: float
    shape: str
    direction: float
    across: bool
    sigma: float
    share: float
    levels: tuple[float, ...] = ()


def fit_roof(polygon: Any, xyz: Float, *, seed: str) -> Roof | None:
    """The roof of a footprint by the points (n, 3) above it; None if they are too few or no shape fits.

    Every shape has a height field between eaves and ridge, so that z is linear in it: two points give a
    hypothesis, and the one with the least truncated squares is refined (MSAC, Torr and Zisserman 2000). The
    Bayesian information criterion chooses among shapes.

    polygon : valid footprint, scene metres
    seed    : name of the building, which the random choices depend on
    """
    if len(xyz) < FEWEST:
        return None
    digest = hashlib.blake2b(seed.encode(), digest_size=8).digest()
    rng = np.random.default_rng(int.from_bytes(digest, "little"))
    if len(xyz) > _AT_MOST:
        xyz = xyz[np.sort(rng.choice(len(xyz), _AT_MOST, replace=False))]
    z = xyz[:, 2]
    flat = _flat(z)
    best, least = flat, _score(flat, z, parameters=_PARAMETERS["flat"])
    near = np.abs(z - flat.top) < max(3.0 * flat.sigma, 0.1)
    if flat.share < 0.9 or near.mean() < 0.85:
        radius = np.sqrt(shapely.area(polygon) / np.pi)
        for spec in _candidates(polygon, xyz):
            field = _height_field(polygon, spec, xy=xyz[:, :2])
            if field is None:
                continue
            fitted = _fit_pitched(field, z, spec=spec, rng=rng)
            if fitted is None or fitted[0].height > _STEEPEST * radius:
                continue
            roof, error = fitted
            score = _score(roof, error, parameters=_PARAMETERS[spec.shape])
            if score < least and _covers(roof, xyz[np.abs(error) < _OFF], polygon=polygon, among=len(xyz)):
                best, least = roof, score
    if best is flat and not _covers(flat, xyz[np.abs(z - flat.top) < _OFF], polygon=polygon, among=len(xyz)):
        return None
    return best


def block_of(polygon: Any, xyz: Float) -> Roof | None:
    """The height alone of points (n, 3) that no roof shape explains; None if they are too few or on one side.

    The top is their 70th percentile, as that of the blocks of the 3D BAG (Peters et al. 2022); ``sigma`` is
    their root mean square distance from it.
    """
    if len(xyz) < FEWEST:
        return None
    top = float(np.percentile(xyz[:, 2], _BLOCK))
    error = xyz[:, 2] - top
    sigma = float(np.sqrt(np.square(error).mean()))
    share = float((np.abs(error) < _OFF).mean())
    block = Roof(top, 0.0, "", np.nan, False, sigma, share)
    return block if _covers(block, xyz, polygon=polygon, among=len(xyz)) else None


def _score(roof: Roof, error: Float, *, parameters: int) -> float:
    """Bayesian information criterion of a fit with errors (n,) under truncated squares."""
    off = error - roof.top if roof.shape == "flat" else error
    cost = float(np.minimum(np.square(off), _OFF**2).mean()) + _NOISE**2
    count = min(len(off), _INDEPENDENT)
    return count * float(np.log(cost)) + parameters * float(np.log(count))


def _flat(z: Float) -> Roof:
    """The level that most points share, and other levels with at least a fifth of them."""
    levels: list[float] = []
    rest, first = z, None
    while len(rest) >= max(0.2 * len(z), FEWEST / 2) and len(levels) < 4:
        ordered = np.sort(rest)
        inside = np.searchsorted(ordered, ordered + _OFF, side="right") - np.arange(len(ordered))
        start = int(np.argmax(inside))
        members = ordered[start : start + inside[start]]
        if levels and len(members) < 0.2 * len(z):
            break
        level = float(np.median(members))
        near = np.abs(rest - level) < _OFF
        sigma = float(np.sqrt(np.square(rest[near] - rest[near].mean()).mean()))
        first = first or (float(rest[near].mean()), sigma, near.mean())
        levels.append(level)
        rest = rest[np.abs(rest - level) > 2 * _OFF]
    top, sigma, share = first or (float(np.median(z)), 0.0, 0.0)
    return Roof(top, 0.0, "flat", np.nan, False, sigma, float(share), tuple(levels[1:]))


def _candidates(polygon: Any, xyz: Float) -> Iterator[RoofSpec]:
    """Unit roofs of all shapes and directions that are tried on a footprint."""
    rectangle = shapely.get_coordinates(shapely.minimum_rotated_rectangle(polygon))
    side = rectangle[1] - rectangle[0]
    turn = float(np.arctan2(side[1], side[0]))
    sides = [turn + k * np.pi / 2 for k in range(4)]
    plane = _slope_of(xyz)
    for shape in _PARAMETERS:
        if shape == "flat":
            continue
        directions: list[float] = [np.nan]
        if shape in _DIRECTED:
            directions = [*sides, plane] if shape == "skillion" else sides
        for direction in directions:
            yield RoofSpec(shape, -1.0, 1.0, 1.0, direction)
        if shape in SECTIONS and shape not in _DIRECTED:
            yield RoofSpec(shape, -1.0, 1.0, 1.0, np.nan, across=True)


def _slope_of(xyz: Float) -> float:
    """Downslope direction of the plane through points, radians."""
    centred = xyz - np.median(xyz, axis=0)
    slope = np.linalg.lstsq(centred[:, :2], centred[:, 2], rcond=None)[0]
    return float(np.arctan2(-slope[1], -slope[0]))


def _height_field(polygon: Any, spec: RoofSpec, *, xy: Float) -> Float | None:
    """Height (n,) of a unit roof at places, as a share of its height; NaN outside.

    None if the footprint cannot have that shape.
    """
    out = np.full(len(xy), np.nan)
    for part in shapely.get_parts(polygon):
        try:
            triangles, note = roof_shell(part, spec)
        except (GEOSException, ValueError, IndexError, FloatingPointError):
            return None
        if note:
            return None
        corners = triangles.corners[triangles.surface == ROOF]
        out = np.fmax(out, _interpolate(corners, xy))
    return out if np.nanmax(out, initial=0.0) > 0 else None


def _interpolate(corners: Float, xy: Float) -> Float:
    """Heights (n,) of triangles (m, 3, 3) at places (n, 2); NaN outside."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    u, v = (b - a)[:, :2], (c - a)[:, :2]
    area = cross(u, v)
    keep = np.abs(area) > 1e-9
    a, b, c, u, v, area = a[keep], b[keep], c[keep], u[keep], v[keep], area[keep]
    out = np.full(len(xy), np.nan)
    for k in range(len(area)):  # a roof has some dozen triangles
        off = xy - a[k, :2]
        s = (off[:, 0] * v[k, 1] - off[:, 1] * v[k, 0]) / area[k]
        t = (u[k, 0] * off[:, 1] - u[k, 1] * off[:, 0]) / area[k]
        inside = (s >= -1e-6) & (t >= -1e-6) & (s + t <= 1 + 1e-6)
        z = a[k, 2] + s[inside] * (b[k, 2] - a[k, 2]) + t[inside] * (c[k, 2] - a[k, 2])
        out[inside] = np.fmax(out[inside], z)
    return out


def _fit_pitched(
    field: Float, z: Float, *, spec: RoofSpec, rng: np.random.Generator
) -> tuple[Roof, Float] | None:
    """The roof of a shape with the least truncated squares, and the errors (n,) of all points."""
    known = np.isfinite(field)
    if known.sum() < FEWEST:
        return None
    s, t = field[known], z[known]
    one, two = rng.integers(0, len(s), (2, 4 * _PAIRS))
    apart = np.abs(s[one] - s[two]) > 0.25
    one, two = one[apart][:_PAIRS], two[apart][:_PAIRS]
    height = (t[two] - t[one]) / (s[two] - s[one])
    one, height = (
        one[(height > _LEAST_ROOF) & (height < _MOST_ROOF)],
        height[(height > _LEAST_ROOF) & (height < _MOST_ROOF)],
    )
    if not len(one):
        return None
    eaves = t[one] - height * s[one]
    cost = np.minimum(np.square(t - eaves[:, None] - height[:, None] * s), _OFF**2).mean(axis=1)
    low, rise = float(eaves[np.argmin(cost)]), float(height[np.argmin(cost)])
    near = np.abs(t - low - rise * s) < _OFF
    reach = _OFF
    for _ in range(5):
        if near.sum() < FEWEST or np.ptp(s[near]) < 0.25:
            return None
        rise, low = (float(v) for v in np.polyfit(s[near], t[near], 1))
        error = t - low - rise * s
        reach = min(max(3 * 1.4826 * float(np.median(np.abs(error[near]))), 0.06), _OFF)
        near = np.abs(error) < reach
    if not _LEAST_ROOF < rise < _MOST_ROOF:
        return None
    sigma = float(np.sqrt(np.square(error[near]).mean())) if near.any() else reach
    everywhere = np.full(len(z), _OFF)
    everywhere[known] = error
    share = float((np.abs(everywhere) < _OFF).mean())
    direction = spec.direction if spec.shape in _DIRECTED else np.nan
    return Roof(low + rise, rise, spec.shape, direction, spec.across, sigma, share), everywhere


def _covers(roof: Roof, inliers: Float, *, polygon: Any, among: int) -> bool:
    """Whether a fit explains enough points, all over the footprint and not along a wall or on one side only.

    inliers : (k, 3) points that it explains
    among   : points on the roof
    """
    least = COVERED["flat" if roof.shape == "flat" else "pitched"]
    if len(inliers) < max(least * among, FEWEST):
        return False
    area = float(shapely.area(polygon))
    cell = max(1.0, np.sqrt(3.0 * area / among))
    taken = len(np.unique(np.floor(inliers[:, :2] / cell), axis=0))
    return bool(taken * cell**2 >= least * area)


def roof_points(polygon: Any, xyz: Float, *, inset: float) -> Bools:
    """Mask (n,) of points within a footprint, at least ``inset`` metres from its walls where it is wide."""
    inner = shapely.buffer(polygon, -inset)
    if shapely.area(inner) < 0.3 * shapely.area(polygon):
        inner = shapely.buffer(polygon, -inset / 2)
    shapely.prepare(inner)
    return np.asarray(shapely.contains_xy(inner, xyz[:, 0], xyz[:, 1]), np.bool_)
