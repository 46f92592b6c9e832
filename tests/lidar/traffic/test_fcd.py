"""Replays of SUMO's floating car data: positions, bodies, and one-line errors for broken files."""

import gzip

import numpy as np
import pytest
import shapely
from cyclopts import CoercionError
from hypothesis import given, settings
from hypothesis import strategies as st
from pyproj import Transformer

from geoscene.geometry.polylines import parallel
from lidar.cli import app
from lidar.errors import FormatError, InputError
from lidar.geometry.poses import Trajectory
from lidar.motion.vehicle import load_vehicle
from lidar.traffic.fcd import read_fcd
from lidar.traffic.fcd_replay import replay
from lidar.traffic.options import TrafficFile
from lidar.world.actors import existing_actors, rotations, states
from lidar.world.ground import ground_heights

CAR = load_vehicle("car")
UTM = "+proj=utm +zone=35 +ellps=WGS84 +datum=WGS84 +units=m +no_defs"
OFFSET = (-385_000.0, -6_671_000.0)
TO_NET = Transformer.from_crs("EPSG:4326", UTM, always_xy=True)


@pytest.fixture(scope="module")
def graph(scene):
    return scene.road_graph()


@pytest.fixture(scope="module")
def street(scene, graph):
    """The middle of the right half of the longest public street level but for its camber, (n, 2) every metre.

    Vehicles park along public streets, not along service roads.
    """
    two_way = (graph.twin >= 0) & (graph.highway != "service")
    for edge in np.argsort(-graph.length * two_way).tolist():
        line = shapely.linestrings(parallel(graph.geometry[edge], -graph.width[edge] / 4)[:, :2])
        xy = shapely.get_coordinates(shapely.line_interpolate_point(line, np.arange(0.0, line.length - 1.0)))
        z = ground_heights(scene, np.column_stack([xy, np.zeros(len(xy))]))
        if np.abs(z).max() < 0.15 and (graph.geometry[edge][:, 2] == 0).all():
            return xy
    pytest.fail("no street is level")


def standing(xy, seconds=10.0):
    time = np.array([0, int(seconds * 1e9)])
    quat = np.array([[0.0, 0.0, 0.0, 1.0]] * 2)
    return Trajectory(time, np.array([[*xy, 0.0]] * 2), quat, np.zeros((2, 3)), np.ones(2))


def net_at(path, proj=UTM, offset=OFFSET):
    shift = f"{offset[0]:.2f},{offset[1]:.2f}"
    path.write_text(f'<net version="1.20"><location netOffset="{shift}" projParameter="{proj}"/></net>')
    return path


def heading_of(line):
    d = np.gradient(line, axis=0)
    return np.arctan2(d[:, 1], d[:, 0])


def movers_at(scene, steps, *, geo=False):
    """The XML of steps: seconds and rows of id, type, scene x and y, and heading."""
    parts = []
    for second, movers in steps:
        parts.append(f'<timestep time="{second:.2f}">')
        for name, kind, x, y, heading in movers:
            d = 0.5 * np.array([np.cos(heading), np.sin(heading)])
            lon, lat = scene.frame.to_geographic(
                np.array([x, x + d[0], x - d[0]]), np.array([y, y + d[1], y - d[1]])
            )
            east, north = TO_NET.transform(lon, lat)
            degrees = np.degrees(np.arctan2(east[1] - east[2], north[1] - north[2])) % 360
            place = (lon[0], lat[0]) if geo else (east[0] + OFFSET[0], north[0] + OFFSET[1])
            tag = "person" if kind == "person" else "vehicle"
            said = f'type="{kind}" lane="1_0" pos="1.00"' if tag == "vehicle" else 'edge="1" pos="1.00"'
            parts.append(
                f'<{tag} id="{name}" x="{place[0]:.8f}" y="{place[1]:.8f}" angle="{degrees:.6f}" {said}/>'
            )
        parts.append("</timestep>")
    return parts


def fcd_at(path, scene, steps, *, head="", geo=False):
    text = (
        f"<?xml version='1.0'?>\n{head}<fcd-export>{''.join(movers_at(scene, steps, geo=geo))}</fcd-export>"
    )
    path.write_bytes(gzip.compress(text.encode()) if path.suffix == ".gz" else text.encode())
    return path


def along(line, metres, *, name="a", kind="car", every=1.0, start=0.0):
    """Steps of a road user at ``metres`` (n,) along a line, from ``start`` at equal intervals."""
    rows = np.arange(len(line))
    heading = np.unwrap(heading_of(line))
    x, y, h = (np.interp(metres, rows, c) for c in (*line.T, heading))
    return [(start + every * k, [(name, kind, *row)]) for k, row in enumerate(zip(x, y, h, strict=True))]


