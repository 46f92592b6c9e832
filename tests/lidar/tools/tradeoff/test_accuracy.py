"""Drives to an accuracy or within a budget: texts, choice, stored profiles, recipes, spot checks."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.profiles import measure_little
from helpers.programs import run_program
from helpers.scenes import same_files

from lidar.dataset.layout import Paths, open_dataset
from lidar.errors import InputError
from lidar.options import AccuracyOptions, DriveOptions, read_accuracy, read_budget
from lidar.simulation.drive import DriveSummary, drive
from lidar.simulation.plan import plan_drive
from lidar.tools.sweep import sweep
from lidar.tools.tradeoff import accuracy, profile
from lidar.tools.tradeoff.accuracy import CheckedDrive, Planned, driven, pace_of, pick_settings
from lidar.tools.tradeoff.choice import Wanted, choice, worst
from lidar.tools.tradeoff.errors import ErrorEstimate, PulseReturns, next_drive, resample
from lidar.tools.tradeoff.profile import Candidate, Profile, profile_of
from lidar.tools.tradeoff.profile_errors import drive_estimates
from lidar.tools.tradeoff.sampling import SampledError, range_figures, sampled_error
from lidar.tools.tradeoff.sensor_errors import SensorErrors, stated
from lidar.tools.tradeoff.spot import SpotCheck
from lidar.traffic.populate import TrafficOptions

DRIVE = DriveOptions(route="random", rig="vlp16", duration=0.5, seed=3, formats=("pcd",))


@pytest.mark.parametrize(
    ("text", "metres", "percent"),
    [
        ("1cm", 0.01, 99.9),
        ("1cm@99.9", 0.01, 99.9),
        ("5mm@99", 0.005, 99.0),
        ("0.1m", 0.1, 99.9),
        ("0.1 m@95%", 0.1, 95.0),
        (" 200um@50", 0.0002, 50.0),
        ("2CM", 0.02, 99.9),
    ],
)
def test_accuracies_are_read(text, metres, percent):
    found = read_accuracy(text)
    assert (found.metres, found.percent, found.levels) == (pytest.approx(metres), percent, 0.0)


@pytest.mark.parametrize(
    ("text", "metres", "percent", "levels"),
    [
        ("3levels", 0.0, 99.9, 3.0),
        ("1 level", 0.0, 99.9, 1.0),
        ("1cm,3levels", 0.01, 99.9, 3.0),
        ("0.5 levels, 5mm@95", 0.005, 95.0, 0.5),
    ],
)
def test_levels_of_colours_are_read(text, metres, percent, levels):
    found = read_accuracy(text)
    assert (found.metres, found.percent, found.levels) == (pytest.approx(metres), percent, levels)


@pytest.mark.parametrize(
    "text",
    [
        *["", "1", "cm", "0cm", "-1cm", "1in", "1cm@", "1cm@100", "1cm@98.7", "1..2cm", "5km", "nan m"],
        *["0levels", "256levels", "3levels@99", "1cm,2cm", "1levels,2levels", "1cm,", "1cm 3levels"],
    ],
)
def test_other_accuracies_are_refused_in_one_line(text):
    with pytest.raises(InputError, match="`accuracy`") as error:
        read_accuracy(text)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("text", "speed"), [("2x-realtime", 2), ("0.5x-realtime", 0.5), (".5X-realtime", 0.5)]
)
def test_budgets_are_read(text, speed):
    assert read_budget(text) == speed


@pytest.mark.parametrize(
    "text", ["", "2", "2x", "0x-realtime", "-1x-realtime", "x-realtime", "1e3x-realtime"]
)
def test_other_budgets_are_refused(text):
    with pytest.raises(InputError, match="`budget`"):
        read_budget(text)


def around(error, *, least=0.5, most=2.0):
    return ErrorEstimate(error, least * error, most * error)


def candidate(rays, cpu, *errors):
    """A candidate of scanners with these errors, which reach twice as far up; ten times less at 99 %."""
    figures = [{"range_99_m": around(e / 10), "range_99.9_m": around(e)} for e in errors]
    cost = around(cpu, least=0.9, most=1.1)
    return Candidate({"rays": rays}, {f"scanner_{k}": of for k, of in enumerate(figures)}, cost)


def camera_candidate(rays, cpu, levels):
    """A candidate of a camera of colours and depths, whose depths err by 2 mm, up to 4 mm."""
    figures = {"rgb_rms": around(levels), "depth_99.9_m": around(0.002)}
    return Candidate({"supersample": rays}, {"eye": figures}, around(cpu, least=0.9, most=1.1))


PROFILE = Profile(
    Path("profile.json"),
    (candidate(1, 0.1, 0.1, 0.2), candidate(7, 0.4, 0.02, 0.04), candidate(19, 0.9, 0.004, 0.009)),
    (),
    drives=12,
    load_s=ErrorEstimate(0.1, 0.1, 0.1),
)
CAMERAS = (camera_candidate(1, 0.3, 4.0), camera_candidate(2, 0.7, 1.0), camera_candidate(3, 2.0, 0.5))
BOTH = replace(PROFILE, cameras=CAMERAS)


def wanted(accuracy="", budget="", **more):
    return Wanted(
        read_accuracy(accuracy) if accuracy else None,
        pace=read_budget(budget) if budget else 0.0,
        budget=budget,
        **more,
    )


@pytest.mark.parametrize(
    ("accuracy", "budget", "rays"),
    [
        ("0.5m", "", 1),
        ("40cm", "", 1),  # the upper end of the worse scanner
        ("39cm", "", 7),
        ("8cm", "", 7),
        ("5cm", "", 19),  # 7 rays have 4 cm, up to 8 cm
        ("1cm@99", "", 7),
        ("", "9x-realtime", 1),
        ("", "2.2x-realtime", 7),
        ("", "2.3x-realtime", 1),  # the upper end of the cost
        ("", "0.1x-realtime", 19),
        ("40cm", "0.1x-realtime", 1),
        ("8cm", "2x-realtime", 7),
    ],
)
def test_the_first_that_is_enough_or_the_last_that_is_affordable_is_chosen(accuracy, budget, rays):
    assert choice(PROFILE, wanted(accuracy, budget)).settings == {"rays": rays}


@pytest.mark.parametrize(
    ("accuracy", "budget", "settings"),
    [
        ("3levels", "", {"supersample": 2}),
        ("8levels", "", {"supersample": 1}),
        ("1.9levels", "", {"supersample": 3}),
        ("8cm", "", {"rays": 7}),
        ("8cm,3levels", "", {"rays": 7, "supersample": 2}),
        ("", "2x-realtime", {"rays": 1, "supersample": 1}),
        ("", "1.2x-realtime", {"rays": 7, "supersample": 1}),  # the cheaper step is taken first
        ("", "0.7x-realtime", {"rays": 7, "supersample": 2}),
        ("", "0.1x-realtime", {"rays": 19, "supersample": 3}),
    ],
)
def test_rigs_with_scanners_and_cameras_have_both_picked(accuracy, budget, settings):
    assert choice(BOTH, wanted(accuracy, budget)).settings == settings


def test_what_is_given_is_neither_picked_nor_forgotten():
    one = choice(BOTH, wanted("8cm", given={"supersample": 2}))
    assert (one.settings, one.cpu_s.value) == ({"rays": 7}, pytest.approx(1.1))
    fixed = choice(BOTH, wanted("", "0.1x-realtime", free=("scanners",), given={"supersample": 2}))
    assert fixed.settings == {"rays": 19}


def test_depths_need_no_setting_and_are_refused_beyond_what_files_hold():
    eye = replace(BOTH, scanners=())
    assert choice(eye, wanted("1cm")).settings == {}
    with pytest.raises(
        InputError, match=r"no image of depths is sure .* that of eye comes nearest .*give 4 mm or more"
    ):
        choice(eye, wanted("3mm"))


@pytest.mark.parametrize(
    ("accuracy", "budget", "line"),
    [
        ("1cm", "", r"rays=19 comes nearest with 9 mm \(4.5 mm to 1.8 cm\): give 1.8 cm or more"),
        ("", "10x-realtime", "even rays=1 is simulated at 9.1 x real time with 1 worker"),
        (
            "5cm",
            "2x-realtime",
            "takes rays=19, simulated at 1 x real time.*allows rays=7, with errors of 4 cm",
        ),
    ],
)
def test_what_none_reaches_is_one_line_with_the_nearest(accuracy, budget, line):
    with pytest.raises(InputError, match=line):
        choice(PROFILE, wanted(accuracy, budget))


def test_colours_that_none_reaches_are_one_line_with_the_nearest():
    with pytest.raises(
        InputError, match=r"supersample=3 comes nearest with 0.5 levels .*: give 1 level or more"
    ):
        choice(BOTH, wanted("0.9levels"))


def test_more_workers_afford_more(monkeypatch):
    monkeypatch.setattr("os.cpu_count", lambda: 4)
    every = [choice(PROFILE, wanted(budget="2x-realtime", workers=w)).settings["rays"] for w in (1, 2, 9)]
    assert every == [7, 19, 19]


def test_errors_that_are_given_as_the_nearest_are_enough():
    best = 0.0123456
    profile = replace(PROFILE, scanners=(candidate(1, 0.1, best / 2),))
    with pytest.raises(InputError, match=r"give 1.3 cm or more"):
        choice(profile, wanted("1cm"))
    assert choice(profile, wanted("1.3cm")).settings == {"rays": 1}


def returns(rows, ranges):
    n = len(rows)
    return PulseReturns(256 * np.array(rows), np.array(ranges, float), np.ones(n, np.uint8), np.zeros((n, 3)))


def test_weighted_errors_of_matched_missed_and_extra_returns():
    weights = np.array([1.0, 10.0, 1.0, 5.0])
    error = sampled_error(
        returns([0, 1, 3], [5.1, 7, 9]), exact=returns([0, 1, 2], [5, 7, 8]), weights=weights
    )
    np.testing.assert_allclose(error.range, [0.1, 0])
    assert (error.weight.tolist(), error.missed, error.extra, error.returns) == ([1, 10], 1, 5, 12)
    found = range_figures([error, error])
    assert found["range_90_m"] == 0
    assert found["range_95_m"] == pytest.approx(0.1)
    assert found["lost"] == pytest.approx(6 / 12)


def test_missed_and_extra_returns_are_stated_where_they_matter():
    half, few = ErrorEstimate(0.5, 0.4, 0.6), ErrorEstimate(1e-4, 0.0, 1e-3)
    errors = {"a": {"range_99_m": few, "lost": half}, "b": {"range_99_m": few, "lost": few}}
    found = stated(errors, percent=99.0, kinds=("ranges",))
    assert found.lost == {"a": half}
    assert "missed and extra returns are 50 % (40 % to 60 %) for a" in found.to_text("are")
    assert SensorErrors.from_json(found.to_json("expected"), "expected") == found


def test_a_stratified_sample_has_the_quantiles_of_all():
    rng = np.random.default_rng(0)
    every = rng.lognormal(-6, 2, (20, 5000))

    def sampled(errors):
        seen = errors * rng.uniform(0.8, 1.2, len(errors))  # by the screening
        hard, easy = np.split(np.argsort(-seen), [120])
        easy = rng.permutation(easy)[:120]
        weight = np.r_[np.ones(120), np.full(120, (5000 - 120) / 120)]
        return SampledError(errors[np.r_[hard, easy]], weight, missed=0.0, extra=0.0, returns=5000.0)

    found = resample([sampled(errors) for errors in every], seed=0, figures=range_figures)
    for percent, tolerance in ((50, 0.2), (90, 0.2), (99, 0.1), (99.9, 0.01)):
        true, one = np.quantile(every, percent / 100), found[f"range_{percent}_m"]
        assert one.value == pytest.approx(true, rel=tolerance)
        assert one.low <= one.value <= one.high


def frame_of(error):
    return SampledError(np.full(50, error), np.ones(50), missed=0.0, extra=0.0, returns=50.0)


def test_intervals_are_of_the_next_drive_or_of_the_frames_of_one():
    errors = (0.01, 0.02, 0.03, 0.1)
    frames = [(k, frame_of(error)) for k, error in enumerate(errors) for _ in range(8)]
    of_next = drive_estimates(frames, figures=range_figures)["range_50_m"]
    of_one = drive_estimates([(0, frame) for _, frame in frames], figures=range_figures)["range_50_m"]
    assert of_next == next_drive(errors, least=1e-6)
    assert of_next.value == pytest.approx(np.exp(np.log(errors).mean()))
    assert of_one.high <= 0.1 < of_next.high


def test_drives_without_returns_tell_nothing():
    empty = SampledError(np.empty(0), np.empty(0), missed=0.0, extra=0.0, returns=0.0)
    frames = [(k, frame_of(error)) for k, error in enumerate((0.01, 0.02, 0.03))]
    assert drive_estimates([*frames, (3, empty)], figures=range_figures) == drive_estimates(
        frames, figures=range_figures
    )
    assert not drive_estimates([(0, empty)], figures=range_figures)


@pytest.mark.parametrize("drives", [4, 12])
def test_the_next_drive_is_within_its_interval_as_often_as_promised(drives):
    rng = np.random.default_rng(7)
    errors = rng.lognormal(-4, 0.8, (4000, drives + 1))
    intervals = [next_drive(row[:-1], least=1e-9) for row in errors]
    above = np.mean([row[-1] > one.high for row, one in zip(errors, intervals, strict=True)])
    below = np.mean([row[-1] < one.low for row, one in zip(errors, intervals, strict=True)])
    assert above == pytest.approx(0.025, abs=0.007)  # 3 standard errors
    assert below == pytest.approx(0.025, abs=0.007)


@pytest.fixture(scope="module", autouse=True)
def quick():
    """Smaller samples, so that a profile takes a second."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(profile, "RAYS", (1, 7, 61))
        patch.setattr(profile, "SUPERSAMPLES", (1, 3))
        measure_little(patch)
        yield


