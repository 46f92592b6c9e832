"""Transformation of scene coordinates to an export CRS, exact or by an affine map of bounded error."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from pyproj import CRS, Transformer

from geoscene.frames import Frame, utm_crs
from geoscene.typing import Float

AFFINE_LIMIT = 1e-4
"""Maximum error in metres of an affine map against the projection: a fifth of half a step in LAS files."""


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
        out = np.array(xyz, np.float64)
        if not len(out):
            return out
        if self.frame.crs == self.crs:
            out[:, 0], out[:, 1] = self.frame.to_projected(out[:, 0], out[:, 1])
            return out
        if not self.exact and (fit := self._affine(out[:, :2])) is not None:
            origin, matrix, shift = fit
            out[:, :2] = (out[:, :2] - origin) @ matrix + shift
        else:
            out[:, 0], out[:, 1] = self._project(out[:, 0], out[:, 1])
        return out

    def scene_points(self, points: Float) -> Float:
        """Scene points (n, 3) of easting, northing and height (n, 3): the exact inverse of `points`."""
        out = np.array(points, np.float64)
        if len(out) and self.frame.crs != self.crs:
            east, north = out[:, 0], out[:, 1]
            out[:, 0], out[:, 1] = self._transformer.transform(east, north, direction="INVERSE")
        out[:, :2] -= self.frame.origin
        return out

    def _affine(self, xy: Float) -> tuple[Float, Float, Float] | None:
        """Origin, matrix and shift of the best affine map over the points; None if beyond `AFFINE_LIMIT`."""
        low, high = xy.min(axis=0), xy.max(axis=0)
        origin = (low + high) / 2
        unit = np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1]), axis=-1).reshape(-1, 2) / 2
        nodes = unit * np.maximum(high - low, 1.0)
        target = np.column_stack(self._project(*(origin + nodes).T))
        terms = np.column_stack([nodes, np.ones(len(nodes))])
        base = target[4]
        solution = np.linalg.lstsq(terms, target - base, rcond=None)[0]
        if np.abs(terms @ solution - (target - base)).max() > AFFINE_LIMIT:
            return None
        return origin, solution[:2], solution[2] + base
