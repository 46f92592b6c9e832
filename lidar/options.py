"""Options of the commands of `lidar`: defaults, units, help and the recipe of a dataset, declared once."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, fields, replace
from datetime import UTC, datetime
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

from cyclopts import Group, Parameter, Token

from geoscene.classes import Class
from geoscene.options import KINDS, BuildOptions, Degrees
from geoscene.support.console import SEVERAL, WORDS, degrees, whole
from geoscene.support.digests import recipe_digest
from geoscene.support.option_values import Reader, brief, listed, take_values
from geoscene.support.registry import unknown_name
from geoscene.support.urls import redacted
from geoscene.uses import RELIEFS
from lidar.dataset.formats import FORMATS, LABELS
from lidar.dataset.layouts import EXPORTERS
from lidar.errors import InputError
from lidar.geometry.time_scales import LONGEST_S
from lidar.parameters import split_pairs, value_text
from lidar.sensors.rig.imu_grades import PRESETS

if TYPE_CHECKING:
    from geoscene.pipeline.reach import RoadMap
    from geoscene.scene import Scene
    from lidar.motion.route import Side, Spec
    from lidar.motion.vehicle import RoadConditions
    from lidar.settings import RecordingSettings
    from lidar.signal.registry import NamedStage
    from lidar.signal.weather.setting import WeatherSetting
    from lidar.traffic.options import TrafficFile, TrafficOptions

    Traffic = TrafficOptions | TrafficFile
    StageList = tuple[NamedStage, ...]
else:  # types that help shows; converters make the values, whose classes take a second to import; Any, as
    # cyclopts checks values against these types where pydantic is imported
    Spec, Traffic, StageList = (list[str] | Any, str | Any, tuple[str, ...] | Any)

OUTPUT = Group("Output", sort_key=3)

COLORS = ("class", "height", "intensity", "sensor", "image")
"""What red, green and blue of a map can show."""

TILE_FORMATS = ("laz", "las", "copc")
"""Formats of the tiles of a map."""

LARGEST_TILE = 1_000_000
"""Metres."""

MOST_NEIGHBOURS = 500
"""Neighbours by which outliers are found."""

RASTERS = ("dsm", "dtm", "density", "intensity")
"""Rasters of a map."""

ORIGINS = ("surface", "weather", "interference", "injected", "replayed", "moved", "receiver")
"""Origins of returns, `lidar.sensors.physics.echoes.Origin` in lower case."""

SHOWN = ("all", "sweep", "cameras", "map")
"""What a film can show."""

FILM_VIEWS = ("chase", "top")
"""Where a film looks at sweeps from."""

FILM_COLORS = ("class", "height", "intensity", "time", "origin")
"""What colours of returns in a film can show."""

METHODS = ("kiss-icp", "genz-icp", "small_gicp", "orb", "orb+depth", "stereo", "fused")
"""Methods of odometry."""

FUSE = ("harmonic", "max", "fisher", "none")
"""Verdicts of several defences together."""

ALIGNMENTS = ("none", "origin", "se3", "sim3", "yaw-position")
"""Motions of an estimated trajectory onto the true one."""

ECHOES = ("all", "first", "last", "single")
"""Echoes of a pulse that a map can be made of."""

_BY_FRAME = {
    frame: ", ".join(f.name for f in FORMATS.values() if f.frame == frame) for frame in ("sensor", "world")
}
_FORMATS = (
    f"Formats of clouds, separated by commas: {_BY_FRAME['sensor']} (sensor frame), {_BY_FRAME['world']}"
    " (georeferenced)."
)
_LABELS = f"Label files in the codes of other datasets, separated by commas: {', '.join(LABELS)}."
CONVERTED_FORMATS = tuple(name for name in FORMATS if name not in EXPORTERS)
"""Formats that clouds of datasets are converted to; those of KITTI and nuScenes are parts of layouts."""

_LAYOUTS = (
    f"Layout: {'; '.join(f'{row.name} ({row.meaning})' for row in EXPORTERS.values())}."
    f" Or a format of clouds: {', '.join(CONVERTED_FORMATS)}."
)


def _pixels(_: object, tokens: Sequence[Token]) -> tuple[int, int]:
    found = re.fullmatch(r"(\d{1,5})x(\d{1,5})", tokens[0].value.strip().lower())
    if not found:
        raise ValueError(f"{tokens[0].value}: give WIDTHxHEIGHT in pixels, such as 1280x720")
    return int(found[1]), int(found[2])


def _route(_: object, tokens: Sequence[Token]) -> str | Path | list[tuple[float, float]]:
    words = [token.value.strip() for token in tokens if token.value.strip()]
    if words == ["random"]:
        return "random"
    points = [_waypoint(word) for word in words]
    if len(words) == 1 and points[0] is None:
        return Path(words[0])
    if len(points) < 2 or any(p is None for p in points):
        raise ValueError(f"{' '.join(words)}: random, a file, or two or more LAT,LON")
    return [p for p in points if p is not None]


def _waypoint(word: str) -> tuple[float, float] | None:
    try:
        lat, lon = (float(v) for v in word.split(","))
    except ValueError:
        return None
    if not (abs(lat) <= 90 and abs(lon) <= 180):
        raise ValueError(f"{word}: not a latitude and longitude in degrees")
    return lat, lon


def _time(_: object, tokens: Sequence[Token]) -> datetime:
    return read_time(tokens[0].value)


def read_time(text: str) -> datetime:
    """The time of an ISO 8601 text, UTC unless it states a zone; raises ValueError for others."""
    if re.search(r":\d\d:60", text):
        raise ValueError(
            f"{text}: a drive cannot start within a leap second; give the second before or after"
        )
    try:
        when = datetime.fromisoformat(text)
        return when.replace(tzinfo=UTC) if when.tzinfo is None else when.astimezone(UTC)
    except (ValueError, OverflowError):
        raise ValueError(f"{text}: not an ISO 8601 time such as 2026-06-21T08:00:00") from None


def _span(_: object, tokens: Sequence[Token]) -> tuple[float, float]:
    text = tokens[0].value.strip()
    try:
        first, last = (float(word) for word in text.split(","))
    except ValueError:
        raise ValueError(f"{text}: give two numbers of seconds as FROM,TO") from None
    return first, last


def _six(_: object, tokens: Sequence[Token]) -> tuple[float, ...]:
    text = tokens[0].value.strip()
    with suppress(ValueError):
        values = tuple(float(word) for word in text.split(","))
        if len(values) == 6 and all(map(math.isfinite, values)):
            return values
    raise ValueError(f"{text}: give six numbers, three of metres and three of degrees")


def _outliers(_: object, tokens: Sequence[Token]) -> tuple[int, float]:
    text = tokens[0].value.strip()
    try:
        neighbours, factor = text.split(",")
        return int(neighbours), float(factor)
    except ValueError:
        raise ValueError(f"{text}: give a number of neighbours and a factor, such as 16,2") from None


def _check_words(options: object, **known: Collection[str]) -> None:
    """Raise InputError if an option, or a word of it, is not among the known words by its name."""
    for name, words in known.items():
        value = getattr(options, name)
        for word in (value,) if isinstance(value, str) else value:
            if word not in words:
                raise InputError(unknown_name(f"`{name}`", word, known=[one for one in words if one]))


def _check_whole(options: object, **bounds: tuple[int, int]) -> None:
    """Raise InputError if an option is not within its bounds, both allowed."""
    for name, (low, high) in bounds.items():
        if not low <= getattr(options, name) <= high:
            raise InputError(f"`{name}` {getattr(options, name)}: give {low} to {high}")


def _check_positive(options: object, **units: str) -> None:
    """Raise InputError if an option that is given is not positive and finite; ``units`` follow "number"."""
    for name, unit in units.items():
        value = getattr(options, name)
        if value is not None and not 0 < value < math.inf:
            raise InputError(f"`{name}` {value:g}: give a positive number{unit}")


def _check_seed(seed: int) -> None:
    """Raise InputError for a seed that random number generators do not take."""
    if not 0 <= seed < 1 << 63:
        raise InputError(f"`seed` {seed}: give a non-negative integer")


def _lower(_: object, tokens: Sequence[Token]) -> str:
    return tokens[0].value.lower()


def _texts(_: object, tokens: Sequence[Token]) -> tuple[str, ...]:
    return tuple(token.value for token in tokens)


NAMED = Parameter(converter=_texts, n_tokens=1, metavar="NAME,...")
"""Parameter of an option that takes names with parameters, ``NAME:KEY=VALUE,KEY=VALUE``, as texts."""


def _settings(_: object, tokens: Sequence[Token]) -> tuple[tuple[str, str], ...]:
    return tuple(pair for token in tokens for pair in split_pairs(token.value))


def _stages(_: object, tokens: Sequence[Token]) -> Any:
    return tuple(_stages_of([token.value for token in tokens]))


def _attacks(_: object, tokens: Sequence[Token]) -> Any:
    return tuple(_attacks_of([token.value for token in tokens]))


def _weather(_: object, tokens: Sequence[Token]) -> Any:
    return tuple(_weather_of([token.value for token in tokens]))


_STAGE = Parameter(name="--stage", converter=_stages, n_tokens=1, accepts_keys=False, metavar="STAGE")
_ATTACK = Parameter(name="--attack", converter=_attacks, n_tokens=1, accepts_keys=False, metavar="ATTACK")
_WEATHER = Parameter(name="--weather", converter=_weather, n_tokens=1, accepts_keys=False, metavar="WEATHER")


def chosen_stages(*groups: Iterable[NamedStage]) -> tuple[NamedStage, ...]:
    """All stages in order of application: weather, attacks, others."""
    from lidar.signal.registry import number_stages  # noqa: PLC0415

    return number_stages(chain.from_iterable(groups))


def with_stage_settings(
    settings: Sequence[tuple[str, str]], stages: Iterable[NamedStage]
) -> tuple[tuple[str, str], ...]:
    """Settings that differ from a fidelity level: those of stages, unless given, and the given ones."""
    given = {name for name, _ in settings}
    by_stages = (pair for named in stages for pair in named.stage.settings)
    return (*dict.fromkeys(pair for pair in by_stages if pair[0] not in given), *settings)


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


def _taken_settings(value: Any) -> tuple[tuple[str, str], ...]:
    """Settings of Python code: NAME=VALUE, a dictionary, or pairs."""
    if isinstance(value, str):
        return tuple(split_pairs(value))
    found: list[tuple[str, str]] = []
    for pair in value.items() if isinstance(value, Mapping) else listed(value):
        if isinstance(pair, str):
            found += split_pairs(pair)
            continue
        if not isinstance(pair, tuple | list) or len(pair) != 2:
            raise ValueError("give NAME=VALUE, or a dictionary")
        found.append((str(pair[0]), value_text(pair[1])))
    return tuple(found)


def _taken_stages(read: Callable[[list[str]], Iterable[Any]]) -> Reader:
    """A reader of stages of Python code: texts as on the command line, or stages that were read."""

    def reader(value: Any) -> tuple[Any, ...]:
        from lidar.signal.registry import NamedStage, Stages, number_stages  # noqa: PLC0415

        if isinstance(value, Stages):
            return value.stages
        taken: list[Any] = []
        for one in [value] if isinstance(value, str | os.PathLike | NamedStage) else listed(value):
            if isinstance(one, str | os.PathLike):
                taken += read([os.fspath(one)])
            elif isinstance(one, NamedStage):
                taken.append(one)
            else:
                raise TypeError("give texts as on the command line, or what read_stages returns")
        return number_stages(taken)

    return reader


def _weather_of(texts: list[str]) -> Iterable[Any]:
    from lidar.signal.weather.setting import read_weather  # noqa: PLC0415

    return chain.from_iterable(map(read_weather, texts))


def _stages_of(texts: list[str]) -> Iterable[Any]:
    from lidar.signal.registry import read_stages  # noqa: PLC0415

    return read_stages(texts).stages


def _attacks_of(texts: list[str]) -> Iterable[Any]:
    from lidar.signal.registry import read_attacks  # noqa: PLC0415

    return read_attacks(texts)


_STAGE_READERS = {
    "stages": _taken_stages(_stages_of),
    "weather": _taken_stages(_weather_of),
    "attacks": _taken_stages(_attacks_of),
}
_READERS = _STAGE_READERS | {
    "route": _taken_route,
    "settings": _taken_settings,
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

    deskew: Annotated[str, Parameter(group=OUTPUT, converter=_lower)] = ""
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
        Parameter(name="--set", converter=_settings, n_tokens=1, metavar="NAME=VALUE"),
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

    stages: Annotated[StageList, _STAGE] = ()
    """Change echoes, clouds, images, fixes or inertial samples by a stage: NAME, NAME:KEY=VALUE,KEY=VALUE or
    a TOML file with tables [[stage]]; several separated by commas, or repeat. lidar stages lists them."""

    weather: Annotated[StageList, _WEATHER] = ()
    """Weather for all sensors: rain=10mm/h, fog=50m (visibility), snow=2mm/h (as water), dust, spray, several
    separated by commas, or a TOML file with tables [[weather]] of time and place; repeat for more. Echoes
    that are too weak are then lost at every fidelity level (--set link=on)."""

    attacks: Annotated[StageList, _ATTACK] = ()
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
        _check_words(self, side=("", "left", "right"), road=_ROADS)
        _check_whole(self, workers=(1, 256))
        _check_seed(self.seed)
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


PERCENTS = (50.0, 68.0, 90.0, 95.0, 99.0, 99.9)
"""Percent of the returns, or of the pixels with a depth, that an accuracy may be asked for."""

_ACCURACY = re.compile(r"([\d.]+) ?(um|µm|mm|cm|m|levels?)(?:@([\d.]+) ?%?)?")
_METRES = {"um": 1e-6, "µm": 1e-6, "mm": 1e-3, "cm": 1e-2, "m": 1.0}


@dataclass(frozen=True, slots=True)
class AccuracyTarget:
    """Maximum errors of the sensors of a drive; 0 without a limit.

    text    : as it was asked for
    metres  : error of ranges of scanners, and of depths of cameras
    percent : share of the returns or pixels to which it applies, of `PERCENTS`
    levels  : rms error of colours of cameras, levels of 255
    """

    text: str
    metres: float = 0.0
    percent: float = 99.9
    levels: float = 0.0


def read_accuracy(text: str) -> AccuracyTarget:
    """An accuracy of a text such as ``1cm``, ``5mm@99``, ``3levels`` or ``1cm,3levels``.

    Raises InputError for others.
    """
    asked = AccuracyTarget(text.strip())
    for part in text.lower().split(","):
        found = _ACCURACY.fullmatch(part.strip())
        size = 0.0
        with suppress(ValueError):  # of numbers with two points
            size = float(found[1]) if found else 0.0
        if found and found[2].startswith("level"):
            if not 0 < size <= 255 or found[3]:
                raise InputError(f"`accuracy` {text}: give levels of 255, rms, as in 3levels")
            given, asked = asked.levels, replace(asked, levels=size)
        else:
            metres = size * _METRES[found[2]] if found else 0.0
            if not found or not 1e-6 <= metres <= 1000:
                raise InputError(
                    f"`accuracy` {text}: give a length and its unit, as in 1cm, 5mm@99 or 0.1m, levels of"
                    " colours, as in 3levels, or both, as in 1cm,3levels"
                )
            given, asked = asked.metres, replace(asked, metres=metres, percent=_percent(text, found[3]))
        if given:
            raise InputError(f"`accuracy` {text}: give one length and one number of levels at most")
    return asked


def _percent(text: str, share: str | None) -> float:
    """Percent of the returns, of `PERCENTS`."""
    percent = 99.9
    with suppress(ValueError):
        percent = float(share) if share else percent
        if percent in PERCENTS:
            return percent
    among = ", ".join(f"{p:g}" for p in PERCENTS)
    raise InputError(f"`accuracy` {text}: after the @ give one of {among} percent of the returns")


def read_budget(text: str) -> float:
    """Simulated seconds per second, of a text such as ``2x-realtime``; raises InputError for others."""
    found = re.fullmatch(r"(\d+\.?\d*|\.\d+)x-realtime", text.strip().lower())
    speed = float(found[1]) if found else 0.0
    if not 0 < speed < math.inf:
        raise InputError(f"`budget` {text}: give a speed such as 2x-realtime or 0.5x-realtime")
    return speed


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class AccuracyOptions:
    """Options by which rays of scanners and cameras are picked, and errors are checked."""

    accuracy: Annotated[str, Parameter(metavar="LENGTH[@PERCENT],LEVELS")] = ""
    """Pick the fewest rays with which every sensor errs less than this: 1cm for 99.9 % of the ranges and
    depths, 5mm@99 for 99 % of them, 3levels for colours of cameras (rms, of 255), 1cm,3levels for both. What
    counts is the upper end of the 95 % interval, by a sample of the drive's frames."""

    budget: Annotated[str, Parameter(metavar="Nx-realtime")] = ""
    """Pick the most rays with which the workers simulate the drive at this speed: 2x-realtime is two
    simulated seconds per second, 0.5x-realtime half of one. With an accuracy: a limit to it."""

    spot_check: bool = False
    """Compare a sample of the recorded frames with the exact reference (float64, up to 999 rays a pulse)
    afterwards; always done for an accuracy or a budget."""

    def __post_init__(self) -> None:
        """Validate the options."""
        take_values(self, error=InputError)
        if self.accuracy:
            read_accuracy(self.accuracy)
        if self.budget:
            read_budget(self.budget)

    @property
    def picks(self) -> bool:
        """Whether settings are to be picked."""
        return bool(self.accuracy or self.budget)

    @property
    def checks(self) -> bool:
        """Whether a sample of frames is to be checked."""
        return self.picks or self.spot_check

    @property
    def request(self) -> dict[str, str]:
        """Accuracy and budget that are given, as text."""
        texts = {"accuracy": self.accuracy.strip(), "budget": self.budget.strip()}
        return {name: text for name, text in texts.items() if text}


