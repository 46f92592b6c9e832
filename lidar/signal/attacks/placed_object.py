"""Objects that an attacker places in the scene: meshes on the road, beside it, or ahead of the vehicle."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from geoscene.classes import Class, materials
from geoscene.errors import need, reason_of
from geoscene.geometry.mesh import Mesh
from geoscene.scene import Scene
from geoscene.typing import Float, Ints
from lidar.errors import InputError
from lidar.geometry.poses import Trajectory
from lidar.parameters import parameter
from lidar.signal.attacks.attacker import checked_digest
from lidar.signal.registry import Stages
from lidar.signal.situation import degrees_of
from lidar.signal.stage import Stage
from lidar.world.actor_shapes import ActorShape
from lidar.world.actors import Actors, first_feature, join_actors
from lidar.world.ground import ground_height, ground_heights

_CLASSES = (
    *(Class.OTHER_STRUCTURE, Class.CAR, Class.VAN, Class.TRUCK, Class.BUS, Class.MOTORCYCLE, Class.BICYCLE),
    *(Class.CYCLIST, Class.PEDESTRIAN, Class.MOTORCYCLIST, Class.TRAFFIC_SIGN, Class.POLE, Class.BOLLARD),
)
_PLACE = "LAT,LON"
_KNOT_S = 0.05  # seconds between poses of an object that moves along
_LARGEST = 100.0  # metres, longest side of an object


_CUBE = (
    np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (0.0, 1.0)]),
    np.array(
        [
            *([0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]),
            *([2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]),
        ]
    ),
)


@dataclass(frozen=True)
class PlacedObject(Stage):
    """A mesh in the scene, which all sensors see: an adversarial object, or one that hides others (Tu 2020).

    It stands at a ``place``, or moves along with the vehicle, ahead of it.
    """

    mesh: str = parameter(
        "", "FILE.obj, .stl or .ply in metres: x forward, y left, z up, on z = 0; empty: a cube of 1 m"
    )
    place: str = parameter("", "LAT,LON in degrees; empty: moves along with the vehicle")
    ahead: float = parameter(
        10.0, "without place: distance before the vehicle's rear axle", unit="m", low=-200, high=200
    )
    left: float = parameter(0.0, "without place: distance to the left", unit="m", low=-100, high=100)
    lift: float = parameter(0.0, "height above the ground, such as on a roof", unit="m", low=-10, high=100)
    yaw: float = parameter(
        0.0, "turn to the left, from east or from the vehicle's heading", unit="degrees", low=-360, high=360
    )
    size: float = parameter(1.0, "factor of the mesh's size", low=1e-4, high=1e4)
    material: str = parameter("metal", "material of all faces", among=(*materials(),))
    digest: str = parameter("", "of the mesh's file, which the program fills in; another one is refused")
    klass: str = parameter(
        "other_structure", "class in labels", among=tuple(klass.name.lower() for klass in _CLASSES)
    )

    def __post_init__(self) -> None:
        """Validate the parameters and read the mesh."""
        super().__post_init__()
        _read_mesh(self.mesh)
        object.__setattr__(self, "digest", checked_digest(self.mesh, known=self.digest))
        if self.place:
            degrees_of(self.place, form=_PLACE)

    def scene(self, scene: Scene, trajectory: Trajectory) -> Actors:
        """The object on the ground of a scene, as a road user of kind ``placed_object``.

        Raises InputError for a place outside the scene.
        """
        shape = self._shape()
        scale = float(np.median(trajectory.scale[:1000]))
        time_ns, position, yaw = self._track(scene, trajectory)
        position[:, 2] += self.lift
        velocity = _rates(position, time_ns)
        one = np.ones(1, np.int32)
        return Actors(
            shapes=(shape,),
            shape=np.zeros(1, np.int32),
            poses=one,
            stride=np.ones(1),
            kind=np.array([shape.kind], np.str_),
            klass=np.array([int(shape.klass)], np.uint8),
            size=np.array([[shape.length, shape.width, shape.height]]),
            stretch=np.ones((1, 3)),
            parked=np.array([bool(self.place)]),
            feature=np.zeros(1, np.int32),
            begin_ns=time_ns[:1],
            end_ns=time_ns[-1:],
            first=np.array([0, len(time_ns)], np.int64),
            time_ns=time_ns,
            position=position,
            angles=np.column_stack([yaw, np.zeros((len(yaw), 2))]),
            velocity=velocity,
            travelled=np.zeros(len(time_ns)),
            scale=scale,
        )

    def _shape(self) -> ActorShape:
        vertices, faces = _read_mesh(self.mesh)
        vertices = vertices * self.size
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        if (high - low).max() > _LARGEST:
            raise InputError(
                f"{self.mesh}: is {(high - low).max():.0f} m large; give metres, or a smaller size"
            )
        vertices = vertices - [*((low + high)[:2] / 2), 0.0]
        klass, material = Class[self.klass.upper()], materials()[self.material].code
        mesh = Mesh.of(vertices, faces, klass=int(klass), material=material)
        length, width, _ = (high - low).tolist()
        name = f"placed_object/{self.mesh}/{self.material}/{self.klass}/{self.size:g}"
        return ActorShape(name, "placed_object", klass, length, width, float(high[2]), length, mesh)

    def _track(self, scene: Scene, trajectory: Trajectory) -> tuple[Ints, Float, Float]:
        """Times (k,), positions (k, 3) on the ground and yaws (k,) of the object."""
        turn = np.radians(self.yaw)
        if self.place:
            lat, lon = degrees_of(self.place, form=_PLACE)
            x, y = scene.frame.from_geographic(lon, lat)
            point = np.array([[float(x), float(y), ground_height(scene, x=float(x), y=float(y))]])
            if not np.isfinite(point).all():
                raise InputError(f"place = {self.place!r} has no ground in the scene")
            return np.zeros(1, np.int64), point, np.array([turn])
        end = trajectory.duration_ns
        count = max(2, int(np.ceil(end * 1e-9 / _KNOT_S)) + 1)
        time_ns = np.linspace(0, end, count).astype(np.int64)
        poses = trajectory.at(time_ns)
        position = poses.place(np.array([[self.ahead, self.left, 0.0]]).repeat(count, axis=0))
        ground = ground_heights(scene, position)
        position[:, 2] = np.where(np.isfinite(ground), ground, position[:, 2])
        heading = np.unwrap(np.arctan2(poses.rotation[:, 1, 0], poses.rotation[:, 0, 0]))
        return time_ns, position, heading + turn


def with_objects(
    actors: Actors | None, stages: Stages, *, scene: Scene, trajectory: Trajectory
) -> Actors | None:
    """The road users together with the objects of stages, which get the last feature numbers."""
    placed = [named.stage for named in stages.stages if isinstance(named.stage, PlacedObject)]
    if not placed:
        return actors
    groups: Iterable[Actors] = [one.scene(scene, trajectory) for one in placed]
    return join_actors([*([] if actors is None else [actors]), *groups], first_feature=first_feature(scene))


@lru_cache(maxsize=16)
def _read_mesh(path: str) -> tuple[Float, Ints]:
    """Vertices (n, 3) and faces (m, 3) of a file; raises InputError if it cannot be read."""
    if not path:
        return _CUBE
    trimesh = need("trimesh", "trimesh")
    if Path(path).suffix.lower() not in (".obj", ".stl", ".ply"):
        raise InputError(f"mesh = {path!r} is no .obj, .stl or .ply file")
    try:
        read = trimesh.load(path, force="mesh", process=False)
    except Exception as error:  # noqa: BLE001 - trimesh raises what its parsers raise
        raise InputError(f"{path}: cannot be read as a mesh ({reason_of(error)})") from None
    vertices, faces = np.asarray(read.vertices, float), np.asarray(read.faces, np.int64)
    if not len(faces) or not np.isfinite(vertices).all():
        raise InputError(f"{path}: has no faces, or vertices that are not finite")
    return vertices, faces


def _rates(position: Float, time_ns: Ints) -> Float:
    """Velocities (k, 3) at knots, scene metres per second."""
    if len(time_ns) < 2:
        return np.zeros_like(position)
    found: Float = np.gradient(position, time_ns * 1e-9, axis=0)
    return found
