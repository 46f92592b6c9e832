"""Small worlds of boxes and plates for tests of sensors."""

from dataclasses import dataclass

import numpy as np

from geoscene.buildings.facades import WallRelief
from geoscene.classes import Class, materials
from geoscene.geometry.mesh import Mesh, concatenate
from lidar.geometry.poses import Trajectory
from lidar.raycast import Caster
from lidar.raycast.geometry import split
from lidar.raycast.relief import NO_WALLS, WallRefiner, join
from lidar.world.settings import PLAIN, WorldSettings
from lidar.world.shelter import shelter_of
from lidar.world.surfaces import MISS, SurfaceFaces, Surfaces, mask_bits, pack_surfaces, surfaces_of
from lidar.world.tiles import openings_of

LEAVES = 0.8  # m2/m3 of leaves in boxes of class HEDGE

_CORNERS = np.array([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)])
_FACES = np.array(
    [
        *([0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]),
        *([2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]),
    ]
)


@dataclass
class MeshWorld:
    """A world of one mesh, with or without openings in its walls."""

    mesh: Mesh
    reach = np.inf
    settings: WorldSettings = PLAIN
    relief: WallRelief | None = None

    def __post_init__(self):
        self.caster = Caster(self.mesh.vertices, self.mesh.faces)
        self.surfaces, tables = surfaces_of(self.mesh, self.settings), NO_WALLS
        if self.relief is not None:
            bits = mask_bits(np.arange(256, dtype=np.uint8))
            tables, added = openings_of(self.relief, origin=np.zeros(3), bits=bits)
            self.surfaces = Surfaces.concatenate([self.surfaces, added])
        self.walls = WallRefiner(join([tables], faces=[0], count=len(self.surfaces) + 1))
        self.caster.refiners = [self.walls] if self.relief is not None else []

    def shelter(self, position):
        """The covered air within 60 m."""
        x, y = np.floor(position[:2]) - 60.0
        parts = split(self.mesh.vertices, self.mesh.faces)
        return shelter_of(parts, origin=np.zeros(3), corner=(x, y), count=120)

    @property
    def faces(self):
        surfaces = self.surfaces
        what = np.append(pack_surfaces(surfaces, surfaces.klass == Class.HEDGE), np.int64(-1) << 32)
        low, high = int(surfaces.feature.min()), int(surfaces.feature.max())
        return SurfaceFaces(
            np.zeros(1, np.int64), np.empty(0, np.int32), what, low, high, np.array([0.0, LEAVES])
        )

    def lookup(self, hits):
        return Surfaces.concatenate([self.surfaces, MISS]).take(hits.face)


def box(low, high, *, feature=0, klass=Class.BUILDING, material="brick"):
    low, high = np.array(low, float), np.array(high, float)
    vertices = low + _CORNERS * (high - low)
    code = materials()[material].code
    return Mesh.of(vertices, _FACES, feature=feature, klass=klass, material=code, closed=True)


def plate(x, *, half=500.0, feature=0, klass=Class.WALL, material="plaster", tilt=0.0):
    """A large square through (x, 0, 0) that faces the origin, rotated by ``tilt`` about the vertical."""
    c, s = np.cos(tilt), np.sin(tilt)
    vertices = [
        [x + s * u, c * u, v] for u, v in ((-half, -half), (half, -half), (half, half), (-half, half))
    ]
    code = materials()[material].code
    faces = np.array([[0, 2, 1], [0, 3, 2]])
    return Mesh.of(np.array(vertices), faces, feature=feature, klass=klass, material=code)


def world(*meshes, **settings):
    return MeshWorld(concatenate(meshes), settings=WorldSettings(**settings))


def driven(velocity=(0.0, 0.0, 0.0), *, yaw_rate=0.0, start=(0.0, 0.0, 0.0), seconds=5.0, scale=1.0):
    """A drive at constant velocity (true m/s) and yaw rate (rad/s)."""
    t = np.arange(0, round(seconds * 1e9) + 1, 10_000_000, dtype=np.int64)
    s = t * 1e-9
    factor = np.array([scale, scale, 1.0])
    position = np.array(start, float) + s[:, None] * np.array(velocity, float) * factor
    half = yaw_rate * s / 2
    quat = np.stack([0 * s, 0 * s, np.sin(half), np.cos(half)], axis=1)
    speed = np.tile(np.array(velocity, float), (len(t), 1))
    return Trajectory(t, position, quat, speed, np.full(len(t), scale))
