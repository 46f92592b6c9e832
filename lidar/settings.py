"""Fidelity of a drive: a level sets all settings at once, a name and a value one of them."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from difflib import get_close_matches
from typing import Any, NamedTuple

from lidar.dataset.deskew import MOMENTS
from lidar.dataset.formats import FORMATS, LABELS, REMOVED, Format, LabelFormat
from lidar.errors import InputError
from lidar.raycast import PRECISIONS
from lidar.sensors.camera import settings as camera_settings
from lidar.sensors.camera.settings import PLAIN as PLAIN_CAMERA
from lidar.sensors.camera.settings import CameraSettings
from lidar.sensors.physics import settings as scanner_settings
from lidar.sensors.physics.reflect import INCIDENCE_LAWS
from lidar.sensors.physics.settings import PLAIN as PLAIN_SCANNER
from lidar.sensors.physics.settings import ScannerSettings
from lidar.signal.registry import NO_STAGES, Stages
from lidar.world.settings import ORIGINS, RELIEFS, WorldSettings
from lidar.world.settings import PLAIN as PLAIN_WORLD

_SWITCH = {"on": True, "yes": True, "true": True, "1": True}
_SWITCH |= {"off": False, "no": False, "false": False, "0": False}

_CHOICES: dict[str, Iterable[object]] = {
    "law": INCIDENCE_LAWS,
    "range_noise": scanner_settings.NOISES,
    "poses": scanner_settings.POSES,
    "precision": PRECISIONS,
    "origin": ORIGINS,
    "relief": RELIEFS,
}


@dataclass(frozen=True, slots=True)
class SettingDescription:
    """One setting as `list_settings` describes it.

    name    : field of `ScannerSettings`, `CameraSettings` or `WorldSettings`
    of      : lidar, camera or world
    values  : as text, at each of `levels`
    meaning : one line
    """

    name: str
    of: str
    values: tuple[str, ...]
    meaning: str


def levels() -> tuple[str, ...]:
    """Names of the fidelity levels, the cheapest first."""
    return tuple(scanner_settings.LEVELS)


class DriveSettings(NamedTuple):
    """Settings of a drive: of scanners, of cameras, and of the scene around the vehicle."""

    lidar: ScannerSettings
    camera: CameraSettings
    world: WorldSettings


def settings_of(level: str, changes: Iterable[tuple[str, str]] = ()) -> DriveSettings:
    """Settings at a level, with single ones changed by name and text.

    A name that both scanners and cameras have changes both. Values are numbers, words, or on/off, yes/no,
    true/false, 1/0. Raises InputError if a level, a name or a value is unknown.
    """
    chosen: tuple[Any, ...] = _at(level)
    known = {f.name for group in chosen for f in fields(group)}
    changed: tuple[dict[str, Any], ...] = tuple({} for _ in chosen)
    for name, text in changes:
        if name not in known:
            near = get_close_matches(name, sorted(known), 3, 0.5)
            hint = f"; is {' or '.join(near)} meant?" if near else ";"
            raise InputError(f"`settings` {name}: unknown{hint} lidar settings lists all {len(known)}")
        for group, values in zip(chosen, changed, strict=True):
            if hasattr(group, name):
                values.update(_parse(name, text, former=getattr(group, name)))
    return DriveSettings(*(replace(group, **values) for group, values in zip(chosen, changed, strict=True)))


def _at(level: str) -> DriveSettings:
    if level not in levels():
        raise InputError(f"`fidelity` {level}: one of {', '.join(levels())}")
    return DriveSettings(scanner_settings.LEVELS[level], camera_settings.LEVELS[level], WorldSettings())


def list_settings() -> list[SettingDescription]:
    """All settings, those of scanners first, with their values at each level."""
    at_levels = [_at(level) for level in levels()]
    found = []
    for k, of in enumerate(DriveSettings._fields):
        meanings = _meanings(inspect.getdoc(type(at_levels[0][k])) or "")
        for f in fields(at_levels[0][k]):
            values = tuple(text_of(getattr(chosen[k], f.name)) for chosen in at_levels)
            found.append(SettingDescription(f.name, of, values, meanings.get(f.name, "")))
    return found


def _meanings(docstring: str) -> dict[str, str]:
    """Meaning of each field by its name: ``name : text``, which may continue in further, indented lines."""
    meanings = {}
    for name, entry in re.findall(r"^(\w+) *: (.+(?:\n {4,}\S.*)*)", docstring, re.MULTILINE):
        text = re.sub(r",? of `[\w.]+`", "", entry)
        meanings[name] = re.sub(r"\s+", " ", text.replace("`", "")).strip()
        if name in _CHOICES:
            meanings[name] += f" ({', '.join(map(str, _CHOICES[name]))})"
    return meanings


def text_of(value: object) -> str:
    """The text of a setting's value, as `settings_of` reads it."""
    if isinstance(value, bool):
        return "on" if value else "off"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _parse(name: str, text: str, *, former: object) -> dict[str, Any]:
    """A setting by its name, its text read as the type of its former value."""
    kind: type = type(former)
    if kind is bool:
        if text.lower() not in _SWITCH:
            raise InputError(f"`settings` {name}={text}: give on or off")
        return {name: _SWITCH[text.lower()]}
    try:
        return {name: kind(text)}
    except ValueError:
        wanted = "a whole number" if kind is int else "a number"
        raise InputError(f"`settings` {name}={text}: give {wanted}") from None


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
        if unknown := sorted(set(self.formats) - set(FORMATS)):
            why = REMOVED.get(unknown[0], f"unknown; there are {', '.join(FORMATS)}")
            raise InputError(f"`formats` {','.join(unknown)}: {why}")
        for form in self.cloud_formats:
            form.require()
        if unknown := sorted(set(self.labels) - set(LABELS)):
            raise InputError(f"`labels` {','.join(unknown)}: unknown; there are {', '.join(LABELS)}")
        if self.deskew and self.deskew not in MOMENTS:
            raise InputError(f"`deskew` {self.deskew}: one of {', '.join(MOMENTS)}")
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
