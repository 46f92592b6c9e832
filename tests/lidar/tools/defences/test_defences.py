"""Defences on frames with forged cars and missing returns, against the same frames as they were measured."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.forgery import CAR, in_box, observed, with_car, without
from helpers.sensor_worlds import box, driven, world

from geoscene.classes import Class
from lidar.dataset.png import write_png
from lidar.errors import InputError
from lidar.geometry.attitude import Mount
from lidar.sensors.physics.detector import METRES_PER_NS
from lidar.sensors.physics.settings import LEVELS, PLAIN
from lidar.sensors.rig.specs import CameraSpec
from lidar.tools.defences.boxes import Occlusion, Shadow, Temporal
from lidar.tools.defences.defence import Window
from lidar.tools.defences.missing import Azimuth, Map, Void
from lidar.tools.defences.navigation import NavigationDefence as Consistency
from lidar.tools.defences.observation import NavigationMeasurements, Picture
from lidar.tools.defences.overlay import Overlay, project_returns
from lidar.tools.defences.registry import able, read_defences
from lidar.tools.defences.returns import Physics, StatisticalDefence, Timing

STREET = (
    box((-60, -60, -1), (60, 60, 0), feature=7, klass=Class.ROAD, material="asphalt"),
    box((-40, 12, 0), (40, 14, 8), feature=8),
    box((30, -8, 0), (32, 8, 6), feature=9),
)
GENUINE = (9.0, -3.0)


def car(x, y):
    """A solid with the size of a car."""
    length, width, height = CAR
    return box((x - length / 2, y - width / 2, 0.2), (x + length / 2, y + width / 2, height), klass=Class.CAR)


@pytest.fixture(scope="module")
def frame():
    return observed(world(*STREET, car(*GENUINE)))[0]


def judged(defence, *frames, scene=None):
    return defence.judge(Window(frames, scene, np.random.default_rng(1)))


def split(frame, forged, suspicion):
    """Greatest suspicion of the boxes with mostly forged returns, and of the others."""
    is_forged = np.array([len(rows) > 0 and forged[rows].mean() > 0.5 for rows in frame.members])
    assert is_forged.any(), "the detector finds the forged car"
    return suspicion[is_forged].max(), suspicion[~is_forged].max(initial=0)


@pytest.mark.full
@pytest.mark.parametrize(("defence", "points"), [(Occlusion(), 60), (Occlusion(), 200), (Shadow(), 60)])
def test_a_car_of_few_points_lets_rays_pass_and_a_genuine_one_does_not(frame, defence, points):
    attacked, forged = with_car(frame, (9.0, 4.0, -0.98), points=points)
    verdict = judged(defence, attacked)
    fake, genuine = split(attacked, forged, verdict.objects)
    assert fake > 0.3 > 2 * genuine
    assert verdict.frame == fake
    assert verdict.returns[forged].mean() > 5 * verdict.returns[~forged].mean()
    assert judged(defence, frame).frame < 0.15


def test_a_car_that_stops_every_ray_is_beyond_occlusion_and_shadow(frame):
    """What the physics allows: an attacker who replaces all echoes of a car leaves nothing behind it."""
    attacked, forged = with_car(frame, (9.0, 4.0, -0.98), points=10**6, noise=0.0, window=np.pi)
    for defence in (Occlusion(), Shadow()):
        assert split(attacked, forged, judged(defence, attacked).objects)[0] < 0.3


def scattered(frame, delay):
    """A forged car whose ranges scatter as by random delays: c J / (2 sqrt 12), 0.43 m at 10 ns."""
    spread = METRES_PER_NS * delay / np.sqrt(12)
    return with_car(frame, (9.0, 4.0, -0.98), points=400, noise=spread, window=np.pi)


def test_objects_whose_ranges_scatter_by_random_firing_delays_stand_out(frame):
    attacked, forged = scattered(frame, 5.0)
    verdict = judged(Timing(), attacked)
    fake, genuine = split(attacked, forged, verdict.objects)
    assert fake > 0.5 > 100 * genuine
    assert verdict.frame == fake
    assert judged(Timing(), frame).frame < 0.01


@pytest.mark.parametrize("delay", [10.0, 100.0])
def test_returns_whose_ranges_scatter_by_random_firing_delays_stand_out(frame, delay):
    """Scattered over 1.5 m and 15 m they are no object any more."""
    attacked, forged = scattered(frame, delay)
    returns = judged(Timing(), attacked).returns
    assert returns[forged].mean() > 0.9
    assert returns[~forged].mean() < 0.01


def test_timing_measures_the_range_noise_of_the_scanner():
    """A scatter of the noise alone has the suspicion of the ratio 1."""
    settings = replace(PLAIN, range_noise="signal")
    noisy = observed(world(*STREET), settings=settings)[0]
    defence = Timing()
    wall = np.abs(noisy.xyz[:, 1] - 12) < 0.2
    assert np.median(judged(defence, noisy).returns[wall]) == pytest.approx(
        1 / (1 + defence.half**2), rel=0.2
    )


def test_timing_needs_a_scanner_that_fires_at_random_times(frame):
    scans = SimpleNamespace(sensor=frame.sensor, dataset=SimpleNamespace(path="drive"))
    with pytest.raises(InputError, match="timing: needs random firing times, and top of drive has none"):
        able([scans], read_defences(["timing"]))
    guarded = SimpleNamespace(sensor=replace(frame.sensor, firing_jitter_ns=10.0), dataset=scans.dataset)
    assert able([guarded], read_defences(["timing"]))


@pytest.mark.full
def test_a_void_is_where_a_car_was_removed(frame):
    gone = in_box(frame, (GENUINE[0], GENUINE[1], -0.9), size=CAR + 0.3)
    verdict = judged(Void(), without(frame, gone))
    worst = verdict.gaps.suspicion.argmax()
    assert verdict.frame == verdict.gaps.suspicion[worst] > 0.4
    assert np.linalg.norm(verdict.gaps.xy[worst] - GENUINE) < verdict.gaps.radius[worst] + 3
    assert judged(Void(), frame).frame < 0.15


def test_ground_that_is_moved_outwards_is_a_void(frame):
    """Pulses that go on through the ground are as suspicious as those without a return."""
    near = frame.ground & (np.abs(frame.azimuth) < 0.2) & (frame.distance < 15)
    shift = np.where(near, 10.0, 0.0)[:, None] * frame.direction
    moved = replace(frame, xyz=frame.xyz + shift, range=frame.range + 10.0 * near)
    assert judged(Void(), moved).frame > 0.5


@pytest.fixture(scope="module")
def turning():
    """Frames of a vehicle in a bend, which pass a wall on one side and open ground on the other."""
    return observed(world(*STREET), frames=6, trajectory=driven((8.0, 0.0, 0.0), yaw_rate=0.1))


def blinded(frame, width):
    """A frame without the returns of a sector at 40 degrees."""
    return without(frame, np.abs(frame.azimuth - np.radians(40)) < np.radians(width / 2))


@pytest.mark.full
@pytest.mark.parametrize("width", [10, 20, 45, 80])
@pytest.mark.parametrize("since", ["the frame", "the drive's start", "two frames"])
def test_a_sector_without_returns_stands_out_however_long_it_has_been_removed(turning, width, since):
    *earlier, last = turning
    if since == "the frame":
        verdict = judged(Azimuth(), *earlier, blinded(last, width))
    elif since == "two frames":
        verdict = judged(Azimuth(), *earlier[:-1], blinded(earlier[-1], width), blinded(last, width))
    else:
        verdict = judged(Azimuth(), *(blinded(frame, width) for frame in turning))
    assert verdict.frame > 0.9
    assert judged(Azimuth(), *turning).frame == 0
    assert np.degrees(np.arctan2(*verdict.gaps.xy[0, ::-1])) == pytest.approx(40, abs=width / 2)


def test_a_scanner_that_sees_no_ground_misses_a_sector_of_walls_that_earlier_frames_had(turning):
    """The rest of the turn looks at the sky: what is missing is known from earlier frames alone."""
    upwards = [without(frame, frame.xyz[:, 2] < 0) for frame in turning]
    last = upwards[-1]
    lost = without(last, np.abs(last.azimuth - np.radians(90)) < np.radians(10))
    assert judged(Azimuth(), *upwards[:-1], lost).frame > 0.5
    assert judged(Azimuth(), *upwards).frame < 0.3
    assert judged(Azimuth(), lost).frame < 0.3


def test_fog_that_takes_returns_all_around_is_no_removed_sector(turning):
    """What no part of the turn has is not expected."""
    near = [without(frame, frame.distance > 6) for frame in turning]
    assert judged(Azimuth(), *near).frame < 0.3


def test_returns_behind_a_wall_of_the_map_and_lost_walls_stand_out(frame):
    here = world(*STREET)
    verdict = judged(Map(), frame, scene=here)
    assert verdict.frame < 0.05, "a car that the map does not have is no contradiction"
    wall = (frame.azimuth > 0.9) & (frame.azimuth < 1.0) & (frame.xyz[:, 2] > 0)
    behind = replace(frame, xyz=frame.xyz + np.where(wall, 5.0, 0.0)[:, None] * frame.direction)
    verdict = judged(Map(), behind, scene=here)
    assert verdict.returns[wall].min() > 0.9
    assert verdict.returns[~wall].max() < 0.05
    lost = judged(Map(), without(frame, (frame.azimuth > 0.85) & (frame.azimuth < 1.05)), scene=here)
    assert lost.frame > 0.9
    assert np.arctan2(*lost.gaps.xy[0, ::-1]) == pytest.approx(0.95, abs=0.1)


@pytest.mark.full
def test_physics_finds_what_no_pulse_can_give(frame):
    some = np.arange(0, len(frame), 50)
    chosen = np.isin(np.arange(len(frame)), some)
    after = np.roll(chosen, 1)
    assert judged(Physics(), frame).returns.max() == 0
    changes = {
        "off the ray": {"xyz": frame.xyz + 0.3 * chosen[:, None]},
        "late": {"time_ns": frame.time_ns + 20_000 * chosen},
        "no such column": {"column": frame.column + 10**6 * chosen},
        "range": {"range": frame.range + 0.2 * chosen},
        "second return": {
            name: np.where(after, np.roll(getattr(frame, name), 1), getattr(frame, name))
            for name in ("ring", "column")
        },
    }
    for name, columns in changes.items():
        found = judged(Physics(), replace(frame, **columns)).returns
        assert found[some[:-1]].mean() > 0.9, name
        assert np.median(found) == 0, name


@pytest.mark.full
@pytest.mark.parametrize("share", [0.01, 0.5])
def test_returns_off_the_range_step_stand_out_even_if_half_of_a_frame_are(share):
    """A forger who computes ranges in floating point does not keep to the scanner's steps."""
    frame = observed(world(*STREET), settings=replace(LEVELS["survey"], false_alarms=False))[0]
    forged = np.random.default_rng(3).random(len(frame)) < share
    shift = np.where(forged, 0.4 * frame.sensor.range_quantum, 0.0)
    moved = replace(frame, xyz=frame.xyz + shift[:, None] * frame.direction, range=frame.range + shift)
    returns = judged(Physics(), moved).returns
    assert returns[forged].min() > 0.8
    assert returns[~forged].max() <= 0.2


