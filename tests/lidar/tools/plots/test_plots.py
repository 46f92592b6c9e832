"""Figures show the numbers of the dataset, and refuse what it lacks with one line."""

import csv
import json
import math
import shutil
from collections import Counter
from typing import get_args

import numpy as np
import pytest
from helpers.figures import images, lines
from helpers.programs import run_program
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from PIL import Image
from pyproj import Geod

import lidar
import lidar.cli.look
from geoscene.classes import Class, class_codes
from lidar.dataset.formats import read_table
from lidar.dataset.formats.table import placed_returns
from lidar.dataset.layout import open_dataset
from lidar.geometry.attitude import Mount
from lidar.options.drive import DriveOptions
from lidar.tools.plots import FIGURES, plot
from lidar.tools.plots.coverage import _coarser
from lidar.tools.plots.sweeps import _image_sides

SCANNER = "lidar_top"


def clouds(town_drive):
    return [read_table(path) for path in sorted((town_drive / SCANNER / "pcd").glob("*.pcd"))]


def drawn(town_drive, tmp_path, what, *words):
    """The SVG of a figure, and the numbers that the program tells of it."""
    out = tmp_path / f"{what}.svg"
    done = run_program("lidar", "plot", what, town_drive, *words, "-o", out, "--json")
    assert done.returncode == 0, done.stderr
    return out.read_bytes(), json.loads(done.stdout)


def series(svg, name, at):
    """Pixels (n,) of y of the line of a series at values of x that reach over the whole axis."""
    (line,) = lines(svg, name)
    x = line[0, 0] + (at - at[0]) / (at[-1] - at[0]) * (line[-1, 0] - line[0, 0])
    return np.interp(x, *line.T)


def straight(shown, expected):
    """Largest deviation of pixels from a linear function of the values, pixels."""
    expected = np.asarray(expected, float)
    fit = np.polyfit(expected, shown, 1)
    return np.abs(np.polyval(fit, expected) - shown).max()


def test_the_program_offers_every_figure():
    assert get_args(lidar.cli.look.Plotted) == tuple(FIGURES)


@pytest.mark.parametrize("what", FIGURES)
def test_every_figure_is_a_png_and_the_same_bytes_again(town_drive, tmp_path, what):
    once, again = tmp_path / "a.png", tmp_path / "b.png"
    for out in (once, again):
        plot(open_dataset(town_drive), what, out=out)
    assert once.read_bytes() == again.read_bytes()
    picture = np.asarray(Image.open(once))
    assert picture.shape[1] >= 700
    edge = np.concatenate([picture[0], picture[-1], picture[:, 0], picture[:, -1]])
    assert (edge == 255).all(), "nothing is cut off"


def test_the_speed_is_that_of_the_trajectory(town_drive, tmp_path):
    svg, told = drawn(town_drive, tmp_path, "speed")
    with (town_drive / "trajectory.csv").open() as file:
        rows = list(csv.DictReader(file))
    speed = [float(np.linalg.norm([float(row[k]) for k in ("vx", "vy", "vz")])) for row in rows]
    shown = series(svg, "speed", np.array([int(row["time_ns"]) for row in rows]))
    assert straight(shown, speed) < 0.2
    assert told["maximum_speed_m_s"] == pytest.approx(max(speed))
    manifest = json.loads((town_drive / "dataset.json").read_text())
    assert told["length_m"] == pytest.approx(manifest["length_m"], rel=0.01)


@pytest.mark.full
def test_returns_by_range_are_those_of_the_clouds(town_drive, tmp_path):
    svg, told = drawn(town_drive, tmp_path, "returns", "--frames", "1:4")
    tables = clouds(town_drive)[1:4]
    distance = np.concatenate([np.sqrt(sum(t[k].astype(float) ** 2 for k in "xyz")) for t in tables])
    assert told["returns"] == len(distance)
    assert told["median_m"] == pytest.approx(np.median(distance), abs=told["bin_m"])
    edges = np.arange(math.ceil(distance.max() / told["bin_m"]) + 1) * told["bin_m"]
    counts = np.histogram(distance, edges)[0] / 3
    shown = series(svg, "all", np.array([0, *(edges[1:] + edges[:-1]) / 2, edges[-1]]))[1:-1]
    assert straight(shown[counts > 0], np.log(counts[counts > 0])) < 0.2
    assert b'id="injected"' in svg, "the attack's returns are shown by their origin"


@pytest.mark.full
def test_intensities_are_those_of_each_class(town_drive, tmp_path):
    _, told = drawn(town_drive, tmp_path, "intensity")
    label = np.concatenate([t["label"] for t in clouds(town_drive)])
    value = np.concatenate([t["intensity"] for t in clouds(town_drive)]).astype(float)
    for name, mean in told["mean_intensity"].items():
        of_class = label == Class[name.replace(" ", "_").upper()]
        assert mean == pytest.approx(value[of_class].mean(), rel=1e-5)
    assert len(told["mean_intensity"]) == len(np.unique(label))


