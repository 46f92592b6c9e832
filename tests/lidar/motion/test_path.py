"""Paths are drivable, stay on the street and avoid obstacles."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
from helpers.roadgrids import grid, road_graph
from hypothesis import example, given, settings
from hypothesis import strategies as st

from geoscene.geometry.frames import Frame
from geoscene.roadgraph import build_road_graph
from geoscene.sources import read_osm
from lidar.errors import BlockedError, RouteError
from lidar.geometry.attitude import matrix_from_quat, quat_from_euler
from lidar.motion.motion import legs_of, motion_along
from lidar.motion.path import plan_path
from lidar.motion.road_drive import plan_route_and_path
from lidar.motion.route import RouteOptions, free_route, lane_route, plan_route
from lidar.motion.steering import body_outlines
from lidar.motion.vehicle import load_vehicle

FRAME = Frame.at(-76.3, 36.88)
CAR = load_vehicle("car")


def outlines(path, vehicle=CAR):
    return body_outlines(path.position[:, :2], path.heading, vehicle=vehicle)


def afloat(path, ground):
    """Height (4, n) of each wheel of the car above the ground, metres, from its attitude."""
    turn = matrix_from_quat(quat_from_euler(path.bank, -path.pitch, gamma=path.heading))
    out = []
    for ahead in (0.0, CAR.wheelbase):
        for left in (CAR.track / 2, -CAR.track / 2):
            x, y, z = (path.position + turn @ [ahead, left, 0.0]).T
            out.append(z - ground(x, y))
    return np.array(out)


def assert_drivable(path, vehicle, scale=1.0):
    """Assert bounded curvature and steering rate, motion along the heading and no jumps."""
    assert np.abs(path.curvature).max() <= 1.0 / vehicle.turning_radius + 1e-9
    for leg in np.unique(path.leg):
        p = path.take(path.leg == leg)
        over = np.hypot(*np.diff(p.position[:, :2], axis=0).T) / scale
        assert np.abs(np.diff(p.curvature)).max() <= vehicle.steering * over.max() * 1.001 + 1e-12
        turn = np.diff(p.heading)
        np.testing.assert_allclose(
            turn, 0.5 * (p.curvature[1:] + p.curvature[:-1]) * over, rtol=1e-3, atol=1e-6
        )
        middle = p.heading[:-1] + turn / 2
        along = np.diff(p.position[:, :2], axis=0)
        across = along[:, 1] * np.cos(middle) - along[:, 0] * np.sin(middle)
        assert np.abs(across).max() < 1e-9  # no side slip
        assert (p.gear[:-1] * (along[:, 0] * np.cos(middle) + along[:, 1] * np.sin(middle)) > 0).all()
    jump = np.linalg.norm(np.diff(path.position, axis=0), axis=1)
    assert jump.max() < 0.6
    assert np.abs(np.diff(path.heading)).max() < 0.2


@st.composite
def crooked_lines(draw):
    """Lines with kinks of up to 140 degrees and segments of 4 to 80 m."""
    turns = draw(st.lists(st.floats(-2.4, 2.4), min_size=1, max_size=8))
    steps = draw(st.lists(st.floats(4.0, 80.0), min_size=len(turns) + 1, max_size=len(turns) + 1))
    heading = np.cumsum([0.0, *turns])
    d = np.stack([np.cos(heading), np.sin(heading)], axis=1) * np.array([[20.0], *[[s] for s in steps[1:]]])
    xy = np.concatenate([[[0.0, 0.0]], np.cumsum(d, axis=0)])
    return np.column_stack([xy, np.zeros(len(xy))])


LOOP = [  # tighter than a car can turn: it leaves the line and comes out far from its end
    (0, 0), (20, 0), (23.51033025, -1.91770215), (22.79734602, 2.01824163), (18.83737604, 2.58272167),
    (16.22280156, -0.44448832), (17.3574503, -4.28018541), (19.62914699, -0.9878619),
    (23.62694466, -1.12057876), (27.62474234, -1.25329563),
]  # fmt: skip


@pytest.mark.full
@example(np.column_stack([LOOP, np.zeros(len(LOOP))]), "car")
@given(crooked_lines(), st.sampled_from(["car", "van", "robot"]))
@settings(max_examples=30, deadline=None)
def test_any_line_gives_a_drivable_path_or_an_error(line, name):
    vehicle = load_vehicle(name)
    try:
        path = plan_path(free_route(line), vehicle, frame=FRAME)
    except BlockedError:
        return
    assert_drivable(path, vehicle)
    end = np.hypot(*(path.position[-1, :2] - line[-1, :2]))
    assert end < 3.0 * vehicle.turning_radius


@pytest.mark.full
@given(st.integers(0, 2**32 - 1), st.sampled_from(["right", "left"]))
@settings(max_examples=5, deadline=None)
def test_among_city_blocks_the_body_stays_on_the_street_and_in_its_lane(seed, side):
    graph = grid(4, 4, width=8.0)
    route = plan_route(graph, FRAME, spec="random", options=RouteOptions(seed=seed, length=800.0, side=side))
    path = plan_path(route, CAR, frame=FRAME)
    assert_drivable(path, CAR)
    # a kerb with the usual rounding at corners
    streets = shapely.union_all(shapely.buffer(shapely.linestrings([g[:, :2] for g in graph.geometry]), 4.0))
    streets = shapely.buffer(shapely.buffer(streets, 6.0), -6.0)
    assert shapely.within(shapely.union_all(outlines(path)), streets)
    # away from junctions it drives in the middle of its lane
    xy = path.position[:, :2]
    between = np.abs(xy - 100.0 * np.round(xy / 100.0)).max(axis=1) > 15.0
    assert np.abs(path.offset[between]).max() < 0.1


@pytest.mark.full
def test_a_corner_house_at_the_kerb_is_driven_round():
    # the inner corner of a right turn is a house; straight through the lanes' rounding the body would hit it
    graph = road_graph([(-60, 0), (0, 0), (0, -60)], [(0, 1), (1, 2)], width=6.0)
    route = lane_route(graph, [0, 2], ends=(0.0, 60.0))
    house = shapely.box(-40, -40, -3.2, -3.2)
    free = plan_path(route, CAR, frame=FRAME)
    assert shapely.intersects(outlines(free), house).any()
    path = plan_path(route, CAR, frame=FRAME, obstacles=[house])
    assert_drivable(path, CAR)
    assert shapely.distance(outlines(path), house).min() >= 0.2
    far_side = shapely.box(-60, 3.5, 10, 20)  # and it does not need the houses on the other side
    both = plan_path(route, CAR, frame=FRAME, obstacles=[house, far_side])
    assert shapely.distance(outlines(both), house).min() >= 0.2
    assert shapely.distance(outlines(both), far_side).min() >= 0.2


def test_a_gap_narrower_than_the_body_is_refused_and_named():
    graph = road_graph([(0, 0), (100, 0)], [(0, 1)])
    walls = [shapely.box(50, 0.8, 60, 20), shapely.box(50, -20, 60, -0.8)]
    with pytest.raises(BlockedError, match=r"does not pass between .* scene x [45]\d\.\d") as caught:
        plan_path(lane_route(graph, [0], ends=(0.0, 100.0)), CAR, frame=FRAME, obstacles=walls)
    assert caught.value.turns == [(0, 0)]
    robot = load_vehicle("robot")
    assert_drivable(
        plan_path(lane_route(graph, [0], ends=(0.0, 100.0)), robot, frame=FRAME, obstacles=walls), robot
    )


def test_buildings_do_not_matter_in_tunnels_and_on_bridges():
    graph = road_graph([(0, 0), (100, 0)], [(0, 1)], tunnel=[True, True])
    house = shapely.box(40, -20, 60, 20)
    path = plan_path(lane_route(graph, [0], ends=(0.0, 100.0)), CAR, frame=FRAME, obstacles=[house])
    assert shapely.intersects(outlines(path), house).any()


def test_a_street_that_the_vehicle_does_not_fit_is_bypassed():
    graph = grid(3, 2)
    across = shapely.box(120, -10, 180, 10)  # a market hall across the southern street
    lat_lon = [FRAME.to_geographic(x, y)[::-1] for x, y in [(50, 0), (200, 50)]]
    direct, _ = plan_route_and_path(graph, FRAME, spec=lat_lon, vehicle=CAR)
    assert direct.line[:, 1].max() < 60.0
    route, path = plan_route_and_path(graph, FRAME, spec=lat_lon, vehicle=CAR, obstacles=[across])
    assert route.line[:, 1].max() > 90.0
    assert not shapely.intersects(outlines(path), across).any()
    with pytest.raises(BlockedError, match="does not pass"):
        plan_route_and_path(
            graph, FRAME, spec=lat_lon, vehicle=CAR, obstacles=[across, shapely.box(120, 90, 180, 110)]
        )


def test_at_a_dead_end_the_vehicle_turns_round_in_three_moves():
    graph = road_graph([(0, 0), (100, 0)], [(0, 1)])
    route = lane_route(graph, [0, 1], ends=(0.0, 100.0))
    path = plan_path(route, CAR, frame=FRAME)
    assert_drivable(path, CAR)
    legs = [path.take(path.leg == k) for k in range(path.leg.max() + 1)]
    assert [leg.gear[0] for leg in legs] == [1, 1, -1, 1, 1]
    assert shapely.get_coordinates(outlines(legs[0]))[:, 0].max() == pytest.approx(100.0, abs=0.5)
    np.testing.assert_allclose(np.cos(path.heading[[0, -1]]), [1.0, -1.0], atol=1e-3)
    np.testing.assert_allclose(path.position[-1, :2], [0.0, 1.75], atol=0.3)
    tight = [shapely.box(85, 5.0, 110, 20), shapely.box(85, -20, 110, -5.0)]
    more = plan_path(route, CAR, frame=FRAME, obstacles=tight)
    assert more.leg.max() > path.leg.max()
    assert not shapely.intersects(shapely.union_all(outlines(more)), shapely.union_all(tight))
    closed = [shapely.box(80, 3.6, 110, 20), shapely.box(80, -20, 110, -3.6)]
    with pytest.raises(BlockedError, match="no room to turn round"):
        plan_path(route, CAR, frame=FRAME, obstacles=closed)


@pytest.mark.parametrize("name", ["car", "van"])
def test_the_vehicle_turns_before_the_island_of_a_turning_loop(name):
    vehicle = load_vehicle(name)
    graph = replace(road_graph([(0, 0), (100, 0)], [(0, 1)]), node_island=np.array([0.0, 3.0]))
    route = lane_route(graph, [0, 1], ends=(0.0, 100.0), turning_radius=vehicle.turning_radius)
    path = plan_path(route, vehicle, frame=FRAME)
    assert shapely.distance(outlines(path, vehicle), shapely.Point(100.0, 0.0)).min() > 3.0


@given(st.integers(0, 2**32 - 1), st.sampled_from(["car", "van", "robot"]))
@settings(max_examples=20, deadline=None)
def test_routes_that_end_in_or_right_after_a_turn_round_are_driven(seed, name):
    """Short streets with dead ends: legs of all lengths between turns, also none."""
    vehicle = load_vehicle(name)
    rng = np.random.default_rng(seed)
    length = rng.uniform(8.0, 40.0)
    graph = road_graph([(0, 0), (length, 0)], [(0, 1)])
    edges = np.arange(rng.integers(2, 6)) % 2
    end = length * rng.uniform(0.0, 1.0)
    route = lane_route(graph, edges, ends=(rng.uniform(0.0, 0.8) * length, end))
    try:
        path = plan_path(route, vehicle, frame=FRAME)
    except RouteError:
        return
    assert_drivable(path, vehicle)
    assert min(last - first for first, last in legs_of(path)) >= 2
    motion = motion_along(path, vehicle)
    assert motion.s[-1] == pytest.approx(path.length)


def test_a_route_that_ends_where_the_vehicle_has_turned_round_ends_with_that_turn():
    """After three moves the rear axle is past the end of the way back."""
    graph = road_graph([(0, 0), (100, 0)], [(0, 1)])
    path = plan_path(lane_route(graph, [0, 1], ends=(0.0, 1.5)), CAR, frame=FRAME)
    assert path.gear[[first for first, _ in legs_of(path)]].tolist() == [1, 1, -1, 1]
    assert_drivable(path, CAR)


def test_on_a_slope_the_vehicle_stands_on_the_ground():
    line = np.array([[0.0, 0.0, 0.0], [200.0, 0.0, 20.0]])
    path = plan_path(free_route(line), CAR, frame=FRAME)
    inner = slice(40, -40)
    np.testing.assert_allclose(path.position[inner, 2], 0.1 * path.position[inner, 0], atol=1e-5)
    np.testing.assert_allclose(path.slope[inner], np.arctan(0.1), atol=1e-6)
    assert path.length == pytest.approx(200.0 * np.hypot(1, 0.1), rel=1e-3)


def test_the_ground_sets_height_and_roll_of_the_vehicle():
    line = np.array([[0.0, 0.0, 0.0], [200.0, 0.0, 0.0]])

    def ground(x, y, _near=None):
        return 5.0 + 0.05 * x + 0.02 * y

    path = plan_path(free_route(line), CAR, frame=FRAME, ground=ground)
    inner = slice(40, -40)
    np.testing.assert_allclose(path.position[inner, 2], ground(*path.position[inner, :2].T), atol=1e-6)
    # the body rolls about an axis that points uphill
    np.testing.assert_allclose(path.bank[inner], np.arctan(0.02 * np.cos(np.arctan(0.05))), atol=1e-6)
    np.testing.assert_allclose(path.slope[inner], np.arctan(0.05), atol=1e-6)


def test_on_faceted_hairpins_each_wheel_keeps_to_the_ground():
    """A hillside of facets up to 20 % steep: wheels are neither above the ground nor in it."""
    t = np.linspace(0.0, np.pi, 60)
    bend = np.column_stack([60.0 + 9.0 * np.sin(t), 9.0 * (1 - np.cos(t)), 0 * t])
    line = np.concatenate([[[0.0, 0.0, 0.0]], bend, [[0.0, 18.0, 0.0]]])

    def ground(x, y, _near=None):
        return np.interp(x, [0, 20, 35, 50, 58, 66, 80], [0, 1, 3.8, 5, 6.4, 6.8, 9]) + 0.1 * np.abs(y - 9.0)

    path = plan_path(free_route(line), CAR, frame=FRAME, ground=ground)
    off = afloat(path, ground)
    assert np.percentile(np.abs(off), 95) < 0.03
    assert np.abs(off).max() < 0.12
    assert np.percentile(np.abs(np.mean(off, axis=0)), 95) < 0.01


@given(st.floats(-0.55, 0.55), st.floats(-0.25, 0.25), st.floats(-np.pi, np.pi))
@settings(max_examples=20, deadline=None)
def test_on_a_plane_however_steep_all_wheels_stand_on_it(ahead, aside, way):
    c, s = np.cos(way), np.sin(way)

    def ground(x, y, _near=None):
        return ahead * (c * x + s * y) + aside * (c * y - s * x)

    line = np.array([[0.0, 0.0, 0.0], [60.0 * c, 60.0 * s, 60.0 * ahead]])
    path = plan_path(free_route(line), CAR, frame=FRAME, ground=ground)
    assert np.abs(afloat(path, ground)[:, 20:-20]).max() < 1e-3


def test_a_street_as_steep_as_stairs_is_not_treated_as_a_step():
    """Gradients of 27 to 33 %, then 52 to 58 %: the wheels follow the facets equally closely on both."""
    worst = []
    for base in (0.30, 0.55):
        x = np.arange(0.0, 201.0, 10.0)
        z = np.cumsum(np.append(0.0, 10.0 * (base + 0.03 * (-1.0) ** np.arange(len(x) - 1))))

        def ground(at, _y, _near=None, x=x, z=z):
            return np.interp(at, x, z)

        path = plan_path(free_route(np.column_stack([x, 0 * x, z])), CAR, frame=FRAME, ground=ground)
        worst.append(np.abs(afloat(path, ground)[:, 20:-20]).max())
    assert max(worst) < 0.02
    assert worst[1] == pytest.approx(worst[0], rel=0.3)


def test_a_wall_beside_the_road_does_not_tip_the_vehicle():
    def ground(x, y, _near=None):
        return np.where(np.abs(y) > 0.6, 1.2, 0.0) + 0.0 * x

    path = plan_path(free_route([[0.0, 0, 0], [60.0, 0, 0]]), CAR, frame=FRAME, ground=ground)
    np.testing.assert_allclose(path.bank, 0.0, atol=1e-9)
    np.testing.assert_allclose(path.position[:, 2], 0.0, atol=1e-9)


def test_lengths_are_true_metres_where_the_projection_shrinks_them():
    frame = Frame.at(-75.0, 40.0, crs="EPSG:32618")  # on the zone's meridian: 0.9996
    lon, lat = frame.to_geographic(np.array([0.0, 1000.0]), np.zeros(2))
    path = plan_path(free_route([[0.0, 0, 0], [1000.0, 0, 0]]), CAR, frame=frame)
    from pyproj import Geod  # noqa: PLC0415

    true = Geod(ellps="WGS84").inv(lon[0], lat[0], lon[1], lat[1])[2]
    assert path.length == pytest.approx(true, abs=0.3)
    assert path.length > 1000.2
    assert_drivable(path, CAR, scale=0.9996)


def test_a_route_that_is_too_short_is_refused():
    with pytest.raises(RouteError, match="too short to drive"):
        plan_path(free_route([[0.0, 0, 0], [0.1, 0, 0]]), CAR, frame=FRAME)


@pytest.mark.shared
@pytest.mark.parametrize("name", ["nyc_lower_east_side.osm.pbf", "helsinki_center.osm.pbf"])
def test_in_a_real_city_the_body_touches_no_building(shared_osm, name):
    osm = read_osm(shared_osm(name))
    west, south, east, north = osm.bounds
    frame = Frame.at((west + east) / 2, (south + north) / 2)
    graph, _ = build_road_graph(osm, frame)

    def project(points):
        return np.column_stack(frame.from_geographic(*points.T))

    shapes = [a.geometry for a in osm.areas if a.tags.get("building", "no") not in ("no", "roof")]
    houses = shapely.STRtree(shapely.transform(np.array(shapes, object), project))
    for seed in range(2):
        route, path = plan_route_and_path(
            graph,
            frame,
            spec="random",
            options=RouteOptions(seed=seed, duration=240.0),
            vehicle=CAR,
            obstacles=houses,
        )
        assert_drivable(path, CAR)
        covered = (graph.bridge | graph.tunnel)[path.edge]
        body, _ = houses.query(outlines(path)[~covered], predicate="intersects")
        assert not len(body)
        assert path.length > 1500.0
        assert np.percentile(np.abs(path.offset), 95) < 1.5
        assert route.edges.size > 10


def test_of_stacked_surfaces_the_vehicle_drives_on_the_one_nearest_to_the_road():
    graph = road_graph(
        [(0, 0), (100, 0), (150, 0), (250, 0)],
        [(0, 1), (1, 2), (2, 3)],
        bridge=[False, False, True, True, False, False],
    )

    def ground(x, _y, near):
        deck, ravine = np.full(len(x), 0.4), np.where((x > 101) & (x < 149), -8.0, 0.4)
        return np.where(np.abs(deck - near) < np.abs(ravine - near), deck, ravine)

    path = plan_path(lane_route(graph, [0, 2, 4], ends=(0.0, 100.0)), CAR, frame=FRAME, ground=ground)
    np.testing.assert_allclose(path.position[:, 2], 0.4, atol=1e-6)


def test_velocity_along_a_hilly_path_is_its_derivative():
    x = np.arange(0.0, 401.0, 4.0)
    line = np.column_stack([x, np.zeros(len(x)), 6.0 * np.sin(x / 30.0)])
    path = plan_path(free_route(line), CAR, frame=FRAME)
    rise = np.diff(path.position[:, 2]) / np.diff(path.s)
    np.testing.assert_allclose(rise, np.sin(0.5 * (path.slope[1:] + path.slope[:-1])), atol=2e-3)


def test_every_row_of_the_path_has_its_street():
    graph = road_graph(
        [(0, 0), (80, 0), (160, 0), (240, 0)], [(0, 1), (1, 2), (2, 3)], speed=[9.0, 9, 5, 5, 12, 12]
    )
    path = plan_path(lane_route(graph, [0, 2, 4], ends=(0.0, 80.0)), CAR, frame=FRAME)
    expected = np.array([0, 2, 4])[np.clip((path.position[:, 0] // 80).astype(int), 0, 2)]
    inner = np.abs(path.position[:, 0] % 80.0 - 40.0) < 39.0
    np.testing.assert_array_equal(path.edge[inner], expected[inner])
    np.testing.assert_array_equal(path.limit[inner], graph.speed[expected[inner]])


def test_the_ground_is_loaded_in_regions_around_the_vehicle(monkeypatch):
    graph = grid(gap=80.0)
    route = plan_route(graph, FRAME, spec="random", options=RouteOptions(seed=3, length=600.0))
    boxes = []

    def ground(x, y, z):
        boxes.append((np.ptp(x), np.ptp(y)))
        return z + 0.1 * np.sin(x / 9) * np.cos(y / 7)

    whole = plan_path(route, load_vehicle("car"), frame=FRAME, ground=ground)
    boxes.clear()
    monkeypatch.setattr("lidar.motion.path._REGION", 150.0)
    parts = plan_path(route, load_vehicle("car"), frame=FRAME, ground=ground)
    assert len(boxes) > 9
    assert np.max(boxes) < 150.0 + 2 * 4.0  # and the axles beside and ahead
    for name, column in whole.columns().items():
        assert column.tobytes() == parts.columns()[name].tobytes()
