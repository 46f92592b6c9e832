"""Registry of stages; reads stages from text, TOML files and recipes."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from difflib import get_close_matches
from importlib import import_module
from pathlib import Path
from typing import Any, cast

import numpy as np

from geoscene.support.untrusted import read_toml
from lidar.errors import InputError
from lidar.geometry.random_streams import generator
from lidar.signal.effects import Counts
from lidar.signal.stage import Stage, parameter_rows

_STAGES = {
    "cover_glass": "signal.cover_glass.CoverGlass",
    "dropped_packets": "signal.dropped_packets.DroppedPackets",
    "lost_rows": "signal.lost_rows.LostRows",
    "inject": "signal.attacks.inject.Inject",
    "replay": "signal.attacks.replay.Replay",
    "relay": "signal.attacks.relay.Relay",
    "remove": "signal.attacks.remove.Remove",
    "placed_object": "signal.attacks.placed_object.PlacedObject",
    "high_frequency_removal": "signal.attacks.high_frequency_removal.HighFrequencyRemoval",
    "perturb": "signal.attacks.points.Perturb",
    "insert": "signal.attacks.points.Insert",
    "delete": "signal.attacks.points.Delete",
    "move": "signal.attacks.points.Move",
    "false_weather": "signal.attacks.points.FalseWeather",
    "gnss_spoof": "signal.attacks.poses.GnssSpoof",
    "camera_blind": "signal.attacks.images.CameraBlind",
    "patch": "signal.attacks.images.Patch",
    "weather": "signal.weather.stage.Weather",
    "weather_model": "signal.weather.model_stage.WeatherModel",
}
"""Module within `lidar` and class, by name."""

SEAMS = {
    "echoes": "lidar",
    "cloud": "lidar",
    "image": "camera",
    "fixes": "gnss",
    "samples": "imu",
    "scene": "scene",
}
"""Kind of sensor of each seam; a stage has a method of that name for each seam that it acts on."""


@dataclass(frozen=True, slots=True)
class NamedStage:
    """A stage that is switched on.

    seed   : of its random numbers; the drive's if None
    sensor : name of the only sensor that it acts on; all if empty
    number : of earlier stages with the same name
    """

    name: str
    stage: Stage
    seed: int | None = None
    sensor: str = ""
    number: int = 0

    def rng(self, seed: int, sensor: str, *, frame: int | str) -> np.random.Generator:
        """The random numbers for a frame of a sensor; ``seed`` is the drive's."""
        own = seed if self.seed is None else self.seed
        return generator(own, "stage", self.name, self.number, sensor, frame)

    @property
    def label(self) -> str:
        """Its name, and its number if an earlier stage has the same."""
        return f"{self.name} {self.number + 1}" if self.number else self.name

    def to_json(self) -> dict[str, Any]:
        """What `read_stage` reads."""
        extra = {"seed": self.seed, "sensor": self.sensor}
        return {
            "name": self.name,
            **asdict(self.stage),
            **{k: v for k, v in extra.items() if v not in (None, "")},
        }


