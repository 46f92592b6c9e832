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
