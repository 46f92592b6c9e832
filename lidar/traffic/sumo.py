"""Traffic simulated by SUMO, with the ego vehicle as one of its vehicles.

The scene's road network goes through netconvert, random trips and the ego's route through sumo, and SUMO's
floating car data through the replay of `lidar.traffic.fcd_replay`. See "Definition of Vehicles, Vehicle
Types, and Routes", "Pedestrians" and "FCD Output" in SUMO's documentation.
"""

from __future__ import annotations

import itertools
import os
import subprocess
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.errors import need
from geoscene.export.sumo import write_sumo
from geoscene.geometry.polylines import directions
from geoscene.roadgraph.graph import RoadGraph
from geoscene.scene import Scene
from geoscene.typing import Float, Ints
from lidar.errors import LidarError, RouteError
from lidar.geometry.poses import Trajectory
from lidar.geometry.random_streams import generator
from lidar.motion.motion import ended_at_rest, poses_along
from lidar.motion.path import Path as VehiclePath
from lidar.motion.road_conditions import DRY, GRAVITY, RoadConditions
from lidar.motion.speed_profile import motion_within
from lidar.motion.vehicle import Vehicle
from lidar.traffic.fcd import Fcd, network_projection, read_fcd
from lidar.traffic.fcd_replay import replay_fcd, scene_positions
from lidar.traffic.populate import TrafficOptions
from lidar.traffic.surroundings import LEFT
from lidar.world.actors import Actors

_EGO = "ego"
_STEP_S = 0.1  # seconds of a simulation step
_WARM_UP_S = 60.0  # seconds that SUMO runs before the ego vehicle departs
_LATEST_S = 60.0  # seconds that the ego vehicle may wait for room to depart
_LONGER = (2.0, 90.0)  # a drive to the route's end takes at most so many times as long as alone, and seconds
_SPEED, _WALKING_SPEED = 14.0, 1.4  # m/s, with which the length of random trips is chosen
_MATCH_M, _MATCH_COS = 6.0, 0.8  # metres, and cosine of the angle, between the path and a matching lane
_SPACING = 5.0  # metres between the points of the path that are matched to lanes
_TYPES = {
    "passenger": (0.82, 'vClass="passenger"'),
    "delivery": (0.09, 'vClass="delivery"'),
    "truck": (0.04, 'vClass="truck"'),
    "bus": (0.02, 'vClass="bus"'),
    "motorcycle": (0.03, 'vClass="motorcycle"'),
}
"""Shares of the vehicle types: assumed."""


_DEFAULTS = {
    "passenger": (2.6, 4.5, 9.0, 200.0, 0.1),
    "delivery": (2.6, 4.5, 9.0, 200.0, 0.05),
    "truck": (1.3, 4.0, 7.0, 130.0, 0.05),
    "bus": (1.2, 4.0, 7.0, 85.0, 0.0),
    "motorcycle": (6.0, 10.0, 10.0, 200.0, 0.1),
    "bicycle": (1.2, 3.0, 7.0, 50.0, 0.0),
}
"""SUMO's own acceleration, deceleration, emergency deceleration in m/s^2, maximum speed in km/h, deviation of
the speed factor ("Vehicle Type Parameter Defaults")."""


@dataclass(frozen=True, slots=True)
class SumoOptions(TrafficOptions):
    """Densities of road users that SUMO simulates; parked vehicles are placed as without it."""

    simulator: str = "sumo"


@dataclass(frozen=True, slots=True)
class _Lanes:
    """Lanes of a SUMO network outside junctions (n).

    name     : ids; ``edge`` the ids of their edges
    line     : centre lines in scene metres
    sidewalk : (n,) bool, for pedestrians only
    linked   : (n,) bool, every linked lane can be reached from every other one by car
    """

    name: NDArray[np.str_]
    edge: NDArray[np.str_]
    line: NDArray[np.object_]
    sidewalk: NDArray[np.bool_]
    linked: NDArray[np.bool_]