@pytest.fixture(scope="module")
def cache(scene, tmp_path_factory):
    """A folder with the profile of the demo scene."""
    folder = tmp_path_factory.mktemp("profiles")
    assert profile_of(scene, DRIVE, folder=folder).made
    return folder


@pytest.fixture
def measured_before(monkeypatch):
    """Let a profile that is measured again fail the test."""

    def again(*_args, **_options):
        raise AssertionError("measured again")

    monkeypatch.setattr(profile, "_measure", again)


def accurate(scene, out, *, options=DRIVE, by):
    pick = pick_settings(scene, options, wanted=by, out=out)
    return driven(scene, out, options=options, wanted=by, pick=pick)


def between(cache, scene):
    """An accuracy that takes 7 rays, by the profile."""
    one, seven, _ = profile_of(scene, DRIVE, folder=cache).scanners
    low, high = (worst(c, "range_99_m").high for c in (seven, one))
    assert low < high
    return f"{500 * (low + high):.6f}mm@99"


def test_more_rays_err_less_and_cost_more(scene, cache):
    one, _, most = profile_of(scene, DRIVE, folder=cache).scanners
    for figure in ("range_99_m", "range_99.9_m"):
        assert most.errors["lidar_top"][figure].value < one.errors["lidar_top"][figure].value
    assert one.cpu_s.value < most.cpu_s.value


