"""Registry of stages; reads stages from text, TOML files and recipes."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from geoscene.support.registry import Registry
from lidar.errors import InputError
from lidar.geometry.random_streams import generator
from lidar.parameters import Item, build, item_of, parameter_rows, read_items
from lidar.signal.situation import Counts
from lidar.signal.stage import Stage

_ATTACKS = {
    "inject": "lidar.signal.attacks.inject:Inject",
    "replay": "lidar.signal.attacks.replay:Replay",
    "relay": "lidar.signal.attacks.replay:Relay",
    "remove": "lidar.signal.attacks.remove:Remove",
    "placed_object": "lidar.signal.attacks.placed_object:PlacedObject",
    "high_frequency_removal": "lidar.signal.attacks.remove:HighFrequencyRemoval",
    "perturb": "lidar.signal.attacks.points:Perturb",
    "insert": "lidar.signal.attacks.points:Insert",
    "delete": "lidar.signal.attacks.points:Delete",
    "move": "lidar.signal.attacks.points:Move",
    "false_weather": "lidar.signal.attacks.points:FalseWeather",
    "gnss_spoof": "lidar.signal.attacks.poses:GnssSpoof",
    "camera_blind": "lidar.signal.attacks.images:CameraBlind",
    "patch": "lidar.signal.attacks.images:Patch",
}

ATTACKS: Registry[type[Stage]] = Registry("attack", _ATTACKS, error=InputError)
"""Classes of the stages that are attacks, by name."""

STAGES: Registry[type[Stage]] = Registry(
    "stage",
    {
        "cover_glass": "lidar.signal.faults:CoverGlass",
        "dropped_packets": "lidar.signal.faults:DroppedPackets",
        "lost_rows": "lidar.signal.faults:LostRows",
        **_ATTACKS,
        "weather": "lidar.signal.weather.stage:Weather",
        "weather_model": "lidar.signal.weather.stage:WeatherModel",
    },
    error=InputError,
)
"""Classes of all stages by name."""

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
        """The table that `read_stage` reads."""
        extra = {"seed": self.seed, "sensor": self.sensor}
        return {
            "name": self.name,
            **{k: "never" if v == math.inf else v for k, v in asdict(self.stage).items()},  # JSON has no inf
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


def read_stage(table: Mapping[str, Any]) -> NamedStage:
    """A stage from its name, its parameters and optionally ``seed`` and ``sensor``.

    Raises InputError for a stage or parameter that is unknown, or a value out of its bounds.
    """
    return _build_stage(item_of(table))


def read_stages(texts: Iterable[str], *, seed: int = 0) -> Stages:
    """Stages from texts ``NAME:KEY=VALUE,KEY=VALUE,NAME,...``, and from files with tables ``[[stage]]``.

    Raises InputError as `read_stage` does, and for a file that cannot be read.
    """
    items = read_items(texts, STAGES, table="stage")
    return Stages(number_stages(map(_build_stage, items)), seed)


def read_attacks(texts: Iterable[str]) -> tuple[NamedStage, ...]:
    """Attacks from texts as `read_stages` reads them, and from files with tables ``[[attack]]``.

    Raises InputError as `read_stages` does, and for a stage that is no attack.
    """
    items = read_items(texts, ATTACKS, table="attack")
    return number_stages(_build_stage(item, ATTACKS) for item in items)


def _build_stage(item: Item, registry: Registry[type[Stage]] = STAGES) -> NamedStage:
    """A stage from its name and values; raises InputError."""
    values = dict(item.values)
    seed, sensor = values.pop("seed", None), values.pop("sensor", "")
    seed = int(seed) if isinstance(seed, str) and seed.isdecimal() else seed
    stage = build(registry, replace(item, values=values), also=("seed", "sensor"))
    where = f"{item.source}{registry.what} {item.name}"
    if seed is not None and (type(seed) is not int or not 0 <= seed < 1 << 63):
        raise InputError(f"{where}: seed = {seed!r} is not a whole number of 0 or more")
    if not isinstance(sensor, str):
        raise InputError(f"{where}: sensor = {sensor!r} is not a name")
    return NamedStage(item.name, stage, seed, sensor)


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
    known = [(table, STAGES[table["name"]]) for table in tables if table["name"] in STAGES]
    return tuple(
        read_stage(table)
        for table, kind in known
        if hasattr(kind, "echoes") and kind.clearness is not Stage.clearness
    )


def acts_on(table: Mapping[str, Any], sensor: str, *, kind: str) -> bool:
    """Whether a stage, as `NamedStage.to_json` writes it, acts on a sensor of a kind of `SEAMS`."""
    if table.get("sensor", "") not in ("", sensor) or table["name"] not in STAGES:
        return False
    stage = STAGES[table["name"]]
    return any(hasattr(stage, seam) for seam, of in SEAMS.items() if of == kind)


def stage_rows() -> list[dict[str, Any]]:
    """Name, seams, meaning and parameters of every stage."""
    rows = []
    for name, kind in STAGES.items():
        seams = [seam for seam in SEAMS if hasattr(kind, seam)]
        meaning = (kind.__doc__ or "").partition("\n")[0]
        rows.append({"name": name, "acts_on": seams, "meaning": meaning, "parameters": parameter_rows(kind)})
    return rows
