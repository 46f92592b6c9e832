"""The shading of images on a device of Warp: the functions of `lidar.sensors.camera.shade`, translated."""

from __future__ import annotations

import functools
from collections import OrderedDict
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from geoscene.typing import Float
from lidar.raycast.device import WarpDevice
from lidar.raycast.device import device as device_of
from lidar.raycast.translate import Translation
from lidar.sensors.camera import shade
from lidar.sensors.camera.facades import SEEN, RenderedFacades

wp.set_module_options({"enable_backward": False})

_KEPT = 64
"""Columns of worlds and lights on a device."""


@wp.struct
class WarpView:
    """What `lidar.sensors.camera.shade.shade` takes of the rays and their hits."""

    origin: wp.array2d[wp.float64]
    row: wp.array[wp.int32]
    direction: wp.array2d[wp.float64]
    range: wp.array[wp.float64]
    normal: wp.array2d[wp.float64]


@wp.struct
class WarpSurfaces:
    """What it takes of the surfaces that are hit."""

    klass: wp.array[wp.uint8]
    material: wp.array[wp.uint8]
    color: wp.array2d[wp.uint8]
    feature: wp.array[wp.int32]
    wall: wp.array[wp.int32]


@wp.struct
class WarpWallTables:
    """What it takes of `lidar.raycast.relief.WallTables`."""

    frame: wp.array2d[wp.float64]
    first: wp.array[wp.int32]
    cells: wp.array[wp.int32]
    faces: wp.array[wp.int32]
    kinds: wp.array2d[wp.float64]


@wp.struct
class WarpWalls:
    """As `lidar.sensors.camera.facades.RenderedFacades`."""

    tables: WarpWallTables
    deep: wp.bool
    color: wp.array2d[wp.uint8]
    material: wp.array[wp.uint8]
    glass: wp.int32


@wp.struct
class WarpLight:
    """What it takes of `lidar.sensors.camera.light.Light`."""

    direction: wp.array[wp.float64]
    beam: wp.array[wp.float64]
    ambient: wp.array2d[wp.float64]
    sky: wp.array3d[wp.float64]
    horizon: wp.array[wp.float64]
    clear: wp.array3d[wp.float64]
    veil: wp.array[wp.float64]
    clouds: wp.array[wp.float64]


@wp.struct
class Materials:
    """As `lidar.sensors.camera.shade.material_tables` and `linear_table`."""

    kind: wp.array[wp.int32]
    floor: wp.array[wp.int32]
    mirror: wp.array[wp.float64]
    plain: wp.array2d[wp.uint8]
    soaked: wp.array[wp.float64]
    linear: wp.array[wp.float64]


@wp.struct
class WarpSettings:
    """As `lidar.sensors.camera.shade.shade` describes them."""

    blur: wp.float64
    angle: wp.float64
    extinction: wp.float64
    detailed: wp.bool


@wp.struct
class Covers:
    """As `lidar.sensors.camera.shade.covers`."""

    wetness: wp.float64
    pools: wp.float64
    snow: wp.float64
    patches: wp.float64


def _fields(name: str, struct: Any) -> list[str]:
    """The fields of an argument of this type."""
    return [f"{name}.{field}" for field in struct.vars]


_SCRATCH = (
    "wp.zeros(shape=(6, 3), dtype=wp.float64)",
    f"wp.zeros(shape=({SEEN},), dtype=wp.float64)",
    "scratch",
)
"""What a pixel is computed in, and the light of the surroundings, which alone the kernel passes."""

_translation = Translation(f"{__name__}.translated")
_pixel = _translation.of(
    shade.pixel,
    {
        "view": _fields("view", WarpView),
        "found": _fields("found", WarpSurfaces),
        "light": _fields("light", WarpLight),
        "tables": _fields("tables", Materials),
        "settings": _fields("settings", WarpSettings),
        "covers": _fields("covers", Covers),
        "scratch": _SCRATCH,
    },
)
Globals = _translation.struct()


