"""Settings to compare: the user's, these with some of them changed, and the reference."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any

from geoscene.drawing.report import metres
from geoscene.uses import RELIEFS
from lidar.parameters import value_text
from lidar.raycast import PRECISIONS
from lidar.sensors.camera.settings import CameraSettings
from lidar.sensors.physics.settings import MOST_RAYS, POSES, ScannerSettings
from lidar.world.settings import ORIGINS, WorldSettings
from lidar.world.settings import PLAIN as WHOLE


def setting_text(name: str, value: Any) -> str:
    """A setting as users write it, as in ``rays=7`` or ``footprint=3cm``."""
    is_length = name == "footprint" and value
    return f"{name}={metres(value).replace(' ', '') if is_length else value_text(value)}"


RAYS = 217
"""Rays per pulse of the reference, unless more are asked for."""

SCANNER_VALUES: dict[str, tuple[Any, ...]] = {
    "rays": (1, 7, 19, 37, 61, 127),
    "footprint": (0.1, 0.03, 0.01, 0.003),
    "poses": POSES,
    "precision": PRECISIONS,
    "retrace": (True, False),
    "mirrors": (True, False),
    "foliage": (True, False),
}
"""Values of the scanner's settings that are compared, by setting."""

CAMERA_VALUES: dict[str, tuple[Any, ...]] = {
    "supersample": (1, 2, 3, 4),
    "edge_rays": (1, 2, 3),
    "blur": (1, 5, 9, 17),
    "shadows": (True, False),
    "detail": (True, False),
    "resolution": (1, 2, 4),
    "precision": PRECISIONS,
    "retrace": (True, False),
    "haze": (20_000.0, float("inf")),
}
"""Values of the camera's settings that are compared; resolution divides width and height."""

WORLD_VALUES: dict[str, tuple[Any, ...]] = {
    "origin": ORIGINS,
    "reach": (25.0, 50.0, 100.0),
    "forests": (True, False),
    "trees": (True, False),
    "furniture": (True, False),
    "barriers": (True, False),
    "relief": ("off", "plain"),
}
"""Values of the world's settings that are compared, by setting."""

OF_EMBREE = frozenset({"precision", "retrace", "origin"})
"""Settings that act on Embree's float32 rays only: alone, they are cast by Embree."""

MODELS = frozenset({"mirrors", "foliage", "haze", "relief"})
"""Settings that change what is modelled: the difference that they make is no error."""

CHEAPER: tuple[tuple[str, Any], ...] = (("precision", "float32"), ("reach", 50.0), ("forests", False))
"""Changes that combinations make to a scanner's number of rays, one after the other."""

CHEAPER_IMAGES: tuple[tuple[str, Any], ...] = (("resolution", 2), ("shadows", False))
"""Changes that combinations make to a camera's number of rays, one after the other."""

SAMPLES = 16
"""Rays along each side of a pixel of the reference; of an exposure with motion blur `BLURRED`."""

BLURRED, MOMENTS = 4, 64
"""Rays along each side of a pixel, and samples of the exposure, of the reference of a blurred image."""

Settings = ScannerSettings | CameraSettings


@dataclass(frozen=True, slots=True)
class SettingVariant:
    """One row of a comparison of settings of a scanner or a camera.

    changes : name and value of each setting that is changed; empty for the user's own settings
    used    : the user's settings with these changed, without random effects
    alone   : the reference's settings with these changed
    world, alone_world : settings of the world of either
    scene   : number of the scene, 0 for the first
    traffic : whether other road users are in the world
    """

    changes: tuple[tuple[str, Any], ...]
    used: Any
    alone: Any
    world: WorldSettings
    alone_world: WorldSettings
    scene: int = 0
    traffic: bool = True

    @property
    def label(self) -> str:
        """Names and values of the changed settings; empty for the user's own."""
        return " ".join(setting_text(*change) for change in self.changes)

    @property
    def names(self) -> frozenset[str]:
        """Names of the changed settings."""
        return frozenset(name for name, _ in self.changes)

    @property
    def choice(self) -> bool:
        """Whether a drive in this world may choose it: not another model, scene or traffic."""
        return not self.names & (MODELS | {"scene", "traffic"})

    @property
    def resolution(self) -> int:
        """Pixels of a camera's side that are one pixel of the image."""
        return int(dict(self.changes).get("resolution", 1))


