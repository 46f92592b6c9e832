"""The scene around a vehicle as rays see it: static tiles that come and go, actors that move."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoscene.mesh import Mesh
from geoscene.scene import Scene
from lidar.raycast import Caster, Hits

Float = NDArray[np.float64]
Region = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class Surfaces:
    """What rays hit, one row a ray; a miss has feature -1 and zero elsewhere.

    feature  : (n,) int32, feature number of the scene, or of the actor
    klass    : (n,) uint8, code of `geoscene.classes.Class`
    material : (n,) uint8, code of `geoscene.classes.Material`
    surface  : (n,) uint8, OTHER, WALL, ROOF or FLOOR of `geoscene.mesh`
    color    : (n, 3) uint8, sRGB
    """

    feature: NDArray[np.int32]
    klass: NDArray[np.uint8]
    material: NDArray[np.uint8]
    surface: NDArray[np.uint8]
    color: NDArray[np.uint8]


class World:
    """The part of a scene that rays can reach; coordinates are scene metres.

    ``world.caster`` casts the rays (see `lidar.raycast.Caster`), `lookup` says what they hit and `normals`
    how it stands. `follow` moves the part along; `with_actors` puts moving things into it.
    """

    caster: Caster

    @classmethod
    def load(
        cls, scene: Scene, *, region: Region | None = None, margin: float = 0.0, actors: Sequence[Mesh] = ()
    ) -> World:
        """The world of the tiles that touch a region.

        region : (xmin, ymin, xmax, ymax) in scene metres; the whole scene by default
        margin : metres to add on every side: the reach of the sensors
        actors : shapes of the things that may move later (see `with_actors`), closed, in their own frames

        Raises InputError if no tile touches the region.
        """
        raise NotImplementedError

    def follow(self, region: Region) -> World:
        """The world of another region with the same margin; tiles of both are kept, others dropped and read."""
        raise NotImplementedError

    def with_actors(self, shape: NDArray[np.int32], transform: Float, feature: NDArray[np.int32]) -> World:
        """This world with actors in it; its static part is shared, not built again.

        shape     : (k,) int32, index into the ``actors`` given to `load`
        transform : (k, 3, 4) float64, scene from actor; or (k, s, 3, 4) at s >= 2 moments evenly spaced over
                    the ray times 0 to 1: each ray meets the actor where it is at the ray's own time
        feature   : (k,) int32, numbers to find in `Surfaces.feature`
        """
        raise NotImplementedError

    def lookup(self, hits: Hits) -> Surfaces:
        """What the rays hit."""
        raise NotImplementedError

    def normals(self, hits: Hits, *, time: NDArray[np.float32] | None = None) -> Float:
        """Unit normals (n, 3) of what the rays hit, scene axes; zero for a miss. See `Caster.normals`."""
        raise NotImplementedError