@dataclass(frozen=True, slots=True)
class Stages:
    """Stages in the order in which they act.

    seed   : of the drive
    before : stages that have acted on recorded data, as far as they take light from what is sent now
    """

    stages: tuple[NamedStage, ...] = ()
    seed: int = 0
    before: tuple[NamedStage, ...] = ()

    def at(self, seam: str, sensor: str) -> list[NamedStage]:
        """The stages that act on a seam of a sensor."""
        return [s for s in self.stages if s.sensor in ("", sensor) and hasattr(s.stage, seam)]

    def act_on(self, sensor: str, *, kind: str) -> bool:
        """Whether any stage acts on a sensor of a kind of `SEAMS`."""
        return any(self.at(seam, sensor) for seam, of in SEAMS.items() if of == kind)

    @property
    def lookback_ns(self) -> int:
        """Nanoseconds before a frame whose clouds the stages ask for."""
        return max((math.ceil(named.stage.lookback * 1e9) for named in self.stages), default=0)

    def check(self, sensors: Mapping[str, str], *, known: Collection[str] = ()) -> None:
        """Raise InputError for a stage that acts on none of the sensors, or needs what is not known.

        sensors : kind by name
        known   : of `POSES`, `ROAD_USERS` and `LABELS`
        """
        for named in self.stages:
            if missing := [need for need in named.stage.requires if need not in known]:
                raise InputError(f"stage {named.name} needs {missing[0]}, of which nothing is known here")
            if named.sensor and named.sensor not in sensors:
                raise InputError(
                    f"stage {named.name}: no sensor {named.sensor!r}; there are {', '.join(sensors)}"
                )
            kinds = {of for seam, of in SEAMS.items() if hasattr(named.stage, seam)}
            if not any(kinds & {kind} for name, kind in sensors.items() if named.sensor in ("", name)):
                raise InputError(
                    f"stage {named.name} acts on a {' or '.join(sorted(kinds))}, and there is none"
                )

    def check_start(self, sensors: Mapping[str, str], *, last: Mapping[str, float]) -> None:
        """Raise InputError for a stage that starts when all sensors that it acts on have measured.

        sensors : kind by name
        last    : start of the last frame, or last measurement, seconds since the drive's start, by name
        """
        for named in self.stages:
            start, alone = getattr(named.stage, "start", 0.0), Stages((named,))
            ends = [last[name] for name, kind in sensors.items() if alone.act_on(name, kind=kind)]
            if ends and start > max(ends):
                raise InputError(
                    f"stage {named.name}: start = {start:g} s is after the last measurement, at"
                    f" {max(ends):g} s (clouds of KITTI and nuScenes count as of 0 s); let it start earlier"
                )

    def effects(self, counts: Counts) -> Counts:
        """What each of them did, nothing of those that are not in ``counts``; not of objects in the scene."""
        seams = SEAMS.keys() - {"scene"}
        acting = [named for named in self.stages if any(hasattr(named.stage, seam) for seam in seams)]
        return {named.label: counts.get(named.label, {}) for named in acting}


NO_STAGES = Stages()


def stage_class(name: str) -> type[Stage]:
    """The class of a stage; raises InputError if the name is unknown."""
    if name not in _STAGES:
        near = get_close_matches(name, _STAGES, 1)
        hint = f"; is {near[0]} meant?" if near else ""
        raise InputError(f"stage {name!r} is unknown{hint} (known are {', '.join(_STAGES)})")
    module, _, kind = _STAGES[name].rpartition(".")
    return cast("type[Stage]", getattr(import_module(f"lidar.{module}"), kind))


def attack_names() -> list[str]:
    """Names of the stages that are attacks."""
    return [name for name, place in _STAGES.items() if place.startswith("signal.attacks.")]


def read_stage(table: Mapping[str, Any]) -> NamedStage:
    """A stage from its name, its parameters and optionally ``seed`` and ``sensor``.

    Raises InputError for a stage or parameter that is unknown, or a value out of its bounds.
    """
    name = table.get("name")
    if not isinstance(name, str):
        raise InputError("a stage has no name")
    kind = stage_class(name)
    values = {key: value for key, value in table.items() if key not in ("name", "seed", "sensor")}
    known = [f.name for f in fields(kind)]
    if unknown := [key for key in values if key not in known]:
        raise InputError(
            f"stage {name}: no parameter {unknown[0]!r} (known are {', '.join([*known, 'seed', 'sensor'])})"
        )
    seed, sensor = table.get("seed"), table.get("sensor", "")
    if seed is not None and (type(seed) is not int or not 0 <= seed < 1 << 63):
        raise InputError(f"stage {name}: seed = {seed!r} is not a whole number of 0 or more")
    if not isinstance(sensor, str):
        raise InputError(f"stage {name}: sensor = {sensor!r} is not a name")
    try:
        return NamedStage(name, kind(**values), seed, sensor)
    except InputError as error:
        raise InputError(f"stage {name}: {error}") from None


def read_stages(texts: Iterable[str], *, seed: int = 0) -> Stages:
    """Stages from texts ``NAME``, ``NAME:KEY=VALUE,KEY=VALUE`` or ``FILE.toml`` with tables ``[[stage]]``.

    Raises InputError as `read_stage` does, and for a file that cannot be read.
    """
    return Stages(number_stages(_read_all(texts, "stage")), seed)


def read_attacks(texts: Iterable[str]) -> tuple[NamedStage, ...]:
    """Attacks from texts as `read_stages` reads them, and from files with tables ``[[attack]]``.

    Raises InputError as `read_stages` does, and for a stage that is no attack.
    """
    return number_stages(_read_all(texts, "attack"))


