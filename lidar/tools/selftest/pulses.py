"""Extremes of footprints of pulses that adapt: wires, pickets, masts, edges of foliage, grazing ground."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from geoscene.classes import Class, materials
from geoscene.geometry.mesh import Mesh, concatenate
from geoscene.options import BuildOptions
from geoscene.pipeline.build import build
from geoscene.sources import read_osm
from geoscene.typing import Float, Ints
from lidar.geometry.attitude import Mount
from lidar.geometry.poses import Trajectory
from lidar.sensors.laser.scan import cast, measure
from lidar.sensors.physics.settings import MOST_RAYS, ScannerSettings
from lidar.sensors.rig.scanner import firings, load_sensor
from lidar.tools.selftest.case import ExtremeCase
from lidar.tools.selftest.footprints import street
from lidar.tools.selftest.rays import cuboid
from lidar.world.world import World

TOLERANCE = 0.01
"""Metres of the footprints that are measured."""

_SIGNAL = ScannerSettings(link=True, foliage=True)
"""What decides on echoes, without chance."""

_SENSOR = "vlp16"
_LOWEST = -15.0
"""Elevation of the sensor's lowest laser, degrees."""

_AHEAD = np.radians(8.0)
"""Azimuth to each side within which pulses are sent."""

_EYE = 100.0
"""Metres of the sensor above the empty ground, out of whose reach it is."""

_FEWEST = 50
"""Returns from which a percentile is taken."""

Body = tuple[Float, Ints]
"""Vertices in metres from the sensor, x ahead, and faces."""


def bar(start: Sequence[float], end: Sequence[float], *, width: float) -> Body:
    """A square bar between two points."""
    a, b = np.asarray(start, float), np.asarray(end, float)
    along = b - a
    u = np.cross(along, np.eye(3)[np.argmin(np.abs(along))])
    u *= width / 2 / np.linalg.norm(u)
    v = np.cross(along, u)
    v *= width / 2 / np.linalg.norm(v)
    vertices, faces = cuboid(np.zeros(3), np.ones(3))
    share = vertices - [0.0, 0.5, 0.5]
    return a + share[:, :1] * along + 2 * share[:, 1:2] * u + 2 * share[:, 2:] * v, faces


def wires(width: float, *, away: float) -> list[Body]:
    """Upright wires around the sensor, 2 m apart."""
    angle = np.arange(-_AHEAD, _AHEAD, 2.0 / away)
    return [
        bar((x, y, -20.0), (x, y, 20.0), width=width)
        for x, y in away * np.column_stack([np.cos(angle), np.sin(angle)])
    ]


def pickets(*, away: float) -> list[Body]:
    """A fence of pickets of 4 cm with gaps of 6 cm, seen at a slant."""
    return [
        bar((away + y / 2, y, -2.0), (away + y / 2, y, 1.5), width=0.04) for y in np.arange(-8.0, 8.0, 0.1)
    ]


def mast(*, away: float) -> list[Body]:
    """A lattice mast: four legs of 10 cm, 2 m apart, with rings and diagonals of 4 cm every 1.5 m."""
    corners = np.array([(away + x, y) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))], float)
    found = [bar((*c, -12.0), (*c, 12.0), width=0.1) for c in corners]
    for z in np.arange(-12.0, 12.0, 1.5):
        for k in range(4):
            a, b = corners[k], corners[(k + 1) % 4]
            found += [bar((*a, z), (*b, z), width=0.04), bar((*a, z), (*b, z + 1.5), width=0.04)]
    return found


def wall(*, away: float) -> list[Body]:
    """A wall across all pulses."""
    return [cuboid(np.array([away, -60.0, -60.0]), np.array([away + 0.5, 60.0, 60.0]))]


def hedge(*, away: float) -> list[Body]:
    """Hedges of 1.5 m with gaps of 1.5 m, seen at a slant."""
    return [
        cuboid(np.array([away + y / 4, y, -1.0]), np.array([away + y / 4 + 2.0, y + 1.5, 0.6]))
        for y in np.arange(-9.0, 9.0, 3.0)
    ]


