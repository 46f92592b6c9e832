"""Drives to an accuracy or within a budget: texts, search, recipes, spot checks."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.programs import run_program
from helpers.samples import measure_little
from helpers.scenes import same_files

from geoscene.support.progress import silent
from lidar.dataset.layout import Paths, open_dataset
from lidar.errors import InputError
from lidar.options.accuracy import AccuracyOptions, read_accuracy, read_budget
from lidar.options.drive import DriveOptions
from lidar.sensors.rig.specs import load_rig
from lidar.simulation.drive import DriveSummary, drive
from lidar.simulation.plan import plan_drive, sensors_of
from lidar.tools.sweep import sweep
from lidar.tools.tradeoff import pick, search
from lidar.tools.tradeoff.accuracy import CheckedDrive, SpotCheck, driven, pick_settings
from lidar.tools.tradeoff.errors import ErrorEstimate, PulseReturns
from lidar.tools.tradeoff.pick import (
    Ladder,
    Pick,
    Row,
    SensorErrors,
    label_of,
    ladders_of,
    settings_of_rows,
    stated,
)
from lidar.tools.tradeoff.sample import (
    DriveSample,
    SampledError,
    range_estimates,
    sampled_error,
)
from lidar.tools.tradeoff.search import DriveCost, find_accurate, find_affordable, pace_of

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


class FakeSample:
    """Errors of rows whose intervals halve when the sample grows beyond a number of frames."""

    complete = False
    counts = {"sensor": 0}  # noqa: RUF012

    def __init__(self, rows, *, narrow_from=10**9):
        self.settings, self.frames, self.narrow_from = rows, 0, narrow_from

    def grow(self, frames, rows):
        self.frames = frames
        assert all(row < len(self.settings) for row in rows)

    def figures(self, row):
        factor = 1.0 if self.frames < self.narrow_from else 0.5
        return {
            sensor: {name: replace(e, high=max(e.value, factor * e.high)) for name, e in figures.items()}
            for sensor, figures in self.settings[row].items()
        }


class FakeSearch:
    """A search with given errors and costs."""

    plan = SimpleNamespace(options=DRIVE)

    def __init__(self, ladders, *, rows, cpu, **more):
        self.ladders = ladders
        self.samples = {kind: FakeSample(of, **more) for kind, of in rows.items()}
        self.cpu = cpu

    def sample(self, kind):
        return self.samples[kind]

    def cost(self, rows):
        cpu = sum(self.cpu[kind][row] for kind, row in rows.items())
        return DriveCost(around(cpu, least=0.9, most=1.1), 0.1)


SCANNER = SimpleNamespace(spec=SimpleNamespace(images=("rgb", "depth")))
RAYS = Ladder("scanners", (SCANNER,), tuple(Row((("rays", n),), n) for n in (1, 7, 19)))
PIXELS = Ladder("cameras", (SCANNER,), tuple(Row((("supersample", n),), n * n) for n in (1, 2, 3)))


def scanner_row(*errors):
    """Figures of scanners with these errors at 99.9 %, twice as much at the upper end; a tenth at 99 %."""
    figures = [{"range_99_m": around(e / 10), "range_99.9_m": around(e)} for e in errors]
    return {f"scanner_{k}": of for k, of in enumerate(figures)}


def camera_row(levels):
    """Figures of a camera of colours and depths, whose depths err by 2 mm, up to 4 mm."""
    return {"eye": {"rgb_rms": around(levels), "depth_99.9_m": around(0.002)}}


ROWS = {
    "scanners": [scanner_row(0.1, 0.2), scanner_row(0.02, 0.04), scanner_row(0.004, 0.009)],
    "cameras": [camera_row(4.0), camera_row(1.0), camera_row(0.5)],
}
CPU = {"scanners": (0.1, 0.4, 0.9), "cameras": (0.3, 0.7, 2.0)}


def search_of(*ladders, **more):
    return FakeSearch({ladder.kind: ladder for ladder in ladders}, rows=ROWS, cpu=CPU, **more)


def accurate(text, *ladders, **more):
    search = search_of(*ladders, **more)
    return settings_of_rows(search.ladders, find_accurate(search, read_accuracy(text)))


def affordable(budget, *ladders, workers=1):
    search = search_of(*ladders)
    rows = find_affordable(search, budget=budget, pace=read_budget(budget), workers=workers)
    return settings_of_rows(search.ladders, rows)


@pytest.mark.parametrize(
    ("text", "rays"),
    [
        ("0.5m", 1),
        ("40cm", 1),  # the upper end of the worse scanner
        ("39cm", 1),  # 20 cm, up to 40 cm; 7 rays are sure, but seven times as many
        ("8cm", 7),
        ("5cm", 19),  # 7 rays have 4 cm, up to 8 cm
        ("1cm@99", 7),
    ],
)
def test_the_first_row_is_picked_whose_upper_end_is_within_the_accuracy_unless_it_is_too_dear(text, rays):
    assert accurate(text, RAYS) == {"rays": rays}


def test_a_sample_grows_until_it_answers():
    growing = search_of(RAYS, narrow_from=6)
    assert find_accurate(growing, read_accuracy("1cm")) == {"scanners": 2}  # 9 mm, at first up to 18 mm
    assert growing.samples["scanners"].frames == 6
    unsure = search_of(RAYS)
    with pytest.raises(InputError, match=r"rays=19 comes nearest with 9 mm .4.5 mm to 1.8 cm.: give 9 mm"):
        find_accurate(unsure, read_accuracy("8mm"))
    assert unsure.samples["scanners"].frames == search.SAMPLES[-1]
    hopeless = search_of(RAYS)
    with pytest.raises(InputError, match="no number of rays reaches 1 mm"):
        find_accurate(hopeless, read_accuracy("1mm"))
    assert hopeless.samples["scanners"].frames == search.SAMPLES[0]


def test_where_the_largest_sample_does_not_decide_the_estimate_does():
    assert accurate("1cm", RAYS) == {"rays": 19}  # 9 mm, up to 18 mm
    assert accurate("4.5cm", RAYS) == {"rays": 19}  # which are sure; 7 rays have 4 cm, up to 8 cm


@pytest.mark.parametrize(
    ("budget", "rays"),
    [("9x-realtime", 1), ("2.2x-realtime", 7), ("2.3x-realtime", 1), ("0.1x-realtime", 19)],
)
def test_the_last_row_whose_upper_end_is_within_the_budget_is_picked(budget, rays):
    assert affordable(budget, RAYS) == {"rays": rays}


@pytest.mark.parametrize(
    ("text", "settings"),
    [
        ("3levels", {"rays": 1, "supersample": 2}),
        ("8levels", {"rays": 1, "supersample": 1}),
        ("1.9levels", {"rays": 1, "supersample": 3}),
        ("8cm,3levels", {"rays": 7, "supersample": 2}),
    ],
)
def test_rigs_with_scanners_and_cameras_have_both_picked(text, settings):
    assert accurate(text, RAYS, PIXELS) == settings


@pytest.mark.parametrize(
    ("budget", "settings"),
    [
        ("2x-realtime", {"rays": 1, "supersample": 1}),
        ("1.2x-realtime", {"rays": 7, "supersample": 1}),  # the cheaper step is taken first
        ("0.7x-realtime", {"rays": 7, "supersample": 2}),
        ("0.1x-realtime", {"rays": 19, "supersample": 3}),
    ],
)
def test_the_cheaper_step_is_taken_first(budget, settings):
    assert affordable(budget, RAYS, PIXELS) == settings


def test_settings_that_are_given_are_not_picked():
    fixed = replace(PIXELS, rows=(Row(),))
    assert accurate("8cm", RAYS, fixed) == {"rays": 7}
    assert affordable("0.1x-realtime", RAYS, fixed) == {"rays": 19}


def test_depths_need_no_setting_and_are_refused_beyond_what_files_hold():
    assert accurate("1cm", replace(PIXELS, rows=(Row(),))) == {}
    with pytest.raises(
        InputError, match=r"no image reaches .* of the depths; it comes nearest .*: give 2 mm"
    ):
        accurate("1.9mm", replace(PIXELS, rows=(Row(),)))


def test_budgets_and_colours_that_none_reaches_are_one_line_with_the_nearest():
    with pytest.raises(InputError, match=r"even rays=1 is simulated at 9\.1 x real time with 1 worker"):
        affordable("10x-realtime", RAYS)
    with pytest.raises(
        InputError, match=r"supersample=3 comes nearest with 0.5 levels .*: give 0.5 levels or more"
    ):
        accurate("0.4levels", PIXELS)


def test_more_workers_afford_more(monkeypatch):
    monkeypatch.setattr("os.cpu_count", lambda: 4)
    assert [affordable("2x-realtime", RAYS, workers=w)["rays"] for w in (1, 2, 9)] == [7, 19, 19]


def test_errors_that_are_given_as_the_nearest_are_enough(monkeypatch):
    monkeypatch.setitem(ROWS, "scanners", [scanner_row(0.00617)] * 3)
    with pytest.raises(InputError, match=r"give 6.2 mm or more"):
        accurate("6mm", RAYS)
    assert accurate("6.2mm", RAYS) == {"rays": 1}


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
    found = range_estimates([error, error], complete=True)
    assert found["range_90_m"].value == 0
    assert found["range_95_m"].value == pytest.approx(0.1)
    assert found["lost"].value == pytest.approx(6 / 12)


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

    found = range_estimates([sampled(errors) for errors in every], complete=False)
    for percent, tolerance in ((50, 0.2), (90, 0.2), (99, 0.1), (99.9, 0.01)):
        true, one = np.quantile(every, percent / 100), found[f"range_{percent}_m"]
        assert one.value == pytest.approx(true, rel=tolerance)
        assert one.low <= one.value <= one.high


@pytest.mark.full
def test_intervals_of_a_drive_that_is_sampled_whole_do_not_depend_on_how_its_frames_differ():
    rng = np.random.default_rng(1)
    quiet, busy = 0.001 * rng.random(2000), 0.001 * rng.random(2000)
    busy[:30] = 0.2  # 1.5 % of its returns, 0.75 % of all

    def one(errors):
        return SampledError(errors, np.ones(len(errors)), missed=0.0, extra=0.0, returns=float(len(errors)))

    frames = [one(quiet), one(busy)] * 10
    part, whole = (range_estimates(frames, complete=complete)["range_99_m"] for complete in (False, True))
    assert part.value == whole.value < 0.001
    assert part.high == 0.2  # most of the frames of another drive may be of the busy kind
    assert whole.high < 0.001


@pytest.fixture(scope="module", autouse=True)
def quick():
    """Smaller samples, so that a search takes a second."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pick, "SCANNERS", tuple(("rays", n, float(n)) for n in (1, 7, 61)))
        patch.setattr(pick, "CAMERAS", ((1, 1), (3, 3)))
        measure_little(patch)
        yield


