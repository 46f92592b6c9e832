"""Lined tunnels: relief along the way, closed solids, and the clearance of vehicles."""

from itertools import pairwise

import numpy as np
import pytest

from geoscene.classes import Class
from geoscene.geometry.watertight import validate_mesh
from geoscene.roadgraph import build_road_graph, find_obstacles, graded_ground, profile
from geoscene.roadgraph.surfaces import road_surfaces
from geoscene.structures import (
    StructureOptions,
    built_structures,
    find_openings,
    ground_below,
    read_structures,
)
from geoscene.structures.lining import NICHE, WALKWAY
from geoscene.uses import RELIEFS
from tests.geoscene.structures.test_structures import (
    FRAME,
    PLACES,
    UNDER,
    crosses,
    first_above,
    first_below,
    flat,
    moved,
    numbered,
    town,
)

CLEARANCE = 4.5
"""Metres of free height that signs state for road tunnels."""


class Tube:
    """The tunnel of a straight road 120 m long, or of a bent one on a map, with a relief."""

    def __init__(self, relief, ways=UNDER, places=PLACES):
        osm = town(places, ways)
        graph, _ = build_road_graph(osm, FRAME)
        self.graph = profile(graph, flat, obstacles=find_obstacles(osm, FRAME))
        graded = graded_ground(self.graph, flat)
        surfaces = road_surfaces(osm, self.graph, frame=FRAME)
        options = StructureOptions.of_relief(relief)
        self.table, _ = read_structures(
            surfaces, self.graph, osm=osm, frame=FRAME, height=graded, options=options
        )
        height = ground_below(self.table, graded)
        openings = find_openings(self.table, height, graph=self.graph)
        self.built = built_structures(self.table, height=height, openings=openings, options=options)
        self.mesh = numbered([built.mesh for built in self.built])

    def guessed(self, kind):
        return sum(built.guessed.get(kind, 0) for built in self.built)

    def points(self, step=0.5):
        """Points (n, 3) along the tunnel's lane, more than 2 m from its ends."""
        line = next(self.graph.geometry[e] for e in np.flatnonzero(self.graph.tunnel))
        along = np.append(0.0, np.cumsum(np.hypot(*np.diff(line[:, :2], axis=0).T)))
        at = np.arange(2.0, along[-1] - 2.0, step)
        return np.column_stack([np.interp(at, along, column) for column in line.T])


@pytest.fixture(scope="module", params=["plain", "full"])
def lined(request):
    return Tube(request.param)


def walls_along(tube, height, side):
    """Metres from the centre line to the wall at stations."""
    ground = tube.points()
    corners = tube.mesh.vertices[tube.mesh.faces]
    return np.array([nearest(corners, moved(p, 0, 0, height), np.array([0.0, side, 0.0])) for p in ground])


def nearest(corners, start, way):
    """Distance to the first of the triangles (m, 3, 3) along a ray (Moeller and Trumbore 1997)."""
    a, u, v = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    p = np.cross(way, v)
    det = np.einsum("ij,ij->i", u, p)
    met = np.abs(det) > 1e-12
    a, u, v, p, det = a[met], u[met], v[met], p[met], det[met]
    s = start - a
    q = np.cross(s, u)
    b, c, t = (s * p).sum(1) / det, q @ way / det, (v * q).sum(1) / det
    inside = (b >= 0) & (c >= 0) & (b + c <= 1) & (t > 1e-9)
    return float(t[inside].min())


def test_lined_tunnels_are_closed_solids(lined):
    verdict = validate_mesh(lined.mesh)
    assert verdict.ok.all(), [verdict.fault(k) for k in np.flatnonzero(~verdict.ok)]


@pytest.mark.full
def test_a_lined_tunnel_keeps_the_clearance_over_its_carriageway(lined):
    points = lined.points()
    for aside in (-2.5, 0.0, 2.5):
        lane = moved(points, 0, aside, 0)
        floor, _ = first_below(lined.mesh, moved(lane, 0, 0, 1))
        np.testing.assert_allclose(floor, points[:, 2], atol=0.01)
        assert (first_above(lined.mesh, moved(lane, 0, 0, 1)) - points[:, 2] >= CLEARANCE).all()
    for a, b in pairwise(points):
        for aside, up in ((-2.9, 0.3), (0.0, 2.0), (2.9, 4.0)):
            assert not crosses(lined.mesh, moved(a, 0, aside, up), moved(b, 0, aside, up))


