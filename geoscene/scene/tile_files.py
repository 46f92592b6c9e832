"""Tiles of a scene and the shapes that their instances copy, as .npz."""

from __future__ import annotations

import functools
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from io import BytesIO
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from geoscene.buildings.facades import FacadeTable, Openings, WallRelief
from geoscene.classes import Class
from geoscene.errors import BUILD_AGAIN, DIFFERS, SceneFormatError, reading
from geoscene.geometry.mesh import Mesh, ShapeInstances
from geoscene.objects.forests import Forests, forest_instances
from geoscene.support.digests import digest
from geoscene.support.files import write_atomically
from geoscene.support.untrusted import read_arrays
from geoscene.typing import Bools, Float

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class FullParts:
    """Parts that full relief adds to plain, and drives can leave out.

    faces     : (m,) bool, of the tile's mesh
    instances : (k,) bool, of the instances of the tile's file
    """

    faces: Bools
    instances: Bools


@dataclass(frozen=True, slots=True)
class Tile:
    """A square of the scene. A building lies entirely in the tile of its representative point; ground is cut.

    origin    : (3,) float64, whole metres: tile coordinates + origin = scene coordinates
    mesh      : in tile coordinates
    instances : in tile coordinates; trees of forests are not in files (see `with_forests`)
    relief    : openings of the walls, in tile coordinates; None in scenes without relief
    full_parts: None in scenes without full relief
    """

    origin: Float
    mesh: Mesh
    instances: ShapeInstances = field(default_factory=ShapeInstances.empty)
    relief: WallRelief | None = None
    full_parts: FullParts | None = None


def with_forests(tile: Tile, forests: Forests, *, box: Sequence[float]) -> Tile:
    """The tile with the trees of its forests among its instances; ``box`` is its ground's, scene metres."""
    if not (tile.mesh.klass == Class.FOREST_FLOOR).any():
        return tile
    trees = forest_instances(tile.mesh.shifted(tile.origin), forests, box=box).shifted(-tile.origin)
    return replace(tile, instances=ShapeInstances.concatenate([tile.instances, trees]))


