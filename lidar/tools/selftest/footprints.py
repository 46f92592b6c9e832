"""Extremes of footprints, heights and roads: every building becomes a solid or a problem that is reported."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from shapely import affinity

from geoscene.buildings import build_solids, read_buildings
from geoscene.errors import GeosceneError
from geoscene.geometry.frames import Frame
from geoscene.geometry.mesh import Mesh
from geoscene.geometry.watertight import MeshVerdict, validate_mesh
from geoscene.options import BuildOptions
from geoscene.pipeline.build import build
from geoscene.scene.validate import check_scene
from geoscene.sources import read_osm
from geoscene.sources.data import Area, OsmData
from geoscene.typing import Float
from lidar.tools.selftest.case import ExtremeCase

_FRAME = Frame.at(8.7, 49.4)


def house(number: int, shape: Any, **tags: str) -> Area:
    """A building of the map with the scene coordinates of a shape; ``__`` in a key stands for a colon."""
    lonlat = shapely.transform(shape, lambda xy: np.column_stack(_FRAME.to_geographic(*xy.T)))
    named = {key.replace("__", ":"): value for key, value in tags.items()}
    return Area(f"way/{number}", {"building": "yes", **named}, lonlat, np.empty(0, np.int64))


def built(areas: Sequence[Area]) -> tuple[Mesh, MeshVerdict, int]:
    """Mesh and verdict of a map's buildings, and the number of areas without a result or a problem.

    Raises no error for any footprint.
    """
    table, problems = read_buildings(OsmData((8.6, 49.3, 8.8, 49.5), [], list(areas), [], []), _FRAME)
    mesh, more = build_solids(table, base=np.zeros(table.count))
    told = {p.osm_id for p in problems + more if p.action == "dropped"}
    stands = np.isin(table.outline, mesh.feature)  # also of parts, which stand in their building's solid
    told |= set(map(str, table.osm_id[stands]))
    lost = sum(area.osm_id not in told for area in areas)
    return mesh, validate_mesh(mesh), lost


def _faults(areas: Sequence[Area]) -> float:
    """Buildings that are no valid solids, and areas that are lost without a word."""
    _, verdict, lost = built(areas)
    return float((~verdict.ok).sum() + lost)


def ring(count: int, *, area: float) -> Any:
    """A star-shaped polygon of ``count`` corners and an area in square metres."""
    angle = np.arange(count) / count * 2 * np.pi
    radius = 1 + 0.1 * np.sin(7 * angle) if count > 20 else np.ones(count)
    shape = shapely.Polygon(np.column_stack([radius * np.cos(angle), radius * np.sin(angle)]))
    scale = float(np.sqrt(area / shape.area))
    return affinity.scale(shape, scale, scale, origin=(0, 0))


def _volume_error(shape: Any, height: float) -> float:
    """Error of the volume of a building, relative to footprint times height; 1 if it is no valid solid."""
    _, verdict, _ = built([house(1, shape, height=f"{height:g}")])
    if len(verdict) != 1 or not verdict.ok[0]:
        return 1.0
    return float(abs(verdict.volume[0] / (shape.area * height) - 1))


def many_corners(count: int) -> float:
    """Largest relative error of the volume of footprints of 3 to ``count`` corners and 10 m2 each."""
    sizes = 3 * 10 ** np.arange(0.0, np.log10(count / 3) + 1e-9, 0.5)
    return max(
        _volume_error(ring(n, area=10.0 * n), 10.0) for n in {*np.rint(sizes).astype(int).tolist(), count}
    )


def areas(count: int) -> float:
    """Largest relative error of the volume of footprints of 1 to 1e6 m2."""
    return max(_volume_error(ring(12, area=a), 10.0) for a in 10 ** np.linspace(0, 6, count))


def tiny_areas(count: int) -> float:
    """Footprints of 1e-4 to 1 m2 that are neither a valid solid nor reported."""
    sizes = 10 ** np.linspace(-4, 0, count)
    return _faults([house(k + 1, affinity.translate(ring(4, area=a), 5 * k)) for k, a in enumerate(sizes)])


def heights(count: int) -> float:
    """Buildings of 0 to 1e4 m, flat or with roofs, that are neither a valid solid nor reported."""
    tall = np.concatenate([[0.0], 10 ** np.linspace(-4, 4, count - 1)])
    kinds = ("flat", "gabled", "pyramidal", "hipped", "dome")
    return _faults(
        [
            house(
                k + 1,
                affinity.translate(shapely.box(0, 0, 10, 8), 20 * k),
                height=f"{z:.6f}",
                roof__shape=kinds[k % len(kinds)],
            )
            for k, z in enumerate(tall)
        ]
    )


def _spoilt(rng: np.random.Generator) -> Any:
    """A polygon with a spike, a bow tie, repeated and collinear points, or holes that touch or nest."""
    corners = np.array([[0, 0], [20, 0], [20, 12], [0, 12]]) + rng.uniform(-3, 3, (4, 2))
    kind = rng.integers(0, 7)
    at = rng.uniform(2, 18)
    if kind == 0:  # spike of no width, then of a hair's width
        tip = [at, rng.uniform(15, 60)]
        corners = np.array([*corners[:3], [at, 12], tip, [at - rng.choice([0, 1e-5, 1e-3]), 12], corners[3]])
    elif kind == 1:
        corners = corners[[0, 2, 1, 3]]
    elif kind == 2:
        corners = np.repeat(corners, rng.integers(1, 5), axis=0)
    elif kind == 3:
        steps = np.linspace(0, 1, 30)[:-1, None]
        corners = np.concatenate(
            [a + steps * (b - a) for a, b in zip(corners, np.roll(corners, -1, 0), strict=True)]
        )
    elif kind == 4:  # an inner ring that touches the outer one in a point
        middle = (corners[0] + corners[1]) / 2
        hole = [middle, middle + np.array([2, 3]), middle + np.array([-2, 3])]
        return shapely.Polygon(corners, [hole])
    elif kind == 5:  # nested inner rings
        return shapely.Polygon(corners, [shapely.box(6, 4, 12, 8).exterior, shapely.box(7, 5, 9, 7).exterior])
    else:  # two courtyards that touch along an edge, or in a corner
        low = rng.choice([4.0, 7.0])
        return shapely.Polygon(
            corners, [shapely.box(5, 4, 9, 7).exterior, shapely.box(9, low, 12, low + 1.5).exterior]
        )
    return shapely.Polygon(corners)


def spoilt_rings(count: int) -> float:
    """Spikes, bow ties, touching and nested rings that are neither a valid solid nor reported."""
    lost = 0.0
    for start in range(0, count, 1000):
        rng = np.random.default_rng([1, start])
        shapes = [_spoilt(rng) for _ in range(min(1000, count - start))]
        roofs = rng.choice(["flat", "gabled", "hipped"], len(shapes))
        lost += _faults(
            [
                house(k + 1, affinity.translate(shape, k % 30 * 100, k // 30 * 100), roof__shape=str(roof))
                for k, (shape, roof) in enumerate(zip(shapes, roofs, strict=True))
            ]
        )
    return lost


def touching_houses(count: int) -> float:
    """Houses that share walls, corners or a few millimetres, and are neither a valid solid nor reported."""
    rng = np.random.default_rng(2)
    gap = rng.choice([0.0, 1e-4, 1e-3, -1e-3, -5e-2], count)
    left = np.concatenate([[0.0], np.cumsum(8 + gap)[:-1]])
    return _faults(
        [house(k + 1, shapely.box(x, 0, x + 8, 10 + k % 3), height="9") for k, x in enumerate(left)]
    )


def nested_parts(count: int) -> float:
    """Faults of one building of nested parts, each higher than the last."""
    inset = np.arange(count) * (24.0 / count)
    parts = [
        Area(
            area.osm_id, {"building:part": "yes", "height": f"{5 + 0.05 * k:.2f}"}, area.geometry, area.nodes
        )
        for k, area in enumerate(house(k + 2, shapely.box(d, d, 50 - d, 50 - d)) for k, d in enumerate(inset))
    ]
    return _faults([house(1, shapely.box(0, 0, 50, 50), height="5"), *parts])


def _unsound(xml: str) -> float:
    """Faults of the scene of a map, 1 if its roads are missing."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "map.osm"
        path.write_text(f'<osm version="0.6">{xml}</osm>')
        scene = build(
            read_osm(path), Path(folder) / "scene", options=BuildOptions(only=("roads", "buildings"))
        )
        checks = check_scene(scene)
        return float(len(checks["broken"]) + len(checks["broken_surfaces"]) + (checks["surfaces"] == 0))


