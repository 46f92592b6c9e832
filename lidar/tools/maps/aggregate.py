"""Aggregated maps: all point clouds of a dataset as one, in its export CRS, in bounded memory."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from geoscene.classes import class_codes
from geoscene.drawing.previews import DARK, PreviewPlan, around, card
from geoscene.scene import open_scene
from geoscene.support.files import atomic_folder, exclusive
from geoscene.support.option_values import expect
from geoscene.support.progress import Progress, displayed, shows_progress
from lidar.dataset.derived import write_map_provenance
from lidar.dataset.formats import MAPS, format_of, map_suffixes, read_table
from lidar.dataset.formats.las import LasInfo
from lidar.dataset.formats.table import Table, rows
from lidar.dataset.layout import Dataset, DatasetLike, open_dataset, own_files
from lidar.errors import InputError
from lidar.options.maps import MapOptions
from lidar.tools.maps.colors import ImageColors, distinct, ramp
from lidar.tools.maps.compare import SurfaceComparison, SurfaceDistances, far_reasons
from lidar.tools.maps.rasters import Rasters
from lidar.tools.maps.source import (
    MapClouds,
    PoseErrors,
    Selection,
    pose_errors,
    read_poses,
    write_poses,
)
from lidar.tools.maps.squares import INDEX, NAMES, Outliers, open_tiles, thin

_MOST_DRAWN = 5_000_000
"""Points of a map up to which notebooks show a picture of it."""


@dataclass(frozen=True, slots=True)
class MapSummary:
    """Numbers of points and frames of a map.

    points_in : returns read
    points    : points written
    left_out  : returns left out, by the first of the reasons of `Selection.unwanted`,
                and of those that these leave, outliers
    frames    : frames read
    missing   : number of missing frames, by scanner
    path      : the file, or the folder of tiles
    beside    : further files: rasters, and those of comparisons
    distances : to the surfaces of the scene that the map was compared with
    poses     : errors of the poses of a file; None for true ones
    notes     : why distances are large, one line each
    """

    points_in: int
    points: int
    left_out: dict[str, int]
    frames: int
    missing: dict[str, int]
    path: Path
    beside: list[Path]
    distances: list[SurfaceDistances]
    poses: PoseErrors | None
    notes: tuple[str, ...] = ()

    def _repr_png_(self) -> bytes | None:
        """A picture from above in the map's colours, for notebooks; None if empty, very large or in tiles."""
        if not 0 < self.points <= _MOST_DRAWN or self.path.is_dir():
            return None
        table = read_table(self.path)
        xyz = np.column_stack([table[axis] for axis in "xyz"])
        plan = PreviewPlan(around(xyz[:, :2]), DARK)
        plan.points(xyz, np.column_stack([table[name] for name in ("red", "green", "blue")]).astype(np.uint8))
        return plan.png()

    def _repr_html_(self) -> str:
        """The picture and a table of figures, for notebooks."""
        rows = [
            ("points", f"{self.points:,} of {self.points_in:,}"),
            ("frames", f"{self.frames:,}"),
            *((f"without {reason}", f"{count:,}") for reason, count in self.left_out.items()),
            ("files", ", ".join(path.name for path in (self.path, *self.beside))),
        ]
        return card(f"Map {self.path.name}", rows, picture=self._repr_png_())


@shows_progress
def aggregate(
    dataset: DatasetLike,
    out: str | Path,
    *,
    options: MapOptions = MapOptions(),
    overwrite: bool = False,
    progress: Progress = displayed,
) -> MapSummary:
    """Write the map of a dataset in the format of the suffix of ``out`` (see `map_suffixes`).

    Sources, licence and the dataset's digest are written beside it, to ``<out>.provenance.json``.

    LAS, LAZ, COPC, E57 and PLY hold easting, northing and height in the dataset's export CRS. PCD, whose
    readers take float32, holds the same minus the whole-metre offset that its comment line states.

    overwrite : replace an existing file

    Rasters, comparisons and trajectories are beside it, have its name and replace files of earlier maps. The
    map itself appears last. With ``options.tiles``, ``out`` is a folder, in which all of them are.

    Raises InputError for an unknown scanner or suffix, and DatasetError for a dataset without clouds.
    """
    dataset = open_dataset(dataset)
    expect(options, MapOptions, name="options", error=InputError)
    out = Path(out)
    _check(out, tiles=options.tiles is not None)
    folder, target = dataset.path.resolve(), out.resolve()
    if folder in target.parents and own_files(folder)(target.relative_to(folder).as_posix()):
        raise InputError(f"{out}: is a file of the dataset; give another one")
    if out.exists() and not overwrite:
        raise InputError(f"{out}: exists already; set `overwrite` to replace it")
    names = _scanners(dataset, options)
    trajectory = None if options.poses == "truth" else read_poses(Path(options.poses), dataset)
    selection = Selection(dataset, options, trajectory=trajectory)
    colors = ImageColors(dataset) if options.color == "image" else None
    form = format_of(out) if options.tiles is None else MAPS[options.tile_format]
    source = MapClouds(
        dataset,
        names,
        selection=selection,
        trajectory=trajectory,
        colors=colors,
        strips=form.module in ("las", "copc"),
    )
    read = _Read()
    stream = read.wanted(source, selection, progress=progress)
    if options.voxel is not None:
        stream = thin(stream, options.voxel, out=out, offset=source.geo.offset)
    outliers = Outliers(*options.outliers) if options.outliers else None
    if outliers:
        stream = outliers.without(stream, out=out, offset=source.geo.offset)
    compared = comparison = None
    if options.compare is not None:
        compared = open_scene(options.compare)
        comparison = SurfaceComparison(compared, dataset.frame, crs=dataset.crs)
        stream = comparison.measured(stream)
    rasters = Rasters(options.raster, options.resolution)
    if options.raster:
        stream = rasters.measured(stream)
    limits = source.height_range() if options.color == "height" else (0.0, 0.0)
    with _open_file(out, source, options=options) as (named, append):
        written = 0
        for table in stream:
            append(_color_points(table, options.color, limits=limits))
            written += rows(table)
        write_map_provenance(dataset, named)
        beside = rasters.write(named, crs=dataset.crs)
        if comparison:
            beside += comparison.write(named)
        if trajectory is not None:
            beside.append(named.with_suffix(".tum"))
            write_poses(beside[-1], trajectory, dataset=dataset)
    distances = comparison.rows() if comparison else []
    return MapSummary(
        read.points,
        written,
        dict(read.left_out) | ({"outliers": outliers.left_out} if outliers else {}),
        len(read.frames),
        source.missing(),
        out,
        beside=beside
        if options.tiles is None
        else [out / name for name in (INDEX, *(p.name for p in beside))],
        distances=distances,
        poses=pose_errors(trajectory, dataset.trajectory()) if trajectory is not None else None,
        notes=tuple(far_reasons(dataset, compared, rows=distances)) if compared is not None else (),
    )


