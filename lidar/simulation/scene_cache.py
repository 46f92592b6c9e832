"""A cache of scenes of maps: each has what drives needed so far, and grows when one needs more.

A folder of the cache holds one scene: of one map, by the digest of its contents, built with one set of
options.

    <cache>/monaco-1a2b3c/scene/          a scene directory; its area is what all drives so far need
    <cache>/monaco-1a2b3c/drives/*.wkb    areas of single drives, by the digests of their recipes

A scene grows in place: tiles first, then tables that hold more rows, the manifest last. Each file is replaced
atomically, so programs that read the scene meanwhile find all that they need.

The area of a map that a drive needs is its course on the roads, buffered by the range of the sensors. A scene
of it gives the drive the bytes of a scene of the whole map.
"""

from __future__ import annotations

import json
import re
import shutil
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from geoscene.clouds.survey import with_clouds
from geoscene.errors import FrameError, NetworkError, SceneFormatError
from geoscene.errors import InputError as SceneInputError
from geoscene.options import BuildOptions, CloudOptions
from geoscene.pipeline.build import build, elevation_digests
from geoscene.pipeline.reach import RoadMap
from geoscene.scene import Scene, open_scene
from geoscene.scene.layout import OVERHANG, SCHEMA, SceneFiles, changed_files
from geoscene.sources import OsmData, Servers, fetch_place, read_osm, with_elevation
from geoscene.support.digests import file_digest, sources_digest, value_digest
from geoscene.support.files import exclusive, write_atomically
from geoscene.support.progress import Aside, Progress, silent
from geoscene.support.storage import cache_folder
from geoscene.typing import Float
from lidar.errors import InputError, LidarError
from lidar.motion.replay import read_replay
from lidar.motion.road_drive import road_course, road_map
from lidar.motion.vehicle import load_vehicle
from lidar.options.drive import DriveOptions
from lidar.options.place import PlaceOptions
from lidar.raycast.device import check_device
from lidar.sensors.navigation.satellite_visibility import BLOCK_M, REACH
from lidar.sensors.rig.devices import Camera
from lidar.sensors.rig.specs import load_rig
from lidar.simulation.flight_planning import flight_course
from lidar.simulation.frame_loop import CHUNK
from lidar.simulation.plan import road_drive_options, sensors_of
from lidar.traffic.surroundings import LEFT

_MARGIN = 2.0
"""Metres that are built beyond the needed area: coordinates on disk are rounded."""

_ROUNDS = 5
"""Maximum number of builds for a drive; more than one is needed after a detour that was not foreseen."""

_PAUSE_S = 0.2
"""Seconds between attempts to take a turn at a scene."""


def built_scene(
    path: Path | None,
    drive: DriveOptions,
    *,
    place: PlaceOptions,
    clouds: CloudOptions,
    servers: Servers | None = None,
    progress: Progress = silent,
) -> tuple[Scene, int]:
    """The scene of a map that a drive needs, from the cache or built now, and how many tiles were built.

    path    : a map file; None for the name of a place
    place   : that name, and how the scene is built
    clouds  : point clouds in which heights, roofs and trees of the map are measured
    servers : of maps, for a place

    Raises InputError (also as RouteError) for a drive that cannot be planned, MissingExtraError without what
    its device needs, and NetworkError if a place cannot be downloaded.
    """
    world = drive.recording_settings.world
    check_device(world.device)
    chosen = place.build_options("", relief=world.relief)
    source = _Map(path, place, clouds=clouds, options=chosen, servers=servers or Servers(), progress=progress)
    folder = _folder(source)
    with _turn(folder, progress):
        return _CachedScene(folder, source, drive, progress).opened()


class _Map:
    """A map that is read when it is needed.

    name    : of its file or place
    place   : how it is read
    clouds  : what is measured in point clouds
    options : of the build
    digest  : of the file's bytes; of a place's features
    """

    def __init__(
        self,
        path: Path | None,
        place: PlaceOptions,
        *,
        clouds: CloudOptions,
        options: BuildOptions,
        servers: Servers,
        progress: Progress,
    ) -> None:
        self._path, self._servers, self._progress = path, servers, progress
        self.place, self.clouds = place, clouds
        self.name = re.sub(r"\.(osm|pbf|gz|bz2|json|o5m)\b", "", path.name) if path else place.place
        self.options = replace(options, name=self.name)
        self.digest = file_digest(path) if path else self.data.digest

    @cached_property
    def data(self) -> OsmData:
        """Its features."""
        self._progress("reading the map", 0, total=0)
        if self._path is not None:
            return read_osm(self._path, bounds=self.place.bbox)
        try:
            return fetch_place(
                self.place.place,
                cache_dir=cache_folder(),
                refresh=self.place.refresh,
                servers=self._servers,
                progress=self._progress,
            )
        except NetworkError as error:
            cause = str(error).split("; without a network")[0]
            raise NetworkError(f"{cause}; without a network, give a map file instead of `place`") from error

    def measured(self, *, workers: int) -> tuple[OsmData, BuildOptions]:
        """Its features with what is measured in clouds, and the options with files of heights."""
        cache, options = cache_folder(), self.options
        if options.elevation_tiles:
            options = with_elevation(options, self.data, cache_dir=cache, progress=self._progress)
        return with_clouds(
            self.data, options, cloud=self.clouds, cache_dir=cache, workers=workers, progress=self._progress
        )


