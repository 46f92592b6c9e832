"""Stages on a frame: changed returns, unchanged returns and the ground truth of both."""

from dataclasses import dataclass, fields, replace

import numpy as np
import pytest
from helpers.sensor_worlds import box, driven, plate, world
from hypothesis import given, settings
from hypothesis import strategies as st

from geoscene.classes import Class
from lidar.errors import InputError
from lidar.geometry.attitude import Mount
from lidar.parameters import parameter
from lidar.sensors.camera.render import CameraImage
from lidar.sensors.laser.cloud import Cloud
from lidar.sensors.laser.scan import cast, scan
from lidar.sensors.physics.echoes import join
from lidar.sensors.physics.origin import Origin
from lidar.sensors.physics.settings import LEVELS, PLAIN, ScannerSettings
from lidar.sensors.rig.scanner import firings, load_sensor
from lidar.signal.faults import DroppedPackets
from lidar.signal.recorded import altered_recording
from lidar.signal.registry import NamedStage, Stages, read_stage, read_stages, stage_rows, stages_of
from lidar.signal.run import altered_image, altered_sweep
from lidar.signal.situation import Situation
from lidar.signal.stage import Stage, added_echoes
from lidar.signal.truth import cloud_truth, image_truth

ROOF = Mount((1.2, 0.0, 1.9))
ROOM = world(
    box((-40, -30, -1), (40, 30, 0), feature=7, klass=Class.ROAD, material="asphalt"),
    box((12, -20, 0), (15, 25, 9), feature=8),
    box((5, -8, 0), (5.2, -6, 3), feature=10, material="glass"),
    box((3, 3, 0), (3.5, 3.1, 2.5), feature=11, klass=Class.TRAFFIC_SIGN, material="retroreflector"),
)
HERE = {"trajectory": driven((10.0, 0.0, 0.0), start=(-20, -10, 0)), "world": ROOM}
NOISY = replace(LEVELS["survey"], rays=7, interference=2000)


@dataclass(frozen=True)
class Injected(Stage):
    """An echo in each pulse."""

    distance: float = parameter(3.0, "metres")
    power: float = parameter(1e6, "over the detection threshold")

    def echoes(self, pulses, echoes, *, at, rng):
        del at, rng
        number = np.arange(len(pulses))
        distance = np.full(len(pulses), self.distance)
        apparent = pulses.apparent(np.full(len(pulses), self.power), distance)
        return join(echoes, added_echoes(number, distance, apparent=apparent, origin=Origin.INJECTED))


@dataclass(frozen=True)
class Shifted(Stage):
    """All returns are moved to the left."""

    def cloud(self, cloud, *, at, rng):
        del at, rng
        moved = np.full(len(cloud), Origin.MOVED, np.uint8)
        return replace(cloud, xyz=cloud.xyz + np.float32([0, 1, 0]), origin=moved)


def swept(settings=PLAIN, *, sensor="vlp16", frame=2, **options):
    return cast(load_sensor(sensor, **options), ROOF, frame=frame, seed=5, settings=settings, **HERE)


def altered(sweep, stages, **known):
    return altered_sweep(sweep, stages, at=Situation(sweep.sensor.name, sweep.frame, **known))


def plain(settings=PLAIN, **options):
    return scan(load_sensor("vlp16", **options), ROOF, frame=2, seed=5, settings=settings, **HERE)


def chain(*stages, seed=5):
    return Stages(tuple(NamedStage(f"test{k}", stage) for k, stage in enumerate(stages)), seed)


def assert_same(cloud, other):
    for f in fields(Cloud):
        assert np.array_equal(getattr(cloud, f.name), getattr(other, f.name)), f.name


@pytest.mark.parametrize("effects", [PLAIN, NOISY])
@pytest.mark.parametrize("mode", ["strongest", "dual"])
def test_stages_without_an_effect_leave_the_returns_unchanged(effects, mode):
    idle = read_stages(["cover_glass:transmission=1", "dropped_packets:loss=0"], seed=5)
    found = altered(swept(effects, return_mode=mode), idle)
    expected = plain(effects, return_mode=mode)
    assert_same(found.cloud, expected)
    assert_same(found.original, expected)
    assert np.array_equal(found.cloud.source, np.arange(len(expected)))
    assert (found.cloud.hidden == -1).all()
    noise = expected.klass == Class.NOISE
    assert (found.cloud.origin[~noise] == Origin.SURFACE).all()
    if effects is NOISY:
        assert {Origin.RECEIVER, Origin.INTERFERENCE} <= set(found.cloud.origin[noise].tolist())


