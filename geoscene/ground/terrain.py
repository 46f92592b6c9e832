"""Heights of the ground from elevation rasters, interpolated in their own grids."""

from __future__ import annotations

import functools
import itertools
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray
from pyproj import CRS, Transformer
from pyproj.exceptions import ProjError

from geoscene.errors import InputError, SourceNotFoundError, reading
from geoscene.geometry.frames import Frame, beside
from geoscene.support.graphs import components
from geoscene.support.problems import Problem
from geoscene.typing import Bools, Float, Height

Vertical = Literal["flat", "orthometric", "ellipsoidal"]

_UNITS = {
    "": 1.0, "m": 1.0, "metre": 1.0, "metres": 1.0, "meter": 1.0, "meters": 1.0,
    "ft": 0.3048, "foot": 0.3048, "feet": 0.3048, "international foot": 0.3048,
    "us-ft": 1200 / 3937, "us survey foot": 1200 / 3937, "us_survey_foot": 1200 / 3937, "ftus": 1200 / 3937,
    "cm": 0.01, "dm": 0.1,
}  # fmt: skip
"""Metres per vertical unit; the US survey foot is 1200/3937 m by its definition."""

_LOWEST, _HIGHEST = -500.0, 9000.0
"""Metres of the lowest and highest land, with a margin; other values are unmarked voids."""

_STEP, _STEEPEST, _SPIKE = 100.0, 5.0, 16
"""Groups of at most 16 posts are spikes if the ground steps by over 100 m and five spacings (79°) all around.

Assumed: rock towers of that slope and height are wider, and single posts that are off are taller."""

_MARGIN = 3
"""Posts read beyond the scene on each side."""

_REMEDY = "give GeoTIFF or .hgt, as gdal_translate writes"


_AT_ONCE = 1000
"""Footprints whose ground is looked up at once: some 300,000 places, which bounds the memory."""


@dataclass(frozen=True)
class ElevationGrid:
    """Posts of one elevation model, or of several that share a lattice.

    crs    : horizontal CRS, WKT
    origin : (2,) float64, post (0, 0) in that CRS, easting or longitude first
    step   : (2, 2) float64, from (column, row) to CRS units: ``place = origin + step @ (column, row)``
    values : (rows, columns) float64 metres, without voids
    known  : (rows, columns) bool, posts that a raster covers, filled voids included
    """

    crs: str
    origin: Float
    step: Float
    values: Float
    known: Bools


@dataclass(frozen=True)
class Terrain:
    """The height of the ground as a function of place; level at 0 by default.

    frame    : the scene frame that x and y are in
    grids    : finest first; a place takes its height from the first that covers it; none for flat ground
    vertical : reference of heights: ``flat``, ``orthometric`` (a geoid) or ``ellipsoidal``
    datum    : the vertical datum in words, such as ``EGM96``, and how it is known
    spacing  : metres between the posts of the finest grid, 0 for flat ground
    posts    : posts read
    voids    : posts among them that held no height and were filled from their neighbours
    uncovered : share of the scene that no raster covers, which took the nearest height
    sources  : names of the files
    credits  : required attribution of each file, empty if none
    problems : voids and spikes that were filled, and ground that no raster covers
    """

    frame: Frame
    grids: tuple[ElevationGrid, ...] = ()
    vertical: Vertical = "flat"
    datum: str = "level ground"
    spacing: float = 0.0
    posts: int = 0
    voids: int = 0
    uncovered: float = 0.0
    sources: tuple[str, ...] = ()
    credits: tuple[str, ...] = ()
    problems: tuple[Problem, ...] = ()

    @property
    def lines(self) -> float:
        """Metres between the ground's terrain lines: half the posts' spacing, 10 to 50; 0 if flat."""
        return float(np.clip(np.floor(self.spacing / 2), 10.0, 50.0)) if self.grids else 0.0

    def height(self, x: ArrayLike, y: ArrayLike) -> Float:
        """Metres of the ground's z at scene coordinates (any shape), bilinear between the four posts around.

        Beyond the posts read, the height of the nearest edge.
        """
        x, y = np.broadcast_arrays(np.asarray(x, float), np.asarray(y, float))
        z = np.zeros(x.shape)
        open_ = np.full(x.shape, bool(self.grids))
        for k, transformer in enumerate(self._transformers):
            grid, last = self.grids[k], k == len(self.grids) - 1
            place = np.stack(transformer.transform(*self.frame.to_projected(x[open_], y[open_])))
            place[0] = beside(place[0], float(grid.origin[0]), turn=self._turns[k])
            column, row = np.linalg.solve(grid.step, place - grid.origin[:, None])
            value, covered = _bilinear(grid, column, row=row)
            take = np.zeros(x.shape, bool)
            take[open_] = True if last else covered
            z[take] = value[take[open_]]
            open_ &= ~take
        return z

    @functools.cached_property
    def _transformers(self) -> list[Transformer]:
        return [Transformer.from_crs(self.frame.crs, CRS.from_wkt(g.crs), always_xy=True) for g in self.grids]

    @functools.cached_property
    def _turns(self) -> list[float]:
        return [_turn(CRS.from_wkt(g.crs)) for g in self.grids]


