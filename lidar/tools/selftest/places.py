"""Extremes of places: poles, zones, the antimeridian, heights, and the size of a scene."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
from pyproj import Geod, Transformer

from geoscene.geometry.frames import Frame, utm_crs, wrap_longitude
from geoscene.options import BuildOptions
from geoscene.pipeline.build import build
from geoscene.scene.validate import check_scene
from geoscene.sources import read_osm
from geoscene.typing import Float
from lidar.raycast import Caster
from lidar.tools.selftest.case import ExtremeCase
from lidar.tools.selftest.rays import directions, sheet
from lidar.world.world import World

PLACES = {
    "equator": (9.45, 0.0),
    "equator at a zone's edge": (11.9999, 0.0001),
    "84.5° N": (25.0, 84.5),
    "last of UTM in the north": (25.0, 83.9999),
    "80.5° S": (-60.0, -80.5),
    "last of UTM in the south": (-60.0, -79.9999),
    "north pole": (0.0, 90.0),
    "beside the north pole": (135.0, 89.9999),
    "south pole": (0.0, -90.0),
    "antimeridian in Fiji": (180.0, -16.8),
    "antimeridian in Chukotka": (-179.9999, 68.9),
    "Bergen, 32V": (5.32, 60.39),
    "Svalbard, 31X": (8.5, 78.0),
    "Svalbard, 33X": (20.0, 78.2),
    "Svalbard, 35X": (26.0, 79.0),
    "Svalbard, 37X": (34.0, 80.0),
    "Dead Sea": (35.48, 31.5),
}
"""Longitude and latitude in degrees of each place."""

_ZONES = (
    (3.0, 56.0, 32632), (2.999, 56.0, 32631), (11.999, 63.999, 32632), (3.0, 64.0, 32631),
    (3.0, 55.999, 32631), (0.0, 72.0, 32631), (8.999, 80.0, 32631), (9.0, 80.0, 32633),
    (20.999, 83.0, 32633), (21.0, 83.0, 32635), (32.999, 75.0, 32635), (33.0, 75.0, 32637),
    (41.999, 72.0, 32637), (42.0, 75.0, 32638), (9.0, 71.999, 32632), (-180.0, 10.0, 32601),
    (179.999, 10.0, 32660), (180.0, 10.0, 32601), (-180.0, -10.0, 32701), (5.999, 10.0, 32631),
    (6.0, 10.0, 32632), (-0.001, 0.0, 32630), (0.0, -0.001, 32731), (12.0, 84.0, 32633),
    (12.0, 84.001, 5041), (12.0, -80.0, 32733), (12.0, -80.001, 5042), (0.0, 90.0, 5041),
    (0.0, -90.0, 5042),
)  # fmt: skip
"""Longitude, latitude and EPSG code of points at the edges of zones, from the grid of NGA.STND.0037."""

_EARTH = Geod(ellps="WGS84")


def _points(rng: np.random.Generator, count: int, *, reach: float) -> Float:
    """Points (n, 2) in a square of ``reach`` metres to each side."""
    return rng.uniform(-reach, reach, (count, 2))


def _at_places(
    count: int, *, seed: int, crs: str = "local"
) -> Iterator[tuple[Frame, np.random.Generator, int]]:
    """Frame and generator of each place, and its share of samples."""
    for k, (lon, lat) in enumerate(PLACES.values()):
        yield Frame.at(lon, lat, crs=crs), np.random.default_rng([seed, k]), count // len(PLACES)


def round_trips(count: int, *, crs: str) -> float:
    """Largest change in metres of points within 50 km, a frame to degrees and back."""
    worst = 0.0
    for frame, rng, n in _at_places(count, seed=1, crs=crs):
        xy = _points(rng, n, reach=5e4)
        back = np.column_stack(frame.from_geographic(*frame.to_geographic(*xy.T)))
        worst = max(worst, float(np.abs(back - xy).max()))
    return worst


def utm_against_local(count: int) -> float:
    """Largest change in metres of points within 5 km, local frame to UTM or UPS and back."""
    worst = 0.0
    for (frame, rng, n), place in zip(_at_places(count, seed=2), PLACES.values(), strict=True):
        xy, crs = _points(rng, n, reach=5e3), Frame.at(*place, crs="utm").crs
        there = frame.to_crs(*xy.T, crs=crs)
        worst = max(worst, float(np.abs(np.column_stack(frame.from_crs(*there, crs=crs)) - xy).max()))
    return worst


def length_errors(count: int, *, crs: str, reach: float = 5e3, scaled: bool = False) -> float:
    """Largest error in mm of lengths of 1 km against geodesics, with the point scale or taken as true."""
    worst = 0.0
    for frame, rng, n in _at_places(count, seed=3, crs=crs):
        start, angle = _points(rng, n, reach=reach), rng.uniform(0, 2 * np.pi, n)
        stop = start + 1000 * np.column_stack([np.cos(angle), np.sin(angle)])
        _, _, true = _EARTH.inv(*frame.to_geographic(*start.T), *frame.to_geographic(*stop.T))
        scale = frame.scale_at(*((start + stop) / 2).T) if scaled else 1.0
        worst = max(worst, float(np.abs(1000 / scale - true).max() * 1000))
    return worst


def lengths_on_high_ground(count: int) -> float:
    """Largest error in mm of 1 km in a local frame, taken as true, on ground at -430 and 5,000 m."""
    to_centre, worst = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True), 0.0
    for frame, rng, n in _at_places(count, seed=5):
        angle = rng.uniform(0, 2 * np.pi, n)
        half = 500 * np.column_stack([np.cos(angle), np.sin(angle)])
        for z in (-430.0, 5000.0):
            here, there = (
                np.column_stack(to_centre.transform(*frame.to_geographic(*end.T), np.full(n, z)))
                for end in (-half, half)
            )
            worst = max(worst, float(np.abs(np.linalg.norm(there - here, axis=1) - 1000).max() * 1000))
    return worst


def wrong_zones(count: int) -> float:
    """Points at edges of zones with another zone than in the standard's grid."""
    return float(sum(utm_crs(lon, lat) != f"EPSG:{code}" for lon, lat, code in _ZONES[:count]))


