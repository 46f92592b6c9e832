"""Physical attacks: budgets, published figures, line of sight, and what their returns look like."""

import functools
from dataclasses import replace

import numpy as np
import pytest
from helpers import ROOT
from helpers.sensor_worlds import box, driven, plate, world
from scipy import stats

from geoscene.classes import Class
from geoscene.geometry.frames import Frame
from lidar.errors import InputError
from lidar.geometry.attitude import Mount
from lidar.sensors.laser.scan import cast
from lidar.sensors.physics.detector import METRES_PER_NS
from lidar.sensors.physics.origin import Origin
from lidar.sensors.physics.settings import LEVELS, PLAIN
from lidar.sensors.rig.scanner import firings, load_sensor
from lidar.signal.attacks.attacker import DEVICES, check_sight, sent_only
from lidar.signal.recorded import altered_recording
from lidar.signal.registry import NamedStage, Stages, read_attacks, read_stage, stages_of
from lidar.signal.run import altered_sweep
from lidar.signal.situation import Situation
from lidar.signal.stage import Stage
from lidar.signal.truth import cloud_truth
from lidar.signal.weather.media import medium_of

ROOF = Mount((1.2, 0.0, 1.9))
GEO = Frame.at(9.5, 47.1)
ROAD = box((-60, -60, -1), (60, 60, 0), feature=7, klass=Class.ROAD, material="asphalt")
WALLS = [box((a, -60, 0), (a + 1, 60, 12), feature=k) for k, a in enumerate((40.0, -40.0), start=8)]
ROOM = world(ROAD, *WALLS)


def swept(sensor="vlp16", *, place=ROOM, settings=PLAIN, frame=2, **options):
    return cast(
        load_sensor(sensor, **options),
        ROOF,
        frame=frame,
        seed=5,
        settings=settings,
        trajectory=driven(),
        world=place,
    )


def situation(sweep, *, place=ROOM, **known):
    track = driven()
    return Situation(
        sweep.sensor.name,
        sweep.frame,
        start_ns=int(sweep.firings.time_ns[0]),
        poses=lambda time_ns: track.at(time_ns).mounted(ROOF.translation, ROOF.rotation),
        world=place,
        geo=GEO,
        **known,
    )


def attacked(sweep, *, known=None, **table):
    return altered_sweep(sweep, stages_of([table], seed=5), at=situation(sweep, **(known or {})))


def added(altered):
    return altered.cloud.where(altered.cloud.source < 0)


def azimuth(cloud):
    return np.degrees(np.arctan2(cloud.xyz[:, 1], cloud.xyz[:, 0]))


VLP, HDL = swept(), swept("hdl64e_s3")


@pytest.mark.parametrize(("device", "most", "width"), [("cao_2019", 60, 8), ("sun_2020", 200, 10)])
def test_a_device_sends_no_more_pulses_and_no_wider_than_it_can(device, most, width):
    found = added(attacked(HDL, name="inject", shape="random", device=device))
    assert most - 3 <= len(found) <= most  # one may be merged with a surface
    assert np.abs(azimuth(found)).max() <= width / 2 + 0.5
    with pytest.raises(InputError, match=f"points = {most + 1} is over the {most} of {device}"):
        read_stage({"name": "inject", "device": device, "points": most + 1})
    with pytest.raises(InputError, match="device = any has no limits"):
        read_stage({"name": "inject", "device": device, "width": width + 1})


def test_the_largest_device_fills_30_by_30_degrees_with_4200_points():
    found = added(attacked(HDL, name="inject", shape="random"))
    assert len(found) == DEVICES["pla_2023"].points == 4200
    assert np.abs(azimuth(found)).max() == pytest.approx(15, abs=0.5)
    rise = np.degrees(np.arcsin(found.xyz[:, 2] / np.linalg.norm(found.xyz, axis=1)))
    assert rise.min() > -16.5