@settings(max_examples=15, deadline=None)
@given(loss=st.floats(0, 1), burst=st.floats(1, 50), columns=st.integers(1, 2000), seed=st.integers(0, 9))
def test_kept_and_removed_returns_are_the_original(loss, burst, columns, seed):
    stages = chain(DroppedPackets(loss, burst, columns), seed=seed)
    found = altered(SWEPT, stages)
    assert_same(found.original, PLAIN_CLOUD)
    truth = cloud_truth(found, start_ns=0)
    rows = np.concatenate([truth["source"], truth["removed"]])
    assert np.array_equal(np.sort(rows), np.arange(len(PLAIN_CLOUD)))
    assert (truth["origin"] == Origin.SURFACE).all()
    for name, column in (("xyz", PLAIN_CLOUD.xyz), ("range", PLAIN_CLOUD.range), ("ring", PLAIN_CLOUD.ring)):
        back = np.concatenate([getattr(found.cloud, name), truth[f"removed_{name}"]])
        assert np.array_equal(back[np.argsort(rows)], column)
    packets = found.original.column // columns
    assert not set(packets[truth["removed"]].tolist()) & set(packets[truth["source"]].tolist())


SWEPT, PLAIN_CLOUD = swept(), plain()


def test_lost_packets_have_the_given_loss_and_burst_length():
    rows = 400_000
    cloud = altered(SWEPT, Stages()).cloud
    many = replace(
        cloud,
        **{f.name: getattr(cloud, f.name)[np.zeros(rows, int)] for f in fields(cloud)[1:]},
    )
    many = replace(many, column=np.arange(rows, dtype=np.int32), source=np.arange(rows, dtype=np.int32))
    kept = DroppedPackets(0.2, 5, 1).cloud(many, at=Situation("vlp16", 2), rng=np.random.default_rng(1))
    lost = np.ones(rows, bool)
    lost[kept.source] = False
    assert lost.mean() == pytest.approx(0.2, abs=0.01)
    bursts = np.count_nonzero(np.diff(lost.astype(int)) == 1)
    assert lost.sum() / bursts == pytest.approx(5, rel=0.05)
    assert (
        len(DroppedPackets(1, 1, 1).cloud(many, at=Situation("vlp16", 2), rng=np.random.default_rng(1))) == 0
    )


def test_an_injected_echo_hides_the_surface_in_strongest_mode_and_joins_it_in_dual_mode():
    found = altered(SWEPT, chain(Injected(3.0)))
    injected = found.cloud.origin == Origin.INJECTED
    near = np.linalg.norm(found.cloud.xyz[injected], axis=1)
    assert near == pytest.approx(3.0, abs=0.1)
    assert (found.cloud.klass[injected] == Class.NOISE).all()
    hides = found.cloud.hidden[injected] >= 0
    assert hides.sum() > 5000
    hidden = found.original.where(
        np.isin(np.arange(len(found.original)), found.cloud.hidden[injected][hides])
    )
    assert len(hidden) == hides.sum()  # each hides one return
    order = found.cloud.hidden[injected][hides]
    assert np.array_equal(found.original.column[order], found.cloud.column[injected][hides])
    assert np.array_equal(found.original.ring[order], found.cloud.ring[injected][hides])
    truth = cloud_truth(found, start_ns=0)
    assert np.array_equal(truth["removed"], np.sort(order))
    dual = altered(swept(return_mode="dual"), chain(Injected(3.0)))
    added = dual.cloud.origin == Origin.INJECTED
    assert (dual.cloud.hidden[added] == -1).all()
    assert len(cloud_truth(dual, start_ns=0)["removed"]) == 0


def test_an_injected_echo_obeys_threshold_separation_and_range_limits():
    effects = ScannerSettings(link=True)
    faint = altered(swept(effects), chain(Injected(3.0, power=0.9)))
    assert_same(faint.cloud, plain(effects))
    bright = altered(swept(effects), chain(Injected(3.0, power=1.1)))
    assert (bright.cloud.origin == Origin.INJECTED).sum() > 5000
    far = altered(swept(effects), chain(Injected(200.0)))
    assert (far.cloud.origin == Origin.SURFACE).all()
    wall = world(plate(20.0))
    sweep = cast(load_sensor("utm30lx"), Mount(), trajectory=driven(), world=wall, frame=0)
    ahead = np.argmin(np.abs(sweep.echoes.range - 20))
    both = altered(sweep, chain(Injected(20.05, power=1e-3)))
    row = np.flatnonzero(both.cloud.source == ahead)
    assert len(row) == 1  # one echo, of the wall, which sends back more
    assert both.cloud.origin[row[0]] == Origin.SURFACE
    assert len(both.cloud) == len(both.cloud.source[both.cloud.source >= 0]) + np.count_nonzero(
        both.cloud.origin == Origin.INJECTED
    )