@pytest.fixture(scope="module")
def sampled(scene):
    """Errors of 1, 7 and 61 rays on the drive."""
    plan = plan_drive(scene, DRIVE)
    rays = [replace(DRIVE.recording_settings.scanner, rays=count) for count in (1, 7, 61)]
    found = DriveSample(plan, plan.sensors, settings=rays, progress=silent)
    found.grow(3)
    return found


def drive_to(scene, out, *, options=DRIVE, by):
    pick = pick_settings(scene, options, wanted=by, out=out)
    return driven(scene, out, options=options, wanted=by, pick=pick)


@pytest.fixture(scope="module")
def between(sampled):
    """An accuracy that takes 7 rays."""
    one, seven = (sampled.figures(row)["lidar_top"]["range_99_m"] for row in (0, 1))
    assert seven.high < one.value
    return f"{500 * (seven.high + one.value):.6f}mm@99"


def test_more_rays_err_less_and_a_sample_grows_to_the_whole_drive(scene, sampled):
    for figure in ("range_99_m", "range_99.9_m"):
        one, _, most = (sampled.figures(row)["lidar_top"][figure].value for row in range(3))
        assert most < one
    assert (sampled.counts, sampled.complete) == ({"lidar_top": 3}, False)
    plan = plan_drive(scene, DRIVE)
    whole = DriveSample(plan, plan.sensors, settings=[DRIVE.recording_settings.scanner], progress=silent)
    whole.grow(9)
    assert (whole.counts, whole.complete) == ({"lidar_top": 5}, True)


