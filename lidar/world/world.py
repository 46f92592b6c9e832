"""The scene around a vehicle for ray casting: static tiles loaded by region, and moving actors."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import Class
from geoscene.geometry.mesh import Mesh, ShapeInstances
from geoscene.objects.shapes import LEAF_AREA_DENSITY
from geoscene.scene import Scene
from geoscene.scene.layout import OVERHANG
from geoscene.typing import Float
from geoscene.uses import MESH
from lidar.errors import InputError
from lidar.raycast import Caster, Hits, MeshInstances
from lidar.raycast.hits import Refiner
from lidar.raycast.relief import (
    NO_WALLS,
    GroundRefiner,
    WallRefiner,
    join,
    joined_ground,
)
from lidar.world.actors import Actors, actor_shapes, actor_transforms
from lidar.world.settings import PLAIN, WorldSettings, check_relief
from lidar.world.shelter import CELL, Shelter, shelter_of
from lidar.world.surfaces import (
    GLASS,
    MISS,
    OPEN,
    SOLID,
    WATER,
    SurfaceFaces,
    Surfaces,
    mask_bits,
    pack_surfaces,
    surfaces_at,
    surfaces_of,
)
from lidar.world.tiles import LoadedTile, SharedTiles, load_tile

Region = tuple[float, float, float, float]

_ABOVE, _CEILING = 0.05, 100.0
"""Metres above a face from which, and up to which, roofs are looked for."""

_WITHIN = 160.0  # metres around a place within which shelter is known, at most
_MOVED = 32.0  # metres between places that share a shelter
_KEPT = 4  # shelters that are kept
_GRID = 2048.0  # spacing in metres of possible origins of float32 coordinates
_PARTS = 8  # part numbers per tile, one for each mask


_TILES = SharedTiles()


def _empty_caster(origin: Float, *, backend: str, settings: WorldSettings) -> Caster:
    return Caster(origin=origin, dynamic=True, backend=backend, device=settings.device)


class _Placed(NamedTuple):
    """Copies of shapes by number, and the same for rays."""

    copies: ShapeInstances
    instances: MeshInstances


class _Shapes:
    """Shapes that get a caster when they are first placed: of most, no copy is near."""

    def __init__(self, meshes: Sequence[Mesh], backend: str, *, device: str) -> None:
        self.meshes, self._backend, self._device = meshes, backend, device
        self._casters: dict[int, Caster] = {}

    def _caster(self, number: int) -> Caster:
        if number not in self._casters:
            mesh = self.meshes[number]
            self._casters[number] = Caster(
                mesh.vertices,
                mesh.faces,
                mask=mask_bits(mesh.material),
                backend=self._backend,
                device=self._device,
            )
        return self._casters[number]

    def placed(self, copies: ShapeInstances) -> _Placed:
        """Copies of the shapes, with transforms as of `World.place_actors`.

        Raises InputError for a number beyond the shapes.
        """
        shape = copies.shape
        if len(shape) and not 0 <= shape.min() <= shape.max() < len(self.meshes):
            raise InputError(f"an instance has a shape number beyond the {len(self.meshes)} shapes")
        used, own = np.unique(shape, return_inverse=True)
        casters = tuple(self._caster(number) for number in used.tolist())
        return _Placed(copies, MeshInstances(casters, own.astype(np.int32), copies.transform))


class World:
    """The loaded part of a scene, for ray casting; coordinates are scene metres.

    ``world.caster`` casts the rays (see `lidar.raycast.Caster`), `lookup` returns the surfaces of their hits.
    ``faces`` has the attributes of all faces, for compiled code; ``surfaces`` is the table of surfaces, where
    hits on the mesh have the row `Hits.face`; ``walls`` has the openings of walls, none without relief.
    `follow` loads another region and `place_actors` places moving actors, both in place: look up hits first.

    scene    : the scene
    margin   : metres around every region: the maximum range of the sensors; at most the reach of the settings
    actors   : bodies of actors (see `place_actors`), closed, in their own frames
    settings : what of the scene is loaded
    backend  : of the caster, see `lidar.raycast.Caster`
    """

    def __init__(
        self,
        scene: Scene,
        *,
        margin: float = 0.0,
        actors: Sequence[Mesh] = (),
        settings: WorldSettings = PLAIN,
        backend: str = "auto",
    ) -> None:
        check_relief(scene, settings)
        self._named = scene.shapes()
        shapes = list(self._named.values())
        self.scene = scene.with_relief_mesh() if settings.relief == MESH else scene
        self._leaves: Mapping[str, float] = scene.manifest.get("leaf_area_density", LEAF_AREA_DENSITY)
        self.margin = min(margin, settings.reach)
        self.settings = settings
        self._backend = backend
        self.region: Region | None = None
        self._shapes, self._actors = (
            _Shapes(meshes, backend, device=settings.device) for meshes in (shapes, actors)
        )
        self._copied = [surfaces_of(mesh, settings) for mesh in (*shapes, *actors)]
        self._tiles: dict[int, LoadedTile] = {}
        self._moving = self._actors.placed(ShapeInstances.empty())
        self.span_ns = 0, 1
        self._sheltered: dict[tuple[float, float], Shelter | None] = {}
        self.caster = _empty_caster(np.zeros(3), backend=backend, settings=settings)
        self.walls = WallRefiner(NO_WALLS)
        self._concatenate_tables()

    @classmethod
    def load(
        cls,
        scene: Scene,
        *,
        region: Region | None = None,
        margin: float = 0.0,
        actors: Sequence[Mesh] = (),
        settings: WorldSettings = PLAIN,
        backend: str = "auto",
    ) -> World:
        """The world of the tiles that intersect a region.

        region : (xmin, ymin, xmax, ymax) in scene metres; the whole scene by default

        Other parameters are those of the class.

        Raises InputError if no tile intersects the region.
        """
        world = cls(scene, margin=margin, actors=actors, settings=settings, backend=backend)
        world.follow(scene.bounds if region is None else region)
        if region is not None and not world.has_tiles:
            raise InputError(
                f"no tile of {scene.path} lies in {tuple(round(float(v), 1) for v in region)};"
                f" the scene covers {scene.bounds}"
            )
        return world

    def follow(self, region: Region) -> None:
        """Load another region in place; tiles of both regions are kept. Regions off the scene are empty.

        The hits depend on the region alone, not on earlier ones.
        """
        ranks = _tiles_intersecting(self.scene, region, margin=self.margin + OVERHANG)
        xmin, ymin, xmax, ymax = region
        origin = np.array([(xmin + xmax) / 2, (ymin + ymax) / 2, 0.0])
        origin = np.round(origin / _GRID) * _GRID if self.settings.origin == "near" else np.zeros(3)
        if not np.array_equal(origin, self.caster.origin):
            self.caster = _empty_caster(origin, backend=self._backend, settings=self.settings)
            self._tiles = {}
        elif ranks == list(self._tiles):
            self.region = region
            return
        old, kept = self._tiles, self._tiles.keys() & set(ranks)
        self._tiles = {rank: old[rank] if rank in kept else self._tile(rank) for rank in ranks}
        _TILES.keep(self._tiles.values())
        self.region = region
        self._concatenate_tables()
        numbers = {r: range(_PARTS * r, _PARTS * r + len(t.parts)) for r, t in (old | self._tiles).items()}
        self.caster.update(
            detach=[number for rank in old.keys() - kept for number in numbers[rank]],
            attach={
                n: part
                for rank in ranks
                if rank not in kept
                for n, part in zip(numbers[rank], self._tiles[rank].parts, strict=True)
            },
            first={n: self._first[rank] for rank in ranks for n in numbers[rank]},
            instances=self._instances,
        )
        self.caster.refiners = self._refiners()
        if self.settings.wetness or self.settings.snow:
            self.caster.update(instances=[self._still.instances])
            self._shelter()
            self.caster.update(instances=self._instances)

    def place_actors(
        self,
        shape: NDArray[np.int32],
        transform: Float,
        *,
        feature: NDArray[np.int32],
        span_ns: tuple[int, int] = (0, 1),
    ) -> None:
        """Replace the actors of this world; its static part is not rebuilt.

        shape     : (k,) int32, index into the ``actors`` of the world
        transform : (k, 3, 4) float64, scene from actor; or (k, s, 3, 4) at s >= 2 moments evenly spaced over
                    the ray times 0 to 1: each ray intersects the actor at its pose at the ray's own time
        feature   : (k,) int32, numbers to find in `Surfaces.feature`
        span_ns   : times that the ray times 0 and 1 stand for
        """
        self.span_ns = span_ns
        copies = ShapeInstances(np.asarray(shape, np.int32), transform, np.asarray(feature, np.int32))
        self._moving = self._actors.placed(copies)
        self._index_instances()
        self.caster.update(instances=self._instances)

    def lookup(self, hits: Hits) -> Surfaces:
        """Surfaces that the rays hit."""
        return surfaces_at(self.surfaces, hits.face, hits.instance, start=self._base, named=self._feature)

    def shelter(self, position: Float) -> Shelter | None:
        """Covered air (under roofs, bridges, in tunnels) around a place; None if nothing is covered.

        It is known within the margin of the world, and at most within 160 m, whatever else is loaded. Trees,
        furniture and actors shelter nothing.

        position : (3,) scene metres
        """
        half = np.floor((min(self.margin, _WITHIN) - _MOVED / 2) / CELL)
        x, y = np.round(position[:2] / _MOVED) * _MOVED
        if half < 1:
            return None
        if (place := (float(x), float(y))) not in self._sheltered:
            corner = float(x - half), float(y - half)
            parts = (p for t in self._tiles.values() for p in t.parts if p.mask & (SOLID | GLASS | WATER))
            found = shelter_of(parts, origin=self.caster.origin, corner=corner, count=int(2 * half / CELL))
            self._sheltered = dict([*self._sheltered.items(), (place, found)][-_KEPT:])
        return self._sheltered[place]

    @property
    def has_tiles(self) -> bool:
        """Whether any tile of the scene is loaded."""
        return bool(self._tiles)

    @property
    def reach(self) -> float:
        """Metres from a sensor beyond which nothing is hit."""
        return self.settings.reach

    def _refiners(self) -> list[Refiner]:
        """Refiners of the loaded tiles: they intersect rays with the surfaces behind the planes of faces.

        A kind of surface is one `lidar.raycast.hits.Refiner`. It finds its own faces by `Hits.face`, which
        is also the row in the table of surfaces of the world.
        """
        count = len(self.surfaces)
        tables = [NO_WALLS, *(tile.walls for tile in self._tiles.values())]
        faces = [0, *(self._first[rank] for rank in self._tiles)]
        self.walls = WallRefiner(join(tables, faces=faces, count=count))
        refiners: list[Refiner] = []
        if self.settings.relief != "off" and len(self.walls.tables.first):
            refiners.append(self.walls)
        rough = {self._first[rank]: tile.ground for rank, tile in self._tiles.items() if tile.ground}
        if rough:
            refiners.append(GroundRefiner(joined_ground(rough, count=count)))
        return refiners

    def _tile(self, rank: int) -> LoadedTile:
        origin, settings = self.caster.origin, self.settings
        # a tile holds its scene, so no other scene has the same number
        key = id(self.scene), rank, settings, *origin.tolist()
        load = partial(load_tile, self.scene, rank, origin=origin, settings=settings, shapes=self._named)
        return _TILES.get(key, load)

    def _concatenate_tables(self) -> None:
        """Concatenate the tables of tiles and shapes, with the row of a miss last (index -1)."""
        tables = [*(tile.surfaces for tile in self._tiles.values()), *self._copied]
        starts = np.cumsum([0, *(len(table.klass) for table in tables)])
        self._first = dict(zip(self._tiles, starts.tolist(), strict=False))
        self.surfaces = Surfaces.concatenate([*tables, MISS])
        self._packed = pack_surfaces(self.surfaces, self._leaves_of(starts[len(self._tiles) :]))
        feature = self.surfaces.feature
        self._bounds = int(feature.min()), int(feature.max())
        copies = [ShapeInstances.empty(), *(tile.instances for tile in self._tiles.values())]
        self._still = self._shapes.placed(ShapeInstances.concatenate(copies))
        self._of_shape, self._of_actor = np.split(starts[len(self._tiles) : -1], [len(self._shapes.meshes)])
        self._index_instances()

    def _shelter(self) -> None:
        """Clear `OPEN` of faces of tiles under roofs, bridges and in tunnels, by a ray upwards from each."""
        first = len(self.surfaces) - sum(len(table) for table in self._copied) - 1
        row = np.flatnonzero(self.surfaces.material[:first] & OPEN)
        if not len(row):
            return
        start = np.concatenate([tile.centre for tile in self._tiles.values()])[row] + [0.0, 0.0, _ABOVE]
        up = np.broadcast_to([0.0, 0.0, 1.0], start.shape)
        covered = row[self.caster.occluded(start, up, far=_CEILING, mask=SOLID | GLASS)]
        self.surfaces.material[covered] &= ~np.uint8(OPEN)
        self._packed[covered] &= ~np.int64(OPEN)
        self._index_instances()

    def _leaves_of(self, starts: NDArray[np.integer]) -> NDArray[np.uint8]:
        """Kinds of leaves of all rows of the tables; ``starts`` are those of the shapes."""
        kinds, found = list(self._leaves), np.zeros(len(self.surfaces.klass), np.uint8)
        for k, (name, mesh) in enumerate(self._named.items()):
            if name in kinds:
                leafy = mesh.klass == Class.TREE_CROWN  # limbs in a crown let no ray pass
                found[starts[k] : starts[k + 1]][leafy] = 1 + kinds.index(name)
        if "hedge" in kinds:
            found[self.surfaces.klass == Class.HEDGE] = 1 + kinds.index("hedge")
        return found

    def _index_instances(self) -> None:
        """Set the first rows and feature numbers of all instances."""
        still, moving = self._still.copies, self._moving.copies
        self._base = np.concatenate([self._of_shape[still.shape], self._of_actor[moving.shape], [0]])
        self._feature = np.concatenate([still.feature, moving.feature])
        low, high = self._bounds
        if len(self._feature):
            low, high = min(low, int(self._feature.min())), max(high, int(self._feature.max()))
        leaves = np.array([0.0, *self._leaves.values()])
        self.faces = SurfaceFaces(self._base, self._feature, self._packed, low, high, leaves)

    @property
    def _instances(self) -> list[MeshInstances]:
        return [self._still.instances, self._moving.instances]


def _tiles_intersecting(scene: Scene, region: Region, *, margin: float) -> list[int]:
    """Indices of the scene's tiles that intersect a region grown by a margin."""
    boxes = scene.tile_boxes
    near = (boxes[:, :2] <= np.array(region[2:]) + margin) & (boxes[:, 2:] >= np.array(region[:2]) - margin)
    return [int(k) for k in np.flatnonzero(near.all(axis=1))]


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
