"""Options of a drive, and the recipe of its dataset."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

from cyclopts import Parameter, Token

from geoscene.support.console import SEVERAL, WORDS, whole
from geoscene.support.digests import recipe_digest
from geoscene.support.option_values import brief, listed, take_values
from geoscene.support.urls import redacted
from lidar.dataset.formats import FORMATS, LABELS
from lidar.errors import InputError
from lidar.geometry.time_scales import LONGEST_S
from lidar.options.shared import OUTPUT, SETTINGS, check_seed, check_whole, check_words, lower, taken_settings
from lidar.options.stages import (
    ATTACK,
    STAGE,
    STAGE_READERS,
    WEATHER,
    StageList,
    chosen_stages,
    with_stage_settings,
)

if TYPE_CHECKING:
    from geoscene.pipeline.reach import RoadMap
    from geoscene.scene import Scene
    from lidar.motion.route import Side, Spec
    from lidar.motion.vehicle import RoadConditions
    from lidar.settings import RecordingSettings
    from lidar.signal.weather.setting import WeatherSetting
    from lidar.traffic.options import TrafficFile, TrafficOptions

    Traffic = TrafficOptions | TrafficFile
else:  # types that help shows; converters make the values, whose classes take a second to import; Any, as
    # cyclopts checks values against these types where pydantic is imported
    Spec, Traffic = (list[str] | Any, str | Any)

_BY_FRAME = {
    frame: ", ".join(f.name for f in FORMATS.values() if f.frame == frame) for frame in ("sensor", "world")
}
_FORMATS = (
    f"Formats of clouds, separated by commas: {_BY_FRAME['sensor']} (sensor frame), {_BY_FRAME['world']}"
    " (georeferenced)."
)
_LABELS = f"Label files in the codes of other datasets, separated by commas: {', '.join(LABELS)}."


def _route(_: object, tokens: Sequence[Token]) -> str | Path | list[tuple[float, float]]:
    words = [token.value.strip() for token in tokens if token.value.strip()]
    if words == ["random"]:
        return "random"
    points = [_waypoint(word) for word in words]
    if len(words) == 1 and points[0] is None:
        return Path(words[0])
    if len(points) < 2 or any(p is None for p in points):
        raise ValueError("give random, a file, or two or more LAT,LON")
    return [p for p in points if p is not None]


def _waypoint(word: str) -> tuple[float, float] | None:
    try:
        lat, lon = (float(v) for v in word.split(","))
    except ValueError:
        return None
    if not (abs(lat) <= 90 and abs(lon) <= 180):
        raise ValueError(f"{word} is not a latitude and longitude in degrees")
    return lat, lon


def _time(_: object, tokens: Sequence[Token]) -> datetime:
    return read_time(tokens[0].value)


def read_time(text: str) -> datetime:
    """The time of an ISO 8601 text, UTC unless it states a zone; raises ValueError for others."""
    if re.search(r":\d\d:60", text):
        raise ValueError("a drive cannot start within a leap second; give the second before or after")
    try:
        when = datetime.fromisoformat(text)
        return when.replace(tzinfo=UTC) if when.tzinfo is None else when.astimezone(UTC)
    except (ValueError, OverflowError):
        raise ValueError("give an ISO 8601 time such as 2026-06-21T08:00:00") from None


def _traffic(_: object, tokens: Sequence[Token]) -> Any:
    from lidar.traffic.options import read_traffic  # noqa: PLC0415

    return read_traffic(tokens[0].value)


def _taken_route(value: Any) -> Any:
    """A route of Python code: random, a path, or two or more places."""
    if isinstance(value, Path) or (isinstance(value, str) and not value):
        return value
    if isinstance(value, str | os.PathLike):
        text = os.fspath(value).strip()
        words = text.split()
        if text != "random" and not (len(words) > 1 and all(map(_waypoint, words))):
            return Path(text)
        return text if text == "random" else [_waypoint(word) for word in words]
    places = [_place(one) for one in listed(value)]
    if len(places) < 2:
        raise ValueError("give two or more places")
    return places


def _place(value: Any) -> tuple[float, float]:
    """A place of a route, of Python code."""
    place = _waypoint(value) if isinstance(value, str) else tuple(map(float, listed(value)))
    if place is None or len(place) != 2 or not (abs(place[0]) <= 90 and abs(place[1]) <= 180):
        raise ValueError(f"{brief(value)} is no latitude and longitude in degrees")
    return place


def _taken_time(value: Any) -> datetime | None:
    """A time of Python code, with its zone."""
    if value is None or (isinstance(value, datetime) and value.tzinfo is not None):
        return value
    if isinstance(value, datetime):
        return value.replace(tzinfo=UTC)
    if isinstance(value, str):
        return read_time(value)
    raise ValueError("give a datetime, or an ISO 8601 time such as 2026-06-21T08:00:00")


def _taken_traffic(value: Any) -> Any:
    """Traffic of Python code."""
    from lidar.traffic.options import TrafficFile, TrafficOptions, read_traffic  # noqa: PLC0415

    if value is None or isinstance(value, TrafficOptions | TrafficFile):
        return value
    if isinstance(value, str | os.PathLike):
        return read_traffic(os.fspath(value))
    raise ValueError("give a text such as on or on:vehicles=20, a TrafficOptions or a TrafficFile")


_READERS = STAGE_READERS | {
    "route": _taken_route,
    "settings": taken_settings,
    "start": _taken_time,
    "traffic": _taken_traffic,
}
"""How options of Python code are read, by name."""

_ROADS = ("dry", "by-weather", "wet", "snow", "ice")
"""What vehicles drive on."""

_NOT_IN_RECIPE = ("relief", "device", "stages", "weather", "attacks", "road", "workers", "scheduler")
"""Options that the recipe states otherwise, or on which no byte depends."""


@Parameter(name="*")
@dataclass(frozen=True)
class DriveOptions:
    """Options of a drive. The dataset stores them; its bytes depend on all but ``workers`` and ``scheduler``.

    In Python all options take the texts of the command line, several of them also as a list, and paths.
    ``route`` may be a list of (latitude, longitude) in degrees, ``settings`` a dictionary, ``start`` a
    `datetime` (UTC unless it states a zone), ``traffic`` a `TrafficOptions` or `TrafficFile`, and
    ``weather``, ``attacks`` and ``stages`` what `read_weather`, `read_attacks` and `read_stages` return.
    """

    route: Annotated[Spec, Parameter(converter=_route, metavar="ROUTE"), SEVERAL] = ""
    """random, a GPX or GeoJSON file, two or more waypoints as LAT,LON in degrees, or the trajectory.csv or
    poses.csv of an earlier drive, whose trajectory is then repeated."""

    duration: float | None = None
    """Seconds to record; by default all of a given route and a second at rest at its end, or 60 seconds of a
    random one."""

    from_rest: bool = False
    """Start and end a random drive at rest, as drives along a given route do; by default the vehicle is under
    way when the record starts and when it ends."""

    survey: str = ""
    """For aircraft, instead of a route: all, W,S,E,N in degrees, or a GeoJSON file with a polygon, which is
    flown over in strips."""

    altitude: float | None = None
    """Metres of a flight above the ground below it; an aircraft's survey is level, that much above the
    highest ground below it. By default heights in the route's file, or 60 (drone) or 600 (aircraft)."""

    overlap: float = 0.3
    """Share of a survey's strip that the next one covers too."""

    turns: bool = False
    """Scan in the turns between a survey's strips too; by default scanners work from a second before each
    strip to a second after it, and the clouds between are empty."""

    rig: str = "seed"
    """Sensors and their mounts: a built-in rig (lidar rigs lists them), or a TOML file."""

    vehicle: str = ""
    """car, van, robot, backpack, drone, aircraft, or a TOML file; the rig's own by default."""

    formats: Annotated[tuple[str, ...], Parameter(name="--format", group=OUTPUT, help=_FORMATS), WORDS] = (
        "pcd",
        "laz",
    )

    labels: Annotated[tuple[str, ...], Parameter(group=OUTPUT, help=_LABELS), WORDS] = ()

    deskew: Annotated[str, Parameter(group=OUTPUT, converter=lower)] = ""
    """Write clouds of the sensor frame a second time, de-skewed to one moment of the frame: start, middle or
    end."""

    seed: Annotated[int, Parameter(converter=whole)] = 0
    """Seed of the random number generators (non-negative integer)."""

    start: Annotated[datetime | None, Parameter(converter=_time)] = None
    """UTC time of the drive's start, ISO 8601 (2026-06-21T08:00:00), from 1980-01-06 to the end of 2261; it
    sets the sun and the time stamps. By default 10:00 local solar time on 21 June 2026."""

    crs: Annotated[str, Parameter(group=OUTPUT)] = "utm"
    """CRS of LAZ files: utm, scene, or an EPSG code."""

    exact: Annotated[bool, Parameter(group=OUTPUT)] = False
    """Georeference every point through the full projection; by default by a local affine approximation, which
    is within 0.1 mm of it."""

    side: str = ""
    """Side of the road to drive on, right or left; the scene's by default."""

    fidelity: str = "standard"
    """Level: standard (one pose and one ray per pulse, exact ranges) or survey (beams with a size,
    several echoes, noise, lost and false returns; image noise)."""

    traffic: Annotated[
        Traffic | None, Parameter(converter=_traffic, n_tokens=1, accepts_keys=False, metavar="STR")
    ] = None
    """Other road users: on, on:vehicles=20,parked=0.5,pedestrians=5,cyclists=2 (vehicles and cyclists per km
    of lane, pedestrians per km of sidewalk, parked as a share of the places; on: may be left out);
    or a file that sumo --fcd-output wrote, FILE.xml:net=FILE.net.xml,begin=SECONDS,parked=0.6 as needed."""

    settings: Annotated[
        tuple[tuple[str, str], ...],
        SETTINGS,
    ] = ()
    """Settings that differ from the fidelity level: NAME=VALUE,NAME=VALUE, or repeat. lidar settings
    lists them."""

    relief: str = ""
    """What is used of the relief of surfaces, short for --set relief: off (walls are planes and the ground is
    smooth), plain (windows and doors in depth, kerbs, rough ground), full (also guessed small parts), or mesh
    (openings as triangles). By default what the scene holds; the scene of a map is built plain."""

    device: str = ""
    """What casts rays and shades images, short for --set device: cpu, or, with the extra gpu, cuda or cuda:N
    (a CUDA device) or warp-cpu (the kernels of CUDA on the CPU, to test them). The CPU by default."""

    stages: Annotated[StageList, STAGE] = ()
    """Change echoes, clouds, images, fixes or inertial samples by a stage: NAME, NAME:KEY=VALUE,KEY=VALUE or
    a TOML file with tables [[stage]]; several separated by commas, or repeat. lidar stages lists them."""

    weather: Annotated[StageList, WEATHER] = ()
    """Weather for all sensors: rain=10mm/h, fog=50m (visibility), snow=2mm/h (as water), dust, spray, several
    separated by commas, or a TOML file with tables [[weather]] of time and place; repeat for more. Echoes
    that are too weak are then lost at every fidelity level (--set link=on)."""

    attacks: Annotated[StageList, ATTACK] = ()
    """Attack on sensors: a TOML file with tables [[attack]], NAME or NAME:KEY=VALUE,KEY=VALUE; repeat for
    more. It acts after the weather and before other stages."""

    road: str = "dry"
    """What the ego vehicle and simulated traffic drive on: dry, whatever the weather; by-weather, so that its
    friction and visibility lower speeds and accelerations; wet, snow or ice."""

    workers: Annotated[int, Parameter(group=OUTPUT, converter=whole)] = 2
    """Threads, at most one per core; each records one frame at a time. The bytes do not depend on it."""

    scheduler: Annotated[str, Parameter(group=OUTPUT, metavar="ADDRESS")] = ""
    """Address of the scheduler of a Dask cluster (tcp://HOST:8786), whose workers record the frames; they
    need the scene's and the output folder under the same paths. The bytes do not depend on it."""

    def __post_init__(self) -> None:
        """Take the options, validate them, and enter ``relief`` and ``device`` among the settings."""
        take_values(self, error=InputError, readers=_READERS)
        for name in ("relief", "device"):
            if value := getattr(self, name):
                if any(given == name for given, _ in self.settings):
                    raise InputError(f"`{name}` {value}: `settings` {name} is given, too; give one of both")
                object.__setattr__(self, "settings", (*self.settings, (name, value)))
                object.__setattr__(self, name, "")
        if self.duration is not None and not 0.1 <= self.duration <= LONGEST_S:
            raise InputError(
                f"`duration` {self.duration}: give 0.1 to {LONGEST_S:.0f} seconds (four hours), and record"
                " several drives for more"
            )
        check_words(self, side=("", "left", "right"), road=_ROADS)
        check_whole(self, workers=(1, 256))
        check_seed(self.seed)
        if self.altitude is not None and not 0 < self.altitude <= 20_000:
            raise InputError(f"`altitude` {self.altitude:g}: give metres above the ground, up to 20000")
        if not 0 <= self.overlap < 1:
            raise InputError(f"`overlap` {self.overlap:g}: give a share from 0 to less than 1")
        if self.road == "by-weather" and not self._weather():
            raise InputError("`road` by-weather: give `weather`, too")
        _ = self.recording_settings

    def road_conditions(self) -> RoadConditions:
        """Grip and visibility that vehicles drive with."""
        from lidar.motion.vehicle import ROADS  # noqa: PLC0415

        if self.road != "by-weather":
            return ROADS[self.road]
        from lidar.signal.weather.media import road_conditions  # noqa: PLC0415

        ground = self.recording_settings.world
        return road_conditions(self._weather(), wetness=ground.wetness, snow=ground.snow)

    def _weather(self) -> tuple[WeatherSetting, ...]:
        from lidar.signal.weather.setting import WeatherSetting  # noqa: PLC0415

        stages = (named.stage for named in self.all_stages)
        return tuple(stage for stage in stages if isinstance(stage, WeatherSetting))

    def check_course(self) -> None:
        """Raise InputError unless the options name either a route or a survey."""
        if bool(self.route) == bool(self.survey):
            raise InputError("give one of `route` and `survey`, such as `route` random")

    def check_on_roads(self, vehicle: str) -> None:
        """Raise InputError for options of flights, for a vehicle that drives on roads."""
        if self.survey or self.altitude is not None:
            option = "survey" if self.survey else "altitude"
            raise InputError(
                f"`{option}` is for aircraft, and a {vehicle} does not fly; set `vehicle` to drone or"
                " aircraft, or take the rig of one"
            )

    def side_in(self, scene: Scene | RoadMap) -> Side:
        """Side of the road that the vehicle drives on."""
        return cast("Side", self.side) if self.side else "left" if scene.left_hand else "right"

    @cached_property
    def recording_settings(self) -> RecordingSettings:
        """Files and settings of every frame, resolved once; raises InputError for unknown names."""
        from lidar.settings import RecordingSettings, settings_of  # noqa: PLC0415  (a second, not needed for --help)
        from lidar.signal.registry import Stages  # noqa: PLC0415

        stages = self.all_stages
        chosen = settings_of(self.fidelity, with_stage_settings(self.settings, stages))
        return RecordingSettings(
            self.formats, self.labels, self.deskew, self.seed, *chosen, Stages(stages, self.seed)
        )

    @property
    def all_stages(self) -> StageList:
        """Weather, attacks and other stages in the order in which they act."""
        return chosen_stages(self.weather, self.attacks, self.stages)

    def recipe(self, scene: Scene) -> dict[str, Any]:
        """Options and digests of inputs that determine the dataset's bytes, as JSON."""
        from lidar.sensors.rig.specs import load_rig, rig_digest  # noqa: PLC0415

        route, side = self.route or "random", self.side_in(scene)
        traffic = None if self.traffic is None else asdict(replace(self.traffic, side=side))
        resolved: dict[str, Any] = {
            "route": _add_digest(route)
            if isinstance(route, str | Path)
            else [list(point) for point in route],
            "survey": _add_digest(self.survey),
            "rig": f"{self.rig} ({rig_digest(self.rig)})",
            "vehicle": _add_digest(self.vehicle or load_rig(self.rig).vehicle),
            "start": self.start.isoformat() if self.start else None,
            "side": side,
            "traffic": traffic
            and {k: _add_digest(v) if isinstance(v, Path) else v for k, v in traffic.items()},
        }
        recipe = {"scene": scene.manifest.get("fingerprint", scene.path.name)}
        names = [f.name for f in fields(self) if f.name not in _NOT_IN_RECIPE]
        recipe |= {name: getattr(self, name) for name in names}
        if scene.area is not None:
            resolved["map"] = scene.origin
        if self.road != "dry":
            resolved["road"] = self.road
        if stages := self.all_stages:
            resolved["stages"] = [stage.to_json() for stage in stages]
            resolved["settings"] = with_stage_settings(self.settings, stages)
        return dict(redacted(recipe | resolved))


def _add_digest(name: str | Path) -> str:
    """A name; for a file with a digest of its contents, so that a changed file changes the recipe."""
    path = Path(name)
    if not str(name) or not path.is_file():
        return str(name)
    return f"{name} ({recipe_digest(path.read_bytes())})"
