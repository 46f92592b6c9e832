"""Errors and costs of settings: known differences, repeatable figures, recommendations, the report."""

import json
from dataclasses import replace
from math import inf

import numpy as np
import pytest
from helpers.pages import text_of

from geoscene.drawing.report import levels, metres
from geoscene.support.progress import silent
from lidar.errors import InputError
from lidar.options.accuracy import TradeoffOptions
from lidar.options.drive import DriveOptions
from lidar.sensors.physics.settings import LEVELS, PLAIN
from lidar.simulation.plan import plan_drive
from lidar.tools.tradeoff.bench import bench_of, chosen_pulses, spread_frames
from lidar.tools.tradeoff.compare import compare_settings, scene_label
from lidar.tools.tradeoff.errors import (
    STATISTICS,
    ErrorEstimate,
    PulseReturns,
    SensorComparison,
    VariantRow,
    estimates,
    frame_error,
    median,
)
from lidar.tools.tradeoff.report import document, pareto, recommendation, write_report
from lidar.tools.tradeoff.sensors import costs, frame_cost
from lidar.tools.tradeoff.variants import Basis, next_step, noiseless, scanner_reference, variants_of
from lidar.world.settings import PLAIN as WHOLE
from lidar.world.settings import WorldSettings

DRIVE = DriveOptions(route="random", rig="vlp16", duration=1.0, seed=3)
FEW = TradeoffOptions(("rays", "poses", "georeferencing"), frames=3, pulses=900, reference_rays=31)


@pytest.fixture(scope="module")
def found(scene):
    return compare_settings(scene, DRIVE, compared=FEW)


def returns(key, distance, klass=None):
    n = len(key)
    xyz = np.column_stack([distance, np.zeros(n), np.zeros(n)]).astype(float)
    kinds = np.ones(n, np.uint8) if klass is None else np.array(klass, np.uint8)
    return PulseReturns(np.array(key, np.int64), np.array(distance, float), kinds, xyz)


def row(label, error, cpu, *, lost=0.0):
    figures = {name: ErrorEstimate(error, error, error) for name in STATISTICS}
    figures |= {name: ErrorEstimate(lost, lost, lost) for name in ("missed", "extra")}
    cost = {name: ErrorEstimate(cpu, cpu, cpu) for name in ("cpu_s", "bytes", "memory_bytes")}
    return VariantRow(label, figures, {}, cost)


def comparison(*rows, residual=0.0):
    gap = {name: ErrorEstimate(residual, residual, residual) for name in STATISTICS}
    return SensorComparison("top (vlp16)", "exact", gap, rows, 10, 1)


def statistics_of(error):
    return estimates([error], seed=1, statistics=STATISTICS)


def test_differences_of_matched_missed_and_extra_returns():
    error = frame_error(
        returns([0, 256, 768], [5.0, 7.5, 9.0], [1, 2, 1]), returns([0, 256, 512], [5.0, 7, 8])
    )
    assert error.range.tolist() == [0.0, 0.5]
    assert (error.missed, error.extra, error.changed, error.returns) == (1, 1, 1, 3)
    np.testing.assert_allclose(error.there, [0, 0.5, 1.0])
    np.testing.assert_allclose(error.back, [0, 0.5, 0.5])
    figures = estimates([error], seed=0, statistics=STATISTICS)
    assert figures["range_rms_m"].value == pytest.approx(0.5 / np.sqrt(2))
    assert figures["chamfer_m"].value == pytest.approx((0.5 + 1 / 3) / 2)
    assert figures["hausdorff_m"].value == pytest.approx(1.0)
    assert figures["missed"].value == pytest.approx(1 / 3)


def test_a_cloud_equals_itself_and_an_empty_one_has_no_error():
    cloud, empty = returns([0, 256], [5.0, 7.0]), returns([], [])
    for one, other in ((cloud, cloud), (empty, empty)):
        assert all(f.value == 0 for f in statistics_of(frame_error(one, other)).values())
    assert frame_error(empty, cloud).missed == 2


def test_intervals_hold_the_value_and_repeat_by_seed():
    frames = [
        frame_error(returns([0, 256], [5.0, 7 + e]), returns([0, 256], [5.0, 7])) for e in (0.1, 0.2, 0.4)
    ]
    one, again = (estimates(frames, seed=5, statistics=STATISTICS) for _ in range(2))
    assert one == again
    rms = one["range_rms_m"]
    assert 0.1 / np.sqrt(2) - 1e-9 <= rms.low < rms.value < rms.high <= 0.4 / np.sqrt(2) + 1e-9
    spent = median([1.0, 9.0, 2.0], seed=0)
    assert (spent.value, spent.low, spent.high) == (2.0, 1.0, 9.0)