def drive_in_sumo(
    scene: Scene,
    graph: RoadGraph,
    *,
    path: VehiclePath,
    vehicle: Vehicle,
    first: Trajectory,
    seed: int,
    options: TrafficOptions,
    duration: float | None = None,
    at_speed: bool = False,
    road: RoadConditions = DRY,
) -> tuple[Trajectory, Actors]:
    """The trajectory of a vehicle along a path in SUMO's traffic, and the other road users.

    first : its trajectory without other road users
    road  : conditions on which the others drive; ``vehicle`` is the ego as it is driven on them
    duration, at_speed : as for `lidar.traffic.ego_drive.drive_with_signals`

    The ego is a vehicle of SUMO with the same route, so SUMO's vehicles react to it. Its trajectory follows
    its own path, smoothly and never ahead of SUMO's ego vehicle. Road users that would touch it all the same
    (it stays in the lane of its path where SUMO changes lanes) are left out.

    Raises MissingExtraError without eclipse-sumo, RouteError if SUMO's network does not have the route, and
    LidarError if a program of SUMO fails.
    """
    home = _home()
    factor, more = _LONGER
    seconds = factor * first.duration_ns * 1e-9 + more if duration is None else duration + 10.0
    with tempfile.TemporaryDirectory(prefix="lidar-sumo-") as name:
        folder = Path(name)
        net = _network(home, scene, folder=folder)
        lanes = _lanes(net, scene)
        demand = _trips(lanes, seed=seed, seconds=_WARM_UP_S + seconds, options=options, road=road)
        own = _ego(lanes, path, vehicle=vehicle, at_speed=at_speed)
        (folder / "trips.rou.xml").write_text(f"<routes>\n{''.join(demand)}{own}</routes>\n", "utf-8")
        _simulate(home, folder, net=net, seed=seed, seconds=seconds, radius=options.radius + LEFT)
        fcd = read_fcd(folder / "fcd.xml", net=net)
    time_s, allowed = _ego_progress(fcd, scene, path=path, vehicle=vehicle)
    until = len(time_s) if duration is None else int(np.searchsorted(time_s, seconds)) + 1
    motion = motion_within(
        path, vehicle, time_s=time_s[:until], max_distance=allowed[:until], at_speed=at_speed
    )
    if duration is None:
        ego = poses_along(path, vehicle, motion=ended_at_rest(motion))
    else:
        ego = poses_along(path, vehicle, motion=motion).until(round(duration * 1e9))
    begin = float(fcd.time[fcd.first[fcd.name.index(_EGO)]])
    actors = replay_fcd(
        fcd.without(_EGO),
        scene,
        graph=graph,
        ego=ego,
        vehicle=vehicle,
        seed=seed,
        begin=begin,
        options=options,
    )
    return ego, actors


def _home() -> Path:
    """Folder of SUMO; raises MissingExtraError without it.

    Importing SUMO points PROJ, and so GDAL, of this process to a database that they refuse; that is undone.
    """
    before = {name: os.environ.get(name) for name in ("PROJ_DATA", "PROJ_LIB")}
    home = Path(need("sumo", "sumo").SUMO_HOME)
    for name, value in before.items():
        if value is None:
            os.environ.pop(name, None)
    return home


def _run(home: Path, program: str, *options: str | Path) -> None:
    """Run a program of SUMO; raises LidarError with the first line of what it reports."""
    command = [home / "bin" / program, *options]
    # no shell, and nothing in the command is the user's
    done = subprocess.run(  # noqa: S603
        command, capture_output=True, text=True, check=False, env={**os.environ, "SUMO_HOME": str(home)}
    )
    if done.returncode:
        lines = [line for line in done.stderr.splitlines() if line.startswith("Error")]
        raise LidarError(f"{program} failed: {(lines or ['no message'])[0].removeprefix('Error: ')}")


def _network(home: Path, scene: Scene, *, folder: Path) -> Path:
    """The scene's network, with sidewalks and crossings beside its streets."""
    roads, net = folder / "roads.net.xml", folder / "walks.net.xml"
    write_sumo(scene, roads)
    guess = ["--sidewalks.guess", "--sidewalks.guess.max-speed", "20", "--default.sidewalk-width", "2"]
    _run(home, "netconvert", "-s", roads, "-o", net, *guess, "--crossings.guess", "--xml-validation", "never")
    return net


def _lanes(net: Path, scene: Scene) -> _Lanes:
    from scipy.sparse import csr_array  # noqa: PLC0415
    from scipy.sparse.csgraph import connected_components  # noqa: PLC0415

    root = ET.parse(net).getroot()  # noqa: S314 - written by netconvert
    projection = network_projection(net)
    names, edges, lines, sidewalk = [], [], [], []
    for edge in root.iterfind("edge"):
        for lane in edge.iterfind("lane") if not edge.get("function") else ():
            xy = np.array([point.split(",")[:2] for point in lane.get("shape", "").split()], float)
            names.append(lane.get("id", ""))
            edges.append(edge.get("id", ""))
            lines.append(
                shapely.linestrings(
                    np.column_stack(scene.frame.from_geographic(*projection.to_geographic(xy)))
                )
            )
            sidewalk.append(lane.get("allow") == "pedestrian")
    number = {name: k for k, name in enumerate(dict.fromkeys(edges))}
    links = np.array(
        [
            (number[c.get("from", "")], number[c.get("to", "")])
            for c in root.iterfind("connection")
            if c.get("from") in number and c.get("to") in number
        ]
    ).reshape(-1, 2)
    matrix = csr_array((np.ones(len(links)), links.T), shape=(len(number), len(number)))
    _, label = connected_components(matrix, directed=True, connection="strong")
    linked = label == np.argmax(np.bincount(label))
    rows = np.array([number[name] for name in edges], np.int64)
    return _Lanes(np.array(names), np.array(edges), np.array(lines, object), np.array(sidewalk), linked[rows])