def road_along_parallel(count: int) -> float:
    """Faults of scenes of a straight road along a parallel, whose map has no height."""
    return sum(_unsound(street(5.0, lat, step=0.004)) for lat in np.linspace(-80, 80, count))


def street(lon: float, lat: float, *, step: float) -> str:
    """OSM elements of a street along a parallel, ``step`` degrees long."""
    ends = "".join(f'<node id="{k}" lon="{lon + step * k}" lat="{lat}"/>' for k in (1, 2))
    return f'{ends}<way id="1"><nd ref="1"/><nd ref="2"/><tag k="highway" v="residential"/></way>'


def lone_node(count: int) -> float:
    """Maps of nodes in one place, or of a way without length, that end otherwise than in one clear line."""
    node = '<node id="1" lon="8.7" lat="49.4"><tag k="natural" v="tree"/></node>'
    twice = node + '<node id="2" lon="8.7" lat="49.4"/>'
    way = '<way id="1"><nd ref="1"/><nd ref="2"/><tag k="highway" v="residential"/></way>'
    lost = 0.0
    for xml in (node, twice, twice + way)[:count]:
        try:
            lost += _unsound(xml)
        except GeosceneError:
            continue
    return lost


def accuracy_of_corners(count: int) -> float:
    """Largest distance in metres of a solid's corners from those of its footprint, simple rings."""
    worst = 0.0
    for k in range(count):
        rng = np.random.default_rng([3, k])
        shape = affinity.rotate(shapely.box(0, 0, *rng.uniform(1, 100, 2)), rng.uniform(0, 90))
        mesh, *_ = built([house(1, shape, height="10")])
        corners: Float = shapely.get_coordinates(shape)
        apart = np.linalg.norm(mesh.vertices[:, None, :2] - corners, axis=2)
        worst = max(worst, float(apart.min(axis=1).max()))
    return worst