def open_terrain(
    paths: Sequence[str | Path],
    frame: Frame,
    *,
    bounds: Sequence[float],
    unit: str | None = None,
    vertical: Literal["orthometric", "ellipsoidal"] | None = None,
    outside: Literal["error", "nearest"] = "error",
    around: float = 0.0,
) -> Terrain:
    """The terrain within a scene's bounds, from elevation rasters.

    GeoTIFF, .hgt, or one of them in a .zip, in any CRS.

    Rasters whose posts share one lattice (the tiles of one model) are joined before anything is
    interpolated, so no seam shows between them. Voids (the raster's nodata, not a number, or lower than
    -500 m or higher than 9,000 m) and spikes are filled from around by inverse distances and listed.

    bounds   : (xmin, ymin, xmax, ymax), scene metres; only what lies within, and around, is read
    unit     : of heights (``m``, ``ft``, ``us-ft``) where the files do not state it or are wrong
    vertical : reference of heights where the files do not state it; a geoid (``orthometric``) by default
    outside  : what to do where no raster covers the bounds: raise, or take the ``nearest`` height and tell
               the share
    around   : metres beyond the bounds in which heights are read where rasters cover them

    Raises SourceNotFoundError for a missing file, InputError for one that is no raster, has no CRS or an
    unknown unit, for rasters that do not cover the bounds, and for ones that differ in the reference of
    heights.
    """
    if not paths:
        raise InputError("no elevation file was given")
    box = shapely.box(*bounds)
    rasters = [_open(Path(path), unit=unit, vertical=vertical) for path in paths]
    kinds = {(r.vertical, r.datum) for r in rasters}
    if len({kind for kind, _ in kinds}) > 1:
        raise InputError(
            "the elevation files differ in the reference of heights: "
            + "; ".join(f"{r.path.name}: {r.vertical}" for r in rasters)
        )
    covered = shapely.intersection(shapely.union_all([_outline(r, frame) for r in rasters]), box).area
    uncovered = max(1.0 - covered / box.area, 0.0)
    if uncovered > 1e-9 and (outside == "error" or covered == 0.0):
        raise InputError(_not_covered(rasters, frame, bounds=bounds, share=uncovered))
    groups: list[list[_Raster]] = []
    for raster in rasters:
        for group in groups:
            if _shares_lattice(group[0], raster):
                group.append(raster)
                break
        else:
            groups.append([raster])
    wide = shapely.bounds(shapely.buffer(box, around, join_style="mitre")).tolist()
    read = [found for group in groups if (found := _read(group, frame, bounds=wide)) is not None]
    read.sort(key=lambda found: found.spacing)
    if not read:
        names = ", ".join(r.path.name for r in rasters)
        raise InputError(f"{names}: no heights within the scene, only voids")
    beyond = []
    if uncovered > 1e-9:
        detail = f"{_percent(uncovered)} of the scene is not covered and takes the nearest height"
        beyond.append(Problem("", "terrain", "repaired", "uncovered", detail))
    return Terrain(
        frame,
        tuple(found.grid for found in read),
        rasters[0].vertical,
        ", ".join(sorted({datum for _, datum in kinds})),
        min(found.spacing for found in read),
        sum(found.posts for found in read),
        sum(found.voids for found in read),
        uncovered if uncovered > 1e-9 else 0.0,
        tuple(r.path.name for r in rasters),
        tuple(r.credit for r in rasters),
        (*beyond, *itertools.chain.from_iterable(found.problems for found in read)),
    )


