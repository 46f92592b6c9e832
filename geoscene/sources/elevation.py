"""Public elevation tiles: web-Mercator PNGs that encode heights, joined into one GeoTIFF."""

from __future__ import annotations

import hashlib
import io
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene import __version__
from geoscene.errors import InputError, NetworkError
from geoscene.geometry.frames import Frame, beside, rim_of, wrap_longitude
from geoscene.options import BuildOptions
from geoscene.sources.data import Bounds, OsmData
from geoscene.sources.network import BUSY, RefusedError, cause, check_address, host_of, open_session, wait
from geoscene.sources.registry import SOURCES
from geoscene.support.files import write_atomically
from geoscene.support.progress import Progress, displayed, shows_progress, silent
from geoscene.support.urls import without_secrets
from geoscene.typing import Float

DATUM = "the geoids of the tiles' sources, mixed (EGM96, EGM2008, NAVD88, national)"

_SIDE = 256  # pixels of a tile
_HALF_WORLD = math.pi * 6378137.0  # metres from the middle of web Mercator to its edge (EPSG:3857)
_COARSEST = 10.0  # metres between posts that the chosen zoom does not exceed; it is then over 5
_LAST_LATITUDE = 85.0  # degrees; web Mercator's square ends at 85.05
_AROUND = 8  # posts fetched beyond the box on each side
_SHORE = 2  # posts from a coastline within which the sea's floor begins
_LONGEST_PAUSE = 30.0  # seconds between two attempts, even if the server states more
_CACHE_VERSION = 1


@dataclass(frozen=True, slots=True)
class TileServer:
    """A server of elevation tiles, and how requests are repeated.

    template   : address of a tile with {z}, {x} and {y}; 256-pixel PNGs in the terrarium encoding
    credit     : attribution of the data
    datum      : vertical datum, in words
    user_agent : header that names the client
    timeout    : seconds per request
    attempts   : how often a tile is requested while the server fails or is busy
    wait       : seconds before the second attempt, doubled before each further one
    deepest    : largest zoom of the server
    most       : largest number of tiles of one map
    """

    template: str = "https://s3.amazonaws.com/elevation-tiles-prod/terrarium/{z}/{x}/{y}.png"
    credit: str = SOURCES["terrain-tiles"].attribution
    datum: str = DATUM
    user_agent: str = f"geoscene/{__version__} (builds 3D scenes from OpenStreetMap)"
    timeout: float = 30.0
    attempts: int = 4
    wait: float = 0.5
    deepest: int = 15
    most: int = 2000

    def __post_init__(self) -> None:
        """Raise InputError for an address that is none, or without the placeholders of a tile."""
        check_address(self.template)
        if not all(part in self.template for part in ("{z}", "{x}", "{y}")):
            raise InputError(
                f"{without_secrets(self.template)}: give the address of a tile with {{z}}, {{x}} and {{y}}"
            )


def zoom_at(lat_deg: float, *, deepest: int = 15) -> int:
    """The smallest zoom whose pixels are at most 10 m wide on the ground at a latitude."""
    whole = 2 * _HALF_WORLD * math.cos(math.radians(lat_deg)) / _SIDE
    return min(max(math.ceil(math.log2(whole / _COARSEST)), 0), deepest)


def decode_terrarium(rgb: NDArray[np.uint8]) -> Float:
    """Metres (rows, columns) of terrarium colours (rows, columns, 3): R * 256 + G + B / 256 - 32768."""
    return rgb.astype(np.float64) @ (256.0, 1.0, 1 / 256) - 32768.0


def with_elevation(
    options: BuildOptions,
    osm: OsmData,
    *,
    cache_dir: Path,
    server: TileServer | None = None,
    progress: Progress = silent,
) -> BuildOptions:
    """Options of a build of a map; with the file of `fetch_elevation` if they ask for public tiles."""
    if not options.elevation_tiles:
        return options
    found = fetch_elevation(osm, cache_dir=cache_dir, crs=options.crs, server=server, progress=progress)
    return replace(options, dem=(str(found),))


