"""Fidelity of a drive: a level sets all settings at once, a name and a value one of them."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from difflib import get_close_matches
from typing import Any

from lidar.camera import settings as camera_settings
from lidar.camera.settings import CameraSettings
from lidar.errors import InputError
from lidar.physics import settings as scanner_settings
from lidar.physics.reflect import INCIDENCE_LAWS
from lidar.physics.settings import ScannerSettings

_SWITCH = {"on": True, "yes": True, "true": True, "1": True}
_SWITCH |= {"off": False, "no": False, "false": False, "0": False}

_CHOICES: dict[str, Iterable[object]] = {
    "law": INCIDENCE_LAWS,
    "range_noise": scanner_settings.NOISES,
}


@dataclass(frozen=True, slots=True)
class Setting:
    """One setting as `list_settings` describes it.

    name    : field of `ScannerSettings` or `CameraSettings`
    of      : lidar or camera
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


def settings_of(
    level: str, changes: Iterable[tuple[str, str]] = ()
) -> tuple[ScannerSettings, CameraSettings]:
    """Settings of scanners and of cameras at a level, with single ones changed by name and text.

    Values are numbers, words, or on/off, yes/no, true/false, 1/0. Raises InputError if a level, a name or a
    value is unknown.
    """
    if level not in scanner_settings.LEVELS:
        raise InputError(f"`fidelity` {level}: one of {', '.join(levels())}")
    scanner, camera = scanner_settings.LEVELS[level], camera_settings.LEVELS[level]
    of_scanner, of_camera = ({f.name for f in fields(kind)} for kind in (ScannerSettings, CameraSettings))
    scanner_changes: dict[str, Any] = {}
    camera_changes: dict[str, Any] = {}
    for name, text in changes:
        if name in of_scanner:
            scanner_changes |= _parsed(name, text, former=getattr(scanner, name))
        elif name in of_camera:
            camera_changes |= _parsed(name, text, former=getattr(camera, name))
        else:
            known = sorted(of_scanner | of_camera)
            near = get_close_matches(name, known, 3, 0.5)
            hint = f"; is {' or '.join(near)} meant?" if near else ";"
            raise InputError(f"`settings` {name}: unknown{hint} lidar settings lists all {len(known)}")
    return replace(scanner, **scanner_changes), replace(camera, **camera_changes)


def list_settings() -> list[Setting]:
    """All settings, those of scanners first, with their values at each level."""
    found = []
    for of, kind, by_level in (
        ("lidar", ScannerSettings, scanner_settings.LEVELS),
        ("camera", CameraSettings, camera_settings.LEVELS),
    ):
        meanings = _meanings(inspect.getdoc(kind) or "")
        for f in fields(kind):
            values = tuple(_text(getattr(by_level[level], f.name)) for level in levels())
            found.append(Setting(f.name, of, values, meanings.get(f.name, "")))
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


def _text(value: object) -> str:
    if isinstance(value, bool):
        return "on" if value else "off"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _parsed(name: str, text: str, *, former: object) -> dict[str, Any]:
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
