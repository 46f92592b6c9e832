"""Coordinate frames: geographic (WGS 84), projected (a CRS), scene (projected minus a whole-metre origin)."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import ArrayLike
from pyproj import CRS, Proj, Transformer
from pyproj.crs import ProjectedCRS
from pyproj.crs.coordinate_operation import TransverseMercatorConversion
from pyproj.exceptions import CRSError, ProjError

from geoscene.errors import FrameError, reason_of
from geoscene.typing import Float

_GEOGRAPHIC = "EPSG:4326"
_LOCAL = "Local transverse Mercator at"
_MARGIN = 10.0  # metres of ground added on both sides of maps narrower than twice that


def _local_wkt(lon_deg: float, lat_deg: float) -> str:
    """WKT 2 of the transverse Mercator projection with origin and scale 1 at the given point."""
    return str(
        ProjectedCRS(
            TransverseMercatorConversion(lat_deg, lon_deg, scale_factor_natural_origin=1.0),
            name=f"{_LOCAL} {lat_deg:.6f}, {lon_deg:.6f}",
            geodetic_crs=CRS.from_user_input(_GEOGRAPHIC),
        ).to_wkt()
    )


@functools.lru_cache(maxsize=64)
def _crs_name(wkt: str) -> str:
    """``EPSG:n`` if the CRS has an EPSG code, else its name; the search takes a tenth of a second."""
    crs = CRS.from_wkt(wkt)
    code = None if crs.name.startswith(_LOCAL) else crs.to_authority(min_confidence=100)
    return ":".join(code) if code else str(crs.name)


def utm_crs(lon_deg: float, lat_deg: float) -> str:
    """EPSG code (``EPSG:326xx`` or ``EPSG:327xx``) of the WGS 84 UTM zone of a point, or of UPS.

    Includes the exceptions of south-west Norway (32V) and Svalbard (31X, 33X, 35X, 37X). Beyond 84° N and
    80° S, where UTM ends, the universal polar stereographic CRS (``EPSG:5041``, ``EPSG:5042``).
    """
    if not -80.0 <= lat_deg <= 84.0:
        return "EPSG:5041" if lat_deg > 0 else "EPSG:5042"
    lon = (lon_deg + 180.0) % 360.0 - 180.0
    zone = int((lon + 180.0) // 6.0) + 1
    if 56.0 <= lat_deg < 64.0 and 3.0 <= lon < 12.0:
        zone = 32
    elif lat_deg >= 72.0 and 0.0 <= lon < 42.0:
        zone = 31 + 2 * int((lon + 3.0) // 12.0)
    return f"EPSG:{32600 + zone if lat_deg >= 0 else 32700 + zone}"


def wrap_longitude(lon_deg: float) -> float:
    """The longitude within ±180°."""
    return lon_deg if -180 <= lon_deg <= 180 else (lon_deg + 180) % 360 - 180


def beside(lon: ArrayLike, middle: float, *, turn: float = 360.0) -> Float:
    """Longitudes (any shape) moved by whole turns (none if infinite) to within half a turn of ``middle``."""
    if np.isinf(turn):
        return np.asarray(lon, float)
    moved: Float = np.asarray(lon, float) - turn * np.round((np.asarray(lon, float) - middle) / turn)
    return moved


def rim_of(bounds: Sequence[float], *, step: float) -> Float:
    """Longitudes and latitudes (2, n) along the edge of a box in degrees, at most ``step`` apart.

    bounds : (west, south, east, north); sides of no length become 1 cm long
    """
    west, south, east, north = bounds
    box = shapely.box(west, south, max(east, west + 1e-7), max(north, south + 1e-7))
    edge: Float = shapely.get_coordinates(shapely.segmentize(box, step)).T
    return edge


@dataclass(frozen=True)
class Frame:
    """The scene frame: x grid east, y grid north, z up, metres, float64.

    wkt      : the projected CRS as WKT 2
    origin   : (easting, northing) of x = y = 0 in that CRS, whole metres
    vertical : reference of z: ``flat`` (an assumed level ground), ``orthometric`` (the geoid of the terrain
               model) or ``ellipsoidal`` (WGS 84)
    """

    wkt: str
    origin: tuple[float, float]
    vertical: str = "flat"

    @classmethod
    def at(cls, lon_deg: float, lat_deg: float, *, crs: str = "local", vertical: str = "flat") -> Frame:
        """The frame of a scene centred on a point.

        crs : ``local`` (transverse Mercator with scale 1 at the centre), ``utm`` (the zone of the centre;
              near the poles UPS), or any projected CRS in metres that pyproj reads (``EPSG:32618``)

        Raises FrameError if the CRS is unknown, not projected, not in metres, or distorts lengths
        by over 10 %.
        """
        if not (np.isfinite(lon_deg) and np.isfinite(lat_deg) and abs(lat_deg) <= 90 and abs(lon_deg) <= 180):
            raise FrameError(f"the centre {lat_deg}, {lon_deg} is not a latitude and longitude in degrees")
        if crs == "local":
            return cls(_local_wkt(round(lon_deg, 6), round(lat_deg, 6)), (0.0, 0.0), vertical)
        try:
            parsed = CRS.from_user_input(utm_crs(lon_deg, lat_deg) if crs == "utm" else crs)
        except CRSError as error:
            raise FrameError(f"`crs` {crs}: unknown to pyproj; give utm or EPSG:<number>") from error
        if not parsed.is_projected:
            raise FrameError(f"`crs` {crs} ({parsed.name}) is not projected; give utm or EPSG:<number>")
        if any(axis.unit_conversion_factor != 1.0 for axis in parsed.axis_info[:2]):
            raise FrameError(f"`crs` {crs} ({parsed.name}) is not in metres")
        frame = cls(str(parsed.to_wkt()), (0.0, 0.0), vertical)
        easting, northing = frame.to_projected(*frame.from_geographic(lon_deg, lat_deg))
        if not (np.isfinite(easting) and np.isfinite(northing)):
            raise FrameError(f"`crs` {crs} ({parsed.name}) cannot project {lat_deg:.4f}, {lon_deg:.4f}")
        frame = cls(str(parsed.to_wkt()), (float(np.round(easting)), float(np.round(northing))), vertical)
        if not 0.9 < float(frame.scale(lon_deg, lat_deg)) < 1.1:
            raise FrameError(
                f"`crs` {crs} ({parsed.name}) distorts lengths by over 10 % at {lat_deg:.4f}, {lon_deg:.4f}"
            )
        return frame

    @functools.cached_property
    def crs(self) -> CRS:
        """The projected CRS."""
        return CRS.from_wkt(self.wkt)

    @property
    def name(self) -> str:
        """``EPSG:n`` if the CRS has an EPSG code, else its name."""
        return _crs_name(self.wkt)

    @functools.cached_property
    def _forward(self) -> Transformer:
        return Transformer.from_crs(_GEOGRAPHIC, self.crs, always_xy=True)

    @functools.cached_property
    def _proj(self) -> Proj:
        return Proj(self.crs)

    def from_geographic(self, lon_deg: ArrayLike, lat_deg: ArrayLike) -> tuple[Any, Any]:
        """Scene x, y (metres, any shape) of longitudes and latitudes in degrees; infinite where undefined."""
        x, y = self._forward.transform(np.asarray(lon_deg, float), np.asarray(lat_deg, float))
        return x - self.origin[0], y - self.origin[1]

    def to_geographic(self, x: ArrayLike, y: ArrayLike) -> tuple[Any, Any]:
        """Longitude and latitude in degrees (any shape) of scene coordinates in metres."""
        east, north = self.to_projected(x, y)
        lon, lat = self._forward.transform(east, north, direction="INVERSE")
        return lon, lat

    def to_projected(self, x: ArrayLike, y: ArrayLike) -> tuple[Any, Any]:
        """Easting and northing in the CRS (metres, any shape) of scene coordinates."""
        return np.asarray(x, float) + self.origin[0], np.asarray(y, float) + self.origin[1]

    def to_crs(self, x: ArrayLike, y: ArrayLike, *, crs: str | CRS) -> tuple[Any, Any]:
        """Easting and northing (or longitude and latitude) in another CRS of scene coordinates."""
        other = Transformer.from_crs(self.crs, CRS.from_user_input(crs), always_xy=True)
        east, north = other.transform(*self.to_projected(x, y))
        return east, north

    def from_crs(self, east: ArrayLike, north: ArrayLike, *, crs: str | CRS) -> tuple[Any, Any]:
        """Scene x, y of coordinates in another CRS (x or longitude first)."""
        other = Transformer.from_crs(CRS.from_user_input(crs), self.crs, always_xy=True)
        x, y = other.transform(np.asarray(east, float), np.asarray(north, float))
        return x - self.origin[0], y - self.origin[1]

    def scale(self, lon_deg: ArrayLike, lat_deg: ArrayLike) -> Float:
        """Grid metres per true metre, horizontally, at points given in degrees.

        1 at the centre of a local frame, 0.9996 on a UTM zone's meridian. A true horizontal length times this
        is the length in the scene; heights are not scaled.
        """
        factors = self._proj.get_factors(np.asarray(lon_deg, float), np.asarray(lat_deg, float))
        scale: Float = np.sqrt(np.asarray(factors.areal_scale, float))
        return scale

    def scale_at(self, x: ArrayLike, y: ArrayLike) -> Float:
        """Point `scale` at scene coordinates."""
        return self.scale(*self.to_geographic(x, y))

    def convergence(self, lon_deg: ArrayLike, lat_deg: ArrayLike) -> Float:
        """Angle from true north to grid north in radians, clockwise positive, at points in degrees.

        A true azimuth minus this is a grid azimuth.
        """
        factors = self._proj.get_factors(np.asarray(lon_deg, float), np.asarray(lat_deg, float))
        angle: Float = np.radians(np.asarray(factors.meridian_convergence, float))
        return angle

    def to_json(self) -> dict[str, object]:
        """The JSON object of ``scene.json``."""
        return {"name": self.name, "wkt": self.wkt, "origin": list(self.origin), "vertical": self.vertical}

    @classmethod
    def from_json(cls, document: dict[str, Any]) -> Frame:
        """The frame of a JSON object of `to_json`; raises FrameError for another object."""
        try:
            east, north = (float(v) for v in document["origin"])
            frame = cls(str(document["wkt"]), (east, north), str(document["vertical"]))
            known = bool(np.isfinite(frame.to_geographic(0.0, 0.0)).all())
        except (KeyError, TypeError, ValueError, ProjError) as error:
            raise FrameError(f"not a coordinate frame ({reason_of(error)})") from error
        if not known:
            raise FrameError("a coordinate frame whose origin is nowhere on Earth")
        return frame


def extent_of(
    frame: Frame, bounds: tuple[float, float, float, float], *, footprints: Any
) -> tuple[float, float, float, float]:
    """Rectangle of a scene's ground in whole metres: contains the bounds of the map and all buildings.

    bounds     : west, south, east, north in degrees
    footprints : (n,) polygons of buildings, scene metres
    """
    west, south, east, north = bounds
    step = max((east - west) / 8, (north - south) / 8, 1e-6)
    x, y = frame.from_geographic(*rim_of(bounds, step=step))
    boxes = shapely.bounds(footprints).reshape(-1, 4)
    xs = np.concatenate([x, boxes[:, 0] - 2, boxes[:, 2] + 2])
    ys = np.concatenate([y, boxes[:, 1] - 2, boxes[:, 3] + 2])
    low = np.floor([xs.min(), ys.min()])
    high = np.ceil([xs.max(), ys.max()])
    thin = high - low < 2 * _MARGIN
    low[thin] -= _MARGIN
    high[thin] += _MARGIN
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])