def together(*tracks):
    seconds = sorted({second for track in tracks for second, _ in track})
    found = [dict(track) for track in tracks]
    return [(s, [m for track in found for m in track.get(s, [])]) for s in seconds]


def played(scene, graph, path, ego, **options):
    return replay(
        scene, graph, ego=ego, vehicle=CAR, seed=1, options=TrafficFile(path, **{"parked": 0.0} | options)
    )


def fronts(actors, k, t):
    at = states(actors, np.full(len(t), k), time_ns=(np.asarray(t) * 1e9).astype(np.int64))
    return at, at.position + rotations(at.angles)[:, :, 0] * actors.size[k, 0] / 2


@pytest.mark.full
@pytest.mark.parametrize("form", ["net", "named", "geo", "packed"])
def test_the_front_bumper_has_sumos_position(form, scene, graph, street, tmp_path):
    metres = 20.0 + 7.0 * np.arange(8)
    steps = along(street, metres, start=100.0)
    head, net = "", None
    if form in ("net", "named"):
        net = net_at(tmp_path / "roads.net.xml")
    if form == "named":
        head, net = '<!-- <sumoConfiguration><net-file value="roads.net.xml"/></sumoConfiguration> -->', None
    path = tmp_path / ("fcd.xml.gz" if form == "packed" else "fcd.xml")
    fcd_at(path, scene, steps, head=head, geo=form in ("geo", "packed"))
    actors = played(scene, graph, path, standing(street[0] + 60.0), net=net)
    assert len(actors) == 1
    at, front = fronts(actors, 0, np.arange(8.0))
    expected = np.stack([np.interp(metres, np.arange(len(street)), c) for c in street.T], axis=1)
    np.testing.assert_allclose(front[:, :2], expected, atol=0.02)
    ground = ground_heights(scene, at.position)
    np.testing.assert_allclose(at.position[:, 2], ground, atol=0.06)
    assert np.hypot(*at.velocity[1:-1, :2].T) == pytest.approx(np.full(6, 7.0), rel=0.05)


@pytest.mark.full
def test_road_users_exist_for_their_time_in_the_file_shifted_by_begin(scene, graph, street, tmp_path):
    net = net_at(tmp_path / "n.net.xml")
    steps = together(
        along(street, 10.0 + 5.0 * np.arange(6), name="early", start=50.0),
        along(street, 10.0 + 5.0 * np.arange(4), name="late", start=56.0),
    )
    path = fcd_at(tmp_path / "fcd.xml", scene, steps)
    ego = standing(street[0] + 60.0)

    def there(times, **options):
        actors = played(scene, graph, path, ego, net=net, **options)
        return [len(existing_actors(actors, int(t * 1e9), end_ns=int(t * 1e9))) for t in times]

    assert there((0.0, 4.9, 5.5, 6.1, 8.9, 9.2)) == [1, 1, 0, 1, 1, 0]
    assert there((0.5, 1.5, 2.5, 4.9, 5.2), begin=54.0) == [1, 0, 1, 1, 0]


@pytest.mark.full
def test_a_vehicle_that_brakes_to_a_stop_neither_overshoots_nor_reverses(scene, graph, street, tmp_path):
    metres = np.array([5.0, 17.0, 27.0, 33.0, 33.0, 33.0, 34.0, 40.0])
    path = fcd_at(tmp_path / "fcd.xml", scene, along(street, metres))
    actors = played(scene, graph, path, standing(street[0] + 60.0), net=net_at(tmp_path / "n.net.xml"))
    t = np.arange(0.0, 7.0, 0.02)
    _, front = fronts(actors, 0, t)
    travelled = shapely.line_locate_point(shapely.linestrings(street), shapely.points(front[:, :2]))
    assert np.diff(travelled).min() > -2e-3
    resting = (t > 3.0) & (t < 5.0)
    np.testing.assert_allclose(travelled[resting], 33.0, atol=0.02)


def test_vehicle_classes_select_bodies_and_rail_vehicles_are_left_out(scene, graph, street, tmp_path):
    kinds = {
        "DEFAULT_VEHTYPE": {"sedan", "hatchback", "suv"},
        "bus_bus": {"bus"},
        "truck_truck": {"truck"},
        "DEFAULT_BIKETYPE": {"cyclist"},
        "DEFAULT_RAILTYPE": set(),
        "person": {"adult", "small_adult"},
        "mine": {"motorcycle"},
    }
    (tmp_path / "r.rou.xml").write_text(
        '<routes><vType id="mine" vClass="motorcycle" length="2.1"/></routes>'
    )
    head = '<!-- <route-files value="r.rou.xml"/> -->'
    apart = (len(street) - 20) // len(kinds)
    starts = zip(kinds, range(20, len(street), apart), strict=False)
    steps = together(*(along(street, k + np.arange(4.0), name=kind, kind=kind) for kind, k in starts))
    path = fcd_at(tmp_path / "fcd.xml", scene, steps, head=head)
    actors = played(scene, graph, path, standing(street[0] + 60.0), net=net_at(tmp_path / "n.net.xml"))
    places = shapely.points(actors.position[actors.first[:-1], :2])
    order = np.argsort(shapely.line_locate_point(shapely.linestrings(street), places))
    expected = [bodies for bodies in kinds.values() if bodies]
    assert all(kind in bodies for kind, bodies in zip(actors.kind[order], expected, strict=True))