def test_a_drive_holds_what_was_asked_picked_expected_and_reached(scene, between, tmp_path):
    by = AccuracyOptions(between)
    done = drive_to(scene, tmp_path / "a", by=by)
    manifest = open_dataset(tmp_path / "a").manifest
    notes = manifest["accuracy"]
    assert notes["asked"] == {"accuracy": by.accuracy}
    assert notes["picked"] == {"rays": 7}
    assert manifest["recipe"]["settings"] == [["rays", "7"]]
    expected, reached = (notes[f"{name}_error_m"]["lidar_top"] for name in ("expected", "reached"))
    assert expected["low"] <= expected["value"] <= expected["high"] <= read_accuracy(by.accuracy).metres
    assert 0 < reached["low"] <= reached["value"] <= reached["high"]
    assert notes["spot_check"]["lidar_top"]["frames"] == 5
    assert "rays=7" in done.pick.to_text()
    assert done.accuracy()["expected_cpu_s"]["value"] > 0
    assert "cpu" not in json.dumps(notes)
    drive(scene, tmp_path / "set", options=replace(DRIVE, settings=(("rays", "7"),)))
    assert Paths(tmp_path / "a").journal.read_bytes() == Paths(tmp_path / "set").journal.read_bytes()
    manifest = json.loads(Paths(tmp_path / "a").manifest.read_text())
    for key in ("reached_error_m", "spot_check"):
        del manifest["accuracy"][key]
    shutil.copytree(tmp_path / "a", tmp_path / "b")
    Paths(tmp_path / "b").manifest.write_text(json.dumps(manifest | {"frames_done": 0}))
    next((tmp_path / "b").glob("*/pcd/*")).unlink()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(search, "pick_by_sample", None)  # an earlier run has picked
        again = drive_to(scene, tmp_path / "b", by=by)
    assert (again.summary.resumed, again.pick.settings) == (4, {"rays": 7})
    assert "as picked before" in again.pick.to_text()
    same_files(tmp_path / "a", tmp_path / "b")


