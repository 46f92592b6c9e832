"""Scene of a drive: a scene directory, or a map, of which the needed area is built."""

from __future__ import annotations

import os
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING

from geoscene.options import CloudOptions
from geoscene.scene import Scene, SceneLike, open_scene
from geoscene.support.progress import Progress, silent
from geoscene.support.storage import url_of
from lidar.errors import InputError
from lidar.options.drive import DriveOptions
from lidar.options.place import PlaceOptions

if TYPE_CHECKING:
    from geoscene.sources import Servers


@dataclass(frozen=True, slots=True)
class OpenedScene:
    """A scene for a drive.

    built : tiles that were built for this drive; None for the directory of a scene
    """

    scene: Scene
    built: int | None = None


def open_scene_or_map(
    path: Path | None,
    drive: DriveOptions,
    *,
    place: PlaceOptions = PlaceOptions(),
    clouds: CloudOptions = CloudOptions(),
    servers: Servers | None = None,
    progress: Progress = silent,
) -> OpenedScene:
    """The scene that a drive needs: of a scene directory, or of a map, from the cache or built now.

    path : a scene directory or a map file; None for the name of a place

    Other parameters are those of `lidar.simulation.scene_cache.built_scene`.

    Raises InputError (also as RouteError) for what is neither and for a drive that cannot be planned, and
    NetworkError if a place cannot be downloaded.
    """
    if (path is None) == (not place.place):
        raise InputError("give one of SCENE, the directory of a scene or a map file, and `place` NAME")
    if path is None or path.is_file():
        from lidar.simulation.scene_cache import built_scene  # noqa: PLC0415  (0.1 s: all that builds scenes)

        return OpenedScene(
            *built_scene(path, drive, place=place, clouds=clouds, servers=servers, progress=progress)
        )
    if not (path.exists() or url_of(path)):
        raise InputError(f"{path}: no such scene or map; give a map file, or the directory of a scene")
    given: tuple[PlaceOptions | CloudOptions, ...] = (place, clouds)
    changed = [f.name for of in given for f in fields(of) if getattr(of, f.name) != f.default]
    if changed:
        raise InputError(f"`{changed[0]}`: is for maps, and {path} is a directory; leave it out")
    return OpenedScene(open_scene(path))


def opened_for(scene: SceneLike, drive: DriveOptions, *, progress: Progress) -> Scene:
    """The scene of a drive of Python code: opened, of a directory or URL, or of a map file."""
    if not isinstance(scene, str | os.PathLike) or isinstance(scene, Scene) or url_of(scene):
        return open_scene(scene)
    return open_scene_or_map(Path(scene), drive, progress=progress).scene