@shows_progress
def fetch_elevation(
    osm: OsmData,
    *,
    cache_dir: Path,
    crs: str = "local",
    server: TileServer | None = None,
    zoom: int | None = None,
    progress: Progress = displayed,
) -> Path:
    """A GeoTIFF of the ground under a map, made from elevation tiles; for `ground.terrain.open_terrain`.

    The tiles include the sea floor. If the map has a coastline, connected areas of negative heights at it are
    set to 0, the height of the water; land below sea level behind a dike keeps its heights.

    cache_dir : folder for the tiles and the GeoTIFF; each tile is requested once
    crs       : of the scene, as in `Frame.at`; the GeoTIFF covers the scene's rectangle
    server    : the public tiles if None
    zoom      : of the tiles; by default the smallest with pixels of at most 10 m (5 to 10 m)

    Raises InputError for a map beyond 85° of latitude or larger than the server's limit, NetworkError if
    a tile cannot be fetched.
    """
    server = server or TileServer()
    west, south, east, north = _scene_box(osm, crs)
    z = zoom_at((south + north) / 2, deepest=server.deepest) if zoom is None else zoom
    (left, top), (right, bottom) = _pixels(np.array([[west, north], [east, south]]), z)
    limit = 2**z - 1
    x0, x1 = int((left - _AROUND) // _SIDE), int((right + _AROUND) // _SIDE)
    y0, y1 = (int(np.clip(v // _SIDE, 0, limit)) for v in (top - _AROUND, bottom + _AROUND))
    names = [(x, y) for y in range(y0, y1 + 1) for x in range(x0, x1 + 1)]
    if len(names) > server.most:
        raise InputError(
            f"{len(names):,} elevation tiles of zoom {z}, more than the {server.most:,} that may be asked"
            " for; take a part of the map, or an elevation file (`dem` FILE)"
        )
    coast = [way.lonlat for way in osm.ways if way.tags.get("natural") == "coastline"]
    shore = np.concatenate(coast) if coast else np.empty((0, 2))
    cache_key = hashlib.sha256(f"{_CACHE_VERSION}\n{server}\n{z} {x0} {y0} {x1} {y1}\n".encode())
    cache_key.update(np.ascontiguousarray(shore).tobytes())
    path = cache_dir / f"elevation-z{z}-{cache_key.hexdigest()[:16]}.tif"
    if path.exists():
        return path
    heights = np.empty(((y1 - y0 + 1) * _SIDE, (x1 - x0 + 1) * _SIDE))
    tiles = zip(names, _tiles(names, z, cache_dir=cache_dir, server=server, progress=progress), strict=True)
    for done, ((x, y), tile) in enumerate(tiles, 1):
        row, column = (y - y0) * _SIDE, (x - x0) * _SIDE
        heights[row : row + _SIDE, column : column + _SIDE] = tile
        progress("elevation tiles", done, total=len(names))
    if len(shore):
        heights = _without_sea_floor(heights, _pixels(shore, z) - (x0 * _SIDE, y0 * _SIDE))
    write_atomically(path, _geotiff(heights, z, column=x0 * _SIDE, row=y0 * _SIDE, server=server))
    return path


def _scene_box(osm: OsmData, crs: str) -> Bounds:
    """Bounding box (degrees) of a scene: the map's bounds and the buildings that extend beyond them."""
    import shapely  # noqa: PLC0415 - slow to import

    built = [a.geometry for a in osm.areas if "building" in a.tags or "building:part" in a.tags]
    boxes = np.vstack([shapely.bounds(np.array(built, object)).reshape(-1, 4), osm.bounds])
    west, south = np.nanmin(boxes[:, :2], axis=0)
    east, north = np.nanmax(boxes[:, 2:], axis=0)
    if max(abs(south), abs(north)) > _LAST_LATITUDE:
        raise InputError(f"elevation tiles end at 85° of latitude; the map spans {south:.2f} to {north:.2f}")
    middle = wrap_longitude((west + east) / 2)
    frame = Frame.at(middle, (south + north) / 2, crs=crs)
    side = max(east - west, north - south, 1e-6) / 8
    xy = np.column_stack(frame.from_geographic(*rim_of((west, south, east, north), step=side)))
    (xmin, ymin), (xmax, ymax) = xy.min(axis=0), xy.max(axis=0)
    side = max(xmax - xmin, ymax - ymin, 1.0) / 8
    square = rim_of((xmin, ymin, xmax, ymax), step=side)
    lon, lat = frame.to_geographic(*square)
    lon = beside(lon, middle)
    return float(lon.min()), float(lat.min()), float(lon.max()), float(lat.max())


def _pixels(lonlat: Float, z: int) -> Float:
    """Fractional pixel coordinates (n, 2) in the world's grid at a zoom, x east and y south."""
    lon, lat = np.radians(lonlat).T
    world = np.column_stack([lon, -np.arcsinh(np.tan(lat))]) / math.pi  # -1 to 1 each
    pixels: Float = (world + 1) / 2 * _SIDE * 2**z
    return pixels


def _tiles(
    names: list[tuple[int, int]], z: int, *, cache_dir: Path, server: TileServer, progress: Progress
) -> Any:
    """Yields the heights (256, 256) of each tile, from the cache or the server."""
    folder = cache_dir / "tiles" / hashlib.sha256(server.template.encode()).hexdigest()[:16] / str(z)
    folder.mkdir(parents=True, exist_ok=True)
    with open_session(server.user_agent) as session:
        for column, y in names:
            x = column % 2**z  # columns run on across 180°
            path = folder / f"{x}_{y}.png"
            heights_of_tile = _heights(path.read_bytes()) if path.exists() else None
            if heights_of_tile is None:
                url = server.template.format(z=z, x=x, y=y)
                content = _download(session, url, server=server, progress=progress)
                heights_of_tile = _heights(content)
                if heights_of_tile is None:
                    raise NetworkError(
                        f"{without_secrets(url)}: no elevation tile (PNG, 256 x 256 pixels) but other data"
                    )
                write_atomically(path, content)
            yield heights_of_tile


def _heights(content: bytes) -> Float | None:
    """Heights of a tile, NaN in voids; None if the bytes are not a tile."""
    from PIL import Image, UnidentifiedImageError  # noqa: PLC0415 - slow to import

    try:
        with Image.open(io.BytesIO(content), formats=("PNG",)) as image:
            rgb = np.asarray(image.convert("RGB"))
    except (UnidentifiedImageError, OSError, SyntaxError, ValueError):
        return None
    if rgb.shape != (_SIDE, _SIDE, 3):
        return None
    return np.where(rgb.any(axis=2), decode_terrarium(rgb), np.nan)


def _download(session: Any, url: str, *, server: TileServer, progress: Progress) -> bytes:
    """The bytes at an address; the request is repeated while the server fails or is busy."""
    pause, failure = server.wait, ""
    for attempt in range(server.attempts):
        if attempt:
            wait(pause, f"{host_of(url)}: {failure}", progress=progress)
            pause *= 2
        try:
            return bytes(session.get(url, timeout=server.timeout).content)
        except RefusedError as error:
            failure = str(error)
            if error.status not in {500, *BUSY}:
                break
            if math.isfinite(error.retry_after):
                pause = min(error.retry_after, _LONGEST_PAUSE)
        except OSError as error:
            failure = cause(error)
    raise NetworkError(
        f"no elevation tile from {host_of(url)} ({without_secrets(url)}: {failure});"
        " without a network, give an elevation file (`dem` FILE) or build on level ground (no `dem`)"
    )


def _without_sea_floor(heights: Float, shore: Float) -> Float:
    """Heights with 0 in connected areas of negative posts that touch a coastline.

    shore : (n, 2) pixels (column, row) of the coastline's vertices, possibly outside
    """
    from scipy import ndimage  # noqa: PLC0415 - slow to import

    negative = heights < 0.0
    areas, _ = ndimage.label(negative, structure=np.ones((3, 3)))
    column, row = np.floor(shore).astype(int).T
    inside = (row >= 0) & (row < heights.shape[0]) & (column >= 0) & (column < heights.shape[1])
    near = np.zeros(heights.shape, np.bool_)
    near[row[inside], column[inside]] = True
    near = ndimage.binary_dilation(near, iterations=_SHORE, structure=np.ones((3, 3)))
    return np.where(negative & np.isin(areas, np.unique(areas[near & negative])), 0.0, heights)


def _geotiff(heights: Float, z: int, *, column: int, row: int, server: TileServer) -> bytes:
    """The bytes of a float32 GeoTIFF of heights, whose first pixel is at (column, row) of the zoom's grid."""
    import rasterio  # noqa: PLC0415 - slow to import
    from rasterio.io import MemoryFile  # noqa: PLC0415
    from rasterio.transform import Affine  # noqa: PLC0415

    step = 2 * _HALF_WORLD / _SIDE / 2**z
    profile: dict[str, Any] = {
        "driver": "GTiff",
        "dtype": "float32",
        "count": 1,
        "height": heights.shape[0],
        "width": heights.shape[1],
        "nodata": math.nan,
        "crs": "EPSG:3857",
        "transform": Affine(step, 0, column * step - _HALF_WORLD, 0, -step, _HALF_WORLD - row * step),
        "compress": "deflate",
        "predictor": 3,
    }
    with rasterio.Env(), MemoryFile() as file:
        with file.open(**profile) as target:
            target.write(heights.astype(np.float32), 1)
            target.update_tags(TIFFTAG_COPYRIGHT=without_secrets(server.credit), VERTICAL_DATUM=server.datum)
        return bytes(file.read())
