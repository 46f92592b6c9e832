"""Fidelity of a drive: a level sets all settings at once, a name and a value one of them."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from difflib import get_close_matches
from typing import Any, NamedTuple

from lidar.camera import settings as camera_settings
from lidar.camera.settings import CameraSettings
from lidar.errors import InputError
from lidar.physics import settings as scanner_settings
from lidar.physics.reflect import INCIDENCE_LAWS
from lidar.physics.settings import ScannerSettings
from lidar.raycast import PRECISIONS
from lidar.world.settings import ORIGINS, RELIEFS, WorldSettings

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
class Setting:
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


class Settings(NamedTuple):
    """Settings of a drive: of scanners, of cameras, and of the scene around the vehicle."""

    lidar: ScannerSettings
    camera: CameraSettings
    world: WorldSettings


def settings_of(level: str, changes: Iterable[tuple[str, str]] = ()) -> Settings:
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
                values.update(_parsed(name, text, former=getattr(group, name)))
    return Settings(*(replace(group, **values) for group, values in zip(chosen, changed, strict=True)))


def _at(level: str) -> Settings:
    if level not in levels():
        raise InputError(f"`fidelity` {level}: one of {', '.join(levels())}")
    return Settings(scanner_settings.LEVELS[level], camera_settings.LEVELS[level], WorldSettings())


def list_settings() -> list[Setting]:
    """All settings, those of scanners first, with their values at each level."""
    at_levels = [_at(level) for level in levels()]
    found = []
    for k, of in enumerate(Settings._fields):
        meanings = _meanings(inspect.getdoc(type(at_levels[0][k])) or "")
        for f in fields(at_levels[0][k]):
            values = tuple(text_of(getattr(chosen[k], f.name)) for chosen in at_levels)
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


def text_of(value: object) -> str:
    """The text of a setting's value, as `settings_of` reads it."""
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