def base_heights(footprints: Sequence[object] | NDArray[np.object_], height: Height | None) -> Float:
    """Lowest ground (n,) along each footprint's outline, metres: base of a building on a slope.

    ``height`` (z of the ground at x, y; None if it is 0 everywhere) is sampled at the outline's vertices and
    at most 2 m apart between them. NaN for a footprint that is None or empty.
    """
    outlines = np.fromiter(footprints, object)
    if height is None:
        return np.where(shapely.is_missing(outlines) | shapely.is_empty(outlines), np.nan, 0.0)
    lowest = np.full(len(outlines), np.inf)
    for first in range(0, len(outlines), _AT_ONCE):
        fine = shapely.segmentize(shapely.boundary(outlines[first : first + _AT_ONCE]), 2.0)
        xy, owner = shapely.get_coordinates(fine, return_index=True)
        np.minimum.at(lowest, first + owner, height(xy[:, 0], xy[:, 1]))
    return np.where(np.isinf(lowest), np.nan, lowest)


@dataclass(frozen=True, slots=True)
class _Raster:
    """One file: lattice, unit and datum; post (0, 0) is the centre of its first pixel."""

    path: Path
    name: str
    crs: CRS
    origin: Float
    step: Float
    shape: tuple[int, int]
    nodata: float | None
    to_metres: tuple[float, float]
    vertical: Literal["orthometric", "ellipsoidal"]
    datum: str
    credit: str
    turn: float

    def origin_beside(self, other: _Raster) -> Float:
        """The origin, on the same side of 180° of longitude as that of another raster."""
        return np.array([beside(self.origin[0], other.origin[0], turn=self.turn), self.origin[1]])


def gdal_name(path: Path) -> str:
    """GDAL's name of a raster: a path, or a path within a zip archive."""
    if not path.exists():
        raise SourceNotFoundError(f"{path}: no such elevation file")
    if path.suffix.lower() != ".zip":
        return str(path)
    try:
        with zipfile.ZipFile(path) as archive:
            names = [n for n in archive.namelist() if n.lower().endswith((".hgt", ".tif", ".tiff"))]
    except zipfile.BadZipFile as error:
        raise InputError(f"{path}: not a zip archive, or a damaged one") from error
    if len(names) != 1:
        raise InputError(f"{path}: {len(names)} rasters (.hgt, .tif) in it; give an archive that holds one")
    return f"/vsizip/{path.resolve()}/{names[0]}"


def driver_of(name: str) -> str:
    """GDAL's driver for a name of `gdal_name`; others, such as VRT, read other files and networks."""
    return "SRTMHGT" if name.lower().endswith(".hgt") else "GTiff"