def _trips(
    lanes: _Lanes, *, seed: int, seconds: float, options: TrafficOptions, road: RoadConditions
) -> Iterator[str]:
    """Random trips of road users that are on the road from the first second, and for as long as SUMO runs."""
    types = {name: words for name, (_, words) in _TYPES.items()} | {"bicycle": 'vClass="bicycle"'}
    yield from (f'<vType id="{name}" {words}{_driven_on(road, name)}/>\n' for name, words in types.items())
    shares = np.array([share for share, _ in _TYPES.values()])
    roads, walks = np.flatnonzero(~lanes.sidewalk & lanes.linked), np.flatnonzero(lanes.sidewalk)
    for kind, density in (("vehicle", options.vehicles), ("cyclist", options.cyclists)):
        rng = generator(seed, "traffic", "sumo", kind)
        for k in range(_count(lanes, roads, density=density)):
            names = lanes.edge[_places(lanes, roads, metres=_SPEED * seconds, rng=rng)]
            type_ = rng.choice(list(_TYPES), p=shares / shares.sum()) if kind == "vehicle" else "bicycle"
            yield (
                f'<trip id="{kind}{k}" type="{type_}" depart="0" from="{names[0]}" to="{names[-1]}" '
                f'via="{" ".join(names[1:-1])}" departPos="random_free" departLane="best" '
                'departSpeed="max"/>\n'
            )
    rng = generator(seed, "traffic", "sumo", "pedestrian")
    for k in range(_count(lanes, walks, density=options.pedestrians)):
        names = lanes.edge[_places(lanes, walks, metres=_WALKING_SPEED * seconds, rng=rng)]
        legs = "".join(f'<walk from="{a}" to="{b}"/>' for a, b in itertools.pairwise(names))
        yield f'<person id="pedestrian{k}" depart="0" departPos="random">{legs}</person>\n'


def _driven_on(road: RoadConditions, name: str) -> str:
    """Attributes of a vehicle type under road conditions; none on dry roads."""
    if road == DRY:
        return ""
    acceleration, deceleration, emergency, speed, deviation = _DEFAULTS[name]
    pace = f"normc({road.pace:.4f},{deviation},0.2,2)" if deviation else f"{road.pace:.4f}"
    values = {
        "accel": acceleration * road.share,
        "decel": deceleration * road.share,
        "emergencyDecel": max(min(emergency, road.grip * GRAVITY), deceleration * road.share),
        "maxSpeed": min(speed / 3.6, road.sight_speed),
    }
    return "".join(f' {key}="{value:.3f}"' for key, value in values.items()) + f' speedFactor="{pace}"'


def _count(lanes: _Lanes, rows: Ints, *, density: float) -> int:
    """Road users on lanes, ``density`` to a kilometre."""
    return round(density * float(shapely.length(lanes.line[rows]).sum()) / 1000)


def _places(lanes: _Lanes, rows: Ints, *, metres: float, rng: np.random.Generator) -> Ints:
    """Random lanes, chosen by length, to visit one after another: two or more, ``metres`` apart in total."""
    length = shapely.length(lanes.line[rows])
    chosen = rng.choice(rows, size=2 + int(metres / 50), p=length / length.sum())
    away = np.cumsum(shapely.distance(lanes.line[chosen[1:]], lanes.line[chosen[:-1]]))
    return chosen[: 2 + int(np.searchsorted(away, metres))]