@pytest.mark.usefixtures("measured_before")
def test_a_profile_is_kept_for_other_routes_and_made_for_other_settings(scene, cache):
    for change in ({"seed": 9}, {"duration": 2.0, "from_rest": True}, {"workers": 1}):
        assert not profile_of(scene, replace(DRIVE, **change), folder=cache).made
    for change in (
        {"rig": "drone", "vehicle": "car"},
        {"fidelity": "survey"},
        {"settings": (("reach", "50"),)},
    ):
        with pytest.raises(AssertionError, match="measured again"):
            profile_of(scene, replace(DRIVE, **change), folder=cache)


@pytest.mark.usefixtures("measured_before")
def test_flights_and_scenes_along_routes_have_profiles_of_their_own_drive(scene, cache, monkeypatch):
    plans = []
    monkeypatch.setattr(profile, "plan_drive", lambda _scene, options, **_more: plans.append(options))
    limits = {"area": "POLYGON ((0 0, 50 0, 50 50, 0 0))"}, {"route": "LINESTRING (0 0, 50 0)"}
    part, along = (replace(scene, manifest=scene.manifest | limit) for limit in limits)
    flight = DriveOptions(survey="all", altitude=50.0, rig="drone", duration=2.0)
    for where, options in ((part, DRIVE), (along, DRIVE), (scene, flight)):
        with pytest.raises(AssertionError, match="measured again"):
            profile_of(where, options, folder=cache)
    assert [(p.duration, p.survey) for p in plans] == [(0.5, ""), (0.5, ""), (2.0, "all")]