def pack(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """A compressed .npz whose bytes depend on the arrays only (no time stamps)."""
    out = BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, array in arrays.items():
            entry = zipfile.ZipInfo(f"{name}.npy", (1980, 1, 1, 0, 0, 0))
            entry.compress_type = zipfile.ZIP_DEFLATED
            plain = np.ascontiguousarray(array)
            archive.writestr(entry, _header(plain.dtype, plain.shape) + plain.tobytes(), compresslevel=1)
    return out.getvalue()


@functools.lru_cache(maxsize=4096)  # columns of one table have one header
def _header(kind: np.dtype[Any], shape: tuple[int, ...]) -> bytes:
    """The header of an .npy file."""
    out = BytesIO()
    descr = np.lib.format.dtype_to_descr(kind)
    np.lib.format.write_array_header_1_0(out, {"descr": descr, "fortran_order": False, "shape": shape})
    return out.getvalue()


def _arrays_of(table: Any, prefix: str = "") -> dict[str, NDArray[Any]]:
    """The columns of a table, by their names after a prefix."""
    return {prefix + f.name: getattr(table, f.name) for f in fields(table)}


def _table_of(kind: type[T], arrays: Mapping[str, NDArray[Any]], *, prefix: str = "") -> T:
    """The table of a kind that `_arrays_of` took apart."""
    names = [f.name for f in fields(cast("Any", kind))]
    return kind(**{name: _column(arrays, prefix + name) for name in names})


def write_tile(path: Path, tile: Tile) -> str:
    """Write one tile as .npz and return the digest of the file."""
    arrays = {"origin": tile.origin, **_arrays_of(tile.mesh), **_arrays_of(tile.instances, "instance_")}
    if (relief := tile.relief) is not None:
        arrays |= _arrays_of(relief.facades, "facade_") | _arrays_of(relief.openings, "opening_")
        arrays |= {"relief_cells": relief.cells, "relief_wall": relief.wall}
    if tile.full_parts is not None:
        arrays |= _arrays_of(tile.full_parts, "extra_")
    data = pack(arrays)
    write_atomically(path, data)
    return digest(data)


def read_tile(path: Path, *, stated: str | None = None) -> Tile:
    """The tile that `write_tile` wrote.

    stated : digest that the file must have; by default any

    Raises SceneFormatError if the file is missing, damaged or another one.
    """
    with reading(path, SceneFormatError, remedy=BUILD_AGAIN, known=SceneFormatError):
        data = path.read_bytes()
        if stated is not None and digest(data) != stated:
            raise SceneFormatError(f"{path}: {DIFFERS}")
        arrays = read_arrays(BytesIO(data))
        mesh, copies = _table_of(Mesh, arrays), _table_of(ShapeInstances, arrays, prefix="instance_")
        relief = _relief(arrays, faces=len(mesh)) if "relief_cells" in arrays else None
        full_parts = (
            _full_parts(arrays, faces=len(mesh), copies=len(copies)) if "extra_faces" in arrays else None
        )
        return Tile(arrays["origin"], mesh, copies, relief, full_parts)


def _full_parts(arrays: Mapping[str, NDArray[Any]], *, faces: int, copies: int) -> FullParts:
    """The parts of full relief in a tile's arrays; raises ValueError if they do not fit the tile."""
    full_parts = _table_of(FullParts, arrays, prefix="extra_")
    if len(full_parts.faces) != faces or len(full_parts.instances) != copies:
        raise ValueError("the parts of full relief do not fit the faces or the instances")
    return full_parts


def _relief(arrays: Mapping[str, NDArray[Any]], *, faces: int) -> WallRelief:
    """The relief in a tile's arrays; raises ValueError if its tables do not fit each other."""
    facades = _table_of(FacadeTable, arrays, prefix="facade_")
    openings = _table_of(Openings, arrays, prefix="opening_")
    cells, wall = _column(arrays, "relief_cells"), _column(arrays, "relief_wall")
    for table in (facades, openings):
        if {len(column) for column in table.columns().values()} - {len(table)}:
            raise ValueError(f"columns of {type(table).__name__} differ in length")
    ends = facades.first + facades.grid.prod(axis=1)
    if len(wall) != faces or ends.max(initial=0) > len(cells) or facades.first.min(initial=0) < 0:
        raise ValueError("walls of the relief do not fit its cells or the faces")
    if cells.max(initial=-1) >= len(openings) or wall.max(initial=-1) >= len(facades):
        raise ValueError("rows of the relief are beyond its tables")
    return WallRelief(facades, cells, openings, wall)


_ROWS = {
    "vertices": (3,), "faces": (3,), "color": (3,), "instance_transform": (3, 4), "facade_foot": (3,),
    "facade_tangent": (2,), "facade_size": (2,), "facade_start": (2,), "facade_cell": (2,),
    "facade_grid": (2,), "opening_panel": (4,), "opening_sill": (4,), "opening_opening": (4,),
    "opening_bars": (2,),
    "opening_trim_color": (3,), "opening_frame_color": (3,), "opening_infill_color": (3,),
    "opening_room_color": (3,),
}  # fmt: skip
"""Shape of a row of a column; of all others a number."""


def _column(arrays: Mapping[str, NDArray[Any]], name: str) -> NDArray[Any]:
    """A column of a table, of any length; raises ValueError if its rows have another shape."""
    array, row = arrays[name], _ROWS.get(name.rpartition("/")[2], ())
    if not array.ndim or array.shape[1:] != row:
        raise ValueError(f"{name} has the shape {array.shape}")
    return array


def write_shapes(path: Path, shapes: Mapping[str, Mesh]) -> None:
    """Write the shapes that instances copy, as one .npz."""
    arrays: dict[str, NDArray[Any]] = {"names": np.array(list(shapes), dtype=np.str_)}
    for name, mesh in shapes.items():
        arrays |= _arrays_of(mesh, f"{name}/")
    write_atomically(path, pack(arrays))


def read_shapes(path: Path) -> dict[str, Mesh]:
    """Shapes that `write_shapes` wrote, in order; empty without a file."""
    if not path.exists():
        return {}
    with reading(path, SceneFormatError, remedy=BUILD_AGAIN, known=SceneFormatError):
        arrays = read_arrays(path)
        return {str(name): _table_of(Mesh, arrays, prefix=f"{name}/") for name in arrays["names"]}
