"""Settings of scanners: which imperfections a measurement has. All are off by default."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite

from lidar.errors import InputError
from lidar.raycast import PRECISIONS
from lidar.sensors.physics.reflect import INCIDENCE_LAWS

NOISES = ("none", "constant", "signal")
"""Models of range noise."""

POSES = ("firing", "column", "frame")
"""Pulses that share the sensor's pose: none, those of a column, all of a frame."""

MOST_RAYS = 999
"""Maximum number of rays per pulse."""


@dataclass(frozen=True)
class ScannerSettings:
    """Settings of the returns. The defaults are a scanner that measures exactly.

    poses        : of `POSES`: pulses have the sensor's pose and time at their own ``firing``, at the first
                   pulse of their ``column`` (block of firings), or at the first of the ``frame``
    precision    : of the ranges of pulses, of `lidar.raycast.PRECISIONS`
    retrace      : trace pulses that miss a second time, as pulses towards a vertex may pass between faces
    law          : incidence law, of `lidar.sensors.physics.reflect.INCIDENCE_LAWS`
    spread       : spread of the reflectance from object to object, as the deviation of its logarithm
    link         : lose echoes below the detection threshold
    detection    : lose echoes near the threshold with a probability; includes ``link``
    daylight_lux : illuminance of the scene, which raises the receiver's noise; with ``detection`` or
                   ``false_alarms``
    extinction   : extinction coefficient of the air, 1/m one way; dims intensity too, which assumes clear air
    rays         : rays per pulse, 1 to 999; more than 1: a beam with a size, mixed pixels, several echoes
    mirrors      : glass transmits and reflects, water reflects
    foliage      : tree crowns and hedges let rays pass between their leaves
    blooming     : pulses that pass close to a retro-reflector may return its range
    interference : number of other scanners whose pulses may be received
    false_alarms : noise may pass the threshold
    range_noise  : ``constant`` (the preset's sigma), ``signal`` (more for dim targets) or ``none``
    stretch      : range noise of a pulse on a slanted surface, for ``rays`` = 1, which does not trace it
    bias         : each laser has a constant range error
    walk         : bright targets appear nearer
    angle_noise  : true beam directions differ at random from the reported ones
    quantise     : round ranges and intensity codes to the sensor's steps
    """

    poses: str = "firing"
    precision: str = "exact"
    retrace: bool = True
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
        """Validate the settings; one InputError names all faults."""
        faults = []
        if self.poses not in POSES:
            faults.append(f"poses={self.poses}: known are {', '.join(POSES)}")
        if self.precision not in PRECISIONS:
            faults.append(f"precision={self.precision}: known are {', '.join(PRECISIONS)}")
        if self.law not in INCIDENCE_LAWS:
            faults.append(f"law={self.law}: known are {', '.join(INCIDENCE_LAWS)}")
        if self.range_noise not in NOISES:
            faults.append(f"range_noise={self.range_noise}: known are {', '.join(NOISES)}")
        if not 1 <= self.rays <= MOST_RAYS:
            faults.append(f"rays={self.rays}: give 1 to {MOST_RAYS}")
        amounts = {n: getattr(self, n) for n in ("spread", "daylight_lux", "extinction", "interference")}
        faults += [
            f"{name}={value}: give 0 or more"
            for name, value in amounts.items()
            if not (isfinite(value) and value >= 0)
        ]
        if self.daylight_lux and not (self.detection or self.false_alarms):
            faults.append(
                f"daylight_lux={self.daylight_lux:g}: has no effect without detection or false_alarms"
            )
        if self.stretch and self.rays > 1:
            faults.append(f"stretch: has no effect with rays={self.rays}, which trace the surface")
        if faults:
            raise InputError("; ".join(faults))


PLAIN = ScannerSettings()
"""Exact ranges, intensity from material and incidence, hard limits of range."""

LEVELS: dict[str, ScannerSettings] = {
    "standard": PLAIN,
    "survey": ScannerSettings(
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
"""Settings of scanners by fidelity level."""
