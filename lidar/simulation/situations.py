"""Context that stages get for the frames of a dataset."""

from __future__ import annotations

import functools
from collections.abc import Callable
from datetime import datetime, timedelta

import numpy as np
from numpy.typing import NDArray

from geoscene.errors import GeosceneError
from geoscene.geometry.frames import Frame
from geoscene.scene import Scene, open_scene
from geoscene.typing import Float
from lidar.dataset.layout import Dataset
from lidar.geometry.attitude import Mount
from lidar.geometry.poses import Poses, Trajectory
from lidar.geometry.random_streams import generator
from lidar.sensors.camera.light import Light, sun_direction
from lidar.sensors.laser.cloud import Cloud
from lidar.sensors.rig.devices import Camera, Scanner
from lidar.signal.situation import Effects, Situation
from lidar.signal.weather.setting import WeatherSetting
from lidar.simulation.recording import Recording
from lidar.world.ground import ground_height
from lidar.world.world import World

_SUN_NS = 10_000_000_000
"""Nanoseconds between updates of the sun's direction, which changes by 0.04 degrees meanwhile."""

_SKY = 100_000.0
"""Metres within which the pattern of clouds begins."""

_AROUND = 20.0
"""Metres around points within which their surroundings are loaded."""


def situation_of(
    recording: Recording,
    device: Scanner | Camera,
    *,
    frame: int,
    world: World | None = None,
    cloud_of: Callable[[int], Cloud] | None = None,
    surroundings: RecordedSurroundings | None = None,
) -> Situation:
    """Context of a sensor's frame for stages.

    world    : what rays hit during it; None for recorded data
    cloud_of : the cloud of a frame of the same scanner, as without stages
    surroundings : the scene of recorded data, if it is there
    """
    mount = device.spec.mount

    def poses(time_ns: NDArray[np.int64]) -> Poses:
        return recording.trajectory.at(time_ns).mounted(mount.translation, mount.rotation)

    def earlier(frames: int) -> Cloud | None:
        assert cloud_of is not None  # noqa: S101
        return cloud_of(frame - frames) if 1 <= frames <= frame else None

    start_ns = device.frame_start_ns(frame)
    known = world or surroundings
    scene = None if known is None else known.scene

    def ground(x: float, y: float) -> float:
        height = np.nan if scene is None else ground_height(scene, x=x, y=y)
        return height if np.isfinite(height) else float(recording.trajectory.at([start_ns]).position[0, 2])

    camera = device.spec if isinstance(device, Camera) else None
    return Situation(
        device.name,
        frame,
        start_ns,
        utc=recording.start,
        poses=poses,
        world=world,
        seed=recording.settings.seed,
        camera=camera,
        light=None if camera is None else light_during(recording, start_ns),
        earlier=None if cloud_of is None else earlier,
        geo=recording.frame,
        ground=ground,
        surroundings=None if surroundings is None else surroundings.around,
        effects=recording.effects,
    )


class RecordedSurroundings:
    """The scene that recorded data were driven in, of which the part around points is loaded."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self._world: World | None = None

    def around(self, points: Float) -> World:
        """The scene around points (k, 3) in its frame, without road users."""
        low, high = points[:, :2].min(axis=0) - _AROUND, points[:, :2].max(axis=0) + _AROUND
        region = (float(low[0]), float(low[1]), float(high[0]), float(high[1]))
        if self._world is None:
            self._world = World(self.scene)
        self._world.follow(region)
        return self._world


def surroundings_of(dataset: Dataset) -> RecordedSurroundings | None:
    """The scene that a dataset was driven in; None if it is not there, or another one by now."""
    try:
        scene = open_scene(dataset.scene_path)
    except (GeosceneError, OSError):
        return None
    same = scene.manifest.get("fingerprint", scene.path.name) == dataset.manifest["recipe"].get("scene")
    return RecordedSurroundings(scene) if same else None


def situation_of_unit(
    name: str,
    mount: Mount,
    *,
    trajectory: Trajectory,
    start: datetime,
    seed: int,
    effects: Effects | None = None,
) -> Situation:
    """Context of a satellite receiver or an inertial unit over a drive for stages."""

    def poses(time_ns: NDArray[np.int64]) -> Poses:
        return trajectory.at(time_ns).mounted(mount.translation, mount.rotation)

    return Situation(name, 0, utc=start, poses=poses, seed=seed, effects=effects)


def light_during(recording: Recording, time_ns: int) -> Light:
    """Sun and sky of the images of a drive at a time."""
    from lidar.sensors.camera.render import light_of  # noqa: PLC0415  (of images alone)

    settings = recording.settings
    return light_of(sun_during(recording, time_ns), cloud=settings.camera.cloud, snow=settings.world.snow)


def clouds_during(recording: Recording, time_ns: int) -> tuple[float, float]:
    """Where the pattern of clouds begins at a time, metres east and north of the scene's origin.

    The seed chooses the part of the pattern, the wind of the weather moves it.
    """
    settings = recording.settings
    east, north = generator(settings.seed, "clouds").uniform(-_SKY, _SKY, 2).tolist()
    stages = (named.stage for named in settings.stages.stages)
    windy = (stage for stage in stages if isinstance(stage, WeatherSetting) and stage.wind)
    weather = next(windy, None)
    blown = (0.0, 0.0) if weather is None else weather.drift(time_ns * 1e-9)
    return east + blown[0], north + blown[1]


def sun_during(recording: Recording, time_ns: int) -> Float:
    """Direction (3,) towards the sun, scene axes."""
    when = recording.start + timedelta(seconds=(time_ns // _SUN_NS) * _SUN_NS // 10**9)
    x, y = recording.trajectory.position[0, :2].tolist()
    return _sun_direction(recording.frame, when, x=x, y=y)


@functools.lru_cache(maxsize=4)
def _sun_direction(frame: Frame, when: datetime, *, x: float, y: float) -> Float:
    return sun_direction(frame, when, at=(x, y))