def _open(path: Path, *, unit: str | None, vertical: Literal["orthometric", "ellipsoidal"] | None) -> _Raster:
    """Metadata of a file, completed by the caller's where it has none."""
    import rasterio  # noqa: PLC0415 - slow to import

    name = gdal_name(path)
    with (
        reading(path, InputError, remedy=_REMEDY),
        rasterio.Env(GTIFF_REPORT_COMPD_CS="YES"),
        rasterio.open(name, driver=driver_of(name)) as source,
    ):
        if source.crs is None:
            raise InputError(f"{path}: no CRS in it; assign one, as with: gdal_edit.py -a_srs EPSG:4326 FILE")
        crs = CRS.from_wkt(source.crs.to_wkt())
        stated, kind, datum = _vertical(crs, source.driver)
        stated = (source.units[0] or stated).strip().lower()
        factor = _UNITS.get((unit or stated).lower())
        if factor is None:
            raise InputError(f"{path}: heights in {unit or stated!r}; say which unit: m, ft or us-ft")
        a, tags = source.transform, source.tags()
        step = np.array([[a.a, a.b], [a.d, a.e]])
        return _Raster(
            path,
            name,
            crs.sub_crs_list[0] if crs.is_compound else crs.to_2d(),
            np.array([a.c, a.f]) + step @ (0.5, 0.5),
            step,
            source.shape,
            source.nodata,
            (source.scales[0] * factor, source.offsets[0] * factor),
            vertical or kind or "orthometric",
            tags.get("VERTICAL_DATUM", datum) if vertical is None else f"{vertical}, as told",
            tags.get("TIFFTAG_COPYRIGHT", ""),
            _turn(crs),
        )


def _vertical(crs: CRS, driver: str) -> tuple[str, Literal["orthometric", "ellipsoidal"] | None, str]:
    """(unit, kind, datum) of heights as a CRS states them."""
    if crs.is_compound:
        upright = crs.sub_crs_list[1]
        factor = upright.axis_info[0].unit_conversion_factor
        unit = {1.0: "m", 0.3048: "ft"}.get(factor, "us-ft" if abs(factor - 1200 / 3937) < 1e-9 else "?")
        return unit, "orthometric", str(upright.name)
    if len(crs.axis_info) == 3:
        return "", "ellipsoidal", f"ellipsoid of {crs.name}"
    if driver == "SRTMHGT":
        return "m", "orthometric", "EGM96"  # the SRTM mission's own datum; the format states none
    return "", None, "not stated, taken for heights above a geoid"


def _outline(raster: _Raster, frame: Frame) -> Any:
    """The raster's edge, outside its pixels, as a polygon in the scene."""
    rows, columns = raster.shape
    edge = shapely.segmentize(shapely.box(-0.5, -0.5, columns - 0.5, rows - 0.5), max(rows, columns) / 32)
    xy = raster.origin + shapely.get_coordinates(edge) @ raster.step.T
    try:
        corners = np.column_stack(frame.from_crs(xy[:, 0], xy[:, 1], crs=raster.crs))
    except ProjError as error:
        raise InputError(f"{raster.path}: its CRS cannot be transformed to the scene's ({error})") from error
    if not np.isfinite(corners).all():
        raise InputError(f"{raster.path}: has pixels outside the area of its CRS or of the scene's CRS")
    outline = shapely.Polygon(corners)
    # Neighbouring tiles' edges agree to the rounding of their headers and of the projection between vertices.
    return shapely.make_valid(outline).buffer(0.01, join_style="mitre")


def _not_covered(rasters: Sequence[_Raster], frame: Frame, *, bounds: Sequence[float], share: float) -> str:
    xmin, ymin, xmax, ymax = bounds
    lon, lat = frame.to_geographic([xmin, xmax, xmax, xmin], [ymin, ymin, ymax, ymax])
    names = ", ".join(r.path.name for r in rasters)
    lacking = "no part of the scene is" if share >= 1.0 else f"{_percent(share)} of the scene is not"
    return (
        f"{names}: {lacking} covered; the scene spans W {lon.min():.5f} S {lat.min():.5f}"
        f" E {lon.max():.5f} N {lat.max():.5f}; add files that cover it"
        + (", or let the rest take the nearest height (`dem_gaps` nearest)" if share < 1.0 else "")
    )


def _percent(share: float) -> str:
    """A share as text that shows 0 % and 100 % only where they are exact."""
    if share >= 1.0:
        return "all"
    if share < 0.001:
        return "less than 0.1 %"
    return f"{min(100 * share, 99.9):.1f} %"


def _shares_lattice(one: _Raster, other: _Raster) -> bool:
    """Whether both share one lattice: the same CRS and steps, a whole number of steps apart."""
    if one.crs != other.crs or not np.allclose(one.step, other.step, rtol=1e-7, atol=0):
        return False
    apart = np.linalg.solve(one.step, other.origin_beside(one) - one.origin)
    return bool(np.abs(apart - np.round(apart)).max() < 1e-2)