def heights(count: int) -> float:
    """Largest error in metres of ranges to ground 430 m below and 5,000 m above zero."""
    worst = 0.0
    for k, z in enumerate((-430.0, 0.0, 5000.0)):
        rng = np.random.default_rng([4, k])
        caster = Caster(*sheet(np.array([0.0, 0, 1]), np.array([0, 0, z]), size=5e4))
        n = count // 3
        way, eye = directions(rng, n), np.column_stack([_points(rng, n, reach=5e3), np.full(n, z + 1.8)])
        way[:, 2] = -np.abs(way[:, 2]) - 0.05
        found = caster.cast(eye, way).range
        worst = max(worst, float(np.abs(found + 1.8 / way[:, 2]).max()))
    return worst


def write_hamlet(frame: Frame, path: Path, *, reach: float) -> None:
    """Write an OSM file of two houses and a crossing of two roads at the frame's origin.

    Roads are ``reach`` metres long in each direction, and bend in the frame's origin.
    """
    nodes: list[str] = []
    ways: list[str] = []

    def place(x: float, y: float) -> int:
        lon, lat = frame.to_geographic(x, y)
        nodes.append(
            f'<node id="{len(nodes) + 1}" lon="{wrap_longitude(float(lon)):.9f}" lat="{float(lat):.9f}"/>'
        )
        return len(nodes)

    def way(corners: list[int], **tags: str) -> None:
        refs = "".join(f'<nd ref="{number}"/>' for number in corners)
        words = "".join(f'<tag k="{key.replace("__", ":")}" v="{value}"/>' for key, value in tags.items())
        ways.append(f'<way id="{len(ways) + 1}">{refs}{words}</way>')

    middle = place(0, 0)
    for x, y in ((reach, 0.0), (0.0, reach)):
        way([place(-x, -y), middle, place(x, y)], highway="residential")
    for x in (8.0, 30.0):
        ring = [place(*corner) for corner in ((x, 8), (x + 12, 8), (x + 12, 18), (x, 18))]
        way([*ring, ring[0]], building="yes", height="9", roof__shape="gabled")
    path.write_text(f'<osm version="0.6">{"".join(nodes)}{"".join(ways)}</osm>')


def _lost(count: int, stands: Callable[[int, Path], bool]) -> float:
    """Number of scenes, by number and path of their files, that do not stand."""
    with tempfile.TemporaryDirectory() as folder:
        return float(sum(not stands(k, Path(folder) / f"{k}") for k in range(count)))


def unbuilt_places(count: int) -> float:
    """Number of scenes, in a local frame and in UTM, that lack a valid house or the ground."""
    places = list(PLACES.values())
    return _lost(
        count,
        lambda k, out: _stands(Frame.at(*places[k * 4 % len(places)]), out, crs=("local", "utm")[k % 2]),
    )