def test_returns_that_a_stage_leaves_alone_keep_their_noise():
    """A cover glass over the left half changes no return on the right, noise included."""
    found = altered(swept(NOISY), read_stages(["cover_glass:transmission=0.2,azimuth=90,width=180"], seed=5))
    right = found.cloud.xyz[:, 1] < -0.5
    assert (found.cloud.source[right] >= 0).all()
    assert np.array_equal(found.cloud.range[right], found.original.range[found.cloud.source[right]])
    lost = cloud_truth(found, start_ns=0)["removed_xyz"]
    assert len(lost) > 100
    assert (lost[:, 1] > -0.5).all()


def test_cover_glass_attenuates_by_the_square_of_its_transmission():
    effects = ScannerSettings(link=True)
    found = altered(swept(effects), read_stages(["cover_glass:transmission=0.5"]))
    diffuse = found.cloud.feature != 11  # codes of retro-reflectors are logarithmic
    before = found.original.intensity[found.cloud.source]
    assert found.cloud.intensity[diffuse] == pytest.approx(before[diffuse] / 4, rel=1e-5)
    assert len(found.cloud) < len(found.original)


def test_moved_returns_replace_their_source():
    found = altered(SWEPT, chain(Shifted()))
    assert np.array_equal(found.cloud.hidden, found.cloud.source)
    truth = cloud_truth(found, start_ns=0)
    assert np.array_equal(truth["removed_xyz"], PLAIN_CLOUD.xyz)


def test_random_numbers_depend_on_seed_stage_sensor_and_frame_alone():
    stages = read_stages(["dropped_packets:loss=0.3", "dropped_packets:loss=0.3"], seed=5)
    first = altered(SWEPT, stages).cloud.source
    altered(swept(frame=1), stages)
    assert np.array_equal(first, altered(SWEPT, stages).cloud.source)
    draws = {
        (seed, name, sensor, frame): NamedStage(name, DroppedPackets())
        .rng(seed, sensor, frame=frame)
        .random()
        for seed in (1, 2)
        for name in ("a", "b")
        for sensor in ("top", "left")
        for frame in (0, 1)
    }
    assert len(set(draws.values())) == len(draws)
    one, two = stages.stages
    assert one.rng(1, "top", frame=0).random() != two.rng(1, "top", frame=0).random()
    own = read_stage({"name": "dropped_packets", "seed": 1})
    assert own.rng(2, "top", frame=0).random() == one.rng(1, "top", frame=0).random()


def test_a_stage_may_act_on_one_sensor():
    stages = read_stages(["dropped_packets:loss=1,sensor=other"])
    assert_same(altered(SWEPT, stages).cloud, PLAIN_CLOUD)
    assert not stages.act_on("vlp16", kind="lidar")
    assert stages.act_on("other", kind="lidar")
    assert not stages.act_on("other", kind="camera")
    with pytest.raises(InputError, match="no sensor 'other'; there are top"):
        stages.check({"top": "lidar"})
    with pytest.raises(InputError, match="lost_rows acts on a camera, and there is none"):
        read_stages(["lost_rows"]).check({"top": "lidar"})


def test_lost_rows_are_black_and_kept_as_truth():
    rgb = np.arange(1, 1 + 40 * 4 * 3, dtype=np.int64).astype(np.uint8).reshape(40, 4, 3) | 1
    blank = np.zeros((40, 4))
    frame = CameraImage(rgb, blank.astype(np.float32), blank.astype(np.uint8), blank.astype(np.int32))
    stages = read_stages(["lost_rows:loss=0.5,rows=4"], seed=3)
    found = altered_image(frame, stages, at=Situation("front", 0))
    black = (found.rgb == 0).all(axis=(1, 2))
    assert 0 < black.sum() < 40
    assert (black.reshape(10, 4).all(axis=1) | ~black.reshape(10, 4).any(axis=1)).all()
    truth = image_truth(found, frame)
    back = found.rgb.copy()
    back[truth["changed"]] = truth["removed"]
    assert np.array_equal(back, rgb)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("droped_packets", "stage 'droped_packets' is unknown; is dropped_packets meant"),
        ("dropped_packets:los=1", "parameter 'los' is unknown; is loss meant"),
        ("dropped_packets:loss", "give NAME:KEY=VALUE"),
        ("dropped_packets:loss=1.5", "loss = 1.5 is not within 0 to 1"),
        ("dropped_packets:loss=nan", "loss = nan is not within 0 to 1"),
        ("dropped_packets:loss=high", "loss = 'high' is not a number"),
        ("dropped_packets:columns=1.5", "columns = '1.5' is not a whole number"),
        ("dropped_packets:seed=-1", "seed = '-1' is not a whole number of 0 or more"),
        ("missing.toml", "missing.toml: cannot be read as TOML"),
    ],
)
def test_faulty_stages_are_refused_in_one_line(text, message):
    with pytest.raises(InputError, match=message) as error:
        read_stages([text])
    assert "\n" not in str(error.value)