def test_tolerances_that_noise_or_steps_hide_are_not_picked(monkeypatch):
    tolerances = tuple(("footprint", metres, 1 / metres) for metres in (0.1, 0.01, 0.0005))
    monkeypatch.setattr(pick, "SCANNERS", tolerances)
    sensors = sensors_of(load_rig("vlp16"), DRIVE)
    exact, survey = (
        ladders_of(options, sensors, free=("scanners",))["scanners"]
        for options in (DRIVE, replace(DRIVE, fidelity="survey"))
    )
    labels = [[label_of(of.values(row)) for row in range(len(of.rows))] for of in (exact, survey)]
    assert labels == [
        ["rays=1", "footprint=10cm", "footprint=1cm", "footprint=500µm"],
        ["rays=19", "footprint=10cm", "footprint=1cm"],
    ]


def test_a_picked_tolerance_is_in_the_recipe_and_the_drive_is_resumed_with_it(scene, tmp_path):
    by = AccuracyOptions("3cm@99")
    expected = SensorErrors(99.0, ranges={"lidar_top": around(0.01)})
    picked = Pick(by.request, {"footprint": 0.03}, expected)
    done = driven(scene, tmp_path / "a", options=DRIVE, wanted=by, pick=picked)
    manifest = open_dataset(tmp_path / "a").manifest
    assert manifest["recipe"]["settings"] == [["footprint", "0.03"]]
    assert 0 < done.reached.reached.ranges["lidar_top"].value < 0.03
    again = pick_settings(scene, DRIVE, wanted=by, out=tmp_path / "a")
    assert (again.settings, again.expected, again.label) == (picked.settings, expected, "footprint=3cm")


EYE_AND_LASER = """
name = "both"
vehicle = "car"
[[lidar]]
name = "lidar_top"
preset = "vlp16"
translation = [0.0, 0.0, 1.9]
[[camera]]
name = "front"
translation = [1.0, 0.0, 1.6]
width = 64
height = 48
fx = 60.0
images = ["rgb"]
"""


