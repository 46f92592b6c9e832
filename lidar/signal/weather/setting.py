"""Settings of weather (a kind with its amount, place and time), from texts and from TOML files."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from math import cos, inf, isfinite, radians, sin
from typing import Any

from geoscene.support.registry import unknown_name
from lidar.errors import InputError
from lidar.parameters import Item, parameter, read_items, read_values
from lidar.signal.registry import STAGES, NamedStage, number_stages
from lidar.signal.stage import POSES, ROAD_USERS, Stage

_TEXTURE = 1.2  # mm of water that fill the texture of a road (Hahner et al. 2022)


@dataclass(frozen=True, slots=True)
class WeatherKind:
    """A kind of weather.

    unit      : of the amount
    meaning   : of the amount
    low, high : bounds of the amount, both allowed
    default   : amount of a text without one; None if it must be given
    media     : words for ``medium``, the default first
    """

    unit: str
    meaning: str
    low: float
    high: float
    default: float | None
    media: tuple[str, ...]


KINDS = {
    "rain": WeatherKind("mm/h", "rain rate", 0.0, 300.0, None, ("marshall-palmer", "large-drop")),
    "fog": WeatherKind(
        "m",
        "visibility at 2 % contrast",
        5.0,
        1e5,
        None,
        ("kim", "kruse", "advection", "radiation", "strong-advection", "moderate-advection", "chu-hogg"),
    ),
    "snow": WeatherKind(
        "mm/h",
        "snowfall rate as water",
        0.0,
        50.0,
        None,
        ("stallabrass", "gunn-marshall", "sekhon-srivastava", "itu-dry", "itu-wet"),
    ),
    "dust": WeatherKind("m", "visibility within the dust", 2.0, 1e5, 20.0, ("plumes", "even")),
    "spray": WeatherKind("mm", "depth of the water on the road", 0.0, 10.0, 1.0, ("plumes",)),
    "clear": WeatherKind("", "nothing", 0.0, 0.0, 0.0, ("air",)),
}
"""Kinds of weather; ``clear`` carries the sun, the cover glass and wet ground without anything in the air."""

MODELS = {
    "physical": tuple(KINDS),
    "lisa": ("rain", "snow", "fog"),
    "goodin": ("rain",),
    "hahner_fog": ("fog",),
    "hahner_snow": ("snow",),
}
"""Models of what lasers measure, and the kinds that each knows."""

_PUBLISHED = {"snow": "gunn-marshall"}
"""Media of published models, where they are not the first one of the kind."""


@dataclass(frozen=True)
class WeatherSetting(Stage):
    """Weather of one kind; several settings act one after the other, in the order given.

    Raises InputError for a value that is out of bounds or does not belong to the kind.
    """

    kind: str = parameter("rain", "what is in the air", among=tuple(KINDS))
    amount: float = parameter(
        10.0, "rain and snow: mm/h (as water); fog and dust: visibility, m; spray: mm of water on the road"
    )
    amount_to: float = parameter(-1.0, "amount at the end, approached linearly; -1: amount, all the time")
    start: float = parameter(0.0, "begin, since the drive's start", unit="s", low=0)
    end: float = parameter(inf, "end, since the drive's start", unit="s", low=0, endless="never")
    model: str = parameter("physical", "model of what lasers measure", among=tuple(MODELS))
    medium: str = parameter("", "law of extinction and sizes of the particles; of the kind if empty")
    longitude: float = parameter(0.0, "centre of the place, with radius", unit="degrees", low=-180, high=180)
    latitude: float = parameter(0.0, "centre of the place, with radius", unit="degrees", low=-90, high=90)
    radius: float = parameter(0.0, "radius of the place; 0: everywhere", unit="m", low=0, high=1e6)
    polygon: str = parameter("", "the place as 'LON LAT, LON LAT, ...', degrees; everywhere if empty")
    edge: float = parameter(
        0.0, "distance over which the weather fades in at the place's edge", unit="m", low=0, high=1e5
    )
    wind: float = parameter(0.0, "wind speed", unit="m/s", low=0, high=60)
    wind_from: float = parameter(270.0, "direction that the wind comes from", unit="degrees", low=0, high=360)
    wetness: float = parameter(-1.0, "wetness of surfaces, 0 to 1; -1: of the kind", low=-1, high=1)
    snow_cover: float = parameter(-1.0, "share of ground under snow; -1: of the kind", low=-1, high=1)
    lens: float = parameter(
        30.0,
        "diameter of the receiver's lens, which blurs what is near; 0: none",
        unit="mm",
        low=0,
        high=1000,
    )
    drops: float = parameter(0.0, "share of the cover glass under drops of water", low=0, high=1)
    dirt: float = parameter(0.0, "share of light that dirt on the cover glass absorbs", low=0, high=0.99)
    sunlight: float = parameter(
        0.0, "direct sunlight, which dazzles the detector", unit="lux", low=0, high=150_000
    )

    def __post_init__(self) -> None:
        """Validate the parameters, and fill in the medium of the kind."""
        super().__post_init__()
        kind = KINDS[self.kind]
        if not self.medium:
            published = _PUBLISHED.get(self.kind) if self.model != "physical" else None
            object.__setattr__(self, "medium", published or kind.media[0])
        if faults := _faults(self, kind):
            raise InputError("; ".join(faults))

    def drift(self, seconds: float) -> tuple[float, float]:
        """Metres east and north that the wind carries the air in a time."""
        bearing, away = radians(self.wind_from), -self.wind * seconds
        return away * sin(bearing), away * cos(bearing)

    @property
    def settings(self) -> tuple[tuple[str, str], ...]:
        """Weak echoes are lost; clouds, wet ground and snow belong to the kind unless they are told.

        Published models of point clouds know dry ground.
        """
        if self.model != "physical":
            return (("link", "on"),)
        amount, wetness, snow = max(self.amount, self.amount_to), self.wetness, self.snow_cover
        if wetness < 0:
            wetness = {"rain": 0.5 + amount / 20, "snow": 0.3, "spray": amount / _TEXTURE}.get(self.kind, 0.0)
            wetness *= amount > 0
        if snow < 0:
            snow = amount / 4 if self.kind == "snow" else 0.0
        cloud = float(self.kind in ("rain", "snow", "fog", "spray"))
        implied = {"cloud": cloud, "wetness": wetness, "snow": snow}
        return (("link", "on"), *((name, f"{min(x, 1.0):g}") for name, x in implied.items() if x > 0))

    @property
    def image_kinds(self) -> tuple[str, ...]:
        """The air's light depends on the distance."""
        return ("depth",)

    @property
    def requires(self) -> tuple[str, ...]:
        """Road users for spray, poses and time for weather over time and place, plumes and the sun."""
        if self.kind == "spray":
            return (ROAD_USERS, POSES)
        passing = self.start > 0 or self.end < inf
        placed = self.radius or self.polygon or self.sunlight or self.medium == "plumes"
        return (POSES,) if passing or placed else ()

    def amount_at(self, seconds: float) -> float | None:
        """The amount at a time since the drive's start; None before and after the weather.

        Visibilities change so that their reciprocal, the extinction, is linear in time.
        """
        if not self.start <= seconds < self.end:
            return None
        if self.amount_to < 0:
            return self.amount
        share = (seconds - self.start) / (self.end - self.start)
        if KINDS[self.kind].unit == "m":
            return 1 / ((1 - share) / self.amount + share / self.amount_to)
        return (1 - share) * self.amount + share * self.amount_to

    def corners(self) -> list[tuple[float, float]]:
        """Longitude and latitude of the place's corners; empty without a polygon."""
        pairs = [pair.split() for pair in self.polygon.split(",")] if self.polygon else []
        return [(float(lon), float(lat)) for lon, lat in pairs]


