"""Settings of scanners: which imperfections a measurement has. All are off by default."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from lidar.parameters import check_parameters, parameter
from lidar.raycast import PRECISIONS
from lidar.sensors.physics.reflect import INCIDENCE_LAWS

NOISES = ("none", "constant", "signal")
"""Models of range noise."""

POSES = ("firing", "column", "frame")
"""Pulses that share the sensor's pose: none, those of a column, all of a frame."""

LEAST_FOOTPRINT = 1e-4
"""Metres: least tolerance of ranges. Float32 has steps of 0.03 mm at 300 m."""

MOST_RAYS = 999
"""Maximum number of rays per pulse."""


@dataclass(frozen=True)
class ScannerSettings:
    """Settings of the returns. The defaults are a scanner that measures exactly.

    Raises InputError for values that are out of bounds or have no effect.
    """

    poses: str = parameter(
        "firing",
        "pulses have the sensor's pose and time at their own firing, at the first pulse of their column"
        " (block of firings), or at the first of the frame",
        among=POSES,
    )
    precision: str = parameter("exact", "precision of the ranges of pulses", among=PRECISIONS)
    retrace: bool = parameter(
        default=True,
        meaning="trace pulses that miss a second time, as pulses towards a vertex may pass between faces",
    )
    law: str = parameter("lambert", "incidence law", among=INCIDENCE_LAWS)
    spread: float = parameter(
        0.0,
        "spread of the reflectance from object to object, as the deviation of its logarithm",
        low=0,
    )
    link: bool = parameter(default=False, meaning="lose echoes below the detection threshold")
    detection: bool = parameter(
        default=False, meaning="lose echoes near the threshold with a probability; includes link"
    )
    daylight_lux: float = parameter(
        0.0,
        "illuminance of the scene, which raises the receiver's noise; with detection or false_alarms",
        unit="lux",
        low=0,
    )
    extinction: float = parameter(
        0.0,
        "extinction coefficient of the air, one way; dims intensity too, which assumes clear air",
        unit="1/m",
        low=0,
    )
    rays: int = parameter(
        1,
        "rays per pulse; more than 1: a beam with a size, mixed pixels, several echoes",
        low=1,
        high=MOST_RAYS,
    )
    footprint: float = parameter(
        0.0,
        "tolerance of ranges for which each pulse has as many rays as its footprint needs, instead of rays; 0"
        " for a fixed number",
        unit="m",
        low=0,
    )
    mirrors: bool = parameter(default=False, meaning="glass transmits and reflects, water reflects")
    foliage: bool = parameter(
        default=False, meaning="tree crowns and hedges let rays pass between their leaves"
    )
    blooming: bool = parameter(
        default=False, meaning="pulses that pass close to a retro-reflector may return its range"
    )
    interference: int = parameter(0, "number of other scanners whose pulses may be received", low=0)
    false_alarms: bool = parameter(default=False, meaning="noise may pass the threshold")
    range_noise: str = parameter(
        "none", "constant (the preset's sigma), signal (more for dim targets) or none", among=NOISES
    )
    stretch: bool = parameter(
        default=False,
        meaning="range noise of a pulse on a slanted surface, for rays = 1, which does not trace it",
    )
    bias: bool = parameter(default=False, meaning="each laser has a constant range error")
    walk: bool = parameter(default=False, meaning="bright targets appear nearer")
    angle_noise: bool = parameter(
        default=False, meaning="true beam directions differ at random from the reported ones"
    )
    quantise: bool = parameter(
        default=False, meaning="round ranges and intensity codes to the sensor's steps"
    )

    def __post_init__(self) -> None:
        """Validate the settings; one InputError names all faults."""
        noisy = self.detection or self.false_alarms
        rays, footprint = (n if isinstance(n, int | float) else 0 for n in (self.rays, self.footprint))
        check_parameters(
            self,
            f"daylight_lux={self.daylight_lux:g}: has no effect without detection or false_alarms"
            if self.daylight_lux and not noisy
            else "",
            f"stretch: has no effect with rays={rays}, which trace the surface"
            if self.stretch and rays > 1
            else "",
            "stretch: has no effect with footprint, which traces the surface"
            if self.stretch and footprint
            else "",
            f"footprint and rays={rays}: give one of them" if footprint and rays > 1 else "",
            f"footprint = {footprint:g} m is below {LEAST_FOOTPRINT:g} m, what ranges of float32 keep"
            if 0 < footprint < LEAST_FOOTPRINT
            else "",
        )

    @property
    def traces_footprints(self) -> bool:
        """Whether a pulse can meet several surfaces."""
        return self.rays > 1 or self.footprint > 0

    def changed(self, **values: Any) -> ScannerSettings:
        """The settings with other values; of ``rays`` and ``footprint`` the one that is given holds."""
        if "rays" in values:
            values = {"footprint": 0.0, **values}
        elif values.get("footprint"):
            values["rays"] = 1
        return replace(self, **values)


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
