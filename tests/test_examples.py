"""The examples in Python run, write what they say and print figures that hold."""

import csv
import itertools
import json
import re
import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import rasterio
from helpers import ROOT
from helpers.programs import ENVIRONMENT

import geoscene
from lidar.dataset.png import read_png

FOLDER = ROOT / "examples" / "python"


@pytest.fixture
def run(scene, tmp_path, monkeypatch, capsys):
    """A function that runs an example in the scene of these tests, which has the same extent as its own."""

    def ran(name):
        monkeypatch.setattr(geoscene, "build", lambda *_, **__: scene)
        monkeypatch.setattr(sys, "argv", [name, str(tmp_path)])
        runpy.run_path(str(FOLDER / f"{name}.py"))
        return capsys.readouterr().out

    return ran


def rows_of(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.gate
def test_all_examples_are_tested():
    text = Path(__file__).read_text("utf-8")
    for path in FOLDER.glob("*.py"):
        assert f'"{path.stem}' in text, path


def test_frames_are_looked_at_one_by_one(run, tmp_path):
    printed = run("frames")
    assert re.search(r"20 frames along \d+ m", printed)
    rows = rows_of(tmp_path / "road_users.csv")
    assert len({row["utc"] for row in rows}) == 20
    assert min(int(row["points"]) for row in rows) > 0
    # nearer road users have more points
    near, far = (
        [int(r["points"]) for r in rows if low <= float(r["distance_m"]) < high]
        for low, high in ((0, 15), (30, 99))
    )
    assert np.mean(near) > 1.5 * np.mean(far)
    assert (read_png(tmp_path / "last_sweep.png") > 100).any()


def test_training_data_are_read_in_batches(run, tmp_path):
    printed = run("training_data")
    assert "16 samples to train with, 4 to validate" in printed
    assert re.search(r"boxes: .*\d+ car", printed)
    figures = json.loads((tmp_path / "normalisation.json").read_text())
    x, y, _, _ = figures["mean"]
    assert np.hypot(x, y) < 20
    assert all(1 < value < 100 for value in figures["deviation"])


def test_the_scanner_with_more_channels_has_more_points(run, tmp_path):
    run("compare_sensors")
    rows = rows_of(tmp_path / "points_on_road_users.csv")
    assert len(rows) > 2
    assert all(float(row["xt32_points"]) > float(row["vlp16_points"]) for row in rows)


def test_an_attack_begins_when_it_says_and_defences_judge_it(run, tmp_path):
    printed = run("attack_and_defence")
    counts = {float(t): int(n) for t, n in re.findall(r"([\d.]+) s: (\d+) injected", printed)}
    assert len(counts) == 20
    assert all((count > 100) == (seconds >= 1) for seconds, count in counts.items())
    scores = json.loads((tmp_path / "verdicts" / "defend.json").read_text())["defences"]
    assert set(scores) == {"temporal", "shadow", "occlusion"}
    assert "temporal" in printed


def test_a_map_becomes_rasters_from_a_bare_folder(tmp_path):
    """In a process of its own, with its own scene, as users run it."""
    script = FOLDER / "map_to_geotiff.py"
    done = subprocess.run(
        [sys.executable, script, tmp_path], capture_output=True, text=True, env=ENVIRONMENT, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "points of" in done.stdout
    with (
        rasterio.open(tmp_path / "map.dsm.tif") as surface,
        rasterio.open(tmp_path / "map.dtm.tif") as ground,
    ):
        assert surface.crs.to_epsg() == ground.crs.to_epsg() == 32635
        height = surface.read(1, masked=True) - ground.read(1, masked=True)
    assert height.min() > -0.1
    assert height.max() > 5


def test_a_street_looks_different_with_each_relief(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["relief", str(tmp_path)])
    runpy.run_path(str(FOLDER / "relief.py"))
    shown = [int(n.replace(",", "")) for n in re.findall(r"relief \w+: ([\d,]+) of", capsys.readouterr().out)]
    assert len(shown) == 3
    assert min(shown) > 500_000
    rows = np.split(read_png(tmp_path / "relief.png"), 3)
    for one, other in itertools.pairwise(rows):
        differs = (one != other).any(axis=2)
        assert all(part.mean() > 0.001 for part in np.split(differs, 3, axis=1))
