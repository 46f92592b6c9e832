"""Checks of surfaces that are made tile by tile."""

from dataclasses import fields

import numpy as np
import pytest
import shapely

from geoscene.classes import Class
from geoscene.ground.partition import Partition, partition_tile, plan_ground


def partition(extent, layers, *, tile_size=250.0, lines=0.0, base=(Class.TERRAIN, "soil"), tiles=None):
    """The cells of the whole extent, or of the chosen tiles, in one table; options as in `plan_ground`."""
    plan = plan_ground(extent, layers, tile_size=tile_size, lines=lines, base=base)
    chosen = [(int(i), int(j)) for i, j in plan.tiles] if tiles is None else list(tiles)
    parts = [partition_tile(plan, i, j=j) for i, j in chosen]
    names = [f.name for f in fields(Partition) if f.name != "slivers"]
    columns = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    return Partition(**columns, slivers=sum(part.slivers for part in parts))


def edge_counts(faces):
    """Undirected edges (k, 2) and the number of faces of each."""
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    return np.unique(edges, axis=0, return_counts=True)


def welded(mesh):
    """The mesh with vertices of equal coordinates merged."""
    points, number = np.unique(mesh.vertices, axis=0, return_inverse=True)
    return points, number.reshape(-1)[mesh.faces]


def on_border(points, edges, extent):
    ends = points[edges][:, :, :2]
    low, high = np.array(extent[:2]), np.array(extent[2:])
    return ((ends == low).all(axis=1) | (ends == high).all(axis=1)).any(axis=1)


def assert_one_surface(points, faces, extent):
    """Assert that every edge has two faces, or one at the extent's border, and that areas add up."""
    edges, count = edge_counts(faces)
    border = on_border(points, edges, extent)
    assert (count[~border] == 2).all()
    assert (count[border] == 1).all()
    a, b, c = (points[faces[:, k], :2] for k in range(3))
    (ux, uy), (vx, vy) = (b - a).T, (c - a).T
    area = (ux * vy - uy * vx) / 2
    assert (area > 0).all()
    assert area.sum() == pytest.approx((extent[2] - extent[0]) * (extent[3] - extent[1]), rel=1e-9)


def heights_on(corners, xy):
    """Heights (n,) at points (n, 2) of triangles (k, 3, 3) that do not overlap in plan; NaN beside them."""
    point, face = shapely.STRtree(shapely.polygons(corners[..., :2])).query(
        shapely.points(xy), predicate="intersects"
    )
    z = np.full(len(xy), np.nan)
    a, b, c = (corners[face, k] for k in range(3))
    normal = np.cross(b - a, c - a)
    z[point] = a[:, 2] - ((xy[point] - a[:, :2]) * normal[:, :2]).sum(axis=1) / normal[:, 2]
    return z