class _Found(NamedTuple):
    """Heights near the scene: spacing in metres, numbers of posts and of voids among them, and repairs."""

    grid: ElevationGrid
    spacing: float
    posts: int
    voids: int
    problems: tuple[Problem, ...]


def _read(group: Sequence[_Raster], frame: Frame, *, bounds: Sequence[float]) -> _Found | None:
    """The heights near the bounds of rasters on one lattice; None if there are none."""
    import rasterio  # noqa: PLC0415 - slow to import
    from rasterio.windows import Window  # noqa: PLC0415

    first = group[0]
    side = max(float(np.diff(bounds[::2])[0]), 1.0)
    edge = shapely.get_coordinates(shapely.segmentize(shapely.box(*bounds), side / 32))
    place = np.column_stack(frame.to_crs(edge[:, 0], edge[:, 1], crs=first.crs))
    centre = first.origin + first.step @ np.array(first.shape[::-1]) / 2
    near = float(beside(place[0, 0], float(centre[0]), turn=first.turn))
    place[:, 0] = beside(place[:, 0], near, turn=first.turn)
    post = np.linalg.solve(first.step, (place - first.origin).T)
    low = np.floor(post.min(axis=1)).astype(int) - _MARGIN
    high = np.ceil(post.max(axis=1)).astype(int) + _MARGIN + 1
    values = np.full((high[1] - low[1], high[0] - low[0]), np.nan)
    known = np.zeros(values.shape, bool)
    for raster in group:
        shift = np.round(np.linalg.solve(first.step, raster.origin_beside(first) - first.origin)).astype(int)
        begin = np.maximum(low - shift, 0)
        end = np.minimum(high - shift, raster.shape[::-1])
        if (begin >= end).any():
            continue
        with (
            reading(raster.path, InputError, remedy=_REMEDY),
            rasterio.open(raster.name, driver=driver_of(raster.name)) as source,
        ):
            found = source.read(1, window=Window(*begin, *(end - begin)))
        void = ~np.isfinite(found)
        if raster.nodata is not None:
            void |= found == np.asarray(raster.nodata, found.dtype)
        metres = found.astype(np.float64) * raster.to_metres[0] + raster.to_metres[1]
        with np.errstate(invalid="ignore"):
            void |= (metres < _LOWEST) | (metres > _HIGHEST)
        metres[void] = np.nan
        (c0, r0), (c1, r1) = begin + shift - low, end + shift - low
        known[r0:r1, c0:c1] = True
        here = values[r0:r1, c0:c1]
        values[r0:r1, c0:c1] = np.where(np.isnan(here), metres, here)
    if np.isnan(values).all():
        return None
    voids = int((known & np.isnan(values)).sum())
    posts = int(known.sum())
    origin = first.origin + first.step @ low
    spacing = _spacing(first, frame, bounds=bounds)
    spikes = _spikes(values, max(_STEP, _STEEPEST * spacing))
    problems = _repairs(
        values, spikes=spikes, known=known, names=[r.path.name for r in group], metres=spacing
    )
    values[spikes] = np.nan
    grid = ElevationGrid(first.crs.to_wkt(), origin, first.step, _fill_gaps(values, known), known)
    return _Found(grid, spacing, posts, voids, problems)


def _spacing(raster: _Raster, frame: Frame, *, bounds: Sequence[float]) -> float:
    """Metres between neighbouring posts of a row, in the middle of the bounds."""
    middle = np.array([(bounds[0] + bounds[2]) / 2, (bounds[1] + bounds[3]) / 2])
    east, north = frame.to_crs(middle[0], middle[1], crs=raster.crs)
    steps = np.column_stack([[0.0, 0.0], raster.step]) + np.array([[east], [north]])
    sx, sy = frame.from_crs(steps[0], steps[1], crs=raster.crs)
    return float(np.hypot(np.diff(sx[[0, 1]]), np.diff(sy[[0, 1]]))[0])


