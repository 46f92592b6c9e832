"""Stages on fixes and inertial samples: their files, truth files, and the same on recorded data."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from lidar.dataset.layout import Paths, open_dataset, read_rows
from lidar.dataset.navigation_files import read_fixes, read_samples
from lidar.errors import InputError, LidarError
from lidar.options.data import ApplyOptions
from lidar.options.drive import DriveOptions
from lidar.parameters import parameter
from lidar.sensors.navigation.nmea import height_note, nmea
from lidar.signal.registry import NamedStage
from lidar.signal.stage import Stage
from lidar.simulation.drive import drive
from lidar.tools.apply import apply_stages

RIG = """
name = "navigation"
[[gnss]]
name = "roof"
translation = [0.5, 0.0, 1.6]
mode = "rtk"
constellations = ["gps", "galileo", "glonass"]
rate_hz = 5.0
[[imu]]
name = "unit"
gyro_noise = 1e-4
accel_noise = 1e-3
rate_hz = 100.0
"""


@dataclass(frozen=True)
class Drifting(Stage):
    """Fixes drift to the north; every tenth is lost."""

    rate: float = parameter(2.0, "degrees * 1e-6 a second")

    def fixes(self, fixes, *, at, rng):
        assert at.poses(fixes.time_ns).position.shape == (len(fixes), 3)
        lonlath = fixes.lonlath.copy()
        lonlath[:, 1] += self.rate * 1e-6 * fixes.time_ns / 1e9
        lost = rng.random(len(fixes)) < 0.1
        lonlath[lost] = np.nan
        quality = np.where(lost, 0, fixes.quality).astype(np.int8)
        return replace(fixes, lonlath=lonlath, quality=quality, true_lonlath=lonlath)


@dataclass(frozen=True)
class Biased(Stage):
    """A gyroscope turns by more than it does, from 2 s on."""

    def samples(self, samples, *, at, rng):
        del at
        gyro = samples.gyro + rng.normal(0, 0.01, samples.gyro.shape) * (samples.time_ns >= 2e9)[:, None]
        return replace(samples, gyro=gyro)


STAGES = (NamedStage("drifting", Drifting()), NamedStage("biased", Biased()))


@pytest.fixture(scope="module")
def options(tmp_path_factory):
    rig = tmp_path_factory.mktemp("rig") / "navigation.toml"
    rig.write_text(RIG)
    return DriveOptions(rig=str(rig), duration=5.0, seed=1)


@pytest.fixture(scope="module")
def plain(scene, options, tmp_path_factory):
    out = tmp_path_factory.mktemp("plain") / "a"
    drive(scene, out, options=options)
    return out


@pytest.fixture(scope="module")
def altered(scene, options, tmp_path_factory):
    out = tmp_path_factory.mktemp("altered") / "a"
    drive(scene, out, options=replace(options, stages=STAGES))
    return out


def numbers(path, *names):
    return np.array([[float(row[name]) for name in names] for row in read_rows(path)])


def test_measurements_change_and_the_truth_of_both_stays(plain, altered):
    assert not (plain / "roof.truth.csv").exists()
    before, after = (numbers(folder / "roof.csv", "lat", "lon") for folder in (plain, altered))
    time_ns = numbers(plain / "roof.csv", "time_ns")[:, 0]
    kept = np.isfinite(after[:, 0])
    assert 0 < np.count_nonzero(~kept) < len(kept) / 2
    assert after[kept, 0] - before[kept, 0] == pytest.approx(2e-15 * time_ns[kept], abs=1e-12)
    truth = numbers(altered / "roof.truth.csv", "changed", "lat", "lon")
    assert np.array_equal(truth[:, 1:], before)
    assert np.array_equal(truth[1:, 0], np.ones(len(kept) - 1))  # the drift of the first fix is 0
    for name in ("true_lat", "true_h", "true_east"):
        assert np.array_equal(numbers(plain / "roof.csv", name), numbers(altered / "roof.csv", name))
    sentences = (altered / "roof.nmea").read_text()
    assert sentences.count("GGA") == len(kept)
    assert sentences.count(",V,") == np.count_nonzero(~kept)
    gyro = [numbers(folder / "unit.csv", "time_ns", "gyro_x")[:, :] for folder in (plain, altered)]
    late = gyro[0][:, 0] >= 2e9
    assert np.array_equal(gyro[0][~late], gyro[1][~late])
    assert (gyro[0][late, 1] != gyro[1][late, 1]).all()
    truth = numbers(altered / "unit.truth.csv", "changed", "gyro_x")
    assert np.array_equal(truth, np.column_stack([late, gyro[0][:, 1]]))


def test_applied_to_the_record_stages_give_the_files_of_the_drive(plain, altered, tmp_path):
    assert apply_stages(plain, tmp_path / "a", options=ApplyOptions(STAGES)).files == 2
    for name in ("roof.csv", "roof.nmea", "roof.truth.csv", "unit.csv", "unit.truth.csv"):
        assert (tmp_path / "a" / name).read_bytes() == (altered / name).read_bytes(), name
    apply_stages(plain, tmp_path / "b", options=ApplyOptions(STAGES[1:]))
    assert (tmp_path / "b" / "roof.nmea").read_bytes() == (plain / "roof.nmea").read_bytes()
    assert not (tmp_path / "b" / "roof.truth.csv").exists()


def test_files_of_receivers_and_inertial_units_read_back(plain):
    dataset = open_dataset(plain)
    fixes, heights = read_fixes(dataset.paths, "roof", vertical=dataset.frame.vertical)
    assert fixes.used.sum(axis=1).max() >= 6
    again = nmea(fixes, dataset.start, vertical=heights.vertical, separation=heights.separation)
    text = height_note(heights.vertical, heights.geoid) + "".join(again)
    assert text == (plain / "roof.nmea").read_bytes().decode()
    samples = read_samples(plain / "unit.csv").accel
    assert np.array_equal(samples, numbers(plain / "unit.csv", "accel_x", "accel_y", "accel_z"))


@pytest.mark.full
def test_overwriting_removes_truth_files(scene, options, tmp_path):
    drive(scene, tmp_path / "a", options=replace(options, stages=STAGES))
    drive(scene, tmp_path / "a", options=options, overwrite=True)
    assert not list(Paths(tmp_path / "a").root.glob("*.truth.csv"))


def test_stages_need_the_sensors_that_they_act_on(scene, options, plain, tmp_path):
    alone = replace(options, rig="vlp16", stages=(NamedStage("biased", Biased(), sensor="unit"),))
    with pytest.raises(InputError, match="no sensor 'unit'"):
        drive(scene, tmp_path / "a", options=alone)
    with pytest.raises(InputError, match="biased acts on a imu, and there is none"):
        apply_stages(
            plain, tmp_path / "a", options=ApplyOptions((NamedStage("biased", Biased(), sensor="roof"),))
        )
    assert not (tmp_path / "a").exists()


@dataclass(frozen=True)
class Losing(Stage):
    """Returns fewer fixes than there are."""

    def fixes(self, fixes, *, at, rng):
        del at, rng
        return fixes.take(np.arange(len(fixes) - 1))


def test_a_stage_that_returns_fewer_fixes_is_an_error(scene, options, tmp_path):
    with pytest.raises(LidarError, match="stage losing returned 25 of 26 fixes"):
        drive(scene, tmp_path / "a", options=replace(options, stages=(NamedStage("losing", Losing()),)))