def test_injected_ranges_have_the_published_errors():
    """Jin et al. 2023: 90 % below 0.102 m within 6 degrees, about 0.25 m at 15 degrees."""
    at = {"shape": "wall", "wide": 100.0, "high": 50.0, "range": 12.0, "frame_jitter": 0.0}
    found = added(attacked(HDL, name="inject", **at))
    error = np.abs(found.xyz[:, 0] - 12.0) / (found.xyz[:, 0] / np.linalg.norm(found.xyz, axis=1))
    away = np.abs(azimuth(found))
    assert np.percentile(error[away <= 6], 90) == pytest.approx(0.102, rel=0.25)
    assert np.percentile(error[away >= 14], 90) == pytest.approx(0.25, rel=0.12)


@pytest.mark.parametrize("sensor", [VLP, HDL], ids=["vlp16", "hdl64e"])
@pytest.mark.parametrize("shape", ["random", "wall", "object", "occluded", "far"])
def test_injected_points_lie_on_beams_of_the_sensor(sensor, shape):
    found = added(attacked(sensor, name="inject", shape=shape))
    assert len(found) > 5
    sent, width = sensor.firings, int(sensor.firings.column.max()) + 1
    row = np.empty(width * 64, int)
    row[sent.ring.astype(int) * width + sent.column] = np.arange(len(sent))
    beam = row[found.ring.astype(int) * width + found.column]
    along = found.xyz - sent.origin[beam]
    off = along - np.einsum("ij,ij->i", along, sent.direction[beam])[:, None] * sent.direction[beam]
    assert np.abs(off).max() < 1e-4
    assert np.array_equal(found.time_ns, sent.time_ns[beam] - sent.time_ns[0])


def test_a_phantom_car_stands_on_the_road_where_it_should():
    found = added(
        attacked(HDL, name="inject", range=9.0, jitter=0.0, jitter_per_degree=0.0, frame_jitter=0.0)
    )
    low, high = found.xyz.min(axis=0), found.xyz.max(axis=0)
    assert low[0] == pytest.approx(9.0, abs=0.1)
    assert high[1] - low[1] == pytest.approx(1.82, abs=0.1)  # a sedan's width
    assert low[2] == pytest.approx(-1.9, abs=0.25)  # the sensor's height
    assert high[2] - low[2] == pytest.approx(1.4, abs=0.2)
    assert found.hidden.min() >= 0
    strip = added(attacked(HDL, name="inject", shape="occluded", range=9.0, frame_jitter=0.0))
    assert 0.15 * len(found) < len(strip) < 0.45 * len(found)
    far = added(attacked(HDL, name="inject", shape="far", range=7.0, device="sun_2020"))
    assert 10 < len(far) < 200
    assert far.xyz[:, 0].min() == pytest.approx(7.0, abs=0.3)


def test_an_injected_pulse_must_beat_the_genuine_echo():
    weak, strong = ({"shape": "wall", "power": p} for p in (0.5, 1000.0))
    assert not len(added(attacked(swept(settings=LEVELS["survey"]), name="inject", **weak)))
    first = added(attacked(VLP, name="inject", **strong))
    assert len(first) > 500
    dual = swept(return_mode="dual")
    both = attacked(dual, name="inject", **strong)
    assert len(added(both)) == pytest.approx(len(first), rel=0.01)
    hidden = both.cloud.hidden[both.cloud.source < 0]
    near = both.original.range[hidden[hidden >= 0]]  # merged with the wall; others are reported, too
    assert np.abs(near - 7.0).max() < 2.0


def test_a_device_that_only_answers_makes_nothing_nearer_than_itself():
    with pytest.raises(InputError, match="range = 7 is nearer than the device at 10 m"):
        read_stage({"name": "inject", "predicts": False})
    late = added(attacked(VLP, name="inject", shape="random", range=10.0, predicts=False))
    assert np.linalg.norm(late.xyz, axis=1).min() > 9.5


def test_a_phantom_comes_nearer():
    def nearest(frame):
        found = added(attacked(swept("hdl64e_s3", frame=frame), name="inject", range=20.0, closing=10.0))
        return np.percentile(found.xyz[:, 0], 5)

    assert nearest(1) - nearest(11) == pytest.approx(10.0, abs=0.3)


def guarded(sweep, **secrets):
    """The sweep of a scanner that delays or codes its pulses; its genuine echoes are the same."""
    return replace(sweep, sensor=replace(sweep.sensor, **secrets))


WALL = {"name": "inject", "shape": "wall", "wide": 100.0, "high": 9.0, "range": 30.0, "jitter": 0.0}
"""A wall whose ranges have no error of the device."""