def test_a_file_holds_stages_in_order(tmp_path):
    path = tmp_path / "stages.toml"
    path.write_text(
        '[[stage]]\nname = "cover_glass"\n[[stage]]\nname = "dropped_packets"\nloss = 1\nseed = 4\n'
    )
    stages = read_stages([str(path)])
    assert [s.name for s in stages.stages] == ["cover_glass", "dropped_packets"]
    assert stages.stages[1].to_json() == {
        "name": "dropped_packets",
        "loss": 1,
        "burst": 1.0,
        "columns": 24,
        "seed": 4,
    }
    assert stages_of([s.to_json() for s in stages.stages]) == stages
    path.write_text("loss = 1\n")
    with pytest.raises(InputError, match=r"give tables \[\[stage\]\]"):
        read_stages([str(path)])


def test_every_listed_stage_is_documented():
    for row in stage_rows():
        assert row["acts_on"], row["name"]
        assert row["meaning"].endswith("."), row["name"]
        assert all(p["meaning"] for p in row["parameters"])
        assert read_stages([row["name"]])


@pytest.mark.parametrize("effects", [PLAIN, NOISY])
@pytest.mark.parametrize("mode", ["strongest", "dual"])
@pytest.mark.parametrize("known", [True, False])
def test_recorded_clouds_stay_the_same_without_an_effect(effects, mode, known):
    recorded = plain(effects, return_mode=mode)
    sensor = load_sensor("vlp16", return_mode=mode)
    idle = read_stages(["cover_glass:transmission=1", "dropped_packets:loss=0"])
    sent = firings(sensor, 2) if known else None
    found = altered_recording(recorded, idle, sensor=sensor, at=Situation(sensor.name, 2), sent=sent)
    assert_same(found.cloud, recorded)
    assert np.array_equal(found.cloud.source, np.arange(len(recorded)))


def test_dropped_packets_of_a_recorded_cloud_are_those_of_the_drive():
    stages = read_stages(["dropped_packets:loss=0.3,burst=4"], seed=5)
    driven_cloud = altered(SWEPT, stages).cloud
    recorded = altered_recording(
        PLAIN_CLOUD, stages, sensor=load_sensor("vlp16"), at=Situation("vlp16", 2), sent=SWEPT.firings
    ).cloud
    assert_same(recorded, driven_cloud)
    assert np.array_equal(recorded.source, driven_cloud.source)


def test_echo_stages_treat_recorded_returns_as_echoes():
    effects = ScannerSettings(link=True)
    glass = read_stages(["cover_glass:transmission=0.5"])
    simulated = altered(swept(effects), glass)
    recorded = altered_recording(
        plain(effects), glass, sensor=load_sensor("vlp16"), at=Situation("vlp16", 2), sent=SWEPT.firings
    )
    assert np.array_equal(recorded.cloud.source, simulated.cloud.source)
    assert recorded.cloud.intensity == pytest.approx(simulated.cloud.intensity, rel=1e-4)
    assert np.array_equal(recorded.cloud.xyz, simulated.cloud.xyz)
    near = altered_recording(
        PLAIN_CLOUD,
        chain(Injected(3.0)),
        sensor=load_sensor("vlp16"),
        at=Situation("vlp16", 2),
        sent=SWEPT.firings,
    )
    injected = near.cloud.origin == Origin.INJECTED
    assert injected.sum() > 5000
    assert np.linalg.norm(near.cloud.xyz[injected], axis=1) == pytest.approx(3.0, abs=0.1)
    drive = altered(SWEPT, chain(Injected(3.0))).cloud
    assert injected.sum() == (drive.origin == Origin.INJECTED).sum() > len(PLAIN_CLOUD)
    for name in ("ring", "column", "time_ns", "origin", "source", "hidden", "echo", "echoes"):
        assert np.array_equal(getattr(near.cloud, name), getattr(drive, name)), name
    assert near.cloud.xyz == pytest.approx(drive.xyz, abs=1e-3)


def test_a_rule_selects_returns_of_both_clouds():
    found = altered(swept(return_mode="dual"), chain(Injected(3.0), DroppedPackets(0.3)))
    early = found.where(lambda cloud: cloud.time_ns < 40_000_000)
    assert 0 < len(early.original) < len(found.original)
    known = early.cloud.source >= 0
    assert known.any()
    assert np.array_equal(early.cloud.xyz[known], early.original.xyz[early.cloud.source[known]])
    assert_same(early.cloud, found.cloud.where(found.cloud.time_ns < 40_000_000))