@pytest.mark.full
def test_the_range_image_has_each_return_at_its_azimuth_and_ring(town_drive, tmp_path):
    svg, told = drawn(town_drive, tmp_path, "range-image", "--frames", "2:")
    table = clouds(town_drive)[2]
    assert (told["frame"], told["returns"]) == (2, len(table["x"]))
    *_, by_class = images(svg)
    azimuth = np.degrees(np.arctan2(table["y"].astype(float), table["x"].astype(float)))
    column = np.clip(((180 - azimuth) / 360 * by_class.shape[1]).astype(int), 0, by_class.shape[1] - 1)
    row = by_class.shape[0] - 1 - table["ring"].astype(int)
    cell, count = np.unique(row * by_class.shape[1] + column, return_counts=True)
    alone = np.isin(row * by_class.shape[1] + column, cell[count == 1])
    assert alone.sum() > 100
    shown = by_class[row[alone], column[alone], :3]
    assert (shown == class_codes().color[table["label"][alone]]).all()


@pytest.mark.full
def test_the_range_image_of_lasers_beside_each_other_has_no_empty_rows(scene, tmp_path):
    rig = tmp_path / "rig.toml"
    rig.write_text(
        'name = "r"\n[[lidar]]\nname = "top"\npreset = "hdl64e_s3"\ntranslation = [0.0, 0.0, 1.73]\n', "utf-8"
    )
    lidar.drive(scene, tmp_path / "drive", options=DriveOptions(rig=str(rig), duration=0.1))
    svg, told = drawn(tmp_path / "drive", tmp_path, "range-image")
    assert told["rows"] == 64
    ranges, *_ = images(svg)
    assert (ranges[..., 3] > 0).any(axis=1).all()


def test_columns_of_turned_scanners_are_azimuths_from_the_vehicle_s_forward():
    """A scanner that looks to the left sees what is ahead of the vehicle to its right."""
    xyz = np.array([[0, -10, 0], [10, 0, 0], [10, 10, 1]], np.float32)
    table = {**dict(zip("xyz", xyz.T, strict=True)), "ring": np.zeros(3, np.uint16)}
    for quat, expected in (((0, 0, 0, 1), [-90, 0, 45]), ((0, 0, 0.5**0.5, 0.5**0.5), [0, 90, 135])):
        angle, title, _ = _image_sides(table, Mount((0.0, 0.0, 0.0), quat))
        np.testing.assert_allclose(angle, expected, atol=1e-4)
        assert "forward" in title


def test_rows_of_scanners_that_look_down_are_times():
    table = {
        **dict(
            zip("xyz", np.array([[0, 0, 0], [-100, 0, 100], [-200, -200, -200]], np.float32), strict=True)
        ),
        "time_ns": np.array([0, 5_000_000, 10_000_000], np.uint32),
        "ring": np.zeros(3, np.uint16),
    }
    angle, _, rows = _image_sides(table, Mount())
    assert np.allclose(angle, np.degrees(np.arctan([-0.5, 0, 0.5])))
    assert (np.diff(rows.row) > 0).all()
    assert rows.ends == (0, 10)


@pytest.mark.full
def test_coverage_counts_every_true_return(town_drive, tmp_path):
    svg, told = drawn(town_drive, tmp_path, "coverage", "--sensor", SCANNER, "--resolution", "0.5")
    dataset = open_dataset(town_drive)
    trajectory, mount = dataset.trajectory(), np.array(dataset.sensors()[SCANNER]["vehicle_from_sensor"])
    starts = dataset.sample_times(SCANNER).tolist()
    cells = set()
    returns = 0
    for start, table in zip(starts, clouds(town_drive), strict=True):
        placed, _ = placed_returns(table, trajectory, start_ns=start, vehicle_from_sensor=mount)
        true = placed[table["label"] != Class.NOISE]
        returns += len(true)
        cells |= set(map(tuple, np.floor(true[:, :2] / 0.5).astype(int).tolist()))
    assert told["returns"] == returns
    assert told["area_m2"] == pytest.approx(0.25 * len(cells), rel=1e-3)
    (plan,) = images(svg)
    assert (plan[..., 3] > 0).sum() == len(cells)
    west, south, east, north = told["bounds_m"]
    assert plan.shape[:2] == (round((north - south) / 0.5), round((east - west) / 0.5))
    row, column = np.nonzero(plan[::-1, :, 3])  # north is up, east is right
    shown = zip((column + round(west / 0.5)).tolist(), (row + round(south / 0.5)).tolist(), strict=True)
    assert set(shown) == cells