def _check(out: Path, *, tiles: bool) -> None:
    """Raise InputError if ``out`` is no name of a map, or MissingExtraError if its format needs a package."""
    named = out.name.lower().endswith(tuple(map_suffixes()))
    if tiles and named:
        raise InputError(f"{out}: `tiles` are written to a folder; give a name without {out.suffix}")
    if not tiles and not (named and format_of(out).maps):
        raise InputError(f"{out}: maps are written as {', '.join(map_suffixes())}; with `tiles`, to a folder")
    if not tiles and out.is_dir():
        raise InputError(f"{out}: is a directory; give a file such as map.laz")
    if not tiles:
        format_of(out).require()


def _scanners(dataset: Dataset, options: MapOptions) -> list[str]:
    """Names of the scanners that options ask for."""
    lidars = dataset.sensors("lidar")
    if unknown := sorted(set(options.sensors) - set(lidars)):
        raise InputError(f"no scanner {', '.join(unknown)} in {dataset.path}; there are {', '.join(lidars)}")
    return [name for name in lidars if not options.sensors or name in options.sensors]


class _Read:
    """Counts of the returns that were read."""

    def __init__(self) -> None:
        self.points = 0
        self.frames: set[int] = set()
        self.left_out = Counter[str]()

    def wanted(self, source: MapClouds, selection: Selection, *, progress: Progress) -> Iterator[Table]:
        """The tables of a source without the returns that a selection leaves out."""
        for k, (frame, name, row, table) in enumerate(source.tables()):
            self.points += rows(table)
            self.frames.add(frame)
            progress("reading clouds", min(k + 1, len(source)), total=len(source))
            keep = np.ones(rows(table), bool)
            for reason, unwanted in selection.unwanted(table, name=name, frame=frame, row=row):
                self.left_out[reason] += int(np.count_nonzero(keep & unwanted))
                keep &= ~unwanted
            yield {column: values[keep] for column, values in table.items() if column != "imaged"}


def _color_points(table: Table, color: str, *, limits: tuple[float, float]) -> Table:
    if color == "image":
        return table
    if color == "class":
        rgb = class_codes().color[table["label"]]
    elif color == "height":
        rgb = ramp(table["z"], limits[0], high=limits[1])
    elif color == "intensity":
        rgb = ramp(table["intensity"], 0.0, high=100.0)
    else:
        rgb = distinct(table["source"])
    return table | {"red": rgb[:, 0], "green": rgb[:, 1], "blue": rgb[:, 2]}


@contextmanager
def _open_file(
    out: Path, source: MapClouds, *, options: MapOptions
) -> Iterator[tuple[Path, Callable[[Table], None]]]:
    """Yield the path whose folder and name files beside a map have, and a function that appends tables.

    The map, or the folder of its tiles, appears at the end, unless the block raises.
    """
    info = LasInfo(source.dataset.crs, source.geo.offset, source.dataset.start)
    columns = (*source.columns, "red", "green", "blue")
    if options.tiles is None:
        with exclusive(out), format_of(out).open_map(out, info=info, columns=columns) as append:
            yield out, append
    else:
        form = MAPS[options.tile_format]
        with (
            atomic_folder(out, mark=INDEX, names=NAMES) as folder,
            open_tiles(folder, options.tiles, form=form, info=info, columns=columns) as append,
        ):
            yield folder / "tiles", append
