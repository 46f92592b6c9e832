"""Colours of instances in images: faces of signs, number plates, clothes and paint."""

# mypy: disallow-untyped-decorators=False
from __future__ import annotations

import weakref
from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import Class, materials
from geoscene.typing import Float
from lidar.raycast import Caster
from lidar.sensors.camera.light import LENSES
from lidar.sensors.camera.sign_faces import OF_SHAPE, PLATE, SIDE, face_levels, plate_levels, sample
from lidar.sensors.camera.texture import compiled, hash_place
from lidar.world.actor_shapes import CLOTHES, FLEET
from lidar.world.actor_solids import HAIR, SKIN, WHITE
from lidar.world.world import World

_CODE = {name: material.code for name, material in materials().items()}
_SHEET, _CLOTH, _SKIN, _PAINT, _GLASS = (
    _CODE[name] for name in ("retroreflector", "clothing", "skin", "car_paint", "glass")
)
_SIGN, _SIGNAL = int(Class.TRAFFIC_SIGN), int(Class.TRAFFIC_LIGHT)
_FIRST, _LAST = int(Class.CAR), int(Class.MOTORCYCLIST)
_PLATED = (Class.CAR, Class.VAN, Class.TRUCK, Class.BUS)

SIGN_HEIGHT = 2.5
"""Height in metres of the centre of a sign's plate in its shape, see `geoscene.objects.shapes`."""

_JACKETS = np.array(
    [[36, 44, 78], [120, 122, 126], [150, 40, 42], [206, 198, 182], [28, 28, 32], [62, 66, 70], [58, 74, 52],
     [96, 74, 52], [168, 128, 72], [72, 98, 138], [226, 224, 216], [88, 36, 58], [196, 168, 48],
     [40, 92, 92]],
    np.uint8,
)  # fmt: skip
_TROUSERS = np.array(
    [[44, 46, 52], [52, 62, 92], [40, 40, 44], [96, 84, 68], [70, 84, 112], [28, 28, 30], [128, 118, 98],
     [60, 62, 56]],
    np.uint8,
)  # fmt: skip
_SKINS = np.array([[236, 196, 170], [214, 170, 138], [188, 140, 106], [146, 100, 70], [98, 64, 46]], np.uint8)
_HAIRS = np.array([[62, 46, 36], [28, 24, 22], [106, 76, 46], [176, 140, 86], [132, 128, 124]], np.uint8)
_PAINTS = np.array(
    [[232, 232, 228], [232, 232, 228], [120, 122, 126], [182, 185, 188], [22, 22, 26], [32, 58, 118],
     [150, 24, 28], [40, 74, 58], [214, 170, 40]],
    np.uint8,
)  # fmt: skip
"""Colours of clothes, skin, hair and of the paint of vans, lorries, buses and two-wheelers: assumed."""

_OLD_JACKETS = np.array([jacket for jacket, _ in CLOTHES.values()], np.uint8)
_OLD_TROUSERS = np.array([trousers for _, trousers in CLOTHES.values()], np.uint8)
_OLD_HAIR, _OLD_SKIN = np.array([HAIR], np.uint8), np.array([SKIN], np.uint8)
_OLD_PAINTS = np.array([paint for fleet in FLEET.values() for paint in fleet.values()], np.uint8)


def colors(
    world: World,
    *,
    instance: NDArray[np.int32],
    face: NDArray[np.int32],
    klass: NDArray[np.uint8],
    material: NDArray[np.uint8],
    feature: NDArray[np.int32],
    color: NDArray[np.uint8],
    place: Callable[[NDArray[np.intp]], Float],
    width: Float,
) -> NDArray[np.uint8]:
    """SRGB (n, 3) of hits on instances: signs, plates, clothes.

    instance, face : (n,) of the hits
    klass, material, feature, color : of their surfaces, see `lidar.world.surfaces.Surfaces`
    place : returns the places (k, 3) of some of these hits, by row, in the instances' own frames
    width : (n,) metres that a pixel is wide at the hit
    """
    out = color.copy()
    _vary(feature, klass, material, out)
    _draw_signs(world, klass, material=material, feature=feature, place=place, width=width, out=out)
    plated = (material == _SHEET) & np.isin(klass, _PLATED) & (color == WHITE).all(axis=1)
    rows = np.flatnonzero(plated)
    if len(rows):
        spot = place(rows)
        centre, across = _plate_axes(world, instance[rows], face=face[rows], place=spot)
        for number in np.unique(feature[rows]).tolist():
            own = np.flatnonzero(feature[rows] == number)
            out[rows[own]] = sample(
                plate_levels(number),
                np.column_stack([across[own], spot[own, 2] - centre[own]]),
                width=width[rows[own]],
                side=PLATE[0],
            )
    return out


