"""Fidelity of a drive: a level sets all settings at once, a name and a value one of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any, TypeVar

from geoscene.support.registry import unknown_name
from lidar.dataset.formats import FORMATS, LABELS, Format, LabelFormat
from lidar.dataset.formats.table import MOMENTS
from lidar.errors import InputError
from lidar.parameters import (
    describe,
    parameter_rows,
    parameters_of,
    read_values,
    shown_value,
    value_text,
)
from lidar.sensors.camera import settings as camera_settings
from lidar.sensors.camera.settings import PLAIN as PLAIN_CAMERA
from lidar.sensors.camera.settings import CameraSettings
from lidar.sensors.physics import settings as scanner_settings
from lidar.sensors.physics.settings import PLAIN as PLAIN_SCANNER
from lidar.sensors.physics.settings import ScannerSettings
from lidar.signal.registry import NO_STAGES, Stages
from lidar.world.settings import PLAIN as PLAIN_WORLD
from lidar.world.settings import WorldSettings

S = TypeVar("S", ScannerSettings, CameraSettings, WorldSettings)


def levels() -> tuple[str, ...]:
    """Names of the fidelity levels, the cheapest first."""
    return tuple(scanner_settings.LEVELS)


Settings = tuple[ScannerSettings, CameraSettings, WorldSettings]
"""Settings of scanners, of cameras, and of the scene around the vehicle."""

_OF = ("lidar", "camera", "world")
_REMEDY = "lidar settings lists all"


def settings_of(level: str, changes: Iterable[tuple[str, str]] = ()) -> Settings:
    """Settings at a level, with single ones changed by name and text.

    A name that both scanners and cameras have changes both. Values are numbers, words, or on/off, yes/no,
    true/false, 1/0. Raises InputError if a level, a name or a value is unknown.
    """
    scanner, camera, world = _at(level)
    given = dict(changes)
    known = {f.name: f for group in (scanner, camera, world) for f in fields(group)}
    for name in given:
        if name not in known:
            raise InputError(unknown_name("`settings`", name, known=known, remedy=_REMEDY))
    return _change(scanner, given), _change(camera, given), _change(world, given)


def _change(settings: S, given: Mapping[str, str]) -> S:
    """Settings of one group with those that are given and that it has changed."""
    own = {name: text for name, text in given.items() if hasattr(settings, name)}
    change: Callable[..., Any] = partial(replace, settings)
    if isinstance(settings, ScannerSettings):
        change = settings.changed
    try:
        found: S = change(**read_values(type(settings), own))
    except InputError as error:
        raise InputError(f"`settings` {error}") from None
    return found


def _at(level: str) -> Settings:
    if level not in levels():
        raise InputError(unknown_name("`fidelity`", level, known=levels()))
    return scanner_settings.LEVELS[level], camera_settings.LEVELS[level], WorldSettings()


def setting_rows() -> list[dict[str, str]]:
    """Name, group (lidar, camera or world), value at each level as text, unit and meaning of all settings.

    Units are empty for counts, shares, factors, words and switches.
    """
    at_levels = [_at(level) for level in levels()]
    found = []
    for of, groups in zip(_OF, zip(*at_levels, strict=True), strict=True):
        kind = type(groups[0])
        for row, declared in zip(parameter_rows(kind), parameters_of(kind), strict=True):
            values = [value_text(shown_value(declared, getattr(group, row["name"]))) for group in groups]
            at = dict(zip(levels(), values, strict=True))
            found.append(
                {"name": row["name"], "of": of, **at, "unit": row.get("unit", ""), "meaning": describe(row)}
            )
    return found


@dataclass(frozen=True, slots=True)
class RecordingSettings:
    """Which files are written of every frame, and how its measurements are simulated.

    formats : of clouds, names in `lidar.dataset.formats.FORMATS`
    labels  : of label files, names in `lidar.dataset.formats.LABELS`
    deskew  : moment of `deskew.MOMENTS` to which clouds in the sensor frame are de-skewed in further files
    seed    : of the random number generators
    scanner : settings of scanners
    camera  : settings of cameras
    world   : settings of the scene around the vehicle
    stages  : that change echoes, clouds or images, see `lidar.signal`
    """

    formats: tuple[str, ...] = ("pcd",)
    labels: tuple[str, ...] = ()
    deskew: str = ""
    seed: int = 0
    scanner: ScannerSettings = PLAIN_SCANNER
    camera: CameraSettings = PLAIN_CAMERA
    world: WorldSettings = PLAIN_WORLD
    stages: Stages = NO_STAGES

    def __post_init__(self) -> None:
        """Validate the names."""
        if not self.formats:
            raise InputError(f"`formats`: give one or more of {', '.join(FORMATS)}")
        FORMATS.check(self.formats)
        for form in self.cloud_formats:
            form.require()
        LABELS.check(self.labels)
        if self.deskew and self.deskew not in MOMENTS:
            raise InputError(unknown_name("`deskew`", self.deskew, known=MOMENTS))
        if self.deskew and all(form.frame == "world" for form in self.cloud_formats):
            sensor = ", ".join(form.name for form in FORMATS.values() if form.frame == "sensor")
            raise InputError(
                f"`deskew`: {','.join(self.formats)} files hold points in the world frame; add a format of"
                f" the sensor frame to `formats` ({sensor})"
            )

    @property
    def cloud_formats(self) -> list[Format]:
        """The formats of clouds."""
        return [FORMATS[name] for name in self.formats]

    @property
    def label_formats(self) -> list[LabelFormat]:
        """The formats of label files."""
        return [LABELS[name] for name in self.labels]

    @property
    def kitti(self) -> bool:
        """Whether scanners' folders are KITTI sequences."""
        return any(f.kitti for f in self.cloud_formats) or any(f.kitti for f in self.label_formats)