@pytest.mark.parametrize(("delay", "metres"), [(10.0, 1.5), (100.0, 15.0)])
def test_prepared_pulses_scatter_uniformly_by_random_firing_delays(delay, metres):
    plain = attacked(VLP, **WALL, jitter_per_degree=0.0)
    delayed = attacked(guarded(VLP, firing_jitter_ns=delay), **WALL, jitter_per_degree=0.0)
    assert np.array_equal(delayed.original.xyz, plain.original.xyz)
    assert added(plain).xyz[:, 0].std() < 0.01
    found, wall = added(delayed).xyz, np.median(added(plain).xyz[:, 0])
    away = np.linalg.norm(found, axis=1)
    off = away - wall * away / found[:, 0]  # along the beam, from where it meets the wall
    assert np.ptp(off) == pytest.approx(metres, rel=0.02)
    assert stats.kstest(off, stats.uniform(-metres / 2, metres).cdf).pvalue > 0.01


@pytest.mark.parametrize("bits", [1, 3, 6])
def test_prepared_pulses_have_the_code_by_chance(bits):
    plain, coded = (added(attacked(guarded(VLP, code_bits=k), **WALL)) for k in (0, bits))
    low, high = stats.binom(len(plain), 0.5**bits).interval(0.9999)
    assert low <= len(coded) <= high


@pytest.mark.full
@pytest.mark.parametrize(
    ("place", "column"), [({}, 20.0), ({"radius": 12.0}, 12.0)], ids=["everywhere", "around"]
)
def test_weather_dims_the_light_of_a_device_once_on_its_way(place, column):
    """Beer-Lambert over the 20 m to the device, or the part of them that lies in the fog."""
    device = read_stage({"name": "inject", "distance": 20.0, "range": 12.0, "power": 1e4}).stage
    seen = []

    class Probe(Stage):
        def echoes(self, pulses, echoes, *, at, rng):
            del rng
            seen.append(device.aim(pulses, echoes, at=at).power.max())
            return echoes

    here = situation(HDL)
    lat, lon, _ = place_of((*here.poses(np.array([here.start_ns])).position[0, :2], 0.0))
    centre = {"latitude": lat, "longitude": lon} if place else {}
    fog = read_stage({"name": "weather", "kind": "fog", "amount": 50.0, **place, **centre})
    for settings, stages in ((PLAIN, ()), (PLAIN, (fog,)), (replace(PLAIN, extinction=0.02), ())):
        sweep = replace(HDL, settings=settings)
        altered_sweep(sweep, Stages((*stages, NamedStage("probe", Probe())), 5), at=here)
    clear, dim, hazy = seen
    medium = medium_of("fog", 50.0, wavelength_nm=HDL.sensor.wavelength_nm, medium=fog.stage.medium)
    assert clear == pytest.approx(1e4 / 4)
    assert dim / clear == pytest.approx(np.exp(-medium.extinction * column), rel=0.05)
    assert hazy / clear == pytest.approx(np.exp(-0.02 * 20))


def test_a_relay_has_the_sensors_own_time_and_code():
    plain, secret = (
        added(attacked(guarded(VLP, **secrets), name="relay", distance=8.0))
        for secrets in ({}, {"firing_jitter_ns": 100.0, "code_bits": 16})
    )
    assert np.array_equal(plain.xyz, secret.xyz)


def test_removal_below_the_least_range_fails_against_random_delays_and_codes():
    """Of pulses that scatter over 15 m, half come before the sensor fires, and few are near enough."""

    def removed(**secrets):
        found = attacked(guarded(VLP, **secrets), name="remove")
        inside = np.abs(azimuth(found.original)) < 22
        gone = np.zeros(len(found.original), bool)
        gone[cloud_truth(found, start_ns=0)["removed"]] = True
        return gone[inside].mean(), len(added(found)) / inside.sum()

    assert removed()[0] > 0.96
    lost, shown = removed(firing_jitter_ns=100.0)
    assert lost == pytest.approx(0.98 * (0.5 + 0.25 / 15), abs=0.05)
    assert shown == pytest.approx(0.98 * (0.5 - 0.25 / 15), abs=0.05)
    assert removed(code_bits=5)[0] < 0.06