def _folder(source: _Map) -> Path:
    """Folder of the cache for a map and options, by digests of both."""
    place, clouds = source.place, source.clouds
    chosen = asdict(replace(source.options, name=""))
    chosen |= {"bbox": place.bbox, "dem": elevation_digests(place.dem)}
    if clouds.cloud:
        chosen |= asdict(clouds) | {"cloud": [file_digest(Path(name)) for name in clouds.cloud]}
    made_of = [sources_digest("geoscene"), SCHEMA, source.digest, place.dem == ("tiles",), chosen]
    key = value_digest(made_of)
    cache = place.scene_cache or cache_folder() / "scenes"
    slug = re.sub(r"[^\w.-]+", "-", source.name).strip("-.")[:32] or "map"
    return next(iter(sorted(cache.glob(f"*-{key}"))), cache / f"{slug}-{key}")


@contextmanager
def _turn(folder: Path, progress: Progress) -> Iterator[None]:
    """Wait until no other process builds or checks the scene of a folder, and keep others out meanwhile.

    A folder that is empty in the end is deleted.
    """
    with ExitStack() as stack:
        while True:
            try:
                stack.enter_context(exclusive(folder))
                break
            except SceneInputError:
                progress(Aside("waiting for another build"), 0, total=0)
                time.sleep(_PAUSE_S)
        try:
            yield
        finally:
            with suppress(OSError):  # it holds a scene
                folder.rmdir()


@dataclass(frozen=True, slots=True)
class _CachedScene:
    """The scene of a folder of the cache, for one drive."""

    folder: Path
    source: _Map
    drive: DriveOptions
    progress: Progress

    @property
    def path(self) -> Path:
        """Directory of the scene."""
        return self.folder / "scene"

    def opened(self) -> tuple[Scene, int]:
        """The scene with all that the drive needs, and how many tiles of it were missing or damaged."""
        scene, built = _intact(self.path), 0
        for _ in range(_ROUNDS):
            area = None if scene is None else self._drive_area(scene)
            if scene is not None and shapely.covers(scene.area, area):
                return scene, built
            scene, more = self._grown(scene, area)
            built += more
        raise LidarError(
            f"{self.source.name}: the route changes with what is built; build all by geoscene build"
        )

    def _drive_area(self, scene: Scene) -> Any:
        """The area that the drive needs, as planned in the scene; it holds if the scene covers it."""
        recipe = value_digest([sources_digest("lidar"), self.drive.recipe(scene)])
        known = self.folder / "drives" / f"{recipe}.wkb"
        with suppress(OSError, shapely.errors.GEOSException):
            return shapely.from_wkb(known.read_bytes())
        self.progress("planning", 0, total=0)
        area = needed_area(road_map(scene), self.drive)
        if shapely.covers(scene.area, area):
            write_atomically(known, shapely.to_wkb(area))
        return area

    def _grown(self, scene: Scene | None, area: Any | None) -> tuple[Scene, int]:
        """The scene with an area and with what the drive needs, and the number of tiles that were built."""
        kept = [shape for shape in (scene and scene.area, area) if shape is not None]

        def needed(roads: RoadMap) -> Any:
            wanted = needed_area(roads, self.drive)
            return shapely.union_all([*kept, shapely.buffer(wanted, _MARGIN)])

        new = self.folder / "scene.new"
        try:
            data, options = self.source.measured(workers=self.drive.workers)
            build(
                data,
                new,
                options=options,
                overwrite=True,
                workers=self.drive.workers,
                needed=needed,
                former=self.path,
                progress=self.progress,
            )
        except FrameError as error:
            raise InputError(str(error).replace("`crs`", "`scene_crs`")) from error
        before = set(scene.tile_indices) if scene is not None else set()
        _publish(new, self.path)
        grown = open_scene(self.path)
        return grown, len(set(grown.tile_indices) - before)


def _intact(path: Path) -> Scene | None:
    """The scene of a directory; None if it is not there, or a file of it is damaged or missing."""
    with suppress(SceneFormatError, OSError, ValueError, LookupError):
        scene = open_scene(path)
        reports = json.loads(scene.files.tile_reports.read_text("utf-8-sig"))["tiles"]
        whole = {(r["i"], r["j"]) for r in reports} == set(scene.tile_indices) and scene.area is not None
        if whole and not changed_files(scene):
            return scene
    return None