@pytest.mark.full
def test_returns_too_weak_to_be_detected_are_suspicious_where_the_others_keep_the_threshold():
    noisy = observed(world(*STREET), settings=replace(LEVELS["survey"], false_alarms=False))[0]
    far = np.flatnonzero(noisy.distance > 30)[:100]
    assert judged(Physics(), noisy).returns.max() <= 0.2
    dark = np.where(np.isin(np.arange(len(noisy)), far), 0.0, noisy.intensity)
    weak = judged(Physics(), replace(noisy, intensity=dark, range=noisy.range)).returns
    assert (weak[far] > 0.8).sum() > 0.5 * len(far)


@pytest.mark.full
def test_scattered_returns_are_outliers(frame):
    rng = np.random.default_rng(2)
    some = rng.permutation(len(frame))[:60]
    xyz = frame.xyz.copy()
    xyz[some] = frame.direction[some] * rng.uniform(2, 8, 60)[:, None]
    verdict = judged(StatisticalDefence(), replace(frame, xyz=xyz))
    assert np.median(verdict.returns[some]) > 0.5
    assert np.median(verdict.returns) < 0.1
    assert verdict.frame > judged(StatisticalDefence(), frame).frame


def followed(speed, frames=9):
    """Frames of a moving vehicle behind a genuine car that drives at a speed (m/s)."""
    ego = driven((6.0, 0.0, 0.0))
    found = []
    for frame in range(frames):
        here = world(*STREET, car(GENUINE[0] + speed * frame / 10, GENUINE[1]))
        found += observed(here, trajectory=ego, only=frame)
    return found