_FAULTS = "no body passes with a fault; what cannot be built is in problems.csv"
_GRID = "grid of 0.1 mm; corners within 2 mm of a straight wall are left out"

_case = partial(ExtremeCase, group="footprints")
_volume = partial(_case, bound=1e-3, unit="of the volume")
_footprints = partial(_case, unit="footprints", of="footprints")
_buildings = partial(_case, unit="buildings", of="buildings", quick=20, full=1000)

CASES = (
    _volume(
        "volume of footprints of 3 to 100,000 corners",
        many_corners,
        _GRID,
        of="corners",
        quick=1000,
        full=100_000,
    ),
    _volume("volume of footprints of 1 to 1e6 m²", areas, _GRID, of="footprints", quick=7, full=61),
    _footprints(
        "corners off their place",
        accuracy_of_corners,
        "grid of 0.1 mm",
        bound=1e-4,
        unit="m",
        quick=5,
        full=1000,
    ),
    _footprints(
        "1e-4 to 1 m², neither solid nor reported",
        tiny_areas,
        "below 0.5 m² they are dropped and reported as too small",
        quick=20,
        full=1000,
    ),
    _buildings("heights of 0 to 1e4 m, neither solid nor reported", heights, _FAULTS),
    _footprints(
        "spikes, bow ties, touching and nested rings, neither solid nor reported",
        spoilt_rings,
        _FAULTS,
        quick=40,
        full=10_000,
    ),
    _buildings("terraced houses within ±5 cm, neither solid nor reported", touching_houses, _FAULTS),
    _case(
        "nested parts of one building", nested_parts, _FAULTS, unit="faults", of="parts", quick=50, full=1000
    ),
    _case("roads along a parallel", road_along_parallel, unit="faults", of="maps", quick=1, full=9),
    _case(
        "maps of one node or a way without length",
        lone_node,
        "refused with one line",
        unit="maps",
        of="maps",
        quick=3,
        full=3,
    ),
)
"""Extremes of footprints, heights and roads."""
