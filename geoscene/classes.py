"""Semantic classes and materials of surfaces; scenes, point clouds and images share their codes."""

from __future__ import annotations

import functools
import tomllib
from dataclasses import dataclass
from enum import IntEnum
from importlib import resources
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


class Class(IntEnum):
    """Semantic classes. The codes are part of the on-disk formats: never renumber."""

    UNLABELED = 0
    ROAD = 1
    LANE_MARKING = 2
    CROSSING = 3
    SIDEWALK = 4
    KERB = 5
    PARKING = 6
    RAIL = 7
    TERRAIN = 8
    GRASS = 9
    FOREST_FLOOR = 10
    SAND = 11
    WATER = 12
    BUILDING_PAD = 13
    BUILDING = 14
    BRIDGE = 15
    TUNNEL = 16
    WALL = 17
    FENCE = 18
    HEDGE = 19
    TREE_CROWN = 20
    TRUNK = 21
    POLE = 22
    TRAFFIC_SIGN = 23
    TRAFFIC_LIGHT = 24
    BOLLARD = 25
    BENCH = 26
    WIRE = 27
    OTHER_STRUCTURE = 28
    PAVED = 29
    CAR = 40
    VAN = 41
    TRUCK = 42
    BUS = 43
    MOTORCYCLE = 44
    BICYCLE = 45
    CYCLIST = 46
    PEDESTRIAN = 47
    MOTORCYCLIST = 48
    NOISE = 60
    SKY = 61


GROUND = (*(Class(code) for code in range(Class.ROAD, Class.BUILDING_PAD + 1)), Class.PAVED)
"""Classes of the surface of the ground, water and the floors of tunnels among them."""


@dataclass(frozen=True, slots=True)
class ClassCodes:
    """Lookup tables (256,) uint16 from `Class` to the codes of other datasets.

    semantic_kitti, nuscenes, waymo : their published label ids
    asprs : LAS 1.4 classification
    color : (256, 3) uint8, sRGB, for pictures
    """

    semantic_kitti: NDArray[np.uint16]
    nuscenes: NDArray[np.uint16]
    waymo: NDArray[np.uint16]
    asprs: NDArray[np.uint16]
    color: NDArray[np.uint8]


# class: (SemanticKITTI, nuScenes lidarseg, Waymo segmentation, ASPRS LAS 1.4 R15, picture colour)
# Ids from semantic-kitti.yaml, the nuScenes lidarseg list, Waymo's segmentation proto and LAS 1.4 R15;
# LAS codes from 64 on are user-definable.
_CODES: dict[Class, tuple[int, int, int, int, tuple[int, int, int]]] = {
    Class.UNLABELED: (0, 0, 0, 1, (60, 60, 60)),
    Class.ROAD: (40, 24, 18, 11, (128, 64, 128)),
    Class.LANE_MARKING: (60, 24, 19, 11, (255, 255, 255)),
    Class.CROSSING: (60, 24, 20, 11, (220, 220, 190)),
    Class.SIDEWALK: (48, 26, 22, 2, (244, 35, 232)),
    Class.KERB: (48, 26, 17, 2, (196, 196, 196)),
    Class.PARKING: (44, 24, 18, 11, (250, 170, 160)),
    Class.RAIL: (49, 25, 20, 10, (230, 150, 140)),
    Class.TERRAIN: (72, 27, 21, 2, (170, 155, 125)),
    Class.GRASS: (72, 27, 21, 2, (152, 251, 152)),
    Class.FOREST_FLOOR: (72, 27, 21, 2, (90, 130, 70)),
    Class.SAND: (72, 27, 21, 2, (230, 210, 150)),
    Class.WATER: (49, 25, 20, 9, (45, 110, 200)),
    Class.BUILDING_PAD: (49, 25, 21, 2, (150, 150, 160)),
    Class.BUILDING: (50, 28, 14, 6, (240, 180, 80)),
    Class.BRIDGE: (52, 28, 18, 17, (150, 100, 100)),
    Class.TUNNEL: (52, 28, 14, 19, (150, 120, 90)),
    Class.WALL: (50, 28, 14, 64, (102, 102, 156)),
    Class.FENCE: (51, 28, 0, 65, (190, 153, 153)),
    Class.HEDGE: (70, 30, 15, 3, (60, 120, 50)),
    Class.TREE_CROWN: (70, 30, 15, 5, (30, 150, 40)),
    Class.TRUNK: (71, 30, 16, 5, (135, 60, 0)),
    Class.POLE: (80, 28, 10, 66, (153, 153, 153)),
    Class.TRAFFIC_SIGN: (81, 28, 8, 67, (255, 240, 0)),
    Class.TRAFFIC_LIGHT: (80, 28, 9, 68, (250, 170, 30)),
    Class.BOLLARD: (80, 28, 10, 66, (200, 120, 60)),
    Class.BENCH: (99, 29, 0, 69, (160, 110, 60)),
    Class.WIRE: (99, 28, 0, 14, (80, 80, 80)),
    Class.OTHER_STRUCTURE: (52, 28, 14, 69, (180, 130, 110)),
    Class.PAVED: (49, 25, 21, 2, (190, 170, 185)),
    Class.CAR: (10, 17, 1, 70, (0, 60, 200)),
    Class.VAN: (20, 17, 1, 70, (0, 80, 150)),
    Class.TRUCK: (18, 23, 2, 71, (0, 0, 110)),
    Class.BUS: (13, 16, 3, 71, (0, 60, 100)),
    Class.MOTORCYCLE: (15, 21, 13, 72, (0, 0, 230)),
    Class.BICYCLE: (11, 14, 12, 72, (119, 11, 32)),
    Class.CYCLIST: (31, 14, 6, 72, (255, 0, 0)),
    Class.PEDESTRIAN: (30, 2, 7, 73, (220, 20, 60)),
    Class.MOTORCYCLIST: (32, 21, 5, 72, (255, 60, 140)),
    Class.NOISE: (1, 0, 0, 7, (0, 255, 255)),
    Class.SKY: (0, 0, 0, 1, (135, 190, 240)),
}


