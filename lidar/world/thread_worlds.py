"""Worlds of the threads of a drive: the static scene and the actors during a frame."""

from __future__ import annotations

import threading

from geoscene.scene import Scene
from lidar.world.actors import Actors, actor_shapes, actor_transforms
from lidar.world.settings import PLAIN, WorldSettings
from lidar.world.world import Region, World


class Worlds:
    """Worlds of the threads of a drive: one for all threads without moving actors, else one per thread.

    scene    : the static scene
    margin   : maximum range of the sensors, metres
    actors   : the road users; none by default
    settings : of the worlds
    """

    def __init__(
        self,
        scene: Scene,
        margin: float,
        *,
        actors: Actors | None = None,
        settings: WorldSettings = PLAIN,
    ) -> None:
        self.scene = scene
        self.margin = min(margin, settings.reach)
        self.settings = settings
        self.actors = actors if actors is not None and len(actors) else None
        self._region: Region | None = None
        self._shared: World | None = None
        self._own = threading.local()

    def follow(self, region: Region) -> None:
        """Load another region. Call it only while no thread uses a world."""
        self._region = region
        if self.actors is None:
            self._shared = self._loaded(self._shared, region)

    def during(self, start_ns: int, end_ns: int) -> World:
        """The world of this thread until its next call; ray times 0 and 1 are ``start_ns`` and ``end_ns``."""
        if self._shared is not None:
            return self._shared
        region = self._region
        assert region is not None, "follow comes before during"  # noqa: S101
        world: World | None = getattr(self._own, "world", None)
        if world is None or self._own.region != region:
            world = self._loaded(world, region)
            self._own.world, self._own.region = world, region
        if self.actors is not None:
            m = self.margin
            around = (region[0] - m, region[1] - m, region[2] + m, region[3] + m)
            shape, transform, feature = actor_transforms(self.actors, start_ns, end_ns=end_ns, region=around)
            world.place_actors(shape, transform, feature=feature, span_ns=(start_ns, end_ns))
        return world

    def _loaded(self, world: World | None, region: Region) -> World:
        if world is None:
            shapes = actor_shapes(self.actors) if self.actors is not None else ()
            world = World(self.scene, margin=self.margin, actors=shapes, settings=self.settings)
        world.follow(region)
        return world
