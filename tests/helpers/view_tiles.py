"""Reads the bytes of a page's tiles."""

import zlib

import numpy as np

from geoscene.geometry.mesh import Mesh, ShapeInstances
from geoscene.scene.tile_files import Tile
from geoscene.view.looks import FacadeLooks
from geoscene.view.tiles import SCALE, TURN, _turn


def unpack_tile(header, data):
    """The tile that `pack_tile` made, faces in the page's order, and its facades; ``closed`` is not kept."""
    raw = zlib.decompress(data, 31)
    at = 0

    def column(kind, *shape):
        nonlocal at
        count = int(np.prod(shape))
        values = np.frombuffer(raw, kind, count, at).reshape(shape)
        at += values.nbytes
        return values

    n, m, k = header["vertices"], header["ends"][-1], sum(run[2] for run in header["runs"])
    b = header["facades"]
    faces, feature = column("<u4", m, 3), column("<i4", m)
    copied = column("<i4", k)
    owner, base = column("<i4", b), column("<f4", b)
    vertices = column("<u2", n, 3) * header["step"]
    klass, material, surface, color = column("u1", m), column("u1", m), column("u1", m), column("u1", m, 3)
    facades = FacadeLooks(owner, base, column("u1", b, 4))
    columns, size, kind = (6, 2, "<u2") if header["upright"] else (12, 4, "<f4")
    planes = np.moveaxis(column("u1", columns, size, k), 1, 2)
    places = np.ascontiguousarray(planes).view(kind).reshape(columns, k)
    transform = (
        _transforms(places, header["step"]) if header["upright"] else places.T.reshape(k, 3, 4).astype(float)
    )
    mesh = Mesh.of(
        vertices, faces, feature=feature, klass=klass, material=material, surface=surface, color=color
    )
    shape = np.repeat(
        np.array([run[1] for run in header["runs"]], np.int32), [run[2] for run in header["runs"]]
    ).astype(np.int32)
    tile = Tile(np.array(header["base"]) * header["step"], mesh, ShapeInstances(shape, transform, copied))
    return tile, facades


def _transforms(columns, step):
    """Transforms (k, 3, 4) of the columns of upright copies."""
    x, y, z, turn, along, lift = columns.astype(np.int64)
    place = np.column_stack([np.cumsum(x) % 65_536, y, z]) * step
    return np.dstack([_turn(along * SCALE, lift * SCALE, turn=turn * TURN), place[:, :, None]])