@pytest.mark.full
@pytest.mark.parametrize("speed", [0.0, 9.0])
def test_earlier_frames_support_genuine_cars_and_no_sudden_ones(speed):
    frames = followed(speed)
    last = frames[-1]
    attacked, forged = with_car(last, (9.0, 4.0, -0.98), points=10**6, noise=0.02, window=np.pi)
    verdict = judged(Temporal(), *frames[:-1], attacked)
    fake, genuine = split(attacked, forged, verdict.objects)
    assert fake > 0.75, "at most one of five frames has something where a motion puts the car"
    assert genuine < 0.3
    assert judged(Temporal(), *frames).frame < 0.3
    assert judged(Temporal(), attacked).frame == 0, "without earlier frames nothing is known"


@pytest.mark.full
def test_a_phantom_that_keeps_pace_is_not_excused_by_motions_through_what_it_hides():
    """Earlier frames cannot see behind the phantom itself; motions that end there prove nothing."""
    frames = followed(0.0, frames=10)
    forged = [with_car(f, (9.0, 1.0, -0.98), points=10**6, noise=0.02, window=np.pi) for f in frames[3:]]
    for count in (1, 4, 7):
        *_, (last, rows) = forged[:count]
        verdict = judged(Temporal(), *frames[:3], *(frame for frame, _ in forged[: count - 1]), last)
        fake, genuine = split(last, rows, verdict.objects)
        assert fake > 0.15 > genuine, count