def ground(*, degrees: float, away: float) -> list[Body]:
    """Level ground that the lowest pulses graze at an angle to it, ``away`` metres ahead."""
    tilt = np.radians(-_LOWEST - degrees)  # by which the ground falls ahead
    normal = np.array([np.sin(tilt), 0.0, np.cos(tilt)])
    met = away * np.array([np.cos(np.radians(_LOWEST)), 0.0, np.sin(np.radians(_LOWEST))])
    along = np.array([np.cos(tilt), 0.0, -np.sin(tilt)])
    half, thick = 300.0, 1.0
    vertices, faces = cuboid(np.array([-half, -half, -thick]), np.array([half, half, 0.0]))
    frame = np.stack([along, [0.0, 1.0, 0.0], normal])
    return [(met + vertices @ frame, faces)]


def _meshes(bodies: Sequence[Body], klass: Class, *, material: str, first: int = 1) -> list[Mesh]:
    """The bodies as one mesh, with numbers from ``first``."""
    code = materials()[material].code
    numbered = enumerate(bodies, first)
    return [
        concatenate([Mesh.of(*b, feature=k, klass=klass, material=code, closed=True) for k, b in numbered])
    ]


class PulseScene:
    """Bodies around a scanner high above empty ground."""

    def __init__(self, folder: Path, meshes: Sequence[Mesh]) -> None:
        path = folder / "map.osm"
        path.write_text(f'<osm version="0.6">{street(10.0, 47.0, step=0.001)}</osm>')
        scene = build(read_osm(path), folder / "scene", options=BuildOptions(only=("roads",)))
        self._world = World.load(scene, region=(-1.0, -1.0, 1.0, 1.0), actors=meshes)
        place = np.eye(3, 4)
        place[2, 3] = _EYE
        numbers = np.arange(len(meshes), dtype=np.int32)
        self._world.place_actors(numbers, np.tile(place, (len(meshes), 1, 1)), feature=numbers)
        self._sensor = load_sensor(_SENSOR)
        n = 1001
        self._still = Trajectory(
            np.arange(n, dtype=np.int64) * 100_000_000,
            np.tile([0.0, 0.0, _EYE], (n, 1)),
            np.tile([0.0, 0.0, 0.0, 1.0], (n, 1)),
            np.zeros((n, 3)),
            np.ones(n),
        )

    def returns(self, frame: int, settings: ScannerSettings) -> tuple[Ints, Float]:
        """Numbers of laser and column of the returns ahead in a frame, as one, and their ranges."""
        way = firings(self._sensor, frame).direction
        ahead = np.flatnonzero(np.abs(np.arctan2(way[:, 1], way[:, 0])) < _AHEAD)
        sweep = cast(
            self._sensor,
            Mount((0.0, 0.0, 0.0)),
            trajectory=self._still,
            world=self._world,
            frame=frame,
            seed=1,
            settings=settings,
            pulses=ahead,
        )
        cloud = measure(sweep)
        return cloud.column.astype(np.int64) * 1024 + cloud.ring, cloud.range


@dataclass(frozen=True, slots=True)
class Comparison:
    """Returns of adaptive footprints against those of `MOST_RAYS` rays.

    errors : (n,) metres, of the ranges of returns that both have
    apart  : number of returns that one of them has
    total  : number of returns of the many rays
    """

    errors: Float
    apart: int
    total: int


def compare(meshes: Sequence[Mesh], *, frames: int, settings: ScannerSettings) -> Comparison:
    """Returns of some frames with a tolerance of `TOLERANCE` against those of very many rays."""
    errors, apart, total = [np.empty(0)], 0, 0
    with tempfile.TemporaryDirectory() as folder:
        scene = PulseScene(Path(folder), meshes)
        for frame in range(frames):
            few, many = (
                scene.returns(frame, settings.changed(**change))
                for change in ({"footprint": TOLERANCE}, {"rays": MOST_RAYS})
            )
            _, a, b = np.intersect1d(few[0], many[0], return_indices=True)
            errors.append(np.abs(few[1][a] - many[1][b]))
            apart += len(few[0]) + len(many[0]) - 2 * len(a)
            total += len(many[0])
    return Comparison(np.concatenate(errors), apart, total)


