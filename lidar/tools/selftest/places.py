"""Extremes of places: poles, zones, the antimeridian, heights, and the size of a scene."""

from __future__ import annotations

import tempfile
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
from lidar.tools.selftest.meshes import directions, sheet
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


def _round_trips(count: int, *, crs: str, reach: float) -> float:
    worst = 0.0
    for k, (lon, lat) in enumerate(PLACES.values()):
        frame = Frame.at(lon, lat, crs=crs)
        xy = _points(np.random.default_rng([1, k]), count // len(PLACES), reach=reach)
        back = np.column_stack(frame.from_geographic(*frame.to_geographic(*xy.T)))
        worst = max(worst, float(np.abs(back - xy).max()))
    return worst


def local_round_trips(count: int) -> float:
    """Largest change in metres of points within 50 km, local frame to degrees and back."""
    return _round_trips(count, crs="local", reach=5e4)


def utm_round_trips(count: int) -> float:
    """Largest change in metres of points within 50 km, UTM or UPS to degrees and back."""
    return _round_trips(count, crs="utm", reach=5e4)


def utm_against_local(count: int) -> float:
    """Largest change in metres of points within 5 km, local frame to UTM or UPS and back."""
    worst = 0.0
    for k, (lon, lat) in enumerate(PLACES.values()):
        frame, utm = Frame.at(lon, lat), Frame.at(lon, lat, crs="utm")
        xy = _points(np.random.default_rng([2, k]), count // len(PLACES), reach=5e3)
        there = frame.to_crs(*xy.T, crs=utm.crs)
        worst = max(worst, float(np.abs(np.column_stack(frame.from_crs(*there, crs=utm.crs)) - xy).max()))
    return worst


def _length_errors(count: int, *, crs: str, reach: float, scaled: bool) -> float:
    """Largest error in millimetres of lengths of 1 km against geodesics, with or without the point scale."""
    worst = 0.0
    for k, (lon, lat) in enumerate(PLACES.values()):
        frame, rng = Frame.at(lon, lat, crs=crs), np.random.default_rng([3, k])
        n = count // len(PLACES)
        start, angle = _points(rng, n, reach=reach), rng.uniform(0, 2 * np.pi, n)
        stop = start + 1000 * np.column_stack([np.cos(angle), np.sin(angle)])
        _, _, true = _EARTH.inv(*frame.to_geographic(*start.T), *frame.to_geographic(*stop.T))
        scale = frame.scale_at(*((start + stop) / 2).T) if scaled else 1.0
        worst = max(worst, float(np.abs(1000 / scale - true).max() * 1000))
    return worst


def utm_lengths(count: int) -> float:
    """Largest error in mm of 1 km in UTM or UPS, divided by its point scale, within 5 km."""
    return _length_errors(count, crs="utm", reach=5e3, scaled=True)


def local_lengths_of_a_town(count: int) -> float:
    """Largest error in mm of 1 km in a local frame, taken as true, in a scene of 10 km."""
    return _length_errors(count, crs="local", reach=5e3, scaled=False)


def local_lengths_of_a_region(count: int) -> float:
    """Largest error in mm of 1 km in a local frame, taken as true, in a scene of 100 km."""
    return _length_errors(count, crs="local", reach=5e4, scaled=False)


def lengths_on_high_ground(count: int) -> float:
    """Largest error in mm of 1 km in a local frame, taken as true, on ground at -430 and 5,000 m."""
    to_centre, worst = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True), 0.0
    for k, (lon, lat) in enumerate(PLACES.values()):
        frame, n = Frame.at(lon, lat), count // len(PLACES)
        angle = np.random.default_rng([5, k]).uniform(0, 2 * np.pi, n)
        half = 500 * np.column_stack([np.cos(angle), np.sin(angle)])
        for z in (-430.0, 5000.0):
            here, there = (
                np.column_stack(to_centre.transform(*frame.to_geographic(*end.T), np.full(n, z)))
                for end in (-half, half)
            )
            worst = max(worst, float(np.abs(np.linalg.norm(there - here, axis=1) - 1000).max() * 1000))
    return worst


def utm_lengths_taken_as_true(count: int) -> float:
    """Largest error in mm of 1 km in UTM or UPS, taken as true, within 5 km."""
    return _length_errors(count, crs="utm", reach=5e3, scaled=False)


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


def unbuilt_places(count: int) -> float:
    """Number of scenes, in a local frame and in UTM, that lack a valid house or the ground."""
    lost, places = 0, list(PLACES.values())
    with tempfile.TemporaryDirectory() as folder:
        for k in range(count):
            where = places[k * 4 % len(places)]
            lost += not _stands(where, Path(folder) / f"{k}", crs=("local", "utm")[k % 2])
    return float(lost)


def _stands(lonlat: tuple[float, float], out: Path, *, crs: str) -> bool:
    place = Frame.at(*lonlat)
    write_hamlet(place, out.with_suffix(".osm"), reach=60.0)
    options = BuildOptions(crs=crs, only=("buildings", "roads"))
    scene = build(read_osm(out.with_suffix(".osm")), out, options=options)
    checks = check_scene(scene)
    x, y = scene.frame.from_geographic(*place.to_geographic(3.3, 1.7))
    world = World.load(scene, region=(x - 1, y - 1, x + 1, y + 1), margin=1.0)
    down = world.caster.cast([x, y, 50], np.array([[0.0, 0, -1]])).range[0]
    return bool(checks["solids"] == 2 and not checks["broken"] and abs(down - 50) < 1)


def unbuilt_heights(count: int) -> float:
    """Scenes on elevation models at -430 and 5,000 m that are not whole, or do not tell errors of lengths."""
    lost = 0
    with tempfile.TemporaryDirectory() as folder:
        for k in range(count):
            height = (5000.0, -430.0)[k % 2]
            lost += not _stands_at(height, Path(folder) / f"{k}", crs=("local", "utm")[k // 2 % 2])
    return float(lost)


def _stands_at(height: float, out: Path, *, crs: str) -> bool:
    place = Frame.at(-67.0, -18.1)
    write_hamlet(place, out.with_suffix(".osm"), reach=60.0)
    write_elevation(place, out.with_suffix(".tif"), height=height)
    options = BuildOptions(crs=crs, only=("buildings", "roads"), dem=(str(out.with_suffix(".tif")),))
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
    import rasterio  # noqa: PLC0415 - slow to import

    lon, lat = (float(v) for v in frame.to_geographic(0.0, 0.0))
    side, step = 101, 1e-4
    heights = height + (np.arange(side) - side // 2) * 0.01 * np.ones((side, 1))
    corner = rasterio.Affine(step, 0.0, lon - side / 2 * step, 0.0, -step, lat + side / 2 * step)
    shape = {"width": side, "height": side, "count": 1, "dtype": "float32"}
    with rasterio.open(path, "w", driver="GTiff", crs="EPSG:4326", transform=corner, **shape) as raster:
        raster.write(heights.astype(np.float32), 1)


def small_scenes(count: int) -> float:
    """Scenes of 10 m that are not built whole."""
    lost, places = 0, list(PLACES.values())
    with tempfile.TemporaryDirectory() as folder:
        for k in range(count):
            path = Path(folder) / f"{k}.osm"
            write_hamlet(Frame.at(*places[k * 5 % len(places)]), path, reach=5.0)
            scene = build(read_osm(path), path.with_suffix(""), options=BuildOptions(only=("roads",)))
            lost += bool(check_scene(scene)["broken_surfaces"]) or not scene.tile_indices
    return float(lost)


CASES = (
    ExtremeCase(
        "places",
        "round trip, local frame to degrees, 100 km wide, 17 places",
        1e-6,
        "m",
        local_round_trips,
        "points",
        17_000,
        1_700_000,
        "PROJ's series and iterations",
    ),
    ExtremeCase(
        "places",
        "round trip, UTM or UPS to degrees, 100 km wide, 17 places",
        1e-6,
        "m",
        utm_round_trips,
        "points",
        17_000,
        1_700_000,
        "PROJ's series and iterations",
    ),
    ExtremeCase(
        "places",
        "round trip, local frame to UTM or UPS, 10 km wide, 17 places",
        1e-6,
        "m",
        utm_against_local,
        "points",
        17_000,
        1_700_000,
        "PROJ's series and iterations",
    ),
    ExtremeCase(
        "places",
        "1 km in UTM or UPS by its point scale",
        0.1,
        "mm",
        utm_lengths,
        "lines",
        17_000,
        1_700_000,
        "the scale of the line's middle stands for the line",
    ),
    ExtremeCase(
        "places",
        "1 km in UTM or UPS, taken as true",
        6100.0,
        "mm",
        utm_lengths_taken_as_true,
        "lines",
        17_000,
        1_700_000,
        "scale is 0.9996 amid a UTM zone, 0.994 at a pole; told by `geoscene build`, corrected in drives",
    ),
    ExtremeCase(
        "places",
        "1 km in a local frame, scene of 10 km",
        1.0,
        "mm",
        local_lengths_of_a_town,
        "lines",
        17_000,
        1_700_000,
        "scale is 1 at the centre and grows as x² / 2R²",
    ),
    ExtremeCase(
        "places",
        "1 km in a local frame, scene of 100 km",
        40.0,
        "mm",
        local_lengths_of_a_region,
        "lines",
        17_000,
        1_700_000,
        "scale is 1 at the centre and grows as x² / 2R²",
    ),
    ExtremeCase(
        "places",
        "1 km in a local frame, ground at -430 and 5,000 m",
        800.0,
        "mm",
        lengths_on_high_ground,
        "lines",
        17_000,
        1_700_000,
        "lengths are those on the ellipsoid: z / R, 785 mm per km at 5,000 m; told by builds and drives",
    ),
    ExtremeCase(
        "places",
        "UTM and UPS zones at their edges, wrong",
        0,
        "points",
        wrong_zones,
        "points",
        len(_ZONES),
        len(_ZONES),
        "exceptions of Norway and Svalbard included",
    ),
    ExtremeCase(
        "places",
        "range to ground at -430, 0 and 5,000 m",
        1e-10,
        "m",
        heights,
        "rays",
        30_000,
        3 * 10**6,
        "float64 plane of the face",
    ),
    ExtremeCase(
        "places",
        "scenes built at 17 places, local and UTM or UPS, not whole",
        0,
        "scenes",
        unbuilt_places,
        "scenes",
        4,
        2 * len(PLACES),
        "",
    ),
    ExtremeCase(
        "places",
        "scenes on elevation models at -430 and 5,000 m, not whole or error of lengths not told",
        0,
        "scenes",
        unbuilt_heights,
        "scenes",
        1,
        4,
        "",
    ),
    ExtremeCase("places", "scenes of 10 m, not whole", 0, "scenes", small_scenes, "scenes", 1, 5, ""),
)
"""Extremes of places."""