def _faults(setting: WeatherSetting, kind: WeatherKind) -> list[str]:
    """What is wrong with a setting whose values are each of their type."""
    faults = []
    amounts = {"amount": setting.amount}
    if setting.amount_to != -1:
        amounts["amount_to"] = setting.amount_to
    bounds = f"within {kind.low:g} to {kind.high:g}" if kind.high else "0: it has no amount"
    faults += [
        f"{name} = {value:g} {kind.unit}".rstrip() + f" of {setting.kind} is not {bounds}"
        for name, value in amounts.items()
        if not kind.low <= value <= kind.high
    ]
    if setting.medium not in kind.media:
        faults.append(f"medium = {setting.medium!r} of {setting.kind} is none of {', '.join(kind.media)}")
    if setting.kind not in MODELS[setting.model]:
        known = [name for name, kinds in MODELS.items() if setting.kind in kinds]
        faults.append(f"model {setting.model} has no {setting.kind}; {setting.kind} has {', '.join(known)}")
    if setting.end <= setting.start:
        faults.append(f"end = {setting.end:g} is not after start = {setting.start:g}")
    if setting.amount_to >= 0 and setting.end == inf:
        faults.append("amount_to needs an end")
    if setting.polygon and setting.radius:
        faults.append("a place is a polygon or a centre with radius, not both")
    if setting.edge and not (setting.radius or setting.polygon):
        faults.append("edge belongs to a place: a polygon or a centre with radius")
    if setting.polygon:
        faults += _polygon_faults(setting)
    return faults


def _polygon_faults(setting: WeatherSetting) -> list[str]:
    """What is wrong with the polygon of a setting."""
    from shapely import Polygon  # noqa: PLC0415  (0.1 s)

    try:
        corners = setting.corners()
    except ValueError:
        return [f"polygon = {setting.polygon!r} is not 'LON LAT, LON LAT, ...' in degrees"]
    if any(not (abs(lon) <= 180 and abs(lat) <= 90) for lon, lat in corners):
        return ["polygon has corners that are not longitude and latitude in degrees"]
    if len(corners) < 3 or not Polygon(corners).is_valid:
        return ["polygon needs three or more corners, and its sides may not cross"]
    return []