def test_a_drive_that_missed_is_resumed_with_the_next_finer_setting_of_the_sensors_that_did(scene, tmp_path):
    rig, out = tmp_path / "both.toml", tmp_path / "a"
    rig.write_text(EYE_AND_LASER)
    options, by = replace(DRIVE, rig=str(rig)), AccuracyOptions("1mm@99")
    with pytest.raises(InputError, match="there is no drive with `accuracy` 1mm@99"):
        pick_settings(scene, options, wanted=replace(by, resume=True), out=out)
    coarse = Pick(by.request, {"rays": 1}, SensorErrors(99.0))
    first = driven(scene, out, options=options, wanted=by, pick=coarse)
    assert "the same command with --resume" in first.missed()[0]
    images = {path: path.stat().st_mtime_ns for path in (out / "front").glob("*/*.png")}
    finer = pick_settings(scene, options, wanted=replace(by, resume=True), out=out)
    assert finer.settings == {"rays": 7}
    assert finer.to_text().startswith("picked rays=7, the next finer; recorded again: lidar_top has")
    second = driven(scene, out, options=options, wanted=replace(by, resume=True), pick=finer)
    assert images == {path: path.stat().st_mtime_ns for path in (out / "front").glob("*/*.png")}
    assert second.summary.resumed == len(images)
    fresh = replace(finer, again={})
    driven(scene, tmp_path / "b", options=options, wanted=by, pick=fresh)
    same_files(out, tmp_path / "b")
    error = [done.reached.reached.ranges["lidar_top"].value for done in (first, second)]
    assert error[1] < error[0]
    again = pick_settings(scene, options, wanted=by, out=out)  # without the flag: as it was recorded
    assert (again.settings, again.again) == (finer.settings, {})