@pytest.mark.full
def test_coverage_is_drawn_in_cells_that_fit(town_drive, tmp_path):
    svg, told = drawn(town_drive, tmp_path, "coverage", "--sensor", SCANNER)
    (plan,) = images(svg)
    assert 200 <= max(plan.shape[:2]) <= 500
    side = told["cell_m"]
    assert all(math.isclose(bound / side, round(bound / side), abs_tol=1e-6) for bound in told["bounds_m"])
    (tmp_path / "fine").mkdir()
    fine = drawn(town_drive, tmp_path / "fine", "coverage", "--sensor", SCANNER, "--resolution", "0.5")[1]
    assert told["returns"] == fine["returns"]


@pytest.mark.full
@given(
    arrays(np.uint32, st.tuples(st.integers(1, 9), st.integers(1, 9)), elements=st.integers(0, 99)),
    st.tuples(st.integers(-50, 50), st.integers(-50, 50)),
    st.integers(1, 7),
)
def test_larger_cells_hold_the_counts_of_the_smaller_ones_in_them(grid, first, factor):
    coarse, corner = _coarser(grid, np.array(first), factor=factor)
    expected = Counter()
    for (row, column), count in np.ndenumerate(grid):
        expected[(column + first[0]) // factor, (row + first[1]) // factor] += int(count)
    found = {
        (column + corner[0], row + corner[1]): int(count) for (row, column), count in np.ndenumerate(coarse)
    }
    assert {cell: count for cell, count in found.items() if count} == +expected


@pytest.mark.full
def test_errors_of_fixes_are_geodesic_differences(town_drive, tmp_path):
    svg, told = drawn(town_drive, tmp_path, "gnss")
    with (town_drive / "gnss.csv").open() as file:
        rows = list(csv.DictReader(file))
    value = {
        key: np.array([float(row[key]) for row in rows])
        for key in ("lon", "lat", "h", "true_lon", "true_lat", "true_h")
    }
    azimuth, _, length = Geod(ellps="WGS84").inv(
        value["true_lon"], value["true_lat"], value["lon"], value["lat"]
    )
    errors = {
        "east": length * np.sin(np.radians(azimuth)),
        "north": length * np.cos(np.radians(azimuth)),
        "up": value["h"] - value["true_h"],
    }
    for direction, error in errors.items():
        assert straight(series(svg, f"error {direction}", np.arange(len(rows))), error) < 0.2
        assert told[f"rms_{direction}_m"] == pytest.approx(np.sqrt(np.mean(error**2)), rel=1e-3)
    assert told["sigma_east_m"] > 0
    assert svg.count(b'sigma, as stated">') == 3


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("speed", "{drive}", "-o", "a.jpg"), "end"),
        (("speed", "{drive}", "-o", "taken.png"), "--overwrite"),
        (("speed", "{drive}", "--sensor", "gnss", "-o", "a.png"), "speed does not take it"),
        (("returns", "{drive}", "--sensor", "lidar", "-o", "a.png"), "there are lidar_top"),
        (("returns", "{drive}", "--frames", "80:", "-o", "a.png"), "frames 0 to 5"),
        (("gnss", "{drive}", "--sensor", "lidar_top", "-o", "a.png"), "there are gnss"),
        (("coverage", "{drive}", "--resolution", "0.0001", "-o", "a.png"), "coarser"),
        (("coverage", "-o", "a.png"), "DATASET"),
        (("speed", "nowhere", "-o", "a.png"), "no dataset.json"),
    ],
)
def test_what_cannot_be_drawn_ends_with_a_line(town_drive, tmp_path, words, told):
    (tmp_path / "taken.png").write_bytes(b"")
    run = run_program("lidar", "plot", *(word.format(drive=town_drive) for word in words), cwd=tmp_path)
    assert run.returncode in (1, 2)
    assert told in run.stderr
    assert run.stderr.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["taken.png"]


def test_data_that_are_missing_are_named(town_drive, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(town_drive, copy)
    for folder in copy.glob("*/pcd"):
        shutil.rmtree(folder)
    calibration = json.loads((copy / "calibration.json").read_text())
    del calibration["sensors"]["gnss"]
    (copy / "calibration.json").write_text(json.dumps(calibration))
    for what, told in (
        ("returns", "--format pcd"),
        ("range-image", "--format pcd"),
        ("gnss", "no GNSS receiver"),
    ):
        run = run_program("lidar", "plot", what, copy, "-o", tmp_path / "a.png")
        assert run.returncode != 0
        assert told in run.stderr
        assert run.stderr.count("\n") == 1
    assert not (tmp_path / "a.png").exists()
