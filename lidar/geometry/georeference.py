"""Transformation of scene coordinates to an export CRS, exact or by an affine map of bounded error."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np
from pyproj import CRS, Transformer

from geoscene.geometry.frames import Frame, utm_crs
from geoscene.support.compiled import njit
from geoscene.typing import Float

AFFINE_LIMIT = 1e-4
"""Maximum error in metres of an affine map against the projection: a fifth of half a step in LAS files."""


_NODES = np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1]), axis=-1).reshape(-1, 2) / 2
"""Test points (9, 2) at which an affine map is compared with the projection, in sides of the points' box."""


def export_crs(frame: Frame, crs: str = "utm") -> CRS:
    """The CRS of exported clouds: ``utm`` (zone of the scene's origin), ``scene``, or any pyproj name.

    For ``utm``, a scene frame in a registered CRS (an EPSG code) keeps that CRS.
    Raises FrameError for a CRS that is unknown, not projected, not in metres, or not valid at the scene.
    """
    if crs == "scene" or (crs == "utm" and frame.name.startswith("EPSG:")):
        return frame.crs
    lon, lat = frame.to_geographic(0.0, 0.0)
    if crs == "utm":
        return CRS.from_user_input(utm_crs(float(lon), float(lat)))
    return Frame.at(float(lon), float(lat), crs=crs).crs


@dataclass(frozen=True)
class Georeference:
    """Transformation from the scene frame to an export CRS.

    frame : of the scene
    crs   : of the export
    exact : project every point; otherwise each call uses an affine map where that is within `AFFINE_LIMIT`
            of the projection (clouds up to about 300 m wide)
    """

    frame: Frame
    crs: CRS
    exact: bool = False

    @functools.cached_property
    def _is_scene(self) -> bool:
        """Whether the export CRS is the scene's."""
        return bool(self.frame.crs == self.crs)

    @functools.cached_property
    def _transformer(self) -> Transformer:
        return Transformer.from_crs(self.frame.crs, self.crs, always_xy=True)

    @functools.cached_property
    def offset(self) -> tuple[float, float, float]:
        """The scene's origin in the export CRS, rounded to metres: the offset of LAS files."""
        east, north = self._project(np.zeros(1), np.zeros(1))
        return float(np.round(east[0])), float(np.round(north[0])), 0.0

    def _project(self, x: Float, y: Float) -> tuple[Float, Float]:
        east, north = self._transformer.transform(*self.frame.to_projected(x, y))
        return east, north

    def points(self, xyz: Float) -> Float:
        """Easting, northing, height (n, 3) of scene points (n, 3); heights are unchanged."""
        xyz = np.asarray(xyz, np.float64)
        if not len(xyz):
            return xyz.copy()
        if not self.exact and not self._is_scene and (fit := self._affine(xyz)) is not None:
            moved: Float = _move(xyz, *fit)
            return moved
        project = self.frame.to_projected if self._is_scene else self._project
        return np.column_stack([*project(xyz[:, 0], xyz[:, 1]), xyz[:, 2]])

    def scene_points(self, points: Float) -> Float:
        """Scene points (n, 3) of easting, northing and height (n, 3): the exact inverse of `points`."""
        out = np.array(points, np.float64)
        if len(out) and not self._is_scene:
            east, north = out[:, 0], out[:, 1]
            out[:, 0], out[:, 1] = self._transformer.transform(east, north, direction="INVERSE")
        out[:, :2] -= self.frame.origin
        return out

    def _affine(self, xyz: Float) -> tuple[Float, Float, Float] | None:
        """Origin, matrix and shift of the best affine map over the points; None if beyond `AFFINE_LIMIT`."""
        low, high = _bounds(xyz)
        origin = (low + high) / 2
        nodes = _NODES * np.maximum(high - low, 1.0)
        target = np.column_stack(self._project(*(origin + nodes).T))
        terms = np.column_stack([nodes, np.ones(len(nodes))])
        base = target[4]
        solution = np.linalg.lstsq(terms, target - base, rcond=None)[0]
        if np.abs(terms @ solution - (target - base)).max() > AFFINE_LIMIT:
            return None
        return origin, solution[:2], solution[2] + base


@njit(cache=True, nogil=True)
def _bounds(xyz: Any) -> Any:
    """Least and greatest x and y of points."""
    low, high = xyz[0, :2].copy(), xyz[0, :2].copy()
    for i in range(len(xyz)):
        for k in range(2):
            low[k] = min(low[k], xyz[i, k])
            high[k] = max(high[k], xyz[i, k])
    return low, high


@njit(cache=True, nogil=True)
def _move(xyz: Any, origin: Any, matrix: Any, shift: Any) -> Any:
    """Points mapped by (xy - origin) @ matrix + shift; heights are unchanged."""
    out = np.empty((len(xyz), 3))
    for i in range(len(xyz)):
        x, y = xyz[i, 0] - origin[0], xyz[i, 1] - origin[1]
        out[i, 0] = x * matrix[0, 0] + y * matrix[1, 0] + shift[0]
        out[i, 1] = x * matrix[0, 1] + y * matrix[1, 1] + shift[1]
        out[i, 2] = xyz[i, 2]
    return out