def _publish(new: Path, path: Path) -> None:
    """Move the files of a new scene into the directory of the scene that it continues, the manifest last."""
    if not path.exists():
        new.rename(path)
        return
    source, target = SceneFiles(new), SceneFiles(path)
    target.tiles.mkdir(exist_ok=True)
    for tile in source.tiles.iterdir():
        tile.replace(target.tiles / tile.name)
    for file in new.iterdir():
        if file not in (source.tiles, source.manifest):
            file.replace(path / file.name)
    source.manifest.replace(target.manifest)
    shutil.rmtree(new)


_ASIDE = 15.0
"""Metres, maximum distance of a sensor from the rear axle's path."""

_OBSTACLES = 25.0
"""Metres from routes within which footprints decide whether they can be driven."""

_STEP = 20.0
"""Metres between the points of a course from which the squares of loaded tiles are taken."""

_ROUNDING = 0.2
"""Metres by which a simplified line may differ from the line."""


def _course(roads: RoadMap, options: DriveOptions) -> tuple[Float, Sequence[Float]]:
    """The path (n, 2) of a drive, all that can be recorded, and lines (k, 2) of routes tried in its search.

    In plan, scene metres. Raises RouteError as the drive would.
    """
    rig = load_rig(options.rig)
    vehicle = load_vehicle(options.vehicle or rig.vehicle)
    route = options.route or "random"
    if isinstance(route, Path) and route.suffix == ".csv" and not options.survey:
        return read_replay(route, roads.frame).position[:, :2], ()
    if vehicle.kind == "air":
        sensors = sensors_of(rig, options)
        return flight_course(roads, vehicle=vehicle, sensors=sensors, options=options), ()
    options.check_on_roads(vehicle.name)
    return road_course(roads, route, options=road_drive_options(options, roads))


def needed_area(roads: RoadMap, options: DriveOptions) -> Any:
    """The polygon, scene metres, that a drive needs the scene of; raises RouteError as the drive would.

    Sensors measure up to their range. Satellites and the sun are blocked by whatever is loaded: by all tiles
    around the stretch of the drive at hand. Road users are simulated within a radius.
    """
    path, tried = _course(roads, options)
    rig, settings = load_rig(options.rig), options.recording_settings
    sensors = sensors_of(rig, options)
    x, y = path[len(path) // 2]
    scale = max(float(np.asarray(roads.frame.scale_at(x, y))), 1.0)
    margin = min(max((s.max_range for s in sensors), default=0.0), settings.world.reach)
    parts = [_around(path, (margin + _ASIDE) * scale)]
    parts += [_around(line, _OBSTACLES * scale) for line in tried]
    colored = any(isinstance(s, Camera) and "rgb" in s.spec.images for s in sensors)
    if colored and settings.camera.shadows:
        parts += _squares(path, CHUNK, margin=margin + OVERHANG)
    if rig.gnss:
        parts += _squares(path, BLOCK_M * scale, margin=REACH + OVERHANG)
    if options.traffic is not None:
        parts.append(_around(path, (options.traffic.radius + LEFT + _ASIDE) * scale))
    return shapely.union_all(parts)


def _around(line: Float, metres: float) -> Any:
    """Buffer of a line (n, 2), scene metres."""
    whole = shapely.linestrings(line) if np.ptp(line, axis=0).max() > 0 else shapely.points(line[0])
    return shapely.buffer(shapely.simplify(whole, _ROUNDING), metres + _ROUNDING, quad_segs=16)


def _squares(line: Float, span: float, *, margin: float) -> list[Any]:
    """Boxes of all stretches of a line (n, 2) of at most ``span`` metres along each axis, with a margin."""
    whole = shapely.linestrings(line) if np.ptp(line, axis=0).max() > 0 else shapely.points(line[0])
    points = shapely.get_coordinates(shapely.segmentize(shapely.simplify(whole, _ROUNDING), _STEP))
    more = margin + _ASIDE + _STEP
    return [
        shapely.box(*(points[rows].min(axis=0) - more), *(points[rows].max(axis=0) + more))
        for rows in _stretches(points, span + _STEP)
    ]


def _stretches(points: Float, span: float) -> Iterator[slice]:
    """The longest runs of points within a box of ``span`` metres, none within another."""
    last = 0
    for first in range(len(points)):
        stop = max(last, first + 1)
        low, high = points[first:stop].min(axis=0), points[first:stop].max(axis=0)
        while stop < len(points):
            low, high = np.minimum(low, points[stop]), np.maximum(high, points[stop])
            if (high - low).max() > span:
                break
            stop += 1
        if stop > last:
            yield slice(first, stop)
        if stop == len(points):
            return
        last = stop
