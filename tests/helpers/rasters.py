"""Elevation files for tests."""

import numpy as np
import rasterio


def write_slope(path, box, *, rise=1.0):
    """A GeoTIFF of 40 x 40 posts, larger than a box in degrees; ``rise`` metres a post to the south-east."""
    west, south, east, north = box
    rows = rise * np.add.outer(np.arange(40.0), np.arange(40.0)).astype(np.float32)
    across, down = (east - west + 0.02) / 40, (north - south + 0.02) / 40
    transform = rasterio.Affine(across, 0.0, west - 0.01, 0.0, -down, north + 0.01)
    profile = {"driver": "GTiff", "width": 40, "height": 40, "count": 1, "dtype": "float32"}
    with rasterio.open(path, "w", **profile, crs="EPSG:4326", transform=transform) as out:
        out.write(rows, 1)
    return path