def test_an_instant_lane_change_is_spread_over_three_seconds(scene, graph, street, tmp_path):
    steps = along(street, 10.0 + 0.8 * np.arange(80), every=0.1)
    heading = heading_of(street)[20]
    left = 3.0 * np.array([-np.sin(heading), np.cos(heading)])
    moved = [
        (s, [(n, k, x + left[0] * (s > 4.0), y + left[1] * (s > 4.0), h)]) for s, [(n, k, x, y, h)] in steps
    ]
    path = fcd_at(tmp_path / "fcd.xml", scene, moved)
    actors = played(scene, graph, path, standing(street[0] + 60.0), net=net_at(tmp_path / "n.net.xml"))
    assert len(actors) == 1
    t = np.arange(0.2, 7.6, 0.1)
    at, front = fronts(actors, 0, t)
    aside = (front[:, :2] - street[20]) @ left / 3.0
    straight = (
        (np.stack([np.interp(10 + 8 * t, np.arange(len(street)), c) for c in street.T], axis=1) - street[20])
        @ left
        / 3.0
    )
    offset = aside - straight
    assert abs(offset[t < 2.4]).max() < 0.05
    assert abs(offset[t > 5.7] - 3.0).max() < 0.05
    assert np.abs(np.diff(offset)).max() < 0.25
    assert np.abs(at.velocity[:, :2] @ left / 3.0).max() < 2.5


@pytest.mark.full
def test_a_teleported_vehicle_becomes_another_road_user(scene, graph, street, tmp_path):
    metres = np.array([5.0, 12.0, 19.0, 80.0, 87.0, 94.0]).clip(max=len(street) - 3)
    path = fcd_at(tmp_path / "fcd.xml", scene, along(street, metres))
    actors = played(scene, graph, path, standing(street[0] + 60.0), net=net_at(tmp_path / "n.net.xml"))
    assert len(actors) == 2
    assert np.hypot(*actors.velocity[:, :2].T).max() < 15.0


def test_road_users_that_would_touch_the_ego_are_removed(scene, graph, street, tmp_path):
    net = net_at(tmp_path / "n.net.xml")
    path = fcd_at(
        tmp_path / "fcd.xml",
        scene,
        together(along(street, 5.0 + 5.0 * np.arange(8)), along(street, 50.0 + 2.0 * np.arange(8), name="b")),
    )
    free = played(scene, graph, path, standing(street[0] + 60.0), net=net, parked=1.0)
    met = played(scene, graph, path, standing(street[20]), net=net, parked=1.0)
    assert (~free.parked).sum() == 2
    assert (~met.parked).sum() == 1
    assert free.parked.sum() > 3
    for t in range(0, 8_000_000_000, 500_000_000):
        rows = existing_actors(free, t, end_ns=t)
        at = states(free, rows, time_ns=t)
        half = shapely.points(at.position[:, :2])
        for k in np.flatnonzero(~free.parked[rows]):
            near = shapely.distance(half[k], half[free.parked[rows]])
            assert near.min() > 1.6


@pytest.mark.full
def test_the_same_file_and_seed_give_the_same_bytes(scene, graph, street, tmp_path):
    path = fcd_at(tmp_path / "fcd.xml", scene, along(street, 20.0 + np.arange(6.0)))
    net = net_at(tmp_path / "n.net.xml")
    first, second = (
        played(scene, graph, path, standing(street[0] + 60.0), net=net, parked=0.5) for _ in (0, 1)
    )
    for name in ("shape", "stretch", "position", "angles", "velocity", "time_ns", "feature"):
        assert getattr(first, name).tobytes() == getattr(second, name).tobytes()