@dataclass(frozen=True, slots=True)
class Basis:
    """Settings of which variants are made.

    used  : the user's, without random effects
    exact : the reference's
    world : the user's settings of the world
    built : relief of the scene, of `geoscene.uses.RELIEFS`
    """

    used: Settings
    exact: Settings
    world: WorldSettings = WHOLE
    built: str = "off"

    @property
    def values(self) -> dict[str, tuple[Any, ...]]:
        """Values of the sensor's settings that are compared, by setting; the first setting counts rays."""
        return SCANNER_VALUES if isinstance(self.used, ScannerSettings) else CAMERA_VALUES

    def variant(
        self, changes: Iterable[tuple[str, Any]] = (), *, scene: int = 0, traffic: bool = True
    ) -> SettingVariant:
        """The variant with some settings changed."""
        changes = tuple(changes)
        values = dict(changes)
        return SettingVariant(
            changes,
            _change(self.used, values),
            _change(self.exact, values),
            world=_change(self.world, values),
            alone_world=_change(WHOLE, values),
            scene=scene,
            traffic=traffic,
        )

    def value(self, name: str) -> Any:
        """The user's value of a setting of the sensor or of the world."""
        if name == "relief" and self.world.relief == "scene":
            return self.built
        for group in (self.used, self.world):
            if hasattr(group, name):
                return getattr(group, name)
        return 1  # resolution

    def others(self, name: str, values: Sequence[Any]) -> list[Any]:
        """The values of a setting that differ from the user's; of relief, those that the scene holds."""
        if name == "relief":
            values = [value for value in values if value in RELIEFS[: RELIEFS.index(self.built) + 1]]
        return [value for value in values if value != self.value(name)]

    @property
    def label(self) -> str:
        """The user's values: of the sensor's settings all, of the world's those that leave something out."""
        shown = [n for n in self.values if hasattr(self.used, n)]
        shown += [n for n in WORLD_VALUES if getattr(self.world, n) != getattr(WHOLE, n)]
        return ", ".join(setting_text(name, self.value(name)) for name in shown)


def _change(settings: Any, values: Mapping[str, Any]) -> Any:
    """Settings of a sensor or the world with those values that they have."""
    own = {f.name for f in fields(settings)}
    change = settings.changed if isinstance(settings, ScannerSettings) else partial(replace, settings)
    return change(**{name: value for name, value in values.items() if name in own})


def noiseless(settings: ScannerSettings) -> ScannerSettings:
    """The settings without random effects and without the sensor's own imperfections.

    Settings that decide which surfaces are seen stay: incidence law, extinction, threshold, mirrors, foliage.
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


def scanner_reference(settings: ScannerSettings, *, rays: int) -> ScannerSettings:
    """The reference of settings: a pose for every firing and a dense footprint; cast it in float64."""
    return noiseless(settings).changed(poses="firing", precision="exact", retrace=True, rays=rays)


def camera_reference(settings: CameraSettings, *, exposed: bool) -> CameraSettings:
    """The reference of settings, with shadows and detail; ``exposed`` if the exposure lasts some time."""
    exact = replace(settings, camera_noise=False, precision="exact", retrace=True, shadows=True, detail=True)
    return (
        replace(exact, supersample=BLURRED, blur=MOMENTS) if exposed else replace(exact, supersample=SAMPLES)
    )


def next_step(rays: int) -> int:
    """The number of rays that shows whether a reference has converged: half as many more."""
    return min(rays + rays // 2 + rays % 2, MOST_RAYS)


def coarser(settings: CameraSettings) -> CameraSettings:
    """A reference with about half as many rays per pixel, which shows whether it has converged."""
    return replace(settings, supersample=round(settings.supersample / 2**0.5))


def variants_of(
    basis: Basis, *, compared: Sequence[str] = (), scenes: Sequence[str] = (), traffic: bool = False
) -> list[SettingVariant]:
    """The user's settings, these with one setting changed, and combinations of cheap ones.

    compared : names of settings; all by default
    scenes   : labels of the scenes after the first
    traffic  : whether there are other road users, to be left out in one variant
    """
    values = basis.values
    chosen = {n: v for n, v in {**values, **WORLD_VALUES}.items() if not compared or n in compared}
    rows = [basis.variant()]
    rows += [
        basis.variant([(name, value)])
        for name, known in chosen.items()
        for value in basis.others(name, known)
    ]
    if not compared or "scene" in compared:
        rows += [basis.variant([("scene", text)], scene=k + 1) for k, text in enumerate(scenes)]
    if traffic and (not compared or "traffic" in compared):
        rows.append(basis.variant([("traffic", False)], traffic=False))
    first = next(iter(values))  # counts rays
    cheaper = CHEAPER if isinstance(basis.used, ScannerSettings) else CHEAPER_IMAGES
    for value in chosen.get(first, ()):
        changes: list[tuple[str, Any]] = [] if value == basis.value(first) else [(first, value)]
        for name, cheap in cheaper:
            if name in chosen and cheap != basis.value(name):
                changes = [*changes, (name, cheap)]
                if len(changes) > 1:
                    rows.append(basis.variant(changes))
    return [row for row in rows if _fewer_rays(row.used, basis.exact) or not row.changes]


def _fewer_rays(one: Settings, exact: Settings) -> bool:
    """Whether settings of a scanner have fewer rays than the reference; true of cameras."""
    return isinstance(one, CameraSettings) or isinstance(exact, CameraSettings) or one.rays < exact.rays


def without_each(basis: Basis, variant: SettingVariant) -> Iterator[tuple[str, SettingVariant]]:
    """Each change of a variant, as text, and the variant without it."""
    for k, (name, value) in enumerate(variant.changes):
        rest = variant.changes[:k] + variant.changes[k + 1 :]
        left = {n for n, _ in rest}
        yield (
            setting_text(name, value),
            basis.variant(
                rest,
                scene=variant.scene if "scene" in left else 0,
                traffic=variant.traffic if "traffic" in left else True,
            ),
        )
