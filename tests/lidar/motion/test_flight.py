"""Flights and walks: strips cover the area, aircraft bank into turns, walkers sway."""

import numpy as np
import pytest
import shapely

from geoscene.geometry.frames import Frame
from lidar.errors import InputError, RouteError
from lidar.geometry.attitude import euler_from_quat
from lidar.motion.flight import survey_flight, waypoint_flight
from lidar.motion.motion import drive_path
from lidar.motion.path import plan_path
from lidar.motion.route import free_route
from lidar.motion.vehicle import load_vehicle, vehicle_names

FRAME = Frame.at(-76.3, 36.88)
AREA = shapely.Polygon([(0, 0), (900, 100), (800, 700), (100, 500)])


@pytest.mark.full
@pytest.mark.parametrize(
    ("name", "spacing", "run_out"), [("drone", 60.0, 20.0), ("drone", 4.0, 20.0), ("aircraft", 250.0, 600.0)]
)
@pytest.mark.parametrize("heading", [90.0, 30.0])
def test_strips_cover_the_area_and_can_be_flown(name, spacing, run_out, heading):
    craft = load_vehicle(name)
    area = AREA if spacing > 10 else shapely.box(0, 0, 200, 30)
    route = survey_flight(
        area,
        spacing=spacing,
        height=80.0,
        radius=1.3 * craft.turning_radius,
        heading_deg=heading,
        run_out=run_out,
    )
    path = plan_path(route, craft, frame=FRAME)
    assert np.abs(path.curvature).max() <= 1 / craft.turning_radius + 1e-9
    flown = shapely.LineString(path.position[:, :2])
    inside = shapely.intersection(flown, shapely.buffer(area, spacing))
    missed = shapely.difference(area, shapely.buffer(inside, 0.5 * spacing + 0.03 * spacing))
    assert missed.area < 1e-3 * area.area
    np.testing.assert_allclose(path.position[:, 2], 80.0, atol=1e-9)
    away = (
        shapely.distance(shapely.points(path.position[:, :2]), area)
        > 3 * spacing + run_out + 4 * craft.turning_radius
    )
    assert not away.any()


def hill(x, y):
    """Ground (n,) with a hill of 120 m in the middle of the area."""
    return 30.0 + 120.0 * np.exp(-((np.asarray(x) - 450.0) ** 2 + (np.asarray(y) - 350.0) ** 2) / 200.0**2)


@pytest.mark.full
@pytest.mark.parametrize(("follow", "lowest", "highest"), [(True, 80.0, 80.0), (False, 80.0, 200.0)])
def test_surveys_follow_the_ground_or_fly_level_above_its_highest_point(follow, lowest, highest):
    route = survey_flight(AREA, spacing=60.0, height=80.0, radius=4.0, ground=hill, follow=follow)
    path = plan_path(route, load_vehicle("drone"), frame=FRAME)
    above = path.position[:, 2] - hill(*path.position[:, :2].T)
    assert above.min() == pytest.approx(lowest, abs=2.0)
    assert above.max() == pytest.approx(highest, abs=4.0)


def test_an_aircraft_keeps_its_speed_and_banks_into_turns():
    craft = load_vehicle("aircraft")
    route = survey_flight(AREA, spacing=400.0, height=500.0, radius=700.0, run_out=400.0)
    trajectory = drive_path(plan_path(route, craft, frame=FRAME), craft)
    speed = np.linalg.norm(trajectory.velocity, axis=1)
    assert speed.min() > 30.0  # slower only to limit the roll rate
    yaw = np.unwrap(euler_from_quat(trajectory.quat_xyzw)[:, 2])
    roll = euler_from_quat(trajectory.quat_xyzw)[:, 0]
    across = speed * np.gradient(yaw, 0.01)
    steep = np.abs(across) > 3.0
    assert steep.any()
    # coordinated: the bank that balances the turn, the left wing down in a left turn
    np.testing.assert_allclose(roll[steep], -np.arctan(across[steep] / 9.81), atol=0.06)


def test_a_drone_climbs_level_and_tips_forward_to_speed_up():
    craft = load_vehicle("drone")
    points = [(0, 0, 10), (100, 0, 40), (100, 80, 40), (200, 80, 5)]
    path = plan_path(waypoint_flight(points), craft, frame=FRAME)
    trajectory = drive_path(path, craft)
    np.testing.assert_allclose(trajectory.position[[0, -1]], [points[0], points[-1]], atol=0.3)
    pitch = euler_from_quat(trajectory.quat_xyzw)[:, 1]
    speed = np.linalg.norm(trajectory.velocity, axis=1)
    change = np.gradient(speed, 0.01)
    np.testing.assert_allclose(pitch, 0.102 * change, atol=1e-3)
    assert trajectory.velocity[:, 2].max() > 1.5
    high = plan_path(waypoint_flight(points, ground=lambda x, _y: 0.1 * x), craft, frame=FRAME)
    assert high.position[-1, 2] == pytest.approx(25.0, abs=0.2)


def test_a_backpack_sways_and_rises_with_every_step():
    walker = load_vehicle("backpack")
    trajectory = drive_path(plan_path(free_route([[0.0, 0, 0], [60.0, 0, 0]]), walker, frame=FRAME), walker)
    middle = slice(1000, 3000)
    sway, rise = trajectory.position[middle, 1], trajectory.position[middle, 2]
    assert (sway.min(), sway.max()) == (pytest.approx(-0.02, abs=1e-3), pytest.approx(0.02, abs=1e-3))
    assert (rise.min(), rise.max()) == (pytest.approx(0.0, abs=1e-3), pytest.approx(0.045, abs=1e-3))
    tops = np.sum((rise[1:-1] > rise[:-2]) & (rise[1:-1] >= rise[2:]))
    assert tops / 20.0 == pytest.approx(1.9, abs=0.1)
    moved = np.diff(trajectory.position[middle], axis=0) / 0.01
    np.testing.assert_allclose(
        moved, 0.5 * (trajectory.velocity[middle][1:] + trajectory.velocity[middle][:-1]), atol=0.01
    )


def test_every_built_in_vehicle_loads_and_an_error_lists_every_fault(tmp_path):
    for name in vehicle_names():
        assert load_vehicle(name).name == name
        assert len(load_vehicle(name).source) > 20
    # the wheels turn about a point on the line of the rear axle (Ackermann); turning circle, wheelbase, track
    radius = np.sqrt((11.4 / 2) ** 2 - 2.71**2) - 1.55 / 2
    assert load_vehicle("car").turning_radius == pytest.approx(radius, abs=0.01)
    with pytest.raises(InputError, match="vehicle 'tank' is unknown"):
        load_vehicle("tank")
    path = tmp_path / "mine.toml"
    path.write_text('name = "mine"\nkind = "boat"\nlength = -1\nwings = 2\nsteering = "soft"\n')
    with pytest.raises(InputError) as caught:
        load_vehicle(path)
    for word in ("unknown key wings", "missing width", "boat", "length = -1", "steering = 'soft'"):
        assert word in str(caught.value)


def test_a_survey_of_an_empty_area_is_refused():
    with pytest.raises(RouteError, match="above zero"):
        survey_flight(shapely.box(0, 0, 1, 1), spacing=0.0, height=10.0, radius=5.0)