def unbuilt_heights(count: int) -> float:
    """Scenes on elevation models at -430 and 5,000 m that are not whole, or do not tell errors of lengths."""
    place = Frame.at(-67.0, -18.1)

    def stands(k: int, out: Path) -> bool:
        return _stands(place, out, crs=("local", "utm")[k // 2 % 2], height=(5000.0, -430.0)[k % 2])

    return _lost(count, stands)


def _stands(place: Frame, out: Path, *, crs: str, height: float = 0.0) -> bool:
    """Whether a hamlet is whole, on an elevation model if it is not at 0 m, and tells errors of lengths."""
    write_hamlet(place, out.with_suffix(".osm"), reach=60.0)
    dem = (str(out.with_suffix(".tif")),) if height else ()
    if height:
        write_elevation(place, out.with_suffix(".tif"), height=height)
    options = BuildOptions(crs=crs, only=("buildings", "roads"), dem=dem)
    scene = build(read_osm(out.with_suffix(".osm")), out, options=options)
    checks = check_scene(scene)
    x, y = scene.frame.from_geographic(*place.to_geographic(3.3, 1.7))
    world = World.load(scene, region=(x - 1, y - 1, x + 1, y + 1), margin=1.0)
    down = world.caster.cast([x, y, height + 50], np.array([[0.0, 0, -1]])).range[0]
    told = "height" in {limit["name"] for limit in scene.manifest["limits"]}
    whole = checks["solids"] == 2 and not checks["broken"] and not checks["broken_surfaces"]
    return bool(whole and abs(down - 50) < 1 and told == (height > 637))


def write_elevation(frame: Frame, path: Path, *, height: float) -> None:
    """Write a raster of 1 km around a frame's origin: a slope of 1 in 1,000 through ``height`` there."""
    lon, lat = (float(v) for v in frame.to_geographic(0.0, 0.0))
    heights = height + (np.arange(101) - 50) * 0.01 * np.ones((101, 1))
    write_raster(path, heights, lonlat=(lon, lat), step=1e-4)


def write_raster(path: Path, heights: Float, *, lonlat: tuple[float, float], step: float) -> None:
    """Write heights (rows, columns) as a raster about a place; ``step`` is in degrees."""
    import rasterio  # noqa: PLC0415 - slow to import

    (rows, columns), (lon, lat) = heights.shape, lonlat
    corner = rasterio.Affine(step, 0.0, lon - columns / 2 * step, 0.0, -step, lat + rows / 2 * step)
    shape = {"width": columns, "height": rows, "count": 1, "dtype": "float32"}
    with rasterio.open(path, "w", driver="GTiff", crs="EPSG:4326", transform=corner, **shape) as raster:
        raster.write(heights.astype(np.float32), 1)


def small_scenes(count: int) -> float:
    """Scenes of 10 m that are not built whole."""
    places = list(PLACES.values())

    def stands(k: int, out: Path) -> bool:
        path = out.with_suffix(".osm")
        write_hamlet(Frame.at(*places[k * 5 % len(places)]), path, reach=5.0)
        scene = build(read_osm(path), out, options=BuildOptions(only=("roads",)))
        return bool(scene.tile_indices) and not check_scene(scene)["broken_surfaces"]

    return _lost(count, stands)


_PROJ = "PROJ's series and iterations"
_LOCAL = "scale is 1 at the centre and grows as x² / 2R²"

_place = partial(ExtremeCase, group="places")
_trip = partial(_place, bound=1e-6, unit="m", of="points", quick=17_000, full=1_700_000)
_length = partial(_place, unit="mm", of="lines", quick=17_000, full=1_700_000)
_scene = partial(_place, unit="scenes", of="scenes")

CASES = (
    _trip(
        "round trip, local frame to degrees, 100 km wide, 17 places", partial(round_trips, crs="local"), _PROJ
    ),
    _trip(
        "round trip, UTM or UPS to degrees, 100 km wide, 17 places", partial(round_trips, crs="utm"), _PROJ
    ),
    _trip("round trip, local frame to UTM or UPS, 10 km wide, 17 places", utm_against_local, _PROJ),
    _length(
        "1 km in UTM or UPS by its point scale",
        partial(length_errors, crs="utm", scaled=True),
        "the scale of the line's middle stands for the line",
        bound=0.1,
    ),
    _length(
        "1 km in UTM or UPS, taken as true",
        partial(length_errors, crs="utm"),
        "scale is 0.9996 amid a UTM zone, 0.994 at a pole; told by `geoscene build`, corrected in drives",
        bound=6100.0,
    ),
    _length("1 km in a local frame, scene of 10 km", partial(length_errors, crs="local"), _LOCAL, bound=1.0),
    _length(
        "1 km in a local frame, scene of 100 km",
        partial(length_errors, crs="local", reach=5e4),
        _LOCAL,
        bound=40.0,
    ),
    _length(
        "1 km in a local frame, ground at -430 and 5,000 m",
        lengths_on_high_ground,
        "lengths are those on the ellipsoid: z / R, 785 mm per km at 5,000 m; told by builds and drives",
        bound=800.0,
    ),
    _place(
        "UTM and UPS zones at their edges, wrong",
        wrong_zones,
        "exceptions of Norway and Svalbard included",
        unit="points",
        of="points",
        quick=len(_ZONES),
        full=len(_ZONES),
    ),
    _place(
        "range to ground at -430, 0 and 5,000 m",
        heights,
        "float64 plane of the face",
        bound=1e-10,
        unit="m",
        of="rays",
        quick=30_000,
        full=3 * 10**6,
    ),
    _scene(
        "scenes built at 17 places, local and UTM or UPS, not whole",
        unbuilt_places,
        quick=4,
        full=2 * len(PLACES),
    ),
    _scene(
        "scenes on elevation models at -430 and 5,000 m, not whole or error of lengths not told",
        unbuilt_heights,
        quick=1,
        full=4,
    ),
    _scene("scenes of 10 m, not whole", small_scenes, quick=1, full=5),
)
"""Extremes of places."""