def test_an_object_that_comes_out_of_hiding_is_not_suspicious():
    """Nothing is known of places that earlier frames did not see."""
    wall = box((6, 3, 0), (6.3, 9, 4), feature=10)
    hidden = observed(world(*STREET, wall, car(12.0, 5.0)))[0]
    seen = replace(observed(world(*STREET, car(12.0, 5.0)))[0], number=1)
    assert judged(Temporal(), hidden, seen).frame < 0.3
    empty = observed(world(*STREET))[0]
    assert judged(Temporal(), empty, seen).frame > 0.8


FRONT = CameraSpec(
    "front", Mount((1.0, 0.0, 1.65), (-0.5, 0.5, -0.5, 0.5)), 640, 360, 500.0, 500.0, 319.5, 179.5
)


def drawn(path, *boxes):
    """A picture of a grey road and sky with painted boxes (left, top, right, bottom)."""
    rng = np.random.default_rng(1)
    image = np.full((FRONT.height, FRONT.width, 3), 110.0)
    image[:180] = (150, 180, 220)
    for left, top, right, bottom in boxes:
        image[top:bottom, left:right] = (160, 30, 30)
    write_png(path, np.clip(image + 4 * rng.standard_normal(image.shape), 0, 255).astype(np.uint8))
    return Picture(FRONT, 0, path)


def bounds(frame, rows, picture):
    pixels = project_returns(frame, rows, picture=picture)
    return *np.floor(pixels.min(axis=0)).astype(int), *np.ceil(pixels.max(axis=0)).astype(int)


@pytest.mark.full
def test_the_camera_confirms_a_car_that_it_sees_and_rejects_one_that_it_does_not(frame, tmp_path):
    attacked, forged = with_car(frame, (10.0, 1.0, -0.98), points=150)
    genuine = next(rows for rows in attacked.members if len(rows) and not forged[rows].any())
    left, top, right, bottom = bounds(attacked, genuine, drawn(tmp_path / "blank.png"))
    during = drawn(tmp_path / "car.png", (left - 2, top - 6, right + 2, bottom + 6))
    later = replace(drawn(tmp_path / "later.png"), time_ns=10**8)
    shown = replace(attacked, pictures=(during, later))
    verdict = judged(Overlay(), shown)
    fake, real = split(shown, forged, verdict.objects)
    assert fake > 0.45 > 2 * real
    pictures = Overlay().pictures(shown, verdict, threshold=0.4)
    colors = {tuple(c) for image in pictures.values() for c in image.reshape(-1, 3).tolist()}
    assert {(255, 40, 40), (40, 255, 40)} <= colors
    late = replace(shown, pictures=(replace(shown.pictures[0], time_ns=10**9),))
    assert judged(Overlay(), late).frame == 0, "a picture of another time says nothing"