@settings(max_examples=10, deadline=None)
@given(
    lon=st.floats(24.0, 30.0),
    lat=st.floats(-70.0, 70.0),
    angle=st.floats(0.0, 359.9),
    shift=st.tuples(st.floats(-1e6, 1e6), st.floats(-1e7, 1e7)),
)
def test_the_networks_projection_inverts_its_coordinates(tmp_path_factory, lon, lat, angle, shift):
    folder = tmp_path_factory.mktemp("net")
    net = net_at(folder / "n.net.xml", offset=shift)
    shift = [float(f"{v:.2f}") for v in shift]
    x, y = TO_NET.transform(lon, lat)
    path = folder / "fcd.xml"
    path.write_text(
        '<fcd-export><timestep time="0"><vehicle id="a" type="" '
        f'x="{x + shift[0]:.6f}" y="{y + shift[1]:.6f}" angle="{angle}"/></timestep></fcd-export>'
    )
    fcd = read_fcd(path, net=net)
    assert fcd.lon[0] == pytest.approx(lon, abs=1e-8)
    assert fcd.lat[0] == pytest.approx(lat, abs=1e-8)
    ahead = np.array(TO_NET.transform(*fcd.ahead[0])) - (x, y)
    np.testing.assert_allclose(ahead, [np.sin(np.radians(angle)), np.cos(np.radians(angle))], atol=1e-4)


BROKEN = {
    "missing": (None, "does not exist"),
    "cut": ('<fcd-export><timestep time="0.00"><vehicle id="a"', "broken XML"),
    "empty": ("", "broken XML"),
    "another": ("<routes><vehicle id='a'/></routes>", "<routes> is not floating car data"),
    "nobody": ('<fcd-export><timestep time="0.00"/></fcd-export>', "no vehicles and no persons in it"),
    "no_x": (
        '<fcd-export><timestep time="3"><vehicle id="a" y="1" angle="0"/></timestep></fcd-export>',
        "vehicle 'a' at 3 s: x is missing",
    ),
    "word": (
        '<fcd-export><timestep time="3"><vehicle id="a" x="1" y="nan" angle="0"/></timestep></fcd-export>',
        "y = 'nan' is no number",
    ),
    "no_net": (
        '<fcd-export><timestep time="3"><vehicle id="a" x="1000" y="1" angle="0"/></timestep></fcd-export>',
        "add net=",
    ),
}


@pytest.mark.parametrize("fault", BROKEN)
def test_unusable_files_are_refused_in_one_line(fault, tmp_path):
    text, said = BROKEN[fault]
    path = tmp_path / "fcd.xml"
    if text is not None:
        path.write_text(text)
    with pytest.raises(FormatError) as error:
        read_fcd(path)
    assert said in str(error.value)
    assert "fcd.xml" in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("<fcd-export/>", "not a SUMO network"),
        ('<net><location netOffset="0,0" projParameter="!"/></net>', "no projection"),
        ('<net><location netOffset="0" projParameter="+proj=utm +zone=35"/></net>', "netOffset"),
        ('<net><location netOffset="0,0" projParameter="+proj=nothing"/></net>', "projParameter"),
    ],
)
def test_networks_without_a_usable_projection_are_refused(text, said, tmp_path):
    path, net = tmp_path / "fcd.xml", tmp_path / "n.net.xml"
    path.write_text(
        '<fcd-export><timestep time="3"><vehicle id="a" x="1" y="1" angle="0"/></timestep></fcd-export>'
    )
    net.write_text(text)
    with pytest.raises(FormatError, match=said) as error:
        read_fcd(path, net=net)
    assert "\n" not in str(error.value)


def test_traffic_of_another_place_is_refused(scene, graph, street, tmp_path):
    net = net_at(tmp_path / "n.net.xml", offset=(OFFSET[0] - 9000.0, OFFSET[1]))
    path = fcd_at(tmp_path / "fcd.xml", scene, along(street, 20.0 + np.arange(6.0)))
    with pytest.raises(InputError, match="this place"):
        played(scene, graph, path, standing(street[0] + 60.0), net=net)
    with pytest.raises(InputError, match="seconds 0 to 5"):
        played(scene, graph, path, standing(street[0] + 60.0), net=net_at(tmp_path / "m.net.xml"), begin=50.0)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("none.xml", "none.xml does not exist"),
        ("none.xml,speed=2", "parameter 'speed' is unknown"),
        ("none.xml,begin=soon", "soon"),
        ("none.xml,parked=2", "parked = 2 is not within 0 to 1"),
    ],
)
def test_the_command_line_refuses_invalid_traffic(words, said, scene, tmp_path, capsys):
    out = tmp_path / "drive"
    with pytest.raises((InputError, CoercionError), match=said):
        app(
            [
                "drive",
                str(scene.path),
                "--route",
                "random",
                "--duration",
                "1",
                "--traffic",
                words,
                "-o",
                str(out),
                "-q",
            ],
            exit_on_error=False,
            result_action="return_value",
        )
    assert not out.exists()
    assert capsys.readouterr().out == ""
