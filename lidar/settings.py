"""The dials of fidelity: three levels set them together, names one by one."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from difflib import get_close_matches
from typing import Any

from lidar.camera import dials
from lidar.camera.dials import CameraDials
from lidar.errors import InputError
from lidar.physics import effects
from lidar.physics.effects import Effects
from lidar.physics.reflect import INCIDENCE_LAWS

_WORDS = {"on": True, "yes": True, "true": True, "1": True}
_WORDS |= {"off": False, "no": False, "false": False, "0": False}


@dataclass(frozen=True, slots=True)
class Dial:
    """One setting.

    name    : as in ``--set NAME=VALUE``
    of      : lidar or camera
    values  : at each of `levels`
    meaning : one line
    """

    name: str
    of: str
    values: tuple[str, ...]
    meaning: str


def levels() -> tuple[str, ...]:
    """Names of the levels of fidelity, the cheapest first."""
    return tuple(effects.LEVELS)


def dials_of(level: str, given: Iterable[tuple[str, str]] = ()) -> tuple[Effects, CameraDials]:
    """The dials of scanners and of cameras at a level, with some set apart by name and text.

    Values are numbers, words, or on/off, yes/no, true/false, 1/0. Raises InputError for a level, a name or a
    value that is not known.
    """
    if level not in effects.LEVELS:
        raise InputError(f"`fidelity` {level}: one of {', '.join(levels())}")
    scanner, camera = effects.LEVELS[level], dials.LEVELS[level]
    of_scanner, of_camera = ({f.name for f in fields(kind)} for kind in (Effects, CameraDials))
    for name, text in given:
        if name in of_scanner:
            scanner = replace(scanner, **_one(name, text, of=scanner))
        elif name in of_camera:
            camera = replace(camera, **_one(name, text, of=camera))
        else:
            known = sorted(of_scanner | of_camera)
            near = get_close_matches(name, known, 3, 0.5)
            hint = f"; is {' or '.join(near)} meant?" if near else ";"
            raise InputError(f"`settings` {name}: unknown{hint} lidar settings lists all {len(known)}")
    return scanner, camera


def list_dials() -> list[Dial]:
    """All settings, those of scanners first, with their values at each level."""
    found = []
    for of, kind, table in (
        ("lidar", Effects, effects.LEVELS),
        ("camera", CameraDials, dials.LEVELS),
    ):
        said = _meanings(kind.__doc__ or "")
        for f in fields(kind):
            values = tuple(_shown(getattr(table[level], f.name)) for level in levels())
            found.append(Dial(f.name, of, values, said.get(f.name, "")))
    return found


def _meanings(text: str) -> dict[str, str]:
    """What a docstring says of each field: ``name : text``, which may go on in further, indented lines."""
    entries = re.findall(r"^ {4}(\w+) *: (.+(?:\n {8,}\S.*)*)", text, re.MULTILINE)
    known = {
        "law": INCIDENCE_LAWS,
        "rays": effects.FOOTPRINTS,
        "range_noise": effects.NOISES,
    }
    out = {}
    for name, said in entries:
        text = re.sub(r",? of `[\w.]+`", "", said)
        out[name] = re.sub(r"\s+", " ", text.replace("`", "")).strip()
        if name in known:
            out[name] += f" ({', '.join(map(str, known[name]))})"
    return out


def _shown(value: object) -> str:
    if isinstance(value, bool):
        return "on" if value else "off"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _one(name: str, text: str, *, of: Effects | CameraDials) -> dict[str, Any]:
    """A setting by its name, of the kind that the field has."""
    kind = type(getattr(of, name))
    return {name: _value(name, text, kind=kind)}


def _value(name: str, text: str, *, kind: type) -> object:
    if kind is bool:
        if text.lower() not in _WORDS:
            raise InputError(f"`settings` {name}={text}: on or off is wanted")
        return _WORDS[text.lower()]
    try:
        return kind(text)
    except ValueError:
        wanted = "a whole number" if kind is int else "a number"
        raise InputError(f"`settings` {name}={text}: {wanted} is wanted") from None