@pytest.mark.full
def test_walls_of_a_lined_tunnel_step_in_and_out_along_the_way(lined):
    smooth = Tube("off")
    for side in (-1.0, 1.0):
        assert np.ptp(walls_along(smooth, 3.2, side)) < 0.01
        steps = np.abs(np.diff(walls_along(lined, 3.2, side)))
        assert (steps > 0.1).sum() >= 2 * 120 / 10 * 0.6  # in and out of ribs every 10 m or less, some hidden


@pytest.mark.full
def test_walkways_stand_beside_the_carriageway_and_vehicles_have_its_whole_width(lined):
    points = lined.points()
    wide = walls_along(lined, 0.5, 1.0).min()
    beside = moved(points, 0, wide - 0.3, 0)
    top, klass = first_below(lined.mesh, moved(beside, 0, 0, 0.8))
    np.testing.assert_allclose(np.median(top - points[:, 2]), WALKWAY, atol=0.01)
    assert Class.ROAD not in klass
    assert wide > walls_along(Tube("off"), 0.5, 1.0).max() + 0.2


@pytest.mark.full
def test_niches_are_set_back_into_the_wall_below_their_ceiling():
    long = {1: (-400, 0), 2: (-150, 0), 3: (150, 0), 4: (400, 0)}
    tube = Tube("plain", places=long)
    count = tube.guessed("niches")
    assert 300 / 150 <= count <= 300 / 50
    low = np.concatenate([walls_along(tube, NICHE - 0.4, side) for side in (-1.0, 1.0)])
    wall = np.median(low)
    inside = low > wall + 0.3
    assert np.isclose(0.5 * inside.sum(), 2.4 * count, atol=0.8 * count)  # each 2.4 m along the tunnel
    above = np.concatenate([walls_along(tube, NICHE + 0.4, side) for side in (-1.0, 1.0)])
    assert not (above > wall + 0.05).any()


def test_only_full_relief_hangs_equipment_in_a_tunnel():
    plain, full = Tube("plain"), Tube("full")
    assert not plain.guessed("lamps")
    assert full.guessed("lamps") >= 120 / 12 - 3
    assert full.guessed("signs") >= 4
    assert full.guessed("ribs") == plain.guessed("ribs") > 5
    assert sum(Tube("off").guessed(kind) for kind in ("ribs", "niches", "walkways")) == 0


def test_without_its_equipment_a_tunnel_of_full_relief_is_one_of_plain_relief():
    plain, full = Tube("plain"), Tube("full")
    assert any(built.equipment.any() for built in full.built)
    for few, many in zip(plain.built, full.built, strict=True):
        left = many.mesh.take(~many.equipment)
        assert not few.equipment.any()
        np.testing.assert_array_equal(
            left.vertices[left.faces], few.mesh.vertices[few.mesh.faces], strict=True
        )


def test_lining_depends_on_the_osm_id_and_not_on_the_order_of_the_map():
    others = {11: (-400, 900), 12: (-60, 900), 13: (60, 900), 14: (400, 900)}
    more = [(tags, [n + 10 for n in nodes]) for tags, nodes in UNDER]
    alone, together = Tube("full"), Tube("full", ways=[*UNDER, *more], places=PLACES | others)
    near = together.mesh.vertices[:, 1] < 450
    rows = near[together.mesh.faces].all(axis=1)
    theirs = together.mesh.take(rows)
    np.testing.assert_allclose(
        theirs.vertices, alone.mesh.take(np.arange(len(alone.mesh))).vertices, atol=1e-6
    )


@pytest.mark.full
@pytest.mark.parametrize("relief", RELIEFS)
def test_a_bent_tunnel_and_a_foot_tunnel_are_closed_solids(relief):
    places = {1: (-200, 0), 2: (-60, 0), 3: (0, 5), 4: (40, 40), 5: (45, 90), 6: (45, 200)}
    places |= {7: (-100, -100), 8: (-60, -100), 9: (-30, -90), 10: (0, -60)}
    road = {"highway": "secondary", "sidewalk": "no"}
    foot = {"highway": "footway"}
    ways = [(road, [1, 2]), (road | {"tunnel": "yes", "layer": "-1"}, [2, 3, 4, 5]), (road, [5, 6]),
            (foot, [7, 8]), (foot | {"tunnel": "yes", "layer": "-1"}, [8, 9, 10])]  # fmt: skip
    tube = Tube(relief, ways=ways, places=places)
    assert validate_mesh(tube.mesh).ok.all()