def test_the_reference_is_the_exact_end_without_random_effects():
    exact = scanner_reference(LEVELS["survey"], rays=217)
    kept = (exact.rays, exact.poses, exact.mirrors, exact.foliage, exact.link)
    assert kept == (217, "firing", True, True, True)
    off = (exact.range_noise, exact.angle_noise, exact.detection, exact.quantise)
    assert off == ("none", False, False, False)
    assert noiseless(PLAIN) == PLAIN
    assert [next_step(r) for r in (7, 217, 665, 900)] == [11, 326, 998, 999]


def basis(*, world=WHOLE):
    return Basis(noiseless(PLAIN), scanner_reference(PLAIN, rays=31), world)


def labels(*compared, world=WHOLE, **more):
    return [r.label for r in variants_of(basis(world=world), compared=compared, **more)]


def test_variants_change_one_setting_each():
    rows = variants_of(basis(), compared=("rays", "poses"))
    assert [r.label for r in rows] == ["", "rays=7", "rays=19", "poses=column", "poses=frame"]
    assert rows[0].used == PLAIN
    assert rows[1].used == replace(PLAIN, rays=7)
    assert rows[3].alone == replace(PLAIN, rays=31, poses="column")
    (asked, other) = variants_of(basis(), compared=("scene",), scenes=["lod=1"])
    assert (other.label, other.scene, other.choice, asked.choice) == ("scene=lod=1", 1, False, True)
    assert labels("traffic", traffic=True) == ["", "traffic=off"]


def test_cheap_settings_are_combined():
    assert labels("rays", "precision", "reach", "forests")[-8:] == [
        "precision=float32 reach=50",
        "precision=float32 reach=50 forests=off",
        "rays=7 precision=float32",
        "rays=7 precision=float32 reach=50",
        "rays=7 precision=float32 reach=50 forests=off",
        "rays=19 precision=float32",
        "rays=19 precision=float32 reach=50",
        "rays=19 precision=float32 reach=50 forests=off",
    ]
    without = labels("rays", "forests", world=WorldSettings(forests=False))
    assert without == ["", "rays=7", "rays=19", "forests=on"]


def test_samples_are_spread_and_repeat():
    assert spread_frames(100, 4) == (12, 37, 62, 87)
    assert spread_frames(2, 8) == (0, 1)
    rows = chosen_pulses(1000, 100, frame=3, seed=1)
    assert len(np.unique(rows)) == 100
    assert (np.diff(rows) > 0).all()
    assert rows.tolist() == chosen_pulses(1000, 100, frame=3, seed=1).tolist()


def test_errors_on_a_drive(found):
    (one,) = found.comparisons
    asked, *rest = one.rows
    by_label = {r.label: r for r in rest}
    assert asked.label == (
        "as asked (rays=1, footprint=0, poses=firing, precision=exact, retrace=on, mirrors=off, foliage=off)"
    )
    assert list(by_label) == ["rays=7", "rays=19", "poses=column", "poses=frame"]
    tail = {name: r.error["range_99_m"].value for name, r in by_label.items()}
    assert tail["rays=19"] <= tail["rays=7"] <= asked.error["range_99_m"].value < tail["poses=frame"]
    assert by_label["rays=7"].alone["range_rms_m"].value == pytest.approx(
        by_label["rays=7"].error["range_rms_m"].value, abs=1e-4
    )
    assert one.residual["range_99_m"].value <= tail["rays=7"]
    assert all(r.cost["cpu_s"].value > 0 and r.cost["memory_bytes"].value > 2**20 for r in one.rows)
    assert (one.frames, one.samples) == (3, 900)


def test_georeferencing_is_within_its_promise(found):
    assert 0 <= found.georeferencing["99.9_m"] <= found.georeferencing["max_m"] <= 1e-4


@pytest.mark.full
def test_errors_repeat_by_seed(scene, found):
    again = compare_settings(scene, DRIVE, compared=FEW)
    assert [r.error for r in again.comparisons[0].rows] == [r.error for r in found.comparisons[0].rows]


def test_the_report_is_written(found, tmp_path):
    write_report(found, tmp_path / "out")
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert {"tradeoff.json", "tradeoff.html"} < names
    assert any(name.startswith("pareto_") for name in names)
    written = json.loads((tmp_path / "out/tradeoff.json").read_text())
    assert written == json.loads(json.dumps(document(found)))
    assert len(written["sensors"][0]["recommendations"]) == 3
    page = (tmp_path / "out/tradeoff.html").read_text()
    assert "data:image/png;base64," in page
    assert "http" not in text_of(page)


