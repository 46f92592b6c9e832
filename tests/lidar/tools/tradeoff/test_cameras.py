"""Errors and costs of cameras' settings: known differences, blocks of images, a comparison on a drive."""

from dataclasses import replace

import numpy as np
import pytest

from lidar.options.accuracy import TradeoffOptions
from lidar.options.drive import DriveOptions
from lidar.sensors.camera.settings import PLAIN
from lidar.simulation.plan import plan_drive
from lidar.tools.tradeoff.bench import FAST, Pixels, bench_of, blocks_of_frame, image, image_error, pixels
from lidar.tools.tradeoff.compare import compare_settings
from lidar.tools.tradeoff.errors import IMAGE_STATISTICS, estimates
from lidar.tools.tradeoff.report import document, recommendation, write_report

RIG = """
name = "front"
vehicle = "car"

[[camera]]
name = "front"
translation = [1.5, 0.0, 1.4]
width = 96
height = 64
fov_deg = 80.0
rate_hz = 10.0
images = ["rgb", "depth", "semantic"]
"""


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    path = tmp_path_factory.mktemp("rig") / "front.toml"
    path.write_text(RIG, "utf-8")
    return DriveOptions(route="random", rig=str(path), duration=0.3, seed=3)


@pytest.fixture(scope="module")
def found(scene, drive):
    names = ("supersample", "shadows", "blur", "resolution")
    return compare_settings(scene, drive, compared=TradeoffOptions(names, frames=2, pixels=256))


def picture(rgb, depth, klass):
    shape = (1, 2, 2)
    return Pixels(
        np.broadcast_to(np.reshape(rgb, (*shape, 1)), (*shape, 3)).astype(np.uint8),
        np.reshape(depth, shape).astype(np.float32),
        np.reshape(klass, shape).astype(np.uint8),
    )


def test_differences_of_colour_depth_and_class():
    exact = picture([10, 20, 30, 40], [5, 5, np.inf, 9], [1, 1, 2, 2])
    other = picture([10, 17, 30, 44], [5, 5.5, 7, 9], [1, 3, 2, 2])
    error = image_error(other, exact)
    assert (error.missing, error.changed, error.pixels) == (1, 1, 4)
    figures = {name: f.value for name, f in estimates([error], seed=0, statistics=IMAGE_STATISTICS).items()}
    assert figures["rgb_rms"] == pytest.approx(np.sqrt((9 + 16) / 4))
    assert (figures["rgb_99.9"], figures["rgb_max"]) == (4, 4)
    assert figures["depth_max_m"] == 0.5
    assert figures["depth_rms_m"] == pytest.approx(0.5 / np.sqrt(3))
    assert (figures["depth_missing"], figures["class_changes"]) == (0.25, 0.25)
    same = estimates([image_error(exact, exact)], seed=0, statistics=IMAGE_STATISTICS)
    assert all(figure.value == 0 for figure in same.values())


@pytest.mark.parametrize("resolution", [1, 2])
def test_blocks_are_parts_of_the_whole_image(scene, drive, resolution):
    bench = bench_of(plan_drive(scene, drive), frames=2)
    (camera,) = bench.plan.sensors
    frame = bench.frames[camera.name][0]
    shot, world = bench.shot(camera, frame), bench.world(camera, frame, backend=FAST)
    blocks = blocks_of_frame(camera.spec, 20, frame=frame, seed=1)
    assert len(np.unique(blocks, axis=0)) == 20
    whole = image(shot, world=world, settings=PLAIN, resolution=resolution)
    parts = pixels(shot, blocks, world=world, settings=PLAIN, resolution=resolution)
    size = 4 // resolution
    for (left, top), rgb, depth, klass in zip(
        blocks // resolution, parts.rgb, parts.depth, parts.klass, strict=True
    ):
        window = np.s_[top : top + size, left : left + size]
        assert np.array_equal(klass, whole.klass[window])
        np.testing.assert_allclose(depth, whole.depth[window], rtol=1e-6)
        assert np.abs(rgb.astype(int) - whole.rgb[window]).max() <= 1


def test_blocks_are_spread_so_that_small_effects_are_met(scene, drive):
    camera = replace(plan_drive(scene, drive).sensors[0].spec, width=1280, height=720)
    for count in (16, 64, 170, 512):
        for frame in range(5):
            column, row = blocks_of_frame(camera, count, frame=frame, seed=1).T // 4
            met = np.zeros((181, 321), int)
            met[row + 1, column + 1] = 1
            met = met.cumsum(axis=0).cumsum(axis=1)
            side = int(2 * np.sqrt(180 * 320 / count))
            inside = met[side:, side:] - met[:-side, side:] - met[side:, :-side] + met[:-side, :-side]
            assert met[-1, -1] == count
            assert inside.min() >= 1


@pytest.mark.full
def test_errors_of_a_camera_on_a_drive(found):
    (one,) = found.comparisons
    assert (one.kind, one.samples, one.frames) == ("camera", 256, 2)
    rows = {r.label: r for r in one.rows}
    rms = {label: r.error["rgb_rms"].value for label, r in rows.items()}
    asked = one.rows[0]
    assert rms["supersample=4"] <= rms["supersample=2"] < asked.error["rgb_rms"].value < rms["resolution=4"]
    assert one.uncertainty < rms["supersample=2"]
    assert asked.error["depth_max_m"].value == pytest.approx(0, abs=1e-3)
    assert rows["resolution=2"].error["depth_max_m"].value > 0
    assert rows["blur=1"].note == "no effect on what was sampled: blur=1"
    assert (rows["blur=1"].choice, rows["resolution=2"].choice) == (False, True)
    assert rows["resolution=2"].cost["bytes"].value < asked.cost["bytes"].value
    assert "resolution=2 shadows=off" in rows
    assert "For 10 levels rms" in recommendation(one, 10.0)


@pytest.mark.full
def test_the_report_of_a_camera_is_written(found, tmp_path):
    write_report(found, tmp_path / "out")
    assert (tmp_path / "out/pareto_front.png").exists()
    (sensor,) = document(found)["sensors"]
    assert sensor["kind"] == "camera"
    assert found.georeferencing == {}
