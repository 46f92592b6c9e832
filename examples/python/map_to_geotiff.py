"""Drive, put all sweeps together as a map, and write its surface and its terrain as GeoTIFF for a GIS.

Writes to the folder given: the drive, the map as LAZ, and three rasters beside it.
"""

import sys
from pathlib import Path

import numpy as np
import rasterio

import geoscene
import lidar

out = Path(sys.argv[1] if len(sys.argv) > 1 else "mapped")
centre = geoscene.read_osm(geoscene.demo_path(), bounds=(24.9405, 60.1655, 24.9475, 60.1690))
scene = geoscene.build(centre, out / "scene", options=geoscene.BuildOptions(use="lidar"), overwrite=True)

options = lidar.DriveOptions(route="random", rig="vlp16", duration=4.0, seed=3, formats=("pcd",))
dataset = lidar.open_dataset(lidar.drive(scene, out / "drive", options=options, overwrite=True).path)
mapped = lidar.aggregate(
    dataset,
    out / "map.laz",
    options=lidar.MapOptions(voxel=0.1, raster=("dsm", "dtm", "density"), resolution=0.5),
    overwrite=True,
)
print(f"{mapped.points:,} points of {mapped.points_in:,} in {mapped.path}")
for path in mapped.beside:
    with rasterio.open(path) as raster:
        values = raster.read(1, masked=True)
        west, south, east, north = raster.bounds
        print(f"{path.name}: {raster.width} x {raster.height} cells of {raster.res[0]:g} m")
        print(f"  EPSG:{raster.crs.to_epsg()}: {west:.1f} to {east:.1f} m, {south:.1f} to {north:.1f} m")
        print(f"  {np.ma.count(values):,} cells with data, {values.min():.2f} to {values.max():.2f}")