def test_errors_are_measured_the_same_again_and_damaged_profiles_are_replaced(scene, cache, tmp_path):
    first = profile_of(scene, DRIVE, folder=cache)
    (tmp_path / first.path.name).write_text("{")
    again = profile_of(scene, DRIVE, folder=tmp_path)
    assert again.made
    assert [c.errors for c in again.scanners] == [c.errors for c in first.scanners]


@pytest.mark.usefixtures("measured_before")
def test_a_drive_holds_what_was_asked_picked_expected_and_reached(scene, cache, tmp_path):
    by = AccuracyOptions(between(cache, scene), profile_cache=cache)
    done = accurate(scene, tmp_path / "a", by=by)
    manifest = open_dataset(tmp_path / "a").manifest
    notes = manifest["accuracy"]
    assert notes["asked"] == {"accuracy": by.accuracy}
    assert notes["picked"] == {"rays": 7}
    assert manifest["recipe"]["settings"] == [["rays", "7"]]
    expected, reached = (notes[f"{name}_error_m"]["lidar_top"] for name in ("expected", "reached"))
    assert expected["low"] <= expected["value"] <= expected["high"] <= read_accuracy(by.accuracy).metres
    assert 0 < reached["low"] <= reached["value"] <= reached["high"]
    assert notes["spot_check"]["lidar_top"]["frames"] == 5
    assert "rays=7" in done.pick.to_text(2)
    assert done.accuracy(2)["expected_cpu_s"]["value"] > 0
    assert "cpu" not in json.dumps(notes)
    drive(scene, tmp_path / "set", options=replace(DRIVE, settings=(("rays", "7"),)))
    assert Paths(tmp_path / "a").journal.read_bytes() == Paths(tmp_path / "set").journal.read_bytes()