_UNITS = {
    "mm/h": {"mm/h": 1.0, "cm/h": 10.0},
    "m": {"m": 1.0, "km": 1000.0},
    "mm": {"mm": 1.0, "cm": 10.0},
    "": {},
}
_OF_FILES = ("from", "to", "centre", "interpolation")
_CENTRE = {"longitude", "latitude", "radius"}
_AMOUNT = re.compile(r"\s*([-+]?[\d.]+(?:[eE][-+]?\d+)?)\s*(\S*)\s*")


def read_weather(text: str) -> tuple[NamedStage, ...]:
    """Stages of weather from a text such as ``rain=10mm/h``, ``fog=50m,medium=radiation`` or ``FILE.toml``.

    A text names one or more kinds, separated by commas, each followed by its parameters; ``rain=10mm/h`` is
    short for ``rain:amount=10mm/h``. A file has a table ``[[weather]]`` for each setting, with ``kind``,
    ``amount``, optionally ``from`` and ``to`` (seconds), ``polygon`` ([[lon, lat], ...]) or ``centre``
    ([lon, lat]) and ``radius`` (metres), ``interpolation`` (``step`` or ``linear``, which goes to
    ``amount_to``), and the other parameters of `WeatherSetting`.

    Raises InputError for what cannot be read.
    """
    found = []
    for item in read_items([text], KINDS, table="weather", key="kind", main="amount"):
        where = item.source or f"weather {text!r}: "
        try:
            found.append(_stage(item, _flat(item.values) if item.source else item.values))
        except InputError as error:
            raise InputError(f"{where}{error}") from None
    return number_stages(found)


def _flat(table: Mapping[str, Any]) -> dict[str, Any]:
    """The values of a table of a file, by the parameters of `WeatherSetting`."""
    row = {{"from": "start", "to": "end"}.get(key, key): value for key, value in table.items()}
    if "centre" in row:
        centre = row.pop("centre")
        if not _is_pair(centre) or "radius" not in row:
            raise InputError("centre is [longitude, latitude] in degrees, with a radius in metres")
        row["longitude"], row["latitude"] = centre
    if isinstance(row.get("polygon"), list):
        if not all(_is_pair(corner) for corner in row["polygon"]):
            raise InputError("polygon is [[longitude, latitude], ...] in degrees")
        row["polygon"] = ", ".join(f"{lon!r} {lat!r}" for lon, lat in row["polygon"])
    way = row.pop("interpolation", "linear" if "amount_to" in row else "step")
    if way not in ("step", "linear") or (way == "linear") != ("amount_to" in row):
        raise InputError("interpolation is step, or linear with amount_to")
    return row


def _is_pair(value: Any) -> bool:
    return (
        isinstance(value, list)
        and len(value) == 2
        and all(isinstance(x, int | float) and isfinite(x) for x in value)
    )


def _stage(item: Item, given: Mapping[str, Any]) -> NamedStage:
    """The stage of a kind of weather and the parameters that are given for it."""
    if item.name not in KINDS:
        raise InputError(unknown_name("kind", item.name, known=KINDS))
    if missing := _CENTRE - given.keys() if _CENTRE & given.keys() else ():
        raise InputError(f"a centre needs longitude, latitude and radius; {min(missing)} is missing")
    if "kind" in given:
        raise InputError("kind is given twice")
    kind, model = KINDS[item.name], str(given.get("model", "physical"))
    if model not in MODELS:
        raise InputError(unknown_name("model", model, known=MODELS))
    if "amount" not in given and kind.default is None:
        raise InputError(f"{item.name} needs an amount ({kind.meaning}, {kind.unit})")
    values = {"kind": item.name, "amount": kind.default, **given}
    for name in ("amount", "amount_to"):
        if isinstance(values.get(name), str):
            values[name] = _amount(values[name], item.name)
    name = "weather" if model == "physical" else "weather_model"
    stage = STAGES[name]
    return NamedStage(name, stage(**read_values(stage, values, also=_OF_FILES if item.source else ())))


def _amount(text: str, kind: str) -> float:
    """An amount in the unit of its kind, from a number with or without a unit."""
    unit = KINDS[kind].unit
    found = _AMOUNT.fullmatch(text)
    factors = {"": 1.0, **_UNITS[unit]}
    if not found or found[2] not in factors:
        raise InputError(
            f"amount {text!r} of {kind} is not a number in {' or '.join(_UNITS[unit]) or 'no unit'}"
        )
    try:
        return float(found[1]) * factors[found[2]]
    except ValueError:
        raise InputError(f"amount {text!r} of {kind} is not a number") from None