MAP = Group("Map instead of a scene", sort_key=2)


@Parameter(name="*", group=MAP)
@dataclass(frozen=True, slots=True)
class PlaceOptions:
    """The map that a drive's scene is built of, and how; what the drive needs of it is built and cached."""

    place: str = ""
    """Name of a place instead of SCENE, found by Nominatim and downloaded from Overpass (needs a network;
    answers are cached)."""

    refresh: bool = False
    """Ask map servers for the place again, and replace their answers in the cache."""

    bbox: Annotated[Degrees | None, degrees("W,S,E,N")] = None
    """W,S,E,N in degrees: only this part of the map."""

    dem: Annotated[tuple[str, ...], SEVERAL] = ()
    """Elevation files, or the word tiles, as for geoscene build. By default the ground is level."""

    dem_gaps: str = "error"
    """If elevation files do not cover the scene: error, or nearest."""

    lod: Annotated[int, Parameter(converter=whole)] = 2
    """Level of detail of buildings: 0 blocks, 1 parts with flat roofs, 2 roofs."""

    only: Annotated[tuple[str, ...], WORDS] = KINDS
    """Kinds of features to build besides the ground, separated by commas."""

    scene_crs: str = "local"
    """CRS of the scene: local, utm or an EPSG code."""

    scene_cache: Path | None = None
    """Folder of the scenes that drives build; ~/.cache/geoscene/scenes by default."""

    def __post_init__(self) -> None:
        """Validate the options."""
        take_values(self, error=InputError)

    def build_options(self, name: str, *, relief: str) -> BuildOptions:
        """Options of the build, with a title of the scene; raises InputError for invalid ones.

        relief : that the drive uses, of `geoscene.uses.USED_RELIEFS`; the default of builds unless a scene
                 can be built with it
        """
        return BuildOptions(
            relief=relief if relief in RELIEFS else BuildOptions().relief,
            crs=self.scene_crs,
            lod=self.lod,
            dem=self.dem,
            dem_gaps=self.dem_gaps,
            only=self.only,
            use="camera",  # all that drives need
            name=name,
        )


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class TradeoffOptions:
    """Options of a comparison of settings."""

    compare: Annotated[tuple[str, ...], Parameter(name="--settings"), WORDS] = ()
    """Settings to compare, separated by commas: rays, poses, mirrors, foliage of scanners; supersample,
    edge_rays, blur, shadows, detail, resolution, haze of cameras; precision, retrace of both; origin, reach,
    forests, trees, furniture, barriers, relief, scene, traffic; georeferencing; all by default. Cheap ones
    are also tried together. lidar settings explains them."""

    sensors: Annotated[tuple[str, ...], Parameter(name="--sensor"), SEVERAL] = ()
    """Names of the scanners and cameras to compare; all by default."""

    frames: Annotated[int, Parameter(converter=whole)] = 8
    """Frames to sample, spread over the drive: 2 to 1000."""

    pulses: Annotated[int, Parameter(converter=whole)] = 16_000
    """Pulses of each scanner to compare, at random over the sampled frames: 100 to 10,000,000."""

    pixels: Annotated[int, Parameter(converter=whole)] = 16384
    """Pixels of each camera to compare, in blocks of 4 by 4 spread over the sampled frames: 256 to
    10,000,000."""

    reference_rays: Annotated[int, Parameter(converter=whole)] = 217
    """Rays per pulse of the reference: 7 to 665."""

    repetitions: Annotated[int, Parameter(converter=whole)] = 3
    """Repetitions of every timing, interleaved: 3 to 100."""

    def __post_init__(self) -> None:
        """Validate the options."""
        take_values(self, error=InputError)
        _check_whole(self, frames=(2, 1000), pulses=(100, 10**7), pixels=(256, 10**7))
        _check_whole(self, reference_rays=(7, 665), repetitions=(3, 100))


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class MapOptions:
    """Options of an aggregated map."""

    voxel: float | None = None
    """Keep only the return nearest to the centre of each cube with this side in metres; all by default."""

    color: str = "class"
    """What colours show: class, height, intensity, sensor, or image (what cameras saw of each point; those
    that none saw are left out)."""

    sensors: Annotated[tuple[str, ...], Parameter(name="--sensor"), SEVERAL] = ()
    """Names of the scanners to use; all by default."""

    noise: bool = False
    """Keep returns of class noise: false alarms and mirror images."""

    moving: bool = False
    """Keep returns of road users that move during the drive; they leave trails."""

    without: Annotated[tuple[str, ...], WORDS] = ()
    """Classes of returns to leave out, separated by commas: names that lidar classes lists, or vehicles,
    which are all of them, parked ones too."""

    only: Annotated[tuple[str, ...], WORDS] = ()
    """Classes of returns to use, by the same names; all by default."""

    bounds_deg: Annotated[Degrees | None, Parameter(name="--bbox"), degrees("W,S,E,N")] = None
    """Use returns in this box only: degrees on WGS 84."""

    polygon: Path | None = None
    """Use returns in the polygons of this GeoJSON file only; with --bbox, in both."""

    time: Annotated[tuple[float, float] | None, Parameter(converter=_span, n_tokens=1, metavar="FROM,TO")] = (
        None
    )
    """Use returns of this time only: seconds since the drive's start, the end excluded."""

    echo: str = "all"
    """Echoes of each pulse to use: all, first, last, or single (of pulses with one echo)."""

    origin: Annotated[tuple[str, ...], WORDS] = ()
    """Origins of returns to use, separated by commas, by the ground truth of stages: surface, weather,
    interference, injected, replayed, moved, receiver; all by default, but for noise."""

    poses: str = "truth"
    """Poses that place the points: truth, or FILE.tum: a trajectory of the vehicle, such as lidar odometry
    writes."""

    outliers: Annotated[
        tuple[int, float] | None,
        Parameter(converter=_outliers, n_tokens=1, metavar="NEIGHBOURS,FACTOR"),
    ] = None
    """Leave out returns whose mean distance to this many neighbours is above the map's mean by more than
    FACTOR standard deviations; after --voxel."""

    tiles: Annotated[int | None, Parameter(converter=whole)] = None
    """Write a file for each square of the projected grid with this side in whole metres, and an index, to the
    folder that --out names."""

    tile_format: str = "laz"
    """Format of the tiles: laz, las or copc."""

    raster: Annotated[tuple[str, ...], WORDS] = ()
    """Rasters to write beside the map as GeoTIFF, separated by commas: dsm (highest return), dtm (mean height
    of the ground's returns), density (returns per square metre), intensity (mean)."""

    resolution: float = 0.5
    """Side of the rasters' cells in metres."""

    compare: Path | None = None
    """Scene to compare with: distances from the map's points to its surfaces, as a table and a picture beside
    the map."""

    def __post_init__(self) -> None:
        """Validate the options."""
        take_values(self, error=InputError)
        _check_words(self, color=COLORS, echo=ECHOES, tile_format=TILE_FORMATS)
        _check_positive(self, voxel=" of metres", resolution=" of metres")
        if self.outliers is not None:
            neighbours, factor = self.outliers
            if not (1 <= neighbours <= MOST_NEIGHBOURS and 0 <= factor < math.inf):
                raise InputError(
                    f"`outliers` {neighbours},{factor:g}: give 1 to {MOST_NEIGHBOURS} neighbours and a"
                    " factor of 0 or more"
                )
        if self.tiles is not None and not 1 <= self.tiles <= LARGEST_TILE:
            raise InputError(f"`tiles` {self.tiles}: give 1 to {LARGEST_TILE} metres")
        classes_of(self.without)
        classes_of(self.only, option="only")
        _check_words(self, origin=ORIGINS, raster=RASTERS)
        if self.poses != "truth" and not self.poses.lower().endswith(".tum"):
            raise InputError(
                f"`poses` {self.poses}: give truth or FILE.tum; lidar odometry --method fused writes"
                " trajectory.tum by receivers, inertial units and scanners"
            )
        if self.time is not None and not self.time[0] < self.time[1]:
            raise InputError(f"`time` {self.time[0]:g},{self.time[1]:g}: ends before it begins")
        if self.bounds_deg is not None:
            west, south, east, north = self.bounds_deg
            if not (-180 <= west < east <= 180 and -90 <= south < north <= 90):
                raise InputError("`bounds_deg`: give west, south, east and north in degrees, in this order")


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class OdometryOptions:
    """Options of odometry."""

    method: Annotated[str, Parameter(converter=_lower, n_tokens=1)]
    """Method: kiss-icp, genz-icp, small_gicp (laser scanners); orb (a camera), orb+depth (a camera and laser
    scanners), stereo (two cameras); fused (GNSS with an inertial unit and odometry, as far as there are)."""

    sensors: Annotated[tuple[str, ...], Parameter(name="--sensor"), SEVERAL] = ()
    """Names of the sensors to use; repeat for more. By default the scanner whose sweeps have the most points,
    the first camera, and for stereo the next one whose images have the same times; several scanners are
    merged."""

    relative: Annotated[str, Parameter(converter=_lower, n_tokens=1)] = ""
    """Odometry that fused takes: one of the other methods, or none; by default small_gicp, without a scanner
    stereo, and none without both."""

    imu_grade: Annotated[str, Parameter(converter=_lower, n_tokens=1)] = ""
    """Noise of the inertial unit that fused takes: adis16448, vn100, mti-g-700 or tactical; by default that
    of the drive's rig."""

    start_pose: Annotated[
        tuple[float, ...] | None, Parameter(converter=_six, n_tokens=1, metavar="X,Y,Z,ROLL,PITCH,YAW")
    ] = None
    """Where the vehicle begins: scene metres, and degrees as alpha, beta and gamma of poses.csv. By default
    poses are relative to the first."""

    settings: Annotated[
        tuple[tuple[str, str], ...],
        Parameter(name="--set", converter=_settings, n_tokens=1, metavar="NAME=VALUE"),
    ] = ()
    """Settings of the method: NAME=VALUE,NAME=VALUE, or repeat. lidar settings lists them."""

    settings_file: Path | None = None
    """TOML file of settings; --set goes before it."""

    def __post_init__(self) -> None:
        """Validate the options."""
        take_values(self, error=InputError, readers={"settings": _taken_settings})
        others = [name for name in METHODS if name != "fused"]
        _check_words(self, method=METHODS, relative=("", "none", *others), imu_grade=("", *PRESETS))
        if self.method != "fused" and (self.relative or self.imu_grade):
            raise InputError("`relative` and `imu_grade` are for the `method` fused")
        if self.method == "fused" and self.start_pose is not None:
            raise InputError("`start_pose`: fused begins where the fixes are; leave it out")


