"""Settings of the world: visible parts of the scene, and the origin of its float32 coordinates."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import TYPE_CHECKING

import numpy as np

from geoscene.pipeline.limits import Limit
from geoscene.typing import Float
from geoscene.uses import USED_RELIEFS, sufficient_reliefs
from lidar.errors import InputError
from lidar.parameters import check_parameters, parameter
from lidar.raycast.device import CPU, name_fault

if TYPE_CHECKING:
    from geoscene.scene import Scene

_FAR = 10_000.0
"""Metres from their origin up to which rays at edges are tested (docs/measurements/extremes.md)."""

ORIGINS = ("near", "scene")
"""Origins of the float32 coordinates of a caster."""


@dataclass(frozen=True, slots=True)
class WorldSettings:
    """Settings of the world around the vehicle. The defaults are the whole scene within range.

    Raises InputError for values that are out of bounds.
    """

    origin: str = parameter(
        "near",
        "origin of Embree's float32 coordinates: the point of a grid of 2,048 m near the vehicle, or the"
        " scene's, from which the margins of faces grow with the distance",
        among=ORIGINS,
    )
    reach: float = parameter(
        inf,
        "distance from the vehicle beyond which no tiles are loaded and nothing is hit; unlimited: the"
        " sensors' maximum range",
        unit="m",
        low=1e-3,
        endless="unlimited",
    )
    forests: bool = parameter(default=True, meaning="the trees of forests")
    trees: bool = parameter(default=True, meaning="single trees and those of rows")
    furniture: bool = parameter(
        default=True, meaning="poles, lamps, signs, traffic lights, bollards, benches and wires"
    )
    barriers: bool = parameter(default=True, meaning="walls, fences and hedges")
    relief: str = parameter(
        "scene",
        "scene: what the scene holds; plain: without the small parts that full relief adds; off: walls are"
        " planes and the ground is smooth, too; full: only of a scene that has them; mesh: openings of walls"
        " as triangles",
        among=USED_RELIEFS,
    )
    wetness: float = parameter(
        0.0, "share of surfaces open to the sky that is soaked and under a film of water", low=0, high=1
    )
    snow: float = parameter(0.0, "share of surfaces open to the sky that is under snow", low=0, high=1)
    device: str = parameter(
        CPU,
        "casts rays and shades images: cpu, or, with the extra gpu, cuda, cuda:N or warp-cpu",
    )

    def __post_init__(self) -> None:
        """Validate the settings; one InputError names all faults."""
        check_parameters(self, name_fault(self.device))


PLAIN = WorldSettings()
"""The whole scene within range."""


def check_relief(scene: Scene, settings: WorldSettings) -> None:
    """Raise InputError if the settings ask for relief that a scene does not hold."""
    sufficient = sufficient_reliefs(settings.relief)
    if scene.relief not in sufficient:
        raise InputError(
            f"`relief` {settings.relief}: {scene.location} was built with relief {scene.relief}; build it"
            f" again with `relief` {' or '.join(sufficient)}, or leave the option out"
        )


def origin_limit(position: Float) -> list[Limit]:
    """The limit of rays from places (n, 3) that refer to the scene's origin; none within the bound."""
    from lidar.raycast.hull import ROUNDING  # noqa: PLC0415 - slow to import

    away = float(np.linalg.norm(position, axis=1).max(initial=0.0))
    if away <= _FAR:
        return []
    advice = (
        f"with the setting origin=scene rays are cast up to {away / 1000:,.0f} km from their origin, where"
        f" edges of surfaces are off by up to {ROUNDING * away * 1000:.1f} mm; leave the setting out"
    )
    return [Limit("origin", round(away / 1000, 1), _FAR / 1000, "km", advice)]