def test_relayed_returns_are_delayed_by_the_speed_of_light():
    found = attacked(VLP, name="relay", delay=100.0, distance=8.0)
    echo = added(found)
    assert set(found.cloud.origin[found.cloud.source < 0]) == {Origin.REPLAYED}
    assert np.median(np.linalg.norm(echo.xyz, axis=1)) == pytest.approx(8.0 + 14.98962, abs=0.05)


@pytest.mark.parametrize("sensor", [VLP, HDL], ids=["vlp16", "hdl64e"])
@pytest.mark.parametrize("method", ["near", "saturation"])
def test_physical_removal_empties_a_sector_of_45_degrees(sensor, method):
    """At least 96 % of the points (Cao et al. 2023)."""
    found = attacked(sensor, name="remove", method=method)
    inside = np.abs(azimuth(found.original)) < 22
    truth = cloud_truth(found, start_ns=0)
    gone = np.zeros(len(found.original), bool)
    gone[truth["removed"]] = True
    assert gone[inside].mean() >= 0.96
    assert not gone[np.abs(azimuth(found.original)) > 24].any()
    assert np.array_equal(truth["removed_xyz"], found.original.xyz[gone])
    assert (found.cloud.source >= 0).all()


def test_removal_fails_where_the_sensor_reports_the_last_echo():
    last = attacked(swept(return_mode="last"), name="remove")
    assert len(last.cloud) == len(last.original)
    dual = attacked(swept(return_mode="dual"), name="remove")
    assert len(dual.cloud) == len(dual.original)  # single echoes are the last ones
    weak = attacked(VLP, name="remove", power=0.9)
    assert len(weak.cloud) == len(weak.original)


def test_jamming_and_pulse_trains_put_returns_at_random_ranges():
    for table in ({"name": "remove", "method": "jamming"}, {"name": "high_frequency_removal"}):
        found = attacked(HDL, **table)
        inside = np.abs(azimuth(found.original)) < 22
        gone = np.zeros(len(found.original), bool)
        gone[cloud_truth(found, start_ns=0)["removed"]] = True
        assert gone[inside].mean() >= 0.96
        away = np.linalg.norm(added(found).xyz, axis=1)
        assert stats.kstest(away[:2000], stats.uniform(0, 120).cdf).statistic < 0.05


def test_pulse_trains_defeat_coarse_codes_and_not_fine_ones():
    """A return is replaced if one of the n pulses that arrive has its code: 1 - (1 - 2^-k)^n."""
    for bits, frequency in ((1, 20.0), (3, 20.0), (8, 20.0), (12, 5.0)):
        found = attacked(guarded(HDL, code_bits=bits), name="high_frequency_removal", frequency=frequency)
        inside = np.abs(azimuth(found.original)) < 22
        gone = np.zeros(len(found.original), bool)
        gone[cloud_truth(found, start_ns=0)["removed"]] = True
        arrive = HDL.sensor.max_range / (METRES_PER_NS * 1e3 / frequency)
        assert gone[inside].mean() == pytest.approx(1 - (1 - 0.5**bits) ** arrive, abs=0.05)


def test_a_device_behind_a_wall_does_nothing():
    sweep, here = VLP, (1.2, 0.0, 1.9)
    open_place = ",".join(map(str, place_of((20.0, 5.0, 1.5))))
    found = attacked(sweep, name="inject", shape="random", place=open_place)
    middle = np.degrees(np.arctan2(5.0, 20.0 - here[0]))
    assert np.median(azimuth(added(found))) == pytest.approx(middle, abs=1.0)
    blind = world(ROAD, *WALLS, box((8, -2, 0), (9, 8, 5), feature=12))
    other = swept(place=blind)
    stages = stages_of([{"name": "inject", "shape": "random", "place": open_place}], seed=5)
    shadowed = altered_sweep(other, stages, at=situation(other, place=blind))
    assert not len(added(shadowed))
    assert np.array_equal(shadowed.cloud.xyz, shadowed.original.xyz)
    far = stages_of([{"name": "inject", "place": open_place, "reach": 15.0}], seed=5)
    assert not len(added(altered_sweep(sweep, far, at=situation(sweep))))


