"""Writes point clouds as surveys deliver them."""

import laspy
import numpy as np
from pyproj import CRS


def write_las(path, coordinates, *, crs=None, klass=None, scale=0.001):
    """Write coordinates (n, 3) as LAS or LAZ, by the suffix; returns the path."""
    header = laspy.LasHeader(version="1.4", point_format=6)
    degrees = crs is not None and CRS.from_user_input(crs).is_geographic
    header.scales = [1e-9, 1e-9, 0.001] if degrees else [scale] * 3
    header.offsets = np.floor(coordinates.min(axis=0))
    if crs is not None:
        header.add_crs(CRS.from_user_input(crs))
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = coordinates.T
    cloud.number_of_returns = cloud.return_number = np.ones(len(coordinates), np.uint8)
    if klass is not None:
        cloud.classification = klass
    cloud.write(path)
    return path


def write_survey(path, box, *, height=20.0):
    """A cloud of level ground in and around a box in degrees, a point every 2 m; returns the path."""
    west, south, east, north = box
    step = 2.0 / 111_195.0
    lat, lon = np.mgrid[south - 0.003 : north + 0.003 : step, west - 0.006 : east + 0.006 : 2 * step]
    coordinates = np.column_stack([lon.ravel(), lat.ravel(), np.full(lon.size, height)])
    return write_las(path, coordinates, crs="EPSG:4326", klass=np.full(lon.size, 2, np.uint8))
