"""Settings to compare: the user's with one of them changed, and the exact end."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

from lidar.physics.settings import MOST_RAYS, POSES, ScannerSettings
from lidar.raycast import PRECISIONS
from lidar.settings import text_of
from lidar.world.settings import ORIGINS, WorldSettings
from lidar.world.settings import PLAIN as WHOLE

RAYS = 217
"""Rays per pulse of the reference, unless more are asked for."""

SCANNER_VALUES: dict[str, tuple[Any, ...]] = {
    "rays": (1, 7, 19, 37, 61, 127),
    "poses": POSES,
    "precision": PRECISIONS,
    "retrace": (True, False),
    "mirrors": (True, False),
    "foliage": (True, False),
}
"""Values of the scanner's settings that are compared, by setting."""

WORLD_VALUES: dict[str, tuple[Any, ...]] = {"origin": ORIGINS, "reach": (25.0, 50.0, 100.0)}
"""Values of the world's settings that are compared, by setting."""

OF_EMBREE = ("precision", "retrace", "origin")
"""Settings that act on Embree's float32 rays only: alone, they are cast by Embree."""

MODELS = ("mirrors", "foliage")
"""Settings that change what is modelled: the difference that they make is no error."""


@dataclass(frozen=True, slots=True)
class Variant:
    """One row of a comparison of scanner settings.

    setting : name, such as ``rays``; empty for the user's own settings, unchanged
    value   : as text; of the user's own settings all that are compared
    used    : the user's settings with this one changed, without random effects
    alone   : the reference's settings with this one changed
    scene   : number of the scene, 0 for the first
    traffic : whether other road users are in the world
    world, alone_world : settings of the world of either
    """

    setting: str
    value: str
    used: ScannerSettings
    alone: ScannerSettings
    scene: int = 0
    traffic: bool = True
    world: WorldSettings = WHOLE
    alone_world: WorldSettings = WHOLE

    @property
    def label(self) -> str:
        """Name of the row."""
        return f"{self.setting}={self.value}" if self.setting else f"as asked ({self.value})"


def noiseless(settings: ScannerSettings) -> ScannerSettings:
    """The settings without random effects and without the sensor's own imperfections.

    What decides which surfaces are seen stays: incidence law, extinction, threshold, mirrors and foliage.
    """
    return replace(
        settings,
        spread=0.0,
        link=settings.link or settings.detection,
        detection=False,
        daylight_lux=0.0,
        blooming=False,
        interference=0,
        false_alarms=False,
        range_noise="none",
        stretch=False,
        bias=False,
        walk=False,
        angle_noise=False,
        quantise=False,
    )


def reference(settings: ScannerSettings, *, rays: int) -> ScannerSettings:
    """The exact end of settings: a pose for every firing and a dense footprint; cast it in float64."""
    return replace(noiseless(settings), poses="firing", precision="exact", retrace=True, rays=rays)


def next_step(rays: int) -> int:
    """The number of rays that shows whether a reference has converged: half as many more."""
    return min(rays + rays // 2 + rays % 2, MOST_RAYS)


def scanner_variants(
    settings: ScannerSettings,
    *,
    rays: int,
    world: WorldSettings = WHOLE,
    compared: Sequence[str] = (),
    scenes: Sequence[str] = (),
    traffic: bool = False,
) -> list[Variant]:
    """The user's settings, and these with one of them changed.

    rays     : of the reference
    world    : the user's settings of the world
    compared : names of settings; all by default
    scenes   : labels of the scenes after the first
    traffic  : whether there are other road users, to be left out in one variant
    """
    used, exact = noiseless(settings), reference(settings, rays=rays)
    values = {name: getattr(used, name) for name in SCANNER_VALUES}
    values |= {name: getattr(world, name) for name in WORLD_VALUES}
    asked = ", ".join(f"{name}={text_of(value)}" for name, value in values.items())
    rows = [Variant("", asked, used, used, world=world)]
    for name in SCANNER_VALUES:
        if not compared or name in compared:
            rows += _of_setting(name, used, exact=exact, world=world)
    for name in WORLD_VALUES:
        if not compared or name in compared:
            rows += _of_world(name, world, used=used, exact=exact)
    if not compared or "scene" in compared:
        rows += [
            Variant("scene", text, used, exact, scene=k + 1, world=world) for k, text in enumerate(scenes)
        ]
    if traffic and (not compared or "traffic" in compared):
        rows.append(Variant("traffic", "off", used, exact, traffic=False, world=world))
    return rows


def _of_setting(
    name: str, used: ScannerSettings, *, exact: ScannerSettings, world: WorldSettings
) -> Iterator[Variant]:
    for value in SCANNER_VALUES[name]:
        change: dict[str, Any] = {name: value}
        if value != getattr(used, name) and (name != "rays" or value < exact.rays):
            yield Variant(
                name, text_of(value), replace(used, **change), replace(exact, **change), world=world
            )


def _of_world(
    name: str, world: WorldSettings, *, used: ScannerSettings, exact: ScannerSettings
) -> Iterator[Variant]:
    for value in WORLD_VALUES[name]:
        change: dict[str, Any] = {name: value}
        if value != getattr(world, name):
            yield Variant(
                name,
                text_of(value),
                used,
                exact,
                world=replace(world, **change),
                alone_world=replace(WHOLE, **change),
            )