def _spikes(values: Float, step: float) -> Bools:
    """(rows, columns) bool, posts in groups of at most `_SPIKE` with steps over ``step`` metres all around.

    Groups at voids or at the rim are no spikes: what lies beyond is unknown.
    """
    number = np.arange(values.size).reshape(values.shape)
    pairs = [(number[:, :-1], number[:, 1:]), (number[:-1], number[1:])]
    a, b = (np.concatenate([pair[k].ravel() for pair in pairs]) for k in (0, 1))
    rise = np.abs(values.ravel()[a] - values.ravel()[b])
    if not (rise > step).any():
        return np.zeros(values.shape, np.bool_)
    joined = ~(rise > step)  # voids join whatever is beside them
    group = components(a[joined], b[joined], count=values.size).reshape(values.shape)
    small = np.bincount(group.ravel()) <= _SPIKE
    small[group[np.isnan(values)]] = False
    for edge in (group[0], group[-1], group[:, 0], group[:, -1]):
        small[edge] = False
    return np.asarray(small[group], np.bool_)


def _repairs(
    values: Float, *, spikes: Bools, known: Bools, names: Sequence[str], metres: float
) -> tuple[Problem, ...]:
    """The voids and the spikes of rasters, as problems."""
    from scipy.ndimage import distance_transform_edt  # noqa: PLC0415 - slow to import

    files, end = ", ".join(names), "filled from around"
    posts = int(known.sum())
    problems = []
    void = known & np.isnan(values)
    if void.any():
        far = float(distance_transform_edt(np.isnan(values))[void].max()) * metres
        detail = f"{files}: {int(void.sum())} of {posts} posts, up to {far:.0f} m from a height; {end}"
        problems.append(Problem("", "terrain", "repaired", "void", detail))
    if spikes.any():
        low, high = values[spikes].min(), values[spikes].max()
        detail = f"{files}: {int(spikes.sum())} of {posts} posts at {low:z.0f} to {high:z.0f} m; {end}"
        problems.append(Problem("", "terrain", "repaired", "spike", detail))
    return tuple(problems)


def _fill_gaps(values: Float, known: Bools) -> Float:
    """Values without gaps: voids by inverse distances, posts outside all rasters by the nearest."""
    from rasterio.fill import fillnodata  # noqa: PLC0415 - slow to import
    from scipy.ndimage import distance_transform_edt  # noqa: PLC0415 - slow to import

    good = ~np.isnan(values)
    if good.all():
        return values
    filled = values.copy()
    void = known & ~good
    if void.any():
        around = fillnodata(np.where(good, values, 0.0), mask=good, max_search_distance=100.0)
        near = distance_transform_edt(~good) < 100.0
        filled[void & near] = around[void & near]
    rest = np.isnan(filled)
    if rest.any():
        row, column = distance_transform_edt(rest, return_distances=False, return_indices=True)
        filled = filled[row, column]
    return filled


def _turn(crs: CRS) -> float:
    """Units of a CRS's first axis around the globe; infinite where the axis does not go round."""
    if crs.is_geographic:
        return 2 * np.pi / float(crs.axis_info[0].unit_conversion_factor)
    return 2 * np.pi * 6378137.0 if crs.to_epsg() == 3857 else np.inf


def _bilinear(grid: ElevationGrid, column: Float, *, row: Float) -> tuple[Float, Bools]:
    """Heights (n,) at fractional posts (n,), and whether a raster covers the place (its pixels do)."""
    rows, columns = grid.values.shape
    column, row = np.clip(column, 0.0, columns - 1.0), np.clip(row, 0.0, rows - 1.0)
    c = np.minimum(column.astype(int), columns - 2)
    r = np.minimum(row.astype(int), rows - 2)
    u, v = column - c, row - r
    z = grid.values
    value: Float = (
        z[r, c] * (1 - u) * (1 - v)
        + z[r, c + 1] * u * (1 - v)
        + z[r + 1, c] * (1 - u) * v
        + z[r + 1, c + 1] * u * v
    )
    return value, grid.known[np.round(row).astype(int), np.round(column).astype(int)]