def stages_of(tables: Iterable[Mapping[str, Any]], *, seed: int = 0) -> Stages:
    """Stages from tables as `read_stage` reads them."""
    return Stages(number_stages(map(read_stage, tables)), seed)


def number_stages(stages: Iterable[NamedStage], *, after: Sequence[str] = ()) -> tuple[NamedStage, ...]:
    """Stages in the order in which they act, each with the number of earlier ones of the same name.

    after : names of stages that have acted on the data before
    """
    found: list[NamedStage] = []
    names = list(after)
    for named in stages:
        found.append(replace(named, number=names.count(named.name)))
        names.append(named.name)
    return tuple(found)


def dimming(tables: Iterable[Mapping[str, Any]]) -> tuple[NamedStage, ...]:
    """Those of some stages, as `NamedStage.to_json` writes them, that take light: weather."""
    known = [table for table in tables if table["name"] in _STAGES]
    return tuple(
        read_stage(table)
        for table in known
        if hasattr(stage_class(table["name"]), "echoes")
        and stage_class(table["name"]).clearness is not Stage.clearness
    )


def acts_on(table: Mapping[str, Any], sensor: str, *, kind: str) -> bool:
    """Whether a stage, as `NamedStage.to_json` writes it, acts on a sensor of a kind of `SEAMS`."""
    if table.get("sensor", "") not in ("", sensor) or table["name"] not in _STAGES:
        return False
    stage = stage_class(table["name"])
    return any(hasattr(stage, seam) for seam, of in SEAMS.items() if of == kind)


def _read_all(texts: Iterable[str], kind: str) -> list[NamedStage]:
    """Stages from texts, and from files with tables ``[[kind]]``; an error names the file and the table."""
    found = []
    for text in texts:
        if not text.endswith(".toml"):
            found.append(_read_kind(_text_table(text), kind))
            continue
        for number, table in enumerate(_file_tables(Path(text), kind), 1):
            try:
                found.append(_read_kind(table, kind))
            except InputError as error:
                raise InputError(f"{text}: [[{kind}]] {number}: {error}") from None
    return found


def _read_kind(table: Mapping[str, Any], kind: str) -> NamedStage:
    """A stage from a table; raises InputError, also for a stage that is no attack where attacks are read."""
    named = read_stage(table)
    if kind == "attack" and named.name not in attack_names():
        raise InputError(f"stage {named.name} is no attack (attacks are {', '.join(attack_names())})")
    return named


def _file_tables(path: Path, kind: str) -> list[Mapping[str, Any]]:
    try:
        document = read_toml(path.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read as TOML ({error})") from None
    tables = document.pop(kind, None)
    if document or not tables or not isinstance(tables, list) or not all(isinstance(t, dict) for t in tables):
        raise InputError(f"{path}: give tables [[{kind}]] with a name and parameters, and nothing else")
    return tables


def _text_table(text: str) -> Mapping[str, Any]:
    name, _, rest = text.partition(":")
    kinds = {f.name: type(f.default) for f in fields(stage_class(name.strip()))} | {
        "seed": int,
        "sensor": str,
    }
    table: dict[str, Any] = {"name": name.strip()}
    key = ""
    for pair in filter(None, rest.split(",")):
        left, equals, value = (part.strip() for part in pair.partition("="))
        if equals:
            key = left
            if key in table:
                raise InputError(f"stage {text}: {key} is given twice")
            table[key] = _value(value, kinds.get(key, str))
        elif key and kinds.get(key) is str:
            table[key] += f",{left}"  # a value with commas, such as a place
        else:
            raise InputError(f"stage {text}: give NAME:KEY=VALUE,KEY=VALUE")
    return table


def _value(text: str, kind: type) -> Any:
    """A value of a kind; the text itself, which `Stage` refuses, if it is none."""
    if kind is bool:
        return {"true": True, "on": True, "false": False, "off": False}.get(text.lower(), text)
    try:
        return kind(text)
    except ValueError:
        return text


def stage_rows() -> list[dict[str, Any]]:
    """Name, seams, meaning and parameters of every stage."""
    rows = []
    for name in _STAGES:
        kind = stage_class(name)
        seams = [seam for seam in SEAMS if hasattr(kind, seam)]
        meaning = (kind.__doc__ or "").partition("\n")[0]
        rows.append({"name": name, "acts_on": seams, "meaning": meaning, "parameters": parameter_rows(kind)})
    return rows