def test_the_height_of_a_place_is_above_the_ground_there():
    here = situation(VLP)
    lat, lon, _ = place_of((20.0, 5.0, 0.0))
    device = read_stage({"name": "inject", "place": f"{lat},{lon},1.5"}).stage
    hill = replace(here, ground=lambda x, y: 100.0 + round(x) + round(y))
    (flat,), (raised,) = (device.towards(np.array([here.start_ns]), at=at) for at in (here, hill))
    assert raised - flat == pytest.approx([0, 0, 125.0], abs=1e-6)


def place_of(point):
    lon, lat = GEO.to_geographic(point[0], point[1])
    return float(lat), float(lon), point[2]


def recorded(sweep):
    return altered_sweep(sweep, stages_of([]), at=Situation(sweep.sensor.name, 2)).original


def test_recorded_clouds_tell_what_stands_before_the_device():
    sensor, cloud = VLP.sensor, recorded(VLP)
    for distance, seen in ((20.0, True), (60.0, False)):
        stages = stages_of([{"name": "inject", "shape": "random", "distance": distance}], seed=5)
        found = altered_recording(cloud, stages, sensor=sensor, at=Situation("vlp16", 2), sent=VLP.firings)
        assert bool(len(added(found))) is seen
    fixed = stages_of([{"name": "inject", "place": "47.1,9.5,2"}])
    with pytest.raises(InputError, match="give `bearing` and `distance`"):
        altered_recording(cloud, fixed, sensor=sensor, at=Situation("vlp16", 2), sent=VLP.firings)


def seen_from_record(cloud, point, *, scene):
    """Whether a device at a point reaches a recorded cloud; without a scene, as the returns tell."""
    table = {"name": "inject", "shape": "wall", "range": 5.0, "place": ",".join(map(str, place_of(point)))}
    at = replace(situation(VLP), world=None, surroundings=None if scene is None else lambda _: scene)
    stages = stages_of([table], seed=5)
    found = altered_recording(cloud, stages, sensor=VLP.sensor, at=at, sent=VLP.firings)
    return len(added(found)) > 0


def test_rays_in_the_scene_tell_more_than_returns_about_recorded_data():
    """A device over a fence is seen, as in a drive, though all returns beside it are of the fence."""
    fence = world(ROAD, *WALLS, box((9, -8, 0), (9.3, 8, 2.05), feature=12))
    cloud = recorded(swept(place=fence))
    over, behind = (20.0, 0.5, 2.35), (20.0, 0.5, 1.0)
    near = recorded(swept(place=world(ROAD, *WALLS, box((9, -8, 0), (9.3, 8, 5), feature=12))))
    assert seen_from_record(cloud, over, scene=fence)
    assert not seen_from_record(near, over, scene=None)
    assert seen_from_record(near, over, scene=fence)  # returns of what is no road user do not count
    assert not seen_from_record(cloud, behind, scene=fence)
    assert not seen_from_record(recorded(VLP), (60.0, 0.5, 2.0), scene=ROOM)


@pytest.mark.parametrize(
    ("klass", "seen"), [(Class.CAR, False), (Class.NOISE, True), (Class.UNLABELED, False)]
)
def test_road_users_of_recorded_data_are_known_by_their_returns(klass, seen):
    """They are not in the scene; flakes do not hide a device, and unknown returns count as solid."""
    truck = box((9, -8, 0), (12, 8, 5), feature=12, klass=klass)
    cloud = recorded(swept(place=world(ROAD, *WALLS, truck)))
    assert seen_from_record(cloud, (20.0, 0.5, 2.35), scene=ROOM) is seen
    assert seen_from_record(recorded(VLP), (20.0, 0.5, 2.35), scene=ROOM)


def test_replay_sends_an_earlier_frame():
    before = recorded(swept(place=world(ROAD, plate(15.0)), frame=1))
    known = {"earlier": lambda frames: before if frames == 10 else None}
    found = attacked(VLP, name="replay", seconds=1.0, known=known, gain=50.0)
    echo = added(found)
    ahead = np.abs(echo.xyz[:, 0] - (15.0 - 1.2)) < 0.6
    assert ahead.mean() > 0.7
    assert set(found.cloud.origin[found.cloud.source < 0]) == {Origin.REPLAYED}
    assert read_stage({"name": "replay", "seconds": 2.5}).stage.lookback == 2.5
    first = attacked(VLP, name="replay", known={"earlier": lambda _: None})
    assert not len(added(first))


