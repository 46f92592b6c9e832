"""Scores, calibrations and fusion against figures that are known."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

from lidar.errors import InputError
from lidar.tools.defences.calibration import (
    FUSIONS,
    Calibration,
    calibration_text,
    fuse_verdicts,
    fused_threshold,
    joint_of,
    read_calibration,
    tail_of,
)
from lidar.tools.defences.defence import Verdict
from lidar.tools.defences.registry import DEFENCES, defence_rows, read_defences
from lidar.tools.defences.scores import FALSE_ALARMS, SuspicionCounts, score, threshold_at


def normal_frames(rng, shift, frames=100, each=100):
    """Suspicions of two normal distributions a ``shift`` apart, squeezed to 0 to 1."""
    rows = []
    for _ in range(frames):
        truth = rng.random(each) < 0.3
        rows.append((norm.cdf(rng.standard_normal(each) + shift * truth), truth))
    return rows


def test_area_and_detection_are_those_of_two_normal_distributions():
    rng = np.random.default_rng(3)
    samples = SuspicionCounts.of(normal_frames(rng, 1.5))
    threshold = threshold_at(samples, 0.05)
    found = score(samples, threshold=threshold, rng=rng)
    assert found.auc[0] == pytest.approx(norm.cdf(1.5 / np.sqrt(2)), abs=0.01)
    assert found.tpr[0] == pytest.approx(1 - norm.cdf(norm.ppf(0.95) - 1.5), abs=0.04)
    assert found.fpr[0] <= 0.05
    for value, low, high in (found.auc, found.tpr, found.fpr):
        assert low < value < high
    assert found.genuine + found.attacked == 100 * 100
    x, y = np.array(found.roc).T
    assert (np.diff(x) >= 0).all()
    assert np.trapezoid(y, x) == pytest.approx(found.auc[0], abs=0.01)


@pytest.mark.full
def test_intervals_hold_the_truth_as_often_as_they_say():
    rng, truth, inside = np.random.default_rng(4), norm.cdf(1 / np.sqrt(2)), 0
    for _ in range(30):
        found = score(SuspicionCounts.of(normal_frames(rng, 1.0, frames=30, each=30)), threshold=0.9, rng=rng)
        inside += found.auc[1] <= truth <= found.auc[2]
    assert inside >= 25  # 95 % of 30 is 28.5; 25 is 3 standard deviations below


def test_frames_that_are_alike_within_give_wide_intervals():
    """Returns of a frame are not independent: a bootstrap of returns would be far too sure."""
    rng = np.random.default_rng(5)
    rows = [(np.full(500, rng.random()), np.full(500, k % 2 == 0)) for k in range(20)]
    _, low, high = score(SuspicionCounts.of(rows), threshold=0.5, rng=rng).tpr
    assert high - low > 0.25


def calibrated(rng):
    samples = SuspicionCounts.of([(rng.random(1000), np.zeros(1000, bool)) for _ in range(100)])
    levels = [(name, level) for name in ("one", "other") for level in ("returns", "objects", "frames")]
    return Calibration(dict.fromkeys(levels, tail_of(samples)), "uniform")


def test_a_calibration_gives_the_share_of_genuine_samples_and_survives_its_file(tmp_path):
    found = calibrated(np.random.default_rng(6))
    (tmp_path / "c.toml").write_text(calibration_text(found))
    again = read_calibration(tmp_path / "c.toml")
    assert again.note == "uniform"
    for level, share in FALSE_ALARMS.items():
        assert again.threshold("one", level) == pytest.approx(1 - share, abs=0.002)
    share = again.tail("one", "returns").of(np.array([0.0, 0.5, 0.9, 0.99, 0.9999, 1.0]))
    assert share[1:4] == pytest.approx([0.5, 0.1, 0.01], rel=0.1)
    assert (np.diff(share) <= 0).all()
    assert share[-1] > 0
    with pytest.raises(InputError, match="calibrate again"):
        again.threshold("third", "frames")
    (tmp_path / "bad.toml").write_text(
        'note = "x"\n[defence.one.returns]\ncount = 1\nshare = [0.1]\nsuspicion = []\n'
    )
    with pytest.raises(InputError, match="no calibration"):
        read_calibration(tmp_path / "bad.toml")


@pytest.mark.parametrize("rule", ["max", "fisher"])
def test_fused_verdicts_of_independent_defences_alarm_as_often_as_they_say(rule):
    rng = np.random.default_rng(7)
    calibration = calibrated(rng)
    n = 200_000
    verdicts = {name: Verdict(rng.random(n), None, float(rng.random())) for name in ("one", "other")}
    found = fuse_verdicts(verdicts, calibration, rule=rule)
    assert found.objects is None
    for level in ("objects", "frames"):  # 1 % and 5 %; 0.1 % is at the end of the tail
        alarms = np.mean(found.returns > fused_threshold(calibration, list(verdicts), level=level, rule=rule))
        assert alarms == pytest.approx(FALSE_ALARMS[level], rel=0.1)
    both = {name: Verdict(np.array([0.97]), None, 0.97) for name in ("one", "other")}
    one = {"one": both["one"], "other": Verdict(np.array([0.3]), None, 0.3)}
    assert (
        fuse_verdicts(both, calibration, rule="fisher").frame
        > fuse_verdicts(one, calibration, rule="fisher").frame
    )


NAMES = ("one", "other", "third", "silent")


def dependent(rng, frames=200, each=100):
    """Suspicions of genuine objects by frame: three defences agree in part, one is silent."""
    for _ in range(frames):
        common = rng.standard_normal(each)
        own = rng.standard_normal((3, each))
        columns = norm.cdf(0.8 * common + 0.6 * own)
        yield dict(zip(NAMES, [*columns, np.zeros(each)], strict=True))


def jointly_calibrated(rng):
    frames = list(dependent(rng))
    tails = {
        (name, level): tail_of(
            SuspicionCounts.of([(row[name], np.zeros(len(row[name]), bool)) for row in frames])
        )
        for name in NAMES
        for level in FALSE_ALARMS
    }
    plain = Calibration(tails, "dependent")
    joint = {level: joint_of(frames, plain, level=level, rng=rng) for level in ("objects", "frames")}
    return replace(plain, joint=joint)


@pytest.mark.full
@pytest.mark.parametrize("names", [NAMES, ("one", "other"), ("third",), ("one", "silent")])
def test_a_harmonic_fusion_alarms_as_often_as_it_says_whatever_defences_have_in_common(names):
    rng = np.random.default_rng(9)
    calibration = jointly_calibrated(rng)
    rows = list(dependent(rng, 1000))
    verdicts = {name: Verdict(None, np.concatenate([row[name] for row in rows]), 0.0) for name in names}
    objects = fuse_verdicts(verdicts, calibration, rule="harmonic").objects
    limit = fused_threshold(calibration, names, level="objects", rule="harmonic")
    assert np.mean(objects > limit) == pytest.approx(FALSE_ALARMS["objects"], rel=0.3)
    bound = fuse_verdicts(verdicts, calibration, rule="max").objects
    known = fused_threshold(calibration, names, level="objects", rule="max")
    if "silent" in names:
        assert np.mean(bound > known) < 0.8 * np.mean(objects > limit), "Bonferroni's bound is too careful"


def test_more_is_fused_than_the_calibration_has_suspicions_of():
    """A defence that was calibrated on other data has the threshold that the rule has by theory."""
    calibration = jointly_calibrated(np.random.default_rng(10))
    tails = {**calibration.tails, ("new", "objects"): calibration.tails["one", "objects"]}
    found = fused_threshold(
        replace(calibration, tails=tails), [*NAMES, "new"], level="objects", rule="harmonic"
    )
    assert found == pytest.approx(-np.log10(FALSE_ALARMS["objects"]) / 6)


@pytest.mark.full
@pytest.mark.parametrize("rule", FUSIONS)
def test_a_fused_suspicion_grows_with_each(rule):
    calibration = jointly_calibrated(np.random.default_rng(11))
    steps = np.linspace(0, 1, 50)
    for name in NAMES[:3]:
        verdicts = {
            other: Verdict(None, steps if other == name else np.full(50, 0.3), 0.0) for other in NAMES
        }
        assert (np.diff(fuse_verdicts(verdicts, calibration, rule=rule).objects) >= -1e-12).all()


def test_defences_are_read_from_text():
    every = read_defences(["all"])
    assert [named.name for named in every] == list(DEFENCES)
    assert len(defence_rows()) == len(every)
    (one,) = read_defences(["occlusion:cell=0.5,core=1"])
    assert one.to_json() == {"name": "occlusion", "valid": 0.05, "spoofed": 0.15, "cell": 0.5, "core": 1.0}
    for text, message in {
        "occlusio": "is occlusion meant",
        "shadow:size=3": "parameter 'size' is unknown",
        "shadow:length": "NAME:KEY=VALUE",
        "occlusion:cell=0.5:core=1": "as in occlusion:cell=0.5,core=1",
        "shadow:length=far": "length = 'far' is not a number",
        "shadow:length=0": "not within 1 to 100",
    }.items():
        with pytest.raises(InputError, match=message):
            read_defences([text])
    with pytest.raises(InputError, match="given twice"):
        read_defences(["shadow", "all"])
    with pytest.raises(InputError, match="give one or more"):
        read_defences([])


def test_a_suspicion_that_most_genuine_samples_have_is_not_unusual():
    """Most returns have suspicion 0; several stored shares are then those of 0."""
    rng = np.random.default_rng(8)
    column = np.where(rng.random(100_000) < 0.97, 0.0, np.where(rng.random(100_000) < 0.5, 0.2, 0.8))
    tail = tail_of(SuspicionCounts.of([(column, np.zeros(len(column), bool))]))
    share = tail.of(np.array([0.0, 0.1, 0.2, 0.5, 0.8]))
    assert share[0] == 1
    true = np.array([np.mean(column >= s) for s in (0.0, 0.1, 0.2, 0.5, 0.8)])
    assert (share >= true / 2.5).all(), "as exact as the stored shares are apart"
    assert (share[1:] < 2.5 * true[1:]).all()
    calibration = Calibration({("one", level): tail for level in ("returns", "frames")})
    verdict = fuse_verdicts({"one": Verdict(column, None, 0.0)}, calibration, rule="max")
    for level in FALSE_ALARMS:
        limit = fused_threshold(calibration, ["one"], level=level, rule="max")
        assert np.mean(verdict.returns > limit) <= FALSE_ALARMS[level]
