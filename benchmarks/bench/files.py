"""Subjects writing and mapping, against laspy and numpy alone."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import laspy
import numpy as np

from bench.measure import Case
from bench.scenes import Setup
from geoscene.classes import class_codes
from lidar.dataset.formats import FORMATS, MAPS, read_table
from lidar.dataset.formats.las import SCALE, LasInfo
from lidar.dataset.formats.pcd import pcd_header
from lidar.dataset.formats.table import Table, rows
from lidar.dataset.layout import open_dataset
from lidar.options.maps import MapOptions
from lidar.simulation.drive import drive
from lidar.tools.maps.aggregate import aggregate

_EXTRA = ("ring", "label", "instance", "range", "incidence", "true_range")
_KINDS = {"ring": "uint16", "label": "uint8", "instance": "int32", "frame": "uint32"}
_VOXEL = 0.1


def recorded(setup: Setup) -> Path:
    """A dataset of a VLP-16 with clouds as LAS and PCD; recorded when it is first needed."""
    out = setup.folder / "dataset"
    if not out.exists():
        options = setup.options("VLP-16", seconds=2.0 if setup.quick else 20.0, formats=("las", "pcd"))
        drive(setup.scene, out, options=options)
    return out


def las_info(setup: Setup) -> LasInfo:
    """Properties of the dataset's LAS files."""
    return setup.plan("VLP-16", seconds=0.5).recording(setup.folder).las_info


def table_of(dataset: Path, suffix: str) -> Table:
    """All points of a dataset's files of one format, as one table."""
    tables = [read_table(path) for path in sorted(dataset.rglob(f"*{suffix}"))]
    return {name: np.concatenate([table[name] for table in tables]) for name in tables[0]}


def writing(setup: Setup) -> Iterator[Case]:
    """Writing the points of a drive as one file of each format."""
    dataset, info = recorded(setup), las_info(setup)
    world, local = table_of(dataset, ".las"), table_of(dataset, ".pcd")
    folder = setup.folder
    for name in ("las", "laz"):
        sides = {
            "lidar": _anew(_written, folder / f"ours.{name}", name, world, info=info),
            "laspy": _anew(laspy_written, folder / f"theirs.{name}", world, info=info),
        }
        note = (
            "same points, columns and CRS. lidar: class codes from labels, 15 echoes at most, millimetres"
            " checked, a complete file or none; laspy: finished columns, through its scaled x, y, z"
        )
        yield Case("writing", name.upper(), rows(world) / 1e6, "M points", sides, note)
    note = "same bytes after the header; numpy: fields copied into records, then tofile"
    for name, plain in (("pcd", numpy_pcd), ("kitti", numpy_kitti)):
        sides = {
            "lidar": _anew(_written, folder / f"ours.{name}", name, local),
            "numpy": _anew(plain, folder / f"theirs.{name}", local),
        }
        yield Case("writing", name.upper(), rows(local) / 1e6, "M points", sides, note)
    yield from _others(folder, world=world, local=local, info=info)


def _others(folder: Path, *, world: Table, local: Table, info: LasInfo) -> Iterator[Case]:
    """Writing formats of other libraries, and COPC against plain LAZ."""
    names = tuple(world)
    colored = world | {name: np.zeros(rows(world), np.uint8) for name in ("red", "green", "blue")}
    theirs = {
        "npz": ("numpy", numpy_npz, "same bytes"),
        "parquet": (
            "pyarrow",
            pyarrow_written,
            "lidar: frame columns, floats split by bytes, Zstandard; pyarrow: defaults",
        ),
    }
    for name, (side, plain, note) in theirs.items():
        sides = {
            "lidar": _anew(_written, folder / f"ours{FORMATS[name].suffix}", name, local),
            side: _anew(plain, folder / f"theirs{FORMATS[name].suffix}", local),
        }
        yield Case("writing", name.upper(), rows(local) / 1e6, "M points", sides, note)
    sides = {
        "lidar": _anew(_written, folder / "ours.e57", "e57", world, info=info),
        "pye57": _anew(pye57_written, folder / "theirs.e57", world, info=info),
    }
    note = "lidar: all columns, an identifier from the content; pye57: x, y, z, intensity and row only"
    yield Case("writing", "E57", rows(world) / 1e6, "M points", sides, note)
    sides = {
        "lidar": _anew(map_written, folder / "ours.copc.laz", colored, info=info, columns=names),
        "laspy": _anew(laspy_written, folder / "theirs.laz", world, info=info),
    }
    note = "lidar: an octree of samples; laspy: plain LAZ in the order of firing, without colours"
    yield Case("writing", "COPC", rows(world) / 1e6, "M points", sides, note)


def map_written(path: Path, table: Table, *, info: LasInfo, columns: tuple[str, ...]) -> None:
    """Write a table as a map."""
    colors = ("red", "green", "blue")
    with MAPS["copc"].open_map(path, info=info, columns=(*columns, *colors)) as append:
        append(table)


def numpy_npz(path: Path, table: Table) -> None:
    """Write a table as NPZ by numpy alone."""
    with path.open("wb") as file:
        np.savez(file, allow_pickle=False, **table)