ATTACKS = (
    *({"name": "inject", "shape": shape} for shape in ("random", "wall", "object", "far")),
    {"name": "relay"},
    {"name": "replay", "gain": 10.0},
    {"name": "remove", "method": "jamming"},
    {"name": "high_frequency_removal"},
)


@pytest.mark.full
@pytest.mark.parametrize("table", ATTACKS, ids=lambda t: "-".join(str(v) for v in t.values()))
@pytest.mark.parametrize("on", ["drive", "recording", "rounded recording"])
def test_no_column_gives_injected_returns_away(table, on):
    """Ranges and intensities have the steps of genuine ones, no value is repeated, rows are in order."""
    sweep = sixty_four_lasers(quantise=on == "drive")
    earlier = recorded(sweep)
    stages = stages_of([table], seed=5)
    if on == "drive":
        at = situation(sweep, earlier=lambda _: earlier)
        found = altered_sweep(sweep, stages, at=at)
    else:
        cloud = earlier
        if on == "rounded recording":
            cloud = replace(cloud, intensity=np.round(cloud.intensity))
        at = Situation("hdl64e_s3", 2, earlier=lambda _: earlier)
        sent = sweep.firings if on == "recording" else None
        found = altered_recording(cloud, stages, sensor=sweep.sensor, at=at, sent=sent)
    cloud, fake = found.cloud, found.cloud.source < 0
    assert fake.sum() > 20
    for column in cloud.columns().values():
        assert np.isfinite(column.astype(float)).all()
    whole = cloud.intensity == np.round(cloud.intensity)
    assert whole[fake].all() == whole[~fake].all()
    step = np.abs(cloud.range / 0.002 - np.round(cloud.range / 0.002)) < 1e-6
    assert step[fake].all() == step[~fake].all()
    _, count = np.unique(cloud.xyz[fake], axis=0, return_counts=True)
    assert count.max() == 1
    sent, width = firings(sweep.sensor, 2), int(sweep.firings.column.max()) + 1
    row = np.empty(width * 64, int)
    row[sent.ring.astype(int) * width + sent.column] = np.arange(len(sent))
    beam = row[cloud.ring.astype(int) * width + cloud.column]
    assert (np.diff(beam) > 0).all()  # in the order of the pulses
    along = cloud.xyz - sent.origin[beam]
    reach = np.linalg.norm(along, axis=1)
    off = np.linalg.norm(np.cross(along, sent.direction[beam]), axis=1) / reach
    assert np.percentile(off[fake], 99) < 1e-5  # 1.7e-4: the step of Velodyne's azimuths


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"name": "inject", "shape": "ball"}, "shape = 'ball' is none of random, wall"),
        ({"name": "inject", "kind": "tank"}, "kind = 'tank' is none of sedan"),
        ({"name": "inject", "place": "47.1"}, "place = '47.1' is not LAT,LON,HEIGHT"),
        ({"name": "inject", "place": "147,9,2"}, "in degrees and metres"),
        ({"name": "inject", "distance": 200.0}, "distance = 200 is over reach = 110"),
        ({"name": "inject", "dimmest": 0.9, "brightest": 0.2}, "dimmest = 0.9 is over brightest"),
        ({"name": "remove", "method": "magic"}, "method = 'magic' is none of near, saturation, jamming"),
        ({"name": "high_frequency_removal", "frequency": 0}, "frequency = 0 is not within"),
        ({"name": "relay", "delay": -1.0}, "delay = -1 is not within"),
    ],
)
def test_faulty_attacks_are_refused_in_one_line(table, message):
    with pytest.raises(InputError, match=message) as error:
        read_stage(table)
    assert "\n" not in str(error.value)