class _OfFrames:
    """Base of options with ``frames``, a text FIRST:END."""

    __slots__ = ()
    frames: str

    @property
    def limits(self) -> tuple[int, float]:
        """The first frame, and the one after the last; infinity for all further ones.

        Raises InputError for another text.
        """
        if not re.fullmatch(r"(\d*:\d*)?", self.frames):
            raise InputError(f"`frames` {self.frames}: give FIRST:END, such as 100:200, 100: or :200")
        first, _, end = self.frames.partition(":")
        return int(first or 0), int(end) if end else math.inf


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class PlaybackOptions(_OfFrames):
    """Options of the page that plays a drive."""

    sensors: Annotated[tuple[str, ...], Parameter(name="--sensor"), SEVERAL] = ()
    """Names of scanners and of cameras to show; by default the first scanner and the first camera with
    images. Frames are those of the first scanner named."""

    frames: str = ""
    """FIRST:END: frames from FIRST up to, not including, END, either of which may be left out; all by
    default."""

    every: int | None = None
    """Show each n-th of these frames only; by default all, or as many as fit `max_mb`."""

    max_mb: Annotated[float, Parameter(name="--max-size")] = 40.0
    """Maximum size of the page in megabytes."""

    def __post_init__(self) -> None:
        """Validate the options."""
        take_values(self, error=InputError)
        _ = self.limits
        if self.every is not None and self.every < 1:
            raise InputError(f"`every` {self.every}: give 1 or more")
        _check_positive(self, max_mb=" of megabytes")


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class PlotOptions(_OfFrames):
    """Options of a figure of a dataset."""

    sensor: str = ""
    """Scanner or receiver; by default the first one, for coverage all scanners."""

    frames: str = ""
    """FIRST:END: frames from FIRST up to, not including, END, either of which may be left out; all by
    default. range-image shows the first of them."""

    resolution: float | None = None
    """Side of the cells of coverage in metres; by default as fits the picture."""

    def __post_init__(self) -> None:
        """Validate the options."""
        take_values(self, error=InputError)
        _ = self.limits
        _check_positive(self, resolution=" of metres")


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class FilmOptions(_OfFrames):
    """Options of a film of a dataset."""

    show: Annotated[str, Parameter(converter=_lower)] = "all"
    """What the film shows: sweep, cameras, map (which grows), or all of these that the dataset has."""

    view: Annotated[str, Parameter(converter=_lower)] = "chase"
    """Sweeps from behind the vehicle (chase) or from above (top)."""

    color: Annotated[str, Parameter(converter=_lower)] = "class"
    """What colours of returns show: class, height, intensity, time (in the sweep) or origin (where stages
    acted)."""

    sensors: Annotated[tuple[str, ...], Parameter(name="--sensor"), SEVERAL] = ()
    """Names of scanners and cameras to show; by default the first scanner and all cameras with images."""

    frames: str = ""
    """FIRST:END: frames from FIRST up to, not including, END, either of which may be left out; all by
    default. They are of the first scanner, or of the first camera in films of cameras only."""

    every: int = 1
    """Show each n-th of these frames only."""

    speed: float = 1.0
    """Seconds of the drive per second of the film."""

    size: Annotated[tuple[int, int], Parameter(converter=_pixels, n_tokens=1, metavar="WxH")] = (1280, 720)
    """Width and height of the film in pixels, both even."""

    def __post_init__(self) -> None:
        """Validate the options."""
        take_values(self, error=InputError)
        _check_words(self, show=SHOWN, view=FILM_VIEWS, color=FILM_COLORS)
        _ = self.limits
        if self.every < 1:
            raise InputError(f"`every` {self.every}: give 1 or more")
        _check_positive(self, speed="")
        if any(side % 2 or not 160 <= side <= 8192 for side in self.size):
            raise InputError(
                f"`size` {self.size[0]}x{self.size[1]}: give even numbers of pixels from 160 to 8192"
            )


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class EvaluateOptions:
    """Options of an evaluation of an estimate against the truth."""

    align: Annotated[str, Parameter(converter=_lower)] = "se3"
    """Motion of the estimated trajectory onto the true one: none, origin (first poses), se3 or sim3 (least
    squares, with scale), yaw-position (turn about z only)."""

    associate: Annotated[str, Parameter(converter=_lower)] = "interpolated"
    """Poses at the same times: interpolated (the truth at the estimate's times) or nearest."""

    max_gap: float | None = None
    """Seconds between poses of the truth that are interpolated (1 by default), or between matched poses
    (nearest: 0.01 by default), at most."""

    delta: Annotated[tuple[str, ...], WORDS] = ("1f", "10m", "100m")
    """Frames (1f) and metres of the true way (10m) of relative errors, separated by commas; those longer than
    the way are left out."""

    sensor: str = ""
    """Sensor whose poses the estimate holds, by default the vehicle; camera that tracks of MOT are of."""

    map_error: Annotated[bool, Parameter(negative=())] = False
    """Map the dataset's clouds with the aligned estimate, and measure the distances to the scene's true
    surfaces."""

    def __post_init__(self) -> None:
        """Validate the options."""
        take_values(self, error=InputError)
        _check_words(self, align=ALIGNMENTS, associate=("interpolated", "nearest"))
        if self.max_gap is not None and not 0 <= self.max_gap < math.inf:
            raise InputError(f"`max_gap` {self.max_gap:g}: give seconds, 0 or more")
        for word in self.delta:
            if not re.fullmatch(r"[1-9]\d{0,8}f|\d{1,9}(\.\d+)?m", word) or not float(word[:-1]):
                raise InputError(f"`delta` {word}: give frames or metres, such as 1f or 10m")


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class ConvertOptions:
    """Options of a conversion of a dataset."""

    to: Annotated[str, Parameter(help=_LAYOUTS)]

    def __post_init__(self) -> None:
        """Validate the options."""
        take_values(self, error=InputError)


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class ApplyOptions:
    """Options of stages on recorded data."""

    stages: Annotated[StageList, _STAGE] = ()
    """Stage to apply: NAME, NAME:KEY=VALUE,KEY=VALUE or a TOML file with tables [[stage]]; repeat for more.
    lidar stages lists them."""

    sensor: str = ""
    """Scanner of KITTI's or nuScenes' clouds: a preset or a TOML file; hdl64e_s2 or hdl32e by default."""

    weather: Annotated[StageList, _WEATHER] = ()
    """Weather for all sensors: rain=10mm/h, fog=50m (visibility), snow=2mm/h (as water), dust, spray, several
    separated by commas, or a TOML file with tables [[weather]]; repeat for more."""

    attacks: Annotated[StageList, _ATTACK] = ()
    """Attack on sensors: a TOML file with tables [[attack]], NAME or NAME:KEY=VALUE,KEY=VALUE; repeat for
    more. It acts after the weather and before other stages."""

    def __post_init__(self) -> None:
        """Validate the options."""
        take_values(self, error=InputError, readers=_STAGE_READERS)
        if not self.all_stages:
            raise InputError("give one or more of `stages`, `weather` and `attacks`")

    @property
    def all_stages(self) -> StageList:
        """Weather, attacks and other stages in the order in which they act."""
        return chosen_stages(self.weather, self.attacks, self.stages)


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class DefendOptions:
    """Options of defences on recorded data."""

    defences: Annotated[tuple[str, ...], Parameter(name="--defence"), NAMED]
    """Defences, separated by commas: NAME or NAME:KEY=VALUE,KEY=VALUE, or all that the data allow; or a TOML
    file with tables [[defence]]. lidar defences lists them."""

    scene: Path | None = None
    """Scene that the map defence compares with; by default the one that the dataset was driven in."""

    detector: str = "rules"
    """What gives the boxes of road users: rules, learned, or the file of a model (lidar train)."""

    fuse: Annotated[str, Parameter(converter=_lower)] = "harmonic"
    """Verdict of all defences together, if there are several: harmonic (mean of the shares of genuine data
    that are as suspicious), max (the least of them), fisher (all count, as if independent) or none."""

    calibrate: bool = False
    """Instead of judging, write the suspicions of these datasets, which must be genuine, to the TOML file
    --out, for --calibration."""

    calibration: Path | None = None
    """TOML file of thresholds and suspicions of genuine data; by default those of
    docs/reference/defences.md, for the detector rules."""

    seed: Annotated[int, Parameter(converter=whole)] = 0
    """Seed of the defences' random numbers and of the intervals."""

    def __post_init__(self) -> None:
        """Validate the options."""
        take_values(self, error=InputError)
        _check_words(self, fuse=FUSE)
        if self.calibrate and (self.fuse != "harmonic" or self.calibration is not None):
            raise InputError("`calibrate`: leave out `fuse` and `calibration`")
        _check_seed(self.seed)


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class SignOptions:
    """Options of signing and verifying."""

    watermark: Path | None = None
    """File with the secret key of the watermark: 16 bytes or more, also as hexadecimal digits."""

    chain: Path | None = None
    """File with the key of the hash chain: a secret as of a watermark (HMAC-SHA-256), or an Ed25519 key
    (PEM), of which the public one is enough to verify."""

    step: float = 0.05
    """Metres between coordinates of the same bit of the watermark; points move by at most half of it along
    each axis. The same to sign and to verify."""

    def __post_init__(self) -> None:
        """Validate the options."""
        take_values(self, error=InputError)


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class DenoiseOptions:
    """Options of filters on recorded clouds."""

    methods: Annotated[tuple[str, ...], Parameter(name="--method"), NAMED]
    """Filters, separated by commas: statistical, dror, dsor, lior, ddior; NAME or NAME:KEY=VALUE,KEY=VALUE.
    docs/reference/weather.md lists their parameters."""

    def __post_init__(self) -> None:
        """Validate the options."""
        take_values(self, error=InputError)


def classes_of(names: Iterable[str], *, option: str = "without") -> list[int]:
    """Codes of classes by name; ``vehicles`` stands for all of them, with and without riders.

    option : that names them, for errors

    Raises InputError for an unknown name.
    """
    vehicles = [k for k in Class if Class.CAR <= k <= Class.MOTORCYCLIST and k != Class.PEDESTRIAN]
    known = {k.name.lower(): [k] for k in Class} | {"vehicles": vehicles}
    for name in names:
        if name not in known:
            remedy = "lidar classes lists all names; vehicles is one, too"
            raise InputError(unknown_name(f"`{option}`", name, known=known, remedy=remedy))
    return [int(code) for name in names for code in known[name]]


def _add_digest(name: str | Path) -> str:
    """A name; for a file with a digest of its contents, so that a changed file changes the recipe."""
    path = Path(name)
    if not str(name) or not path.is_file():
        return str(name)
    return f"{name} ({recipe_digest(path.read_bytes())})"
