"""Which imperfections a scanner has: everything is off unless asked for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from math import isfinite

from lidar.errors import InputError
from lidar.physics.reflect import INCIDENCE_LAWS

NOISES = ("none", "constant", "signal")
"""Models of range noise."""

FOOTPRINTS = (1, 7, 19, 37, 61)
"""Rays a pulse."""


@dataclass(frozen=True)
class Effects:
    """The dials of the returns. The defaults are a scanner that measures exactly.

    motion       : each pulse is cast from the sensor's pose at its own time; else all from the frame's first
    law          : incidence law, of `lidar.physics.reflect.INCIDENCE_LAWS`
    spread       : spread of the reflectance from object to object, as the deviation of its logarithm
    link         : targets too dim to be seen at their range are lost
    detection    : and those near the limit are lost with a probability; includes ``link``
    daylight_lux : light on the scene, which raises the receiver's noise
    extinction   : 1/m, of the air, one way
    rays         : rays a pulse, of `FOOTPRINTS`: a beam with a size, mixed pixels, several echoes
    mirrors      : glass lets through and mirrors, water mirrors
    foliage      : crowns and hedges let rays through between their leaves
    blooming     : pulses that pass close by a retro-reflector may return its range
    interference : number of other scanners whose pulses may be received
    false_alarms : noise may pass the threshold
    range_noise  : ``constant`` (the preset's sigma), ``signal`` (more for dim targets) or ``none``
    stretch      : noise of a pulse on a slanted surface; for ``rays`` = 1, where that is not traced
    bias         : each laser has a constant error
    walk         : bright targets appear nearer
    angle_noise  : the beam is not quite where the sensor says
    quantise     : ranges and codes are whole multiples of the sensor's steps
    """

    motion: bool = True
    law: str = "lambert"
    spread: float = 0.0
    link: bool = False
    detection: bool = False
    daylight_lux: float = 0.0
    extinction: float = 0.0
    rays: int = 1
    mirrors: bool = False
    foliage: bool = False
    blooming: bool = False
    interference: int = 0
    false_alarms: bool = False
    range_noise: str = "none"
    stretch: bool = False
    bias: bool = False
    walk: bool = False
    angle_noise: bool = False
    quantise: bool = False

    def __post_init__(self) -> None:
        """Refuse settings that mean nothing, all faults in one message."""
        faults = []
        if self.law not in INCIDENCE_LAWS:
            faults.append(f"law={self.law}: known are {', '.join(INCIDENCE_LAWS)}")
        if self.range_noise not in NOISES:
            faults.append(f"range_noise={self.range_noise}: known are {', '.join(NOISES)}")
        if self.rays not in FOOTPRINTS:
            faults.append(f"rays={self.rays}: known are {', '.join(map(str, FOOTPRINTS))}")
        amounts = {n: getattr(self, n) for n in ("spread", "daylight_lux", "extinction", "interference")}
        faults += [
            f"{name}={value}: it is to be 0 or more"
            for name, value in amounts.items()
            if not (isfinite(value) and value >= 0)
        ]
        if faults:
            raise InputError("; ".join(faults))


PLAIN = Effects()
"""Exact ranges, intensity from material and incidence, hard limits of range."""

LEVELS: dict[str, Effects] = {
    "draft": Effects(motion=False),
    "standard": PLAIN,
    "survey": Effects(
        law="phong",
        spread=0.2,
        detection=True,
        rays=19,
        mirrors=True,
        foliage=True,
        blooming=True,
        false_alarms=True,
        range_noise="signal",
        bias=True,
        walk=True,
        angle_noise=True,
        quantise=True,
    ),
}
"""Effects by level of fidelity."""


def effects_of(level: str = "standard", settings: Mapping[str, str] | None = None) -> Effects:
    """The effects of a level, with some set apart: ``effects_of("standard", {"rays": "7"})``.

    Values are text as on a command line: numbers, words, or on/off, yes/no, true/false, 1/0.

    Raises InputError for a level, a name or a value that is not known.
    """
    if level not in LEVELS:
        raise InputError(f"fidelity {level!r} is not known: {', '.join(LEVELS)}")
    known = {f.name: type(getattr(PLAIN, f.name)) for f in fields(Effects)}
    values: dict[str, object] = {}
    for name, text in (settings or {}).items():
        if name not in known:
            raise InputError(f"setting {name!r} is not known: {', '.join(known)}")
        values[name] = _value(name, text, kind=known[name])
    return replace(LEVELS[level], **values)  # type: ignore[arg-type]


def _value(name: str, text: str, *, kind: type) -> object:
    if kind is bool:
        words = {"on": True, "yes": True, "true": True, "1": True}
        words |= {"off": False, "no": False, "false": False, "0": False}
        if text.lower() not in words:
            raise InputError(f"{name}={text}: on or off is wanted")
        return words[text.lower()]
    try:
        return kind(text)
    except ValueError:
        wanted = "a whole number" if kind is int else "a number"
        raise InputError(f"{name}={text}: {wanted} is wanted") from None