@pytest.mark.usefixtures("measured_before")
def test_a_drive_is_resumed_with_what_was_picked_and_has_the_same_bytes(scene, cache, tmp_path):
    by = AccuracyOptions(between(cache, scene), profile_cache=cache)
    accurate(scene, tmp_path / "a", by=by)
    accurate(scene, tmp_path / "b", options=replace(DRIVE, workers=1), by=by)
    same_files(tmp_path / "a", tmp_path / "b")
    manifest = json.loads(Paths(tmp_path / "b").manifest.read_text())
    for key in ("reached_error_m", "spot_check"):
        del manifest["accuracy"][key]
    Paths(tmp_path / "b").manifest.write_text(json.dumps(manifest | {"frames_done": 0}))
    next((tmp_path / "b").glob("*/pcd/*")).unlink()
    elsewhere = replace(by, profile_cache=tmp_path / "none")
    done = accurate(scene, tmp_path / "b", by=elsewhere)
    assert (done.summary.resumed, done.pick.settings) == (4, {"rays": 7})
    assert "as picked before" in done.pick.to_text(1)
    same_files(tmp_path / "a", tmp_path / "b")


def test_settings_that_contradict_and_rigs_without_scanners_are_one_line(scene, cache, tmp_path):
    words = ["drive", scene.path, "--route", "random", "--duration", "0.5", "--profile-cache", cache]
    for more, line in (
        (["--accuracy", "1cm", "--set", "rays=3"], "--set rays=3: --accuracy picks it"),
        (["--budget", "1x-realtime", "--set", "stretch=on"], "--set stretch=on: --budget picks rays"),
        (["--budget", "1x-realtime", "--scheduler", "tcp://a:1"], "--budget is for this machine"),
        (["--accuracy", "1cm@42"], "--accuracy 1cm@42: after the @ give one of 50, 68"),
        (["--budget", "fast"], "--budget fast: give a speed such as 2x-realtime"),
    ):
        ended = run_program("lidar", *words, *more, "--rig", "vlp16", "-o", tmp_path / "d")
        assert ended.returncode == 2
        assert line in ended.stderr
        assert ended.stderr.count("\n") == 1
    assert not (tmp_path / "d").exists()