@wp.kernel
def _shade(
    view: WarpView,
    found: WarpSurfaces,
    walls: WarpWalls,
    lit: wp.array[wp.bool],
    light: WarpLight,
    tables: Materials,
    settings: WarpSettings,
    covers: Covers,
    town: wp.array[wp.float64],
    out: wp.array2d[wp.float32],
    gloss: wp.array[wp.float32],
    facet: wp.array2d[wp.float32],
    globals_: Globals,  # type: ignore[valid-type]
) -> None:
    """The loop of `lidar.sensors.camera.shade.shade`."""
    i = wp.tid()
    _pixel(i, view, found, walls, lit, light, tables, settings, covers, town, out, gloss, facet, globals_)


class WarpShader:
    """Shades pixels on a device.

    Columns of the world and the light are copied to the device once, as long as they are used.
    """

    def __init__(self, device: WarpDevice) -> None:
        self.device = device
        self._copies: OrderedDict[int, tuple[NDArray[Any], Any]] = OrderedDict()
        self._globals = Globals()
        for name, array in _translation.arrays.items():
            setattr(self._globals, name, device.upload(array))

    def shade(
        self,
        origin: Float,
        row: NDArray[np.int32],
        direction: Float,
        range_: Float,
        normal: Float,
        klass: NDArray[np.uint8],
        material: NDArray[np.uint8],
        color: NDArray[np.uint8],
        feature: NDArray[np.int32],
        wall: NDArray[np.int32],
        walls: RenderedFacades,
        lit: NDArray[np.bool_],
        light: Sequence[Float],
        tables: Sequence[NDArray[Any]],
        settings: tuple[float, float, float, bool],
        covers: tuple[float, float, float, float],
        out: NDArray[np.float32],
        gloss: NDArray[np.float32],
        facet: NDArray[np.float32],
    ) -> None:
        """Fill ``out``, ``gloss`` and ``facet`` as `lidar.sensors.camera.shade.shade` does."""
        with self.device.lock:
            upload = self.device.upload
            results = [upload(column) for column in (out, gloss, facet)]
            given = (
                _fill(WarpView, map(upload, (origin, row, direction, range_, normal))),
                _fill(WarpSurfaces, map(upload, (klass, material, color, feature, wall))),
                self._walls(walls),
                upload(lit),
                self._kept_in(WarpLight, light),
                self._kept_in(Materials, tables),
                _fill(WarpSettings, settings),
                _fill(Covers, covers),
                upload(shade.TOWN * light[4]),
                *results,
                self._globals,
            )
            wp.launch(_shade, dim=len(out), inputs=given, device=self.device.warp_device)
            for column, found in zip((out, gloss, facet), results, strict=True):
                column[...] = found.numpy()

    def _walls(self, walls: RenderedFacades) -> Any:
        t = walls.tables
        tables = self._kept_in(WarpWallTables, (t.frame, t.first, t.cells, t.faces, t.kinds))
        return self._kept_in(WarpWalls, walls._replace(tables=tables))

    def _kept_in(self, struct: Any, values: Iterable[Any]) -> Any:
        """A struct with these values, of which arrays are copied to the device unless they are there."""
        kinds = [field.type for field in struct.vars.values()]
        return _fill(struct, map(self._kept, values, kinds))

    def _kept(self, value: Any, kind: Any) -> Any:
        if not isinstance(value, np.ndarray):
            return value
        key = id(value)  # of an array that is kept: no other gets its number
        column, copy = self._copies.pop(key, (value, None))
        if copy is None:
            copy = self.device.upload(value.astype(wp.dtype_to_numpy(kind.dtype), copy=False))
        self._copies[key] = column, copy
        if len(self._copies) > _KEPT:
            self._copies.popitem(last=False)
        return copy


def _fill(struct: Any, values: Iterable[Any]) -> Any:
    """A struct of Warp with these values of its fields."""
    new = struct()
    for name, value in zip(struct.vars, values, strict=True):
        setattr(new, name, value)
    return new


@functools.cache
def shader(device: str) -> WarpShader:
    """The shader of a device; one object in a process."""
    return WarpShader(device_of(device))