@pytest.mark.full
def test_a_picture_counts_until_60_ms_after_the_last_pulse_on_an_object(frame, tmp_path):
    attacked, forged = with_car(frame, (10.0, 1.0, -0.98), points=150)
    row = next(k for k, rows in enumerate(attacked.members) if len(rows) and forged[rows].all())
    road, last = drawn(tmp_path / "road.png"), int(attacked.time_ns[attacked.members[row]].max())
    for late_ns, counts in ((59_000_000, True), (61_000_000, False)):
        shown = replace(attacked, pictures=(replace(road, time_ns=last + late_ns),))
        assert (judged(Overlay(), shown).objects[row] > 0.45) == counts


@pytest.mark.full
@pytest.mark.parametrize("level", [0, 255])
def test_a_blinded_camera_or_lost_rows_say_nothing_of_an_object(frame, tmp_path, level):
    attacked, _ = with_car(frame, (10.0, 1.0, -0.98), points=150)
    road = drawn(tmp_path / "road.png")
    assert judged(Overlay(), replace(attacked, pictures=(road,))).objects.max() > 0.45
    write_png(tmp_path / "blind.png", np.full((FRONT.height, FRONT.width, 3), level, np.uint8))
    blinded = replace(attacked, pictures=(replace(road, file=tmp_path / "blind.png"),))
    verdict = judged(Overlay(), blinded)
    assert verdict.objects.max() == 0
    assert not Overlay().pictures(blinded, verdict, threshold=0.4)


def with_fixes(frames, *, spoofed=(0.0, 0.0), gyro_z=0.0):
    """Frames with RTK fixes that drift away at a speed (m/s east and north) and a gyroscope."""
    rng, path = np.random.default_rng(1), frames[0].trajectory
    time_ns = np.arange(0, 2 * 10**9, 10**8)
    place = path.at(time_ns).position[:, :2] + 0.015 * rng.standard_normal((len(time_ns), 2))
    place += np.outer(time_ns / 1e9, spoofed)
    ones = np.ones(len(time_ns))
    imu_ns = np.arange(0, 2 * 10**9, 10**7)
    rate = gyro_z + 0.002 * rng.standard_normal(len(imu_ns))
    gnss = {"time_ns": time_ns, "quality": 4 * ones, "hdop": ones}
    data = NavigationMeasurements(gnss, {"time_ns": imu_ns, "gyro_z": rate}, np.zeros(3), place)
    return [replace(frame, navigation=data) for frame in frames]


@pytest.mark.full
def test_fixes_that_drift_and_wrong_poses_contradict_the_scanner():
    path = driven((6.0, 0.0, 0.0), yaw_rate=0.1)
    frames = [
        frame
        for k in range(0, 11, 2)
        for frame in observed(world(*STREET, car(*GENUINE)), trajectory=path, only=k)
    ]
    assert judged(Consistency(), *with_fixes(frames, gyro_z=0.1)).frame < 0.45
    assert judged(Consistency(), *with_fixes(frames, spoofed=(0.0, 0.5), gyro_z=0.1)).frame > 0.8
    assert judged(Consistency(), *with_fixes(frames, gyro_z=0.0)).frame > 0.8, "the gyroscope feels no turn"
    false = driven((6.0, 0.5, 0.0), yaw_rate=0.1)
    moved = [replace(frame, trajectory=false) for frame in with_fixes(frames, gyro_z=0.1)]
    assert judged(Consistency(), *moved).frame > 0.8


def test_without_fixes_or_with_too_little_to_match_nothing_is_known(frame):
    navigation = with_fixes([frame])[0].navigation
    lost = replace(navigation, east_north=np.full_like(navigation.east_north, np.nan))
    path = driven((6.0, 0.0, 0.0))
    frames = [observed(world(*STREET), trajectory=path, only=k)[0] for k in (0, 5)]
    assert judged(Consistency(), *(replace(f, navigation=lost) for f in frames)).frame < 0.45
    bare = [observed(world(STREET[0]), trajectory=path, only=k)[0] for k in (0, 5)]
    assert judged(Consistency(), *with_fixes(bare, spoofed=(9.0, 0.0))).frame == 0
