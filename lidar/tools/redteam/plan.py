"""Description of a matrix of attacks and defences, a TOML file; published results to compare it with."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from geoscene.errors import reading
from geoscene.support.registry import unknown_name
from geoscene.support.untrusted import read_toml
from lidar.errors import InputError
from lidar.parameters import check_parameters, parameter, read_values
from lidar.tools.defences.registry import NamedDefence, read_defences
from lidar.tools.detection import RULES
from lidar.tools.detection.learned import read_detector
from lidar.tools.sweep.grid import GridDrive, drives_of, naming, text_of

GOALS = ("forge", "hide", "mislead")
"""What an attack is for: an object that is not there, one that is not found, or a false position."""

_TABLES = ("drive", "grid", "map", "attack", "defences", "measure")
_KEYS = ("name", "attack", "goal", "published")
_POOLED = ("seed", "attack")
"""Options of the grid that are no conditions: seeds are repetitions."""


@dataclass(frozen=True, slots=True)
class PublishedResult:
    """A published result of another detector, sensor and data: a band to compare with, no value to reach.

    text      : what it is of
    source    : where it is from
    low, high : shares that bound it; equal for a single value, None if the source gives none
    """

    text: str
    source: str
    low: float | None = None
    high: float | None = None


PUBLISHED_ATTACKS = {
    "adv-lidar": PublishedResult(
        "white-box phantom of 60 points 5 m ahead, success about 75 %", "Cao et al. 2019", 0.75, 0.75
    ),
    "black-box": PublishedResult(
        "traces of occluded and far cars, 200 points at 5 to 8 m, mean success about 80 %",
        "Sun et al. 2020",
        low=0.8,
        high=0.8,
    ),
    "object-removal": PublishedResult(
        "200 points moved outwards by 2 m; loss of recall depends on the detector", "Hau et al. 2021"
    ),
    "physical-removal": PublishedResult(
        "removal of 90 % of a target's points, success 92.7 %", "Cao et al. 2023", 0.927, 0.927
    ),
    "high-frequency": PublishedResult(
        "at least 96 % of the points in the window removed; no success rate is stated",
        "Sato et al. 2024, 2025",
    ),
    "pla": PublishedResult(
        "up to 4200 points in 30 x 30 degrees, positions within 0.1 m; no success rate is stated",
        "Jin et al. 2023",
    ),
    "wraith": PublishedResult(
        "ghost over several frames; the best earlier defences remove fewer than 30 % of forged cars",
        "arXiv 2303.09731",
    ),
}
"""Success of attacks, by key of the option ``published``."""

PUBLISHED_DEFENCES = {
    "occlusion": PublishedResult(
        "CARLO lowers the mean success of black-box forgery from 80 % to 5.5 %", "Sun et al. 2020"
    ),
    "shadow": PublishedResult(
        "Shadow-Catcher: accuracy over 94 %, 3 to 21 ms per object", "Hau et al. 2020", low=0.94
    ),
    "temporal": PublishedResult(
        "3D-TC2: over 98 % of the attacks, 41 Hz; ADoPT: over 85 % at under 10 % false alarms",
        "You et al. 2021",
        low=0.98,
    ),
    "void": PublishedResult(
        "fake shadow detection: alarm over 15 cubic metres without an occluder", "Cao et al. 2023"
    ),
}
"""Detection of attacks, by defence."""


@dataclass(frozen=True, slots=True)
class Attack:
    """An attack of the matrix.

    name      : as in the report
    option    : the value of ``--attack``
    goal      : of `GOALS`
    published : key of `PUBLISHED_ATTACKS`; empty for none
    """

    name: str
    option: str
    goal: str
    published: str = ""


@dataclass(frozen=True, slots=True)
class Measure:
    """Parameters of the evaluation of a matrix.

    detector : what reports road users, as for `lidar.tools.detection.learned.read_detector`; several are
               measured on the same drives and stand side by side

    Raises InputError for values that are out of bounds.
    """

    score: float = parameter(0.3, "score of a detection from which on it counts", low=1e-6, high=1 - 1e-6)
    false_alarms: float = parameter(
        0.05, "share of the genuine frames that may be alarmed", low=1e-6, high=1 - 1e-6
    )
    false_objects: float = parameter(
        0.01, "share of the genuine objects that may be alarmed", low=1e-6, high=1 - 1e-6
    )
    deviation: float = parameter(
        0.85,
        "distance of a fix from the genuine one from which on the vehicle is misled; a car that is 1.8 m wide"
        " in the middle of a lane of 3.5 m is 0.85 m from its edge",
        unit="m",
        low=0.01,
        high=1e6,
    )
    block: float = parameter(
        1.0, "time of a drive that counts as one independent trial", unit="s", low=0.1, high=600
    )
    detector: tuple[str, ...] = (RULES.name,)

    def __post_init__(self) -> None:
        """Validate the values."""
        check_parameters(self)
        if not self.detector or len(set(self.detector)) < len(self.detector):
            raise InputError("detector: give one or more that differ")
        for name in self.detector:
            read_detector(name)


@dataclass(frozen=True, slots=True)
class Run:
    """One drive of the matrix.

    drive      : to record
    attack     : None for the drive without attack
    conditions : values of the grid's other options, without the seed
    twin       : name of the drive that differs by the attack alone
    """

    drive: GridDrive
    attack: Attack | None
    conditions: dict[str, str]
    twin: str


@dataclass(frozen=True, slots=True)
class RedteamPlan:
    """A matrix of attacks, defences and conditions."""

    runs: tuple[Run, ...]
    attacks: tuple[Attack, ...]
    defences: tuple[NamedDefence, ...]
    measure: Measure


def read_plan(path: Path) -> RedteamPlan:
    """The matrix that a file describes.

    Tables ``drive``, ``grid`` and ``map`` are those of a sweep; each drive is made without attack and with
    each attack of the tables ``[[attack]]`` (``name``, ``attack``: the value of ``lidar drive --attack``,
    ``goal``: of `GOALS`, ``published``: what to compare with). Table ``defences`` has ``use``, a list of
    defences as for ``lidar defend``; table ``measure`` has the fields of `Measure`.

    Raises InputError, which names the file and what in it has the error.
    """
    with reading(path, InputError, remedy="give a TOML file with [grid] and [[attack]]", known=InputError):
        document = read_toml(path.read_text("utf-8-sig"))
    if unknown := sorted(set(document) - set(_TABLES)):
        raise InputError(f"{path}: {unknown_name('table', unknown[0], known=_TABLES)}")
    attacks = _attacks(path, document.get("attack", []))
    with naming(path, "defences"):
        defences = _defences(document.get("defences", {}))
    with naming(path, "measure"):
        measure = _measure(document.get("measure", {}))
    tables = {name: document[name] for name in ("drive", "map") if name in document}
    grids = document.get("grid", {})
    grids = grids if isinstance(grids, list) else [grids]
    for name in [name for table in (document.get("drive", {}), *grids) for name in table]:
        if name == "attack":
            raise InputError(f"{path}: attack is an option of the tables [[attack]], not of drives")
    options = {"attack": ["", *(attack.option for attack in attacks)]}
    drives = drives_of(tables | {"grid": [{**grid, **options} for grid in grids]}, path)
    return RedteamPlan(tuple(_runs(drives, attacks)), attacks, defences, measure)


def _attacks(path: Path, tables: Any) -> tuple[Attack, ...]:
    if not isinstance(tables, list) or not tables or not all(isinstance(table, dict) for table in tables):
        raise InputError(f"{path}: no attacks; add tables [[attack]] with a name, an attack and a goal")
    found: dict[str, Attack] = {}
    for number, table in enumerate(tables, 1):
        what = f"attack {table.get('name') or number}"
        with naming(path, what):
            attack = _attack(table)
        if attack.name in found:
            raise InputError(f"{path}: two attacks are named {attack.name}; rename one of them")
        if attack.option in {other.option for other in found.values()}:
            raise InputError(f"{path}: {what}: the same as another one; leave one out")
        found[attack.name] = attack
    return tuple(found.values())


def _attack(table: Mapping[str, Any]) -> Attack:
    if unknown := sorted(set(table) - set(_KEYS)):
        raise InputError(unknown_name("key", unknown[0], known=_KEYS))
    for name, kinds in (("name", str), ("attack", (str, dict)), ("goal", str)):
        if not table.get(name) or not isinstance(table[name], kinds):
            raise InputError(f"{name}: give a text")
    if table["goal"] not in GOALS:
        raise InputError(unknown_name("goal", table["goal"], known=GOALS))
    published = table.get("published", "")
    if published and published not in PUBLISHED_ATTACKS:
        raise InputError(unknown_name("published", published, known=PUBLISHED_ATTACKS))
    return Attack(table["name"], text_of(table["attack"]), table["goal"], published)


def _defences(table: Any) -> tuple[NamedDefence, ...]:
    if not isinstance(table, dict) or set(table) - {"use"}:
        raise InputError('give a table with use = ["NAME", ...]')
    use = table.get("use", ["all"])
    if not isinstance(use, list) or not all(isinstance(name, str | dict) for name in use):
        raise InputError('use: give a list of names, such as ["occlusion", "shadow"]')
    return read_defences(map(text_of, use))


def _measure(table: Any) -> Measure:
    if not isinstance(table, dict):
        raise InputError("give a table")
    numbers = {name: value for name, value in table.items() if name != "detector"}
    values = read_values(Measure, numbers, also=["detector"])
    detector = table.get("detector", list(Measure().detector))
    detector = [detector] if isinstance(detector, str) else detector
    if not isinstance(detector, list) or not all(isinstance(name, str) for name in detector):
        raise InputError('detector: give a name or a list of names, such as ["rules", "learned"]')
    return Measure(**values, detector=tuple(detector))


def _runs(drives: list[GridDrive], attacks: tuple[Attack, ...]) -> list[Run]:
    by_option = {attack.option: attack for attack in attacks}
    plain = {_without_attack(drive): drive.name for drive in drives if not drive.values["attack"]}
    runs = []
    for drive in drives:
        conditions = {name: text for name, text in drive.values.items() if name not in _POOLED}
        attack = by_option.get(drive.values["attack"])
        runs.append(Run(drive, attack, conditions, plain[_without_attack(drive)]))
    return runs


def _without_attack(drive: GridDrive) -> tuple[tuple[str, str], ...]:
    return tuple((name, text) for name, text in drive.values.items() if name != "attack")