def _ego(lanes: _Lanes, path: VehiclePath, *, vehicle: Vehicle, at_speed: bool) -> str:
    """The ego vehicle's type and trip: along the lanes nearest to its path, with a stop at its end."""
    at = np.arange(0.0, path.length, _SPACING)
    xy = np.column_stack([np.interp(at, path.s, path.position[:, c]) for c in (0, 1)])
    heading = np.interp(at, path.s, path.heading)
    roads = np.flatnonzero(~lanes.sidewalk)
    tree, points = shapely.STRtree(lanes.line[roads]), shapely.points(xy)
    point, lane = tree.query(points, predicate="dwithin", distance=_MATCH_M)
    line = lanes.line[roads[lane]]
    along = shapely.line_locate_point(line, points[point])
    ahead = np.column_stack([np.cos(heading), np.sin(heading)])[point]
    cosine = (directions(line, along, reach=0.5) * ahead).sum(axis=1)
    off = shapely.distance(line, points[point])
    inside = (along > 0) & (along < shapely.length(line))
    fit = inside & (cosine > _MATCH_COS)
    order = np.flatnonzero(fit)[np.lexsort((off[fit], point[fit]))]
    nearest = order[np.unique(point[order], return_index=True)[1]]
    if not len(nearest):
        raise RouteError("traffic: the route is not on the network that SUMO has of the scene")
    edges = lanes.edge[roads[lane[nearest]]]
    edges = edges[np.append(True, edges[1:] != edges[:-1])]
    first, last = nearest[0], nearest[-1]
    start = float(np.clip(along[first] + vehicle.front - at[point[first]], 0.0, line[first].length - 0.1))
    speed = "desired" if at_speed else "0"
    stop = lanes.name[roads[lane[last]]]
    return (
        f'<vType id="{_EGO}" vClass="passenger" length="{vehicle.length}" width="{vehicle.width}" tau="1.4" '
        f'accel="{0.8 * vehicle.acceleration:.3f}" decel="{0.7 * vehicle.deceleration:.3f}" sigma="0" '
        f'maxSpeed="{vehicle.max_speed:.3f}" speedFactor="1" speedDev="0"/>\n'
        f'<trip id="{_EGO}" type="{_EGO}" depart="{_WARM_UP_S}" from={quoteattr(edges[0])} '
        f'to={quoteattr(edges[-1])} via={quoteattr(" ".join(edges[1:-1]))} departSpeed="{speed}" '
        f'departLane="{str(lanes.name[roads[lane[first]]]).rpartition("_")[2]}" departPos="{start:.2f}">'
        f'<stop lane={quoteattr(stop)} endPos="{max(along[last], 1.0):.2f}" duration="86400"/></trip>\n'
    )


def _simulate(home: Path, folder: Path, *, net: Path, seed: int, seconds: float, radius: float) -> None:
    """Run SUMO and write the floating car data within a radius in metres around the ego vehicle."""
    options: dict[str, str | Path] = {
        "net-file": net,
        "route-files": folder / "trips.rou.xml",
        "fcd-output": folder / "fcd.xml",
        "device.fcd.explicit": _EGO,
        "device.fcd.radius": f"{radius:g}",
        "device.fcd.begin": f"{_WARM_UP_S}",
        "step-length": f"{_STEP_S}",
        "lanechange.duration": "3",
        "seed": str(seed % 2**31),
        "end": f"{_WARM_UP_S + _LATEST_S + seconds:.1f}",
        "time-to-teleport": "-1",
        "collision.action": "none",
        "xml-validation": "never",
    }
    words: list[str | Path] = [word for name, value in options.items() for word in (f"--{name}", value)]
    _run(home, "sumo", *words, "--ignore-route-errors", "--no-warnings", "--no-step-log")


def _ego_progress(fcd: Fcd, scene: Scene, *, path: VehiclePath, vehicle: Vehicle) -> tuple[Float, Float]:
    """Seconds (k,) after its departure, and metres (k,) along the path that SUMO's ego vehicle has covered.

    Raises RouteError if SUMO has found no route or no room for the ego vehicle.
    """
    if _EGO not in fcd.name:
        raise RouteError("traffic: SUMO found no route for the ego vehicle, or no room where it starts")
    row = fcd.name.index(_EGO)
    rows = slice(fcd.first[row], fcd.first[row + 1])
    front, heading = scene_positions(fcd, scene)
    scale = float(path.scale.mean())
    axle = front[rows] - scale * vehicle.front * np.column_stack(
        [np.cos(heading[rows]), np.sin(heading[rows])]
    )
    time = fcd.time[rows] - fcd.time[rows][0]
    travelled = np.zeros(len(axle))
    k = 0
    for n, point in enumerate(axle):
        window = slice(k, int(np.searchsorted(path.s, path.s[k] + 15.0)) + 1)
        k += int(np.argmin(np.hypot(*(path.position[window, :2] - point).T)))
        travelled[n] = path.s[k]
    return time, np.maximum.accumulate(travelled)