def class_rows() -> list[dict[str, str | int]]:
    """Name of each class with its code here, in SemanticKITTI, nuScenes lidarseg, Waymo and LAS."""
    names = ("semantic_kitti", "nuscenes", "waymo", "asprs")
    rows: list[dict[str, str | int]] = []
    for klass in Class:
        *codes, _ = _CODES[klass]
        rows.append({"name": klass.name.lower(), "code": int(klass), **dict(zip(names, codes, strict=True))})
    return rows


@functools.cache
def class_codes() -> ClassCodes:
    """The tables that turn `Class` codes into those of other datasets."""
    import numpy as np  # noqa: PLC0415  (0.1 s, and options of commands name classes)

    tables = [np.zeros(256, np.uint16) for _ in range(4)]
    tables[3][:] = 1
    color = np.full((256, 3), 60, np.uint8)
    for klass, (*codes, rgb) in _CODES.items():
        for table, code in zip(tables, codes, strict=True):
            table[klass] = code
        color[klass] = rgb
    kitti, nuscenes, waymo, asprs = tables
    return ClassCodes(kitti, nuscenes, waymo, asprs, color)


def material_names(codes: NDArray[np.integer]) -> NDArray[np.object_]:
    """Names (n,) of material codes."""
    import numpy as np  # noqa: PLC0415

    table = np.full(256, "", object)
    for name, material in materials().items():
        table[material.code] = name
    names: NDArray[np.object_] = table[codes]
    return names


@dataclass(frozen=True, slots=True)
class Material:
    """Optical properties of a surface material.

    code        : number in scene files
    color       : sRGB 0..255, used where the map has no colour
    reflectance : diffuse (hemispherical) reflectance 0..1 at 905, 1064 and 1550 nm
    specular    : share of the reflected light that is specular, 0..1
    wet         : factor of the diffuse reflectance where water has soaked the surface
    source      : source of the numbers
    """

    name: str
    code: int
    color: tuple[int, int, int]
    reflectance: tuple[float, float, float]
    specular: float
    wet: float
    source: str


@functools.cache
def materials() -> dict[str, Material]:
    """Materials by name, from ``geoscene/materials.toml``."""
    table = tomllib.loads(resources.files("geoscene").joinpath("materials.toml").read_text("utf-8"))
    return {
        name: Material(
            name,
            row["code"],
            tuple(row["color"]),
            tuple(row["reflectance"]),
            row["specular"],
            row["wet"],
            row["source"],
        )
        for name, row in table.items()
    }