EYE = """
name = "eye"
vehicle = "car"
[[camera]]
name = "front"
width = 64
height = 48
fx = 60.0
images = IMAGES
"""


@pytest.mark.parametrize(
    ("images", "accuracy", "line"),
    [
        ('["rgb"]', "1cm", "no sensor of rig .* measures lengths; ask for levels of colours, as in 3levels"),
        ('["depth"]', "3levels", "no sensor of rig .* has colours; ask for a length, as in 1cm"),
        ('["semantic"]', "1cm", "no sensor of rig .* measures lengths"),
    ],
)
def test_units_that_no_sensor_has_are_refused(scene, tmp_path, images, accuracy, line):
    rig = tmp_path / "eye.toml"
    rig.write_text(EYE.replace("IMAGES", images))
    with pytest.raises(InputError, match=line):
        pick_settings(scene, replace(DRIVE, rig=str(rig)), wanted=AccuracyOptions(accuracy))


def test_a_rig_of_a_camera_drives_to_levels_and_to_depths(scene, tmp_path):
    rig = tmp_path / "eye.toml"
    rig.write_text(EYE.replace("IMAGES", '["rgb", "depth"]'))
    options = replace(DRIVE, rig=str(rig))
    one, three = profile_of(scene, options, folder=tmp_path).cameras
    low, high = (worst(c, "rgb_rms").high for c in (three, one))
    assert 0 < low < high
    by = AccuracyOptions(f"1cm,{(low + high) / 2:.3f}levels", profile_cache=tmp_path)
    done = accurate(scene, tmp_path / "d", options=options, by=by)
    manifest = open_dataset(tmp_path / "d").manifest
    notes = manifest["accuracy"]
    assert notes["picked"] == {"supersample": 3}
    assert manifest["recipe"]["settings"] == [["supersample", "3"]]
    for kind in ("expected", "reached"):
        assert 0 < notes[f"{kind}_error_levels"]["front"]["value"] < (low + high) / 2
        assert 0 < notes[f"{kind}_depth_error_m"]["front"]["value"] <= 0.0021
    assert "levels) for front" in done.to_text()
    depths = AccuracyOptions("5mm", profile_cache=tmp_path)
    assert pick_settings(scene, options, wanted=depths).settings == {}
    with pytest.raises(InputError, match="`settings` supersample=2: `accuracy` picks it"):
        pick_settings(scene, replace(options, settings=(("supersample", "2"),)), wanted=by)


@pytest.mark.usefixtures("measured_before")
def test_the_program_says_what_it_picks_and_what_was_reached(scene, cache, tmp_path):
    words = ["drive", scene.path, "--route", "random", "--duration", "0.5", "--rig", "vlp16", "--seed", "3"]
    words += ["--format", "pcd", "--profile-cache", cache]
    ended = run_program("lidar", *words, "--budget", "0.01x-realtime", "-o", tmp_path / "d")
    assert ended.returncode == 0, ended.stderr
    first, _, last = ended.stdout.splitlines()
    assert first.startswith("picked rays=61: 99.9 % of the range errors should be below ")
    assert "with planning (" in first
    assert "x real time with" in first
    assert last.startswith("spot check of 5 frames: 99.9 % of the range errors are below ")
    ended = run_program("lidar", *words, "--spot-check", "--json", "-o", tmp_path / "e")
    assert json.loads(ended.stdout)["accuracy"]["reached_error_m"]["lidar_top"]["value"] > 0
    manifest = open_dataset(tmp_path / "e").manifest
    assert "picked" not in manifest["accuracy"]