def test_the_cheapest_sufficient_setting_is_recommended():
    rows = (row("as asked (rays=1)", 0.2, 1.0), row("rays=7", 0.3, 4.0), row("rays=19", 0.02, 9.0))
    several = comparison(*rows, row("rays=61", 0.005, 30.0), residual=0.002)
    assert [r.label for r in pareto(several)] == ["as asked (rays=1)", "rays=19", "rays=61"]
    assert "cheapest setting is rays=19: 2 cm" in recommendation(several, 0.1)
    assert "cheapest setting is rays=61" in recommendation(several, 0.01)
    none = recommendation(several, 0.001)
    assert "no setting that was compared is sure to be enough; nearest is rays=61: 5 mm" in none
    loose = comparison(row("rays=61", 0.0005, 30.0), residual=0.002)
    assert "certain to 2 mm only" in recommendation(loose, 0.001)


def test_recommendations_count_the_upper_end_of_the_interval():
    unsure = row("rays=7", 0.008, 4.0)
    unsure.error["range_99.9_m"] = ErrorEstimate(0.008, 0.002, 0.03)
    several = comparison(unsure, row("rays=19", 0.009, 9.0))
    said = recommendation(several, 0.01)
    assert "cheapest setting is rays=19" in said
    assert "9 mm, 9 mm at the upper end of the 95 % interval" in said
    assert "nearest is rays=19: 9 mm" in recommendation(several, 0.001)


def test_levels_have_a_singular():
    assert [levels(v) for v in (0, 0.5, 1.0, 3.0)] == ["0 levels", "0.5 levels", "1 level", "3 levels"]


def test_settings_that_lose_returns_are_not_recommended():
    rows = (row("as asked (rays=1)", 0.02, 2.0), row("reach=25", 0.02, 1.0, lost=0.1))
    assert "cheapest setting is as asked (rays=1)" in recommendation(comparison(*rows), 0.1)
    assert "all miss or add more than 0.1 %" in recommendation(comparison(rows[1]), 0.1)


def test_lengths_have_fitting_units():
    assert [metres(v) for v in (0, 3e-8, 2e-6, 0.0015, 0.25, 12.0)] == [
        "0",
        "30 nm",
        "2 µm",
        "1.5 mm",
        "25 cm",
        "12 m",
    ]


def test_scenes_are_named_by_what_differs(scene, scene_utm):
    assert scene_label(scene, scene_utm).startswith("crs=")
    assert scene_label(scene, scene) == scene.path.name


def test_bad_input_is_one_clear_line(scene, scene_utm):
    def refused(*names, match, **more):
        with pytest.raises(InputError, match=match):
            compare_settings(scene, DRIVE, compared=TradeoffOptions(names, **more))

    refused("leaves", match=r"`compare` 'leaves' is unknown \(known are rays")
    refused("rays", "shadows", match="`compare` shadows: a setting of cameras, and none is compared")
    refused("scene", match="`compare` scene: no other scene is given")
    refused("traffic", match="`compare` traffic: the drive has none")
    refused(sensors=("roof",), match="`sensors` roof: not in rig vlp16; there are lidar_top")
    with pytest.raises(InputError, match="another frame"):
        compare_settings(scene, DRIVE, compared=FEW, others=[scene_utm])
    with pytest.raises(InputError, match="`frames` 1: give 2 to 1000"):
        TradeoffOptions(frames=1)


@pytest.mark.full
def test_kinds_of_objects_that_a_place_lacks_have_no_effect(scene):
    compared = TradeoffOptions(
        ("forests", "trees", "barriers", "furniture"), frames=2, pulses=200, reference_rays=7
    )
    (one,) = compare_settings(scene, DRIVE, compared=compared).comparisons
    rows = {r.label: r for r in one.rows}
    assert rows["forests=off"].note == "no effect on what was sampled: forests=off"
    assert rows["furniture=off"].note == ""
    assert (rows["forests=off"].choice, rows["furniture=off"].choice) == (False, True)
    assert rows["furniture=off"].error["range_max_m"].value > one.rows[0].error["range_max_m"].value


@pytest.mark.full
def test_rows_of_the_world_are_timed_in_their_own_world(scene, monkeypatch):
    bench = bench_of(plan_drive(scene, DRIVE), frames=2)
    (scanner,) = bench.plan.sensors
    variants = variants_of(basis(), compared=("reach",))[:2]
    used = []

    def counted(bench, sensor, *, variant, frame):
        used.append(variant.world.reach)
        return frame_cost(bench, sensor, variant=variant, frame=frame)

    monkeypatch.setattr("lidar.tools.tradeoff.sensors.frame_cost", counted)
    found = costs(bench, scanner, variants=variants, repetitions=3, progress=silent)
    assert used == [inf, *[inf, 25.0] * 3]
    assert all(f["cpu_s"].value > 0 and f["memory_bytes"].value > 2**20 for f in found)