def pyarrow_written(path: Path, table: Table) -> None:
    """Write a table as Parquet by pyarrow alone."""
    import pyarrow.parquet  # noqa: PLC0415 - optional

    pyarrow.parquet.write_table(pyarrow.table(table), path)


def pye57_written(path: Path, table: Table, *, info: LasInfo) -> None:
    """Write what pye57 writes of a table as E57."""
    import pye57  # noqa: PLC0415 - optional

    data = {f"cartesian{k.upper()}": table[k] - o for k, o in zip("xyz", info.offset, strict=True)}
    data |= {"intensity": table["intensity"], "rowIndex": table["ring"], "columnIndex": table["ring"]}
    with pye57.E57(str(path), mode="w") as file:
        file.write_scan_raw(data, translation=np.array(info.offset))


def _written(path: Path, name: str, table: Table, **info: Any) -> None:
    FORMATS[name].write(path, table, **info)


def _anew(write: Callable[..., None], path: Path, *arguments: object, **named: object) -> Callable[[], None]:
    """Writing of a file that is not there, as in a drive: replacing one waits for the disk."""

    def written() -> None:
        path.unlink(missing_ok=True)
        write(path, *arguments, **named)

    return written


def _las_header(info: LasInfo, *, point_format: int, extra: tuple[str, ...]) -> Any:
    header = laspy.LasHeader(version="1.4", point_format=point_format)
    header.scales, header.offsets = np.full(3, SCALE), np.asarray(info.offset, float)
    header.add_crs(info.crs)
    header.add_extra_dims([laspy.ExtraBytesParams(n, _KINDS.get(n, "float32")) for n in extra])
    return header


def laspy_written(path: Path, table: Table, *, info: LasInfo) -> None:
    """Write a table as LAS or LAZ by laspy alone."""
    las = laspy.LasData(_las_header(info, point_format=6, extra=_EXTRA))
    las.x, las.y, las.z = table["x"], table["y"], table["z"]
    las.intensity = np.rint(table["intensity"] * 257).astype(np.uint16)
    las.gps_time, las.classification = table["gps_time"], table["classification"]
    las.return_number, las.number_of_returns = table["echo"], table["echoes"]
    for name in _EXTRA:
        las[name] = table[name]
    las.write(path)


def numpy_pcd(path: Path, table: Table) -> None:
    """Write a table as binary PCD by numpy alone."""
    points = np.empty(rows(table), [(name, column.dtype) for name, column in table.items()])
    for name, column in table.items():
        points[name] = column
    with path.open("wb") as file:
        file.write(pcd_header(table, len(points)))
        points.tofile(file)


def numpy_kitti(path: Path, table: Table) -> None:
    """Write a table as a KITTI cloud by numpy alone."""
    points = np.empty((rows(table), 4), np.float32)
    for k, name in enumerate("xyz"):
        points[:, k] = table[name]
    np.divide(table["intensity"], np.float32(255), out=points[:, 3])
    points.tofile(path)


def mapping(setup: Setup) -> Iterator[Case]:
    """Aggregating a dataset's LAS files into one LAS file."""
    dataset, info, folder = recorded(setup), las_info(setup), setup.folder
    count = rows(table_of(dataset, ".las")) / 1e6
    for name, voxel in (("all points", None), (f"voxels of {_VOXEL} m", _VOXEL)):
        options = MapOptions(voxel=voxel)
        sides = {
            "lidar": partial(
                aggregate,
                open_dataset(dataset),
                folder / "ours_map.las",
                options=options,
                overwrite=True,
            ),
            "laspy": partial(laspy_map, dataset, folder / "theirs_map.las", info=info, voxel=voxel),
        }
        note = "lidar: a frame at a time, moving road users left out; laspy: all points in memory"
        if voxel:
            note = "voxels: lidar keeps the point nearest to the centre and sorts on disk, numpy the first"
        yield Case("mapping", name, count, "M points", sides, note)


def laspy_map(dataset: Path, out: Path, *, info: LasInfo, voxel: float | None) -> None:
    """The LAS files of a dataset as one, with colours of classes, by laspy and numpy alone."""
    paths = sorted(dataset.rglob("*.las"))
    files = [laspy.read(path) for path in paths]
    points = np.concatenate([file.points.array for file in files])
    frame = np.repeat([int(path.stem) for path in paths], [len(file.points) for file in files])
    if voxel:
        xyz = np.column_stack([points[axis] for axis in "XYZ"])
        _, first = np.unique(np.floor(xyz * (SCALE / voxel)).astype(np.int64), axis=0, return_index=True)
        points, frame = points[np.sort(first)], frame[np.sort(first)]
    las = laspy.LasData(_las_header(info, point_format=7, extra=("ring", "label", "instance", "frame")))
    las.points = laspy.ScaleAwarePointRecord.zeros(len(points), header=las.header)
    for name in las.points.array.dtype.names:
        if name in points.dtype.names:
            las.points.array[name] = points[name]
    las.frame = frame
    color = class_codes().color[points["label"]].astype(np.uint16) * 257
    las.red, las.green, las.blue = color.T
    las.write(out)