def test_a_missed_accuracy_or_budget_is_named():
    errors = PROFILE.scanners[0].errors
    reached = SpotCheck(99.9, ("ranges",), errors, dict.fromkeys(errors, 5))
    summary = DriveSummary(
        Path("d"), 5, 0, {}, 0, duration=3.0, length=9.0, wall=9.0, planning=0.5, recording=1.5, stages={}
    )
    done = CheckedDrive(summary, AccuracyOptions("15cm", "2x-realtime"), None, reached)
    assert done.missed() == [
        "the accuracy of 15cm is missed on this drive: scanner_1 has 20 cm (10 cm to 40 cm)",
        (
            "the budget of 2x-realtime is missed: 3 s took 0.5 s to plan and 1.5 s to record, 1.5 x real"
            " time; was the machine busy?"
        ),
    ]
    assert not replace(done, wanted=AccuracyOptions("25cm", "1x-realtime")).missed()
    assert not replace(done, wanted=AccuracyOptions()).missed()
    assert replace(done, summary=replace(summary, resumed=2)).speed is None


@pytest.mark.usefixtures("measured_before")
def test_drives_of_a_sweep_have_picks_of_their_own(scene, cache, tmp_path, monkeypatch):
    coarse = AccuracyOptions(between(cache, scene)).accuracy
    (tmp_path / "grid.toml").write_text(
        f'[drive]\nroute = "random"\nrig = "vlp16"\nduration = 0.5\nformat = ["pcd"]\nseed = 3\n'
        f'profile-cache = "{cache}"\n'
        f'[grid]\nscene = ["{scene.path}"]\naccuracy = ["{coarse}", "100m@50", "1um"]\n'
    )
    with monkeypatch.context() as patch:  # other processes check samples of full size
        patch.setattr("lidar.tools.sweep.run.run_tasks", lambda work, tasks, **_: map(work, tasks))
        summary = sweep(tmp_path / "grid.toml", tmp_path / "out")
    assert [row.state for row in summary.rows] == ["done", "done", "failed"]
    assert "no number of rays is sure to reach 1 µm" in summary.rows[2].error
    assert [row.picked for row in summary.rows] == ["rays=7", "rays=1", ""]
    assert all("range errors are below" in row.reached for row in summary.rows[:2])
    picks = [open_dataset(summary.path / row.name).manifest["accuracy"]["picked"] for row in summary.rows[:2]]
    assert picks == [{"rays": 7}, {"rays": 1}]
    shutil.rmtree(summary.path / summary.rows[1].name / "lidar_top")
    again = sweep(tmp_path / "grid.toml", tmp_path / "out", workers=2)
    assert [row.digest for row in again.rows] == [row.digest for row in summary.rows]


def test_a_budget_leaves_time_for_planning_and_loading(scene, cache):
    options = replace(DRIVE, traffic=TrafficOptions())
    plan = plan_drive(scene, options)
    planned = Planned(plan, seconds=9.0, cpu_s=0.2, loading=0.05)  # of 0.5 s: half as much again as the drive
    assert planned.overhead == pytest.approx(0.5)
    assert pace_of(planned, "1x-realtime") == pytest.approx(2.0)
    with pytest.raises(InputError, match=r"allows 0.25 s for a drive of 0.5 s, and planning took 0.2 CPU s"):
        pace_of(planned, "2x-realtime")
    by = AccuracyOptions(budget="0.01x-realtime", profile_cache=cache)
    pick = pick_settings(scene, DRIVE, wanted=by)
    assert pick.planned.plan.options == DRIVE
    assert pick.costs(1)["expected_speed"] < pick.costs(1)["expected_cpu_s"]["value"] ** -1


def test_a_drive_within_a_budget_is_planned_once(scene, cache, tmp_path, monkeypatch):
    plans = []

    def counted(*args, **more):
        plans.append(args)
        return plan_drive(*args, **more)

    monkeypatch.setattr(accuracy, "plan_drive", counted)
    monkeypatch.setattr("lidar.simulation.drive.plan_drive", counted)
    by = AccuracyOptions(budget="0.001x-realtime", profile_cache=cache)
    pick = pick_settings(scene, DRIVE, wanted=by)
    done = driven(scene, tmp_path / "d", options=DRIVE, wanted=by, pick=pick)
    assert len(plans) == 1
    assert done.speed < done.summary.duration / done.summary.recording
    drive(scene, tmp_path / "set", options=replace(DRIVE, settings=(("rays", "61"),)))
    assert Paths(tmp_path / "d").journal.read_bytes() == Paths(tmp_path / "set").journal.read_bytes()