def range_error(
    frames: int, *, meshes: Sequence[Mesh], percent: float = 99.9, settings: ScannerSettings = _SIGNAL
) -> float:
    """Error in metres that so many per cent of the returns do not exceed; infinite with too few returns."""
    found = compare(meshes, frames=frames, settings=settings)
    return float(np.percentile(found.errors, percent)) if len(found.errors) >= _FEWEST else np.inf


def share_apart(frames: int, *, meshes: Sequence[Mesh]) -> float:
    """Missed and extra returns, per cent; 100 if there are none to compare."""
    found = compare(meshes, frames=frames, settings=_SIGNAL)
    return 100.0 * found.apart / found.total if found.total else 100.0


def returns_of_nothing(frames: int, *, meshes: Sequence[Mesh]) -> float:
    """Returns, of either, of what sends back too little to be detected."""
    found = compare(meshes, frames=frames, settings=_SIGNAL)
    return float(found.total + found.apart)


def _wires(width: float, *, away: float) -> list[Mesh]:
    return _meshes(wires(width, away=away), Class.WIRE, material="metal")


_WALL = 900
"""Number of the body behind the others."""

_PICKETS = _meshes(pickets(away=20.0), Class.WALL, material="wood")
_MAST = _meshes(mast(away=40.0), Class.POLE, material="metal")
_HEDGE = _meshes(hedge(away=15.0), Class.HEDGE, material="foliage")
_GROUND = _meshes(ground(degrees=0.1, away=60.0), Class.ROAD, material="asphalt")

_TWO = "two echoes whose powers differ by less than the rays can tell; tolerance 1 cm"
_BETWEEN = "what all of seven rays pass by is not looked for"

_pulse = partial(ExtremeCase, group="pulses", of="frames", quick=1, full=50)
_range = partial(_pulse, bound=TOLERANCE, unit="m")
_lost = partial(_pulse, unit="%")


def _before_wall(meshes: Sequence[Mesh], *, away: float) -> list[Mesh]:
    return [*meshes, *_meshes(wall(away=away), Class.WALL, material="brick", first=_WALL)]


CASES = (
    _range(
        "wire of 3 mm at 80 m before a wall, 99.9 %",
        partial(range_error, meshes=_before_wall(_wires(0.003, away=80.0), away=85.0)),
        _BETWEEN,
    ),
    _pulse(
        "wire of 3 mm at 80 m against the sky, returns",
        partial(returns_of_nothing, meshes=_wires(0.003, away=80.0)),
        "it sends back less than the scanner detects",
        unit="returns",
    ),
    _lost(
        "wire of 3 mm at 10 m against the sky, returns missed or extra",
        partial(share_apart, meshes=_wires(0.003, away=10.0)),
        _BETWEEN,
        bound=60.0,
    ),
    _range(
        "picket fence at 20 m before a wall, 99 %",
        partial(range_error, meshes=_before_wall(_PICKETS, away=26.0), percent=99.0),
        _TWO,
    ),
    _range(
        "lattice mast at 40 m before a wall, 99.9 %",
        partial(range_error, meshes=_before_wall(_MAST, away=60.0)),
        _TWO,
    ),
    _lost(
        "lattice mast at 40 m against the sky, returns missed or extra",
        partial(share_apart, meshes=_MAST),
        _BETWEEN,
        bound=5.0,
    ),
    _range(
        "edges of hedges at 15 m before a wall, 99.9 %",
        partial(range_error, meshes=_before_wall(_HEDGE, away=30.0)),
        "each ray ends on a leaf of its own",
        bound=0.2,
    ),
    _range(
        "ground at an incidence of 89.9°, whatever it sends back, 99.9 %",
        partial(range_error, meshes=_GROUND, settings=ScannerSettings()),
        "the footprint is 60 m long, and has up to 499 rays",
        bound=0.1,
    ),
)
"""Extremes of footprints that adapt."""