def test_a_device_that_is_never_in_sight_is_refused():
    seen, hidden = place_of((20.0, 5.0, 1.5)), place_of((20.0, 5.0, -3.0))
    for place, fits in ((seen, True), (hidden, False)):
        stages = stages_of([{"name": "inject", "place": "{} {} {}".format(*place)}], seed=5)
        frames = [(situation(VLP), lambda: sent_only(VLP.sensor, situation(VLP)))] * 2
        if fits:
            check_sight(stages, frames)
        else:
            with pytest.raises(InputError, match="attack inject: its device is in the line of sight of no"):
                check_sight(stages, frames)
    check_sight(stages_of([{"name": "cover_glass"}]), [])
    aside = stages_of([{"name": "inject", "bearing": 90.0}])  # of a scanner that looks ahead
    livox = load_sensor("mid40")
    with pytest.raises(InputError, match="in the line of sight of no scanner"):
        check_sight(aside, [(situation(VLP), lambda: sent_only(livox, situation(VLP)))])
    lon, lat = GEO.to_geographic(500.0, 0.0)  # what far frames show is not asked for
    far = stages_of([{"name": "inject", "place": f"{lat} {lon} 1.5"}], seed=5)
    with pytest.raises(InputError, match="in the line of sight of no scanner"):
        check_sight(far, [(situation(VLP), pytest.fail)])


@functools.cache
def sixty_four_lasers(*, quantise):
    return swept("hdl64e_s3", settings=replace(LEVELS["standard"], quantise=quantise))


EXAMPLES = sorted((ROOT / "examples" / "attacks").glob("*.toml"))


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
@pytest.mark.parametrize("on", ["drive", "recording"])
def test_truth_of_every_example_is_the_original_cloud(path, on):
    """Every return of the original is kept or removed once; an added one hides only what was removed."""
    named = read_attacks([str(path)])
    if any(hasattr(one.stage, "cloud") or not hasattr(one.stage, "echoes") for one in named):
        pytest.skip("no attack before the detector")
    original, stages = recorded(VLP), Stages(named, 5)
    if on == "drive":
        found = altered_sweep(VLP, stages, at=situation(VLP, earlier=lambda _: original))
    else:
        at = Situation("vlp16", 2, earlier=lambda _: original)
        found = altered_recording(original, stages, sensor=VLP.sensor, at=at, sent=VLP.firings)
    truth = cloud_truth(found, start_ns=0)
    kept = truth["source"][truth["source"] >= 0]
    rows = np.sort(np.concatenate([kept, truth["removed"]]))
    assert np.array_equal(rows, np.arange(len(original)))
    assert np.array_equal(truth["removed_xyz"], original.xyz[truth["removed"]])
    fake = truth["source"] < 0
    assert set(truth["origin"][fake]) <= {Origin.INJECTED, Origin.REPLAYED, Origin.SURFACE}
    assert (truth["origin"][~fake] == Origin.SURFACE).all()
    hidden = truth["hidden"][truth["hidden"] >= 0]
    assert np.isin(hidden, truth["removed"]).all()
    assert len(truth["removed"]) > 0


def test_an_attack_has_a_beginning_an_end_and_a_bearing():
    late = added(attacked(VLP, name="inject", start=0.2, stop=0.25, bearing=90.0))
    assert np.median(azimuth(late)) == pytest.approx(90.0, abs=1.0)
    assert not len(added(attacked(VLP, name="inject", start=0.3)))
    assert not len(added(attacked(VLP, name="inject", stop=0.2)))


def test_a_phantom_stands_in_the_scene():
    """From a sensor that drives 10 m/s it comes nearer by 1 m in each frame."""
    track = driven((10.0, 0.0, 0.0))

    def at_frame(frame):
        sweep = cast(
            load_sensor("hdl64e_s3"), ROOF, frame=frame, seed=5, trajectory=track, world=ROOM, settings=PLAIN
        )
        at = replace(
            situation(sweep),
            poses=lambda time_ns: track.at(time_ns).mounted(ROOF.translation, ROOF.rotation),
        )
        stages = stages_of([{"name": "inject", "range": 18.0, "standing": True, "frame_jitter": 0.0}], seed=5)
        found = added(altered_sweep(sweep, stages, at=at))
        return np.percentile(found.xyz[:, 0], 5)

    assert at_frame(0) == pytest.approx(18.0, abs=1.0)
    assert at_frame(1) - at_frame(6) == pytest.approx(5.0, abs=0.2)
    with pytest.raises(InputError, match="stage inject needs poses"):
        stages_of([{"name": "inject", "standing": True}]).check({"top": "lidar"})