def _draw_signs(
    world: World,
    klass: NDArray[np.uint8],
    *,
    material: NDArray[np.uint8],
    feature: NDArray[np.int32],
    place: Callable[[NDArray[np.intp]], Float],
    width: Float,
    out: NDArray[np.uint8],
) -> None:
    """Draw the faces of signs and signals into colours (n, 3)."""
    signs = np.flatnonzero((klass == _SIGN) & (material == _SHEET))
    if len(signs):
        faces = _faces(world)
        for number in np.unique(feature[signs]).tolist():
            own = signs[feature[signs] == number]
            where = place(own)[:, 1:] - [0.0, SIGN_HEIGHT]
            out[own] = sample(face_levels(faces.get(number, "plain")), where, width=width[own], side=SIDE)
    signals = np.flatnonzero((klass == _SIGNAL) & (material == _GLASS))
    if len(signals):
        where = place(signals)[:, 1:] - [0.0, LENSES]
        out[signals] = sample(face_levels("signal"), where, width=width[signals], side=SIDE)


@compiled
def _vary(
    feature: NDArray[np.int32],
    klass: NDArray[np.uint8],
    material: NDArray[np.uint8],
    color: NDArray[np.uint8],
) -> None:
    """Replace colours (n, 3) of the catalogue's people and vehicles by ones that depend on their numbers."""
    for i in range(len(feature)):
        if klass[i] < _FIRST or klass[i] > _LAST:
            continue
        m = material[i] & 127
        if m == _CLOTH:
            if _one_of(color[i], _OLD_JACKETS):
                _pick(color[i], feature[i], _JACKETS, 90)
            elif _one_of(color[i], _OLD_TROUSERS):
                _pick(color[i], feature[i], _TROUSERS, 91)
            elif _one_of(color[i], _OLD_HAIR):
                _pick(color[i], feature[i], _HAIRS, 92)
        elif m == _SKIN and _one_of(color[i], _OLD_SKIN):
            _pick(color[i], feature[i], _SKINS, 93)
        elif m == _PAINT and klass[i] != _FIRST:
            if _one_of(color[i], _OLD_PAINTS):
                _pick(color[i], feature[i], _PAINTS, 94)
        elif m == _PAINT:
            for c in range(3):  # cars have the paints of the catalogue, in shades
                shade = (
                    1.0
                    + 0.16 * (hash_place(feature[i], 95, 20) - 0.5)
                    + 0.08 * (hash_place(feature[i], c, 96) - 0.5)
                )
                color[i, c] = np.uint8(min(color[i, c] * shade, 255.0))


@compiled
def _one_of(color: NDArray[np.uint8], table: NDArray[np.uint8]) -> bool:
    for k in range(len(table)):
        if color[0] == table[k, 0] and color[1] == table[k, 1] and color[2] == table[k, 2]:
            return True
    return False


@compiled
def _pick(color: NDArray[np.uint8], feature: int, table: NDArray[np.uint8], key: int) -> None:
    row = int(hash_place(feature, key, 20) * len(table))
    for c in range(3):
        color[c] = table[row, c]


_FACES: weakref.WeakKeyDictionary[World, dict[int, str]] = weakref.WeakKeyDictionary()


def _faces(world: World) -> Mapping[int, str]:
    """Sign faces of the scene by feature number: as mapped, else inferred from the form."""
    found = _FACES.get(world)
    if found is None:
        columns = world.scene.features("furniture", geometry="none").columns
        shape = columns["shape"].tolist()
        mapped = columns["face"].tolist() if "face" in columns else [None] * len(shape)
        found = {
            number: face or OF_SHAPE.get(name, "plain")
            for number, name, face in zip(columns["feature"].tolist(), shape, mapped, strict=True)
            if name.startswith("sign_")
        }
        _FACES[world] = found
    return found


_CORNERS: weakref.WeakKeyDictionary[Caster, Float] = weakref.WeakKeyDictionary()


def _corners(shape: Caster) -> Float:
    """Corners (m, 3, 3) of the faces of an instanced caster, by their numbers in hits."""
    known = _CORNERS.get(shape)
    if known is None:
        parts = list(shape.scene.parts.values())
        count = sum(len(part) for part in parts)
        known = np.empty((count, 3, 3))
        for part in parts:
            own = part.numbers[: len(part)] if len(part.numbers) else np.arange(len(part))
            known[own + part.first] = part.vertices[part.faces] + shape.origin
        _CORNERS[shape] = known
    return known


def _plate_axes(
    world: World, instance: NDArray[np.int32], *, face: NDArray[np.int32], place: Float
) -> tuple[Float, Float]:
    """Height of the plate's centre at each hit, and metres to its right, viewed from outside.

    A face of a plate is half of a rectangle, which has the same bounds.
    """
    low, high = np.empty((len(face), 3)), np.empty((len(face), 3))
    start = 0
    for group in world.caster.instances:
        for shape in np.unique(group.shape).tolist():
            own = np.flatnonzero((instance >= start) & (instance < start + len(group)))
            own = own[group.shape[instance[own] - start] == shape]
            if len(own):
                corners = _corners(group.shapes[shape])[face[own]]
                low[own], high[own] = corners.min(axis=1), corners.max(axis=1)
        start += len(group)
    middle = (low + high) / 2
    facing = np.where(middle[:, 0] > 0, 1.0, -1.0)
    return middle[:, 2], facing * (place[:, 1] - middle[:, 1])