def test_settings_that_contradict_and_rigs_without_scanners_are_one_line(scene, tmp_path):
    words = ["drive", scene.path, "--route", "random", "--duration", "0.5"]
    for more, line in (
        (["--accuracy", "1cm", "--set", "rays=3"], "--set rays=3: --accuracy picks it"),
        (["--budget", "1x-realtime", "--set", "stretch=on"], "--set stretch=on: --budget picks rays"),
        (["--accuracy", "1cm", "--set", "footprint=1cm"], "footprint=1cm: --accuracy picks it"),
        (["--budget", "1x-realtime", "--scheduler", "tcp://a:1"], "--budget is for this machine"),
        (["--accuracy", "1cm@42"], "--accuracy 1cm@42: after the @ give one of 50, 68"),
        (["--accuracy", "1cm", "--resume", "--overwrite"], "--resume keeps files of the drive"),
        (["--resume"], "--resume is for drives that missed an accuracy"),
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


@pytest.mark.full
def test_a_rig_of_a_camera_drives_to_levels_and_to_depths(scene, tmp_path):
    rig = tmp_path / "eye.toml"
    rig.write_text(EYE.replace("IMAGES", '["rgb", "depth"]'))
    options = replace(DRIVE, rig=str(rig))
    plan = plan_drive(scene, options)
    images = [
        replace(options.recording_settings.camera, supersample=side, edge_rays=at_edges)
        for side, at_edges in ((3, 3), (1, 2))
    ]
    sampled = DriveSample(plan, plan.sensors, settings=images, progress=silent)
    sampled.grow(3)
    many, one = (sampled.figures(row)["front"]["rgb_rms"] for row in (0, 1))
    low, high = many.high, one.value
    assert 0 < low < high
    by = AccuracyOptions(f"1cm,{(low + high) / 2:.3f}levels")
    done = drive_to(scene, tmp_path / "d", options=options, by=by)
    manifest = open_dataset(tmp_path / "d").manifest
    notes = manifest["accuracy"]
    assert notes["picked"] == {"supersample": 3, "edge_rays": 3}
    assert manifest["recipe"]["settings"] == [["supersample", "3"], ["edge_rays", "3"]]
    for kind in ("expected", "reached"):
        assert 0 < notes[f"{kind}_error_levels"]["front"]["value"] < (low + high) / 2
        assert 0 < notes[f"{kind}_depth_error_m"]["front"]["value"] <= 0.0021
    assert "levels) for front" in done.to_text()
    assert pick_settings(scene, options, wanted=AccuracyOptions("5mm")).settings == {}
    with pytest.raises(InputError, match="`settings` supersample=2: `accuracy` picks it"):
        pick_settings(scene, replace(options, settings=(("supersample", "2"),)), wanted=by)


@pytest.mark.full
def test_the_program_says_what_it_picks_and_what_was_reached(scene, tmp_path):
    words = ["drive", scene.path, "--route", "random", "--duration", "0.5", "--rig", "vlp16", "--seed", "3"]
    words += ["--format", "pcd"]
    ended = run_program("lidar", *words, "--budget", "0.01x-realtime", "-o", tmp_path / "d")
    assert ended.returncode == 0, ended.stderr
    first, _, last = ended.stdout.splitlines()
    assert first.startswith("picked rays=61: 99.9 % of the range errors should be below ")
    assert "x real time with" in first
    assert first.endswith("included")
    assert last.startswith("spot check of 5 frames: 99.9 % of the range errors are below ")
    ended = run_program("lidar", *words, "--spot-check", "--json", "-o", tmp_path / "e")
    assert json.loads(ended.stdout)["accuracy"]["reached_error_m"]["lidar_top"]["value"] > 0
    manifest = open_dataset(tmp_path / "e").manifest
    assert "picked" not in manifest["accuracy"]


def test_a_missed_accuracy_or_budget_is_named():
    errors = ROWS["scanners"][0]
    reached = SpotCheck(stated(errors, percent=99.9, kinds=("ranges",)), errors, dict.fromkeys(errors, 5))
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


@pytest.mark.full
def test_drives_of_a_sweep_have_picks_of_their_own(scene, between, tmp_path, monkeypatch):
    (tmp_path / "grid.toml").write_text(
        f'[drive]\nroute = "random"\nrig = "vlp16"\nduration = 0.5\nformat = ["pcd"]\nseed = 3\n'
        f'[grid]\nscene = ["{scene.path}"]\naccuracy = ["{between}", "100m@50", "1um"]\n'
    )
    with monkeypatch.context() as patch:  # other processes check samples of full size
        patch.setattr("lidar.tools.sweep.run.run_tasks", lambda work, tasks, **_: map(work, tasks))
        summary = sweep(tmp_path / "grid.toml", tmp_path / "out")
    assert [row.state for row in summary.rows] == ["done", "done", "failed"]
    assert "no number of rays reaches 1 µm" in summary.rows[2].error
    assert [row.picked for row in summary.rows] == ["rays=7", "rays=1", ""]
    assert all("range errors are below" in row.reached for row in summary.rows[:2])
    picks = [open_dataset(summary.path / row.name).manifest["accuracy"]["picked"] for row in summary.rows[:2]]
    assert picks == [{"rays": 7}, {"rays": 1}]


def test_a_budget_leaves_time_for_planning_and_loading():
    more = {"duration": 0.5, "planning": 0.2, "loading": 0.05}  # half as much again as the drive
    assert pace_of("1x-realtime", **more) == pytest.approx(2.0)
    with pytest.raises(InputError, match=r"allows 0.25 s for a drive of 0.5 s, and planning took 0.2 CPU s"):
        pace_of("2x-realtime", **more)


@pytest.mark.full
def test_a_drive_within_a_budget_is_planned_once(scene, tmp_path, monkeypatch):
    plans = []

    def counted(*args, **more):
        plans.append(args)
        return plan_drive(*args, **more)

    monkeypatch.setattr(search, "plan_drive", counted)
    monkeypatch.setattr("lidar.simulation.drive.plan_drive", counted)
    by = AccuracyOptions(budget="0.001x-realtime")
    pick = pick_settings(scene, DRIVE, wanted=by)
    assert pick.cost.speed < pick.cost.threads / pick.cost.cpu_s.value
    done = driven(scene, tmp_path / "d", options=DRIVE, wanted=by, pick=pick)
    assert len(plans) == 1
    assert done.speed < done.summary.duration / done.summary.recording
    drive(scene, tmp_path / "set", options=replace(DRIVE, settings=(("rays", "61"),)))
    assert Paths(tmp_path / "d").journal.read_bytes() == Paths(tmp_path / "set").journal.read_bytes()
