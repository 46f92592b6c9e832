"""The page of a drive in a browser: it shows what was recorded, and its controls work, without network."""

from io import BytesIO
from threading import Thread

import numpy as np
import pytest
from helpers.browser import browser
from PIL import Image

from lidar.dataset.formats import read_table
from lidar.dataset.formats.table import placed_returns
from lidar.dataset.ground_truth import read_boxes, read_truth
from lidar.dataset.layout import open_dataset
from lidar.options.look import PlaybackOptions
from lidar.sensors.physics.origin import Origin
from lidar.tools.view import view_drive
from lidar.tools.view.page import DriveServer
from lidar.tools.view.sweeps import ANGLE_STEP, RANGE_STEP, TIME_STEP_NS

BACKGROUND = (16, 18, 24)

# Software rendering reads pixels back slowly and says so.
SLOW = ("GPU stall due to ReadPixels", "willReadFrequently")


@pytest.fixture(scope="module")
def dataset(town_drive):
    return open_dataset(town_drive)


@pytest.fixture(scope="module")
def page(dataset, tmp_path_factory):
    return view_drive(dataset, tmp_path_factory.mktemp("page") / "a page.html").path


@pytest.fixture(scope="module")
def window(tmp_path_factory):
    with browser(tmp_path_factory.mktemp("chromium")) as opened:
        yield opened


@pytest.fixture
def opened(window, page):
    """The window with the page newly opened; asserts no console errors and no network requests."""
    window.complaints(), window.requests()
    window.open(page)
    yield window
    assert [text for text in window.complaints() if not any(part in text for part in SLOW)] == []
    assert {address.split(":")[0] for address in window.requests()} <= {"file", "about", "data", "blob"}


def show(window, frame):
    window.js("lidar.show(arguments[0])", frame)
    window.wait(f"return lidar.view.frame === {frame} && lidar.view.sweep.count > 0")
    window.settle()


def press(window, *keys):
    window.js("document.getElementById('canvas').focus()")
    window.keys(*keys)
    window.settle()


def frame_of(window):
    return window.js("return lidar.view.frame")


def picture(window):
    """The part of the window that no panel covers."""
    return np.asarray(Image.open(BytesIO(window.screenshot())).convert("RGB")).astype(int)[20:560, 260:660]


def recorded(dataset, frame):
    """The returns of a sweep in the order of the page: by ring, column and echo; and that order."""
    table = read_table(dataset.path / "lidar_top" / "pcd" / f"{frame:06d}.pcd")
    order = np.lexsort([table["echo"], table["column"], table["ring"]])
    return {name: values[order] for name, values in table.items()}, order


def test_the_returns_shown_are_those_recorded(dataset, opened):
    for frame in (0, 4):
        show(opened, frame)
        shown = opened.js("return lidar.points()")
        table, order = recorded(dataset, frame)
        for name in ("ring", "column", "label", "instance", "echo"):
            assert np.array_equal(shown[name], table[name].astype(int)), name
        xyz = np.column_stack([table[axis] for axis in "xyz"]).astype(float)
        distance = np.linalg.norm(xyz, axis=1)
        error = np.linalg.norm(np.reshape(shown["xyz"], (-1, 3)) - xyz, axis=1)
        assert np.all(error <= RANGE_STEP / 2 + distance * ANGLE_STEP * 0.71 + 2e-5)
        assert np.abs(np.array(shown["time"]) - table["time_ns"]).max() <= TIME_STEP_NS
        assert np.abs(np.array(shown["intensity"]) - table["intensity"]).max() <= 0.5
        truth = read_truth(dataset.paths.truth("lidar_top", frame), count=len(order))
        assert np.array_equal(shown["origin"], truth["origin"][order])
        assert {Origin.SURFACE, Origin.WEATHER} <= set(truth["origin"].tolist())


def test_returns_stand_where_the_scanner_was_at_their_own_time(dataset, opened):
    show(opened, 3)
    table, _ = recorded(dataset, 3)
    rows = list(range(0, len(table["x"]), 97))
    mount = np.array(dataset.sensors()["lidar_top"]["vehicle_from_sensor"])
    start = int(dataset.sample_times("lidar_top")[3])
    world, _ = placed_returns(table, dataset.trajectory(), start_ns=start, vehicle_from_sensor=mount)
    shown = np.array(opened.js("return lidar.placed(arguments[0])", rows))
    assert np.linalg.norm(shown - world[rows], axis=1).max() < 0.005


def test_boxes_enclose_the_returns_of_their_road_users(dataset, opened):
    show(opened, 2)
    boxes = opened.js("return lidar.view.sweep.boxes")
    true = read_boxes(dataset.paths.frame_boxes("lidar_top", 2), ("id",))
    assert [box["id"] for box in boxes] == [box["id"] for box in true]
    seen = [box for box in boxes if box["points"]]
    assert seen
    instance = np.array(opened.js("return [...lidar.view.sweep.instance]"))
    for box in seen:
        rows = np.flatnonzero(instance == box["instance"]).tolist()
        away = np.array(opened.js("return lidar.placed(arguments[0])", rows)) - [box[axis] for axis in "xyz"]
        reach = np.linalg.norm([box["length"], box["width"], box["height"]]) / 2
        moved = 0.1 * np.hypot(box["vx"], box["vy"])  # during the sweep
        assert np.linalg.norm(away, axis=1).max() < reach + moved + 0.05


def test_the_cloud_is_drawn_in_many_colours_and_boxes_can_be_hidden(opened):
    before = picture(opened)
    assert (np.abs(before - BACKGROUND).max(axis=2) > 30).mean() > 0.01
    assert len(np.unique(before.reshape(-1, 3), axis=0)) > 10
    press(opened, "b")
    assert not opened.js("return document.getElementById('boxes').checked")
    press(opened, "b")
    assert np.array_equal(picture(opened), before)


def test_each_colouring_differs_and_the_legend_counts_the_returns(dataset, opened):
    names = opened.js("return [...document.getElementById('color').options].map((o) => o.value)")
    assert set(names) >= {"class", "height", "intensity", "instance", "time", "echo", "origin"}
    seen = []
    for name in names:
        opened.js("const c = document.getElementById('color'); c.value = arguments[0]; c.onchange();", name)
        seen.append(picture(opened).tobytes())
        if name == "origin":
            truth = read_truth(dataset.paths.truth("lidar_top", 0))
            for origin, count in zip(*np.unique(truth["origin"], return_counts=True), strict=True):
                assert f"{Origin(origin).name.lower()} ({count})" in opened.text("legend")
    # All returns have one echo but those of doubly hit pulses, so only that picture may equal another.
    assert len(set(seen)) == len(names)


def test_keys_step_play_and_change_the_rate(opened):
    assert frame_of(opened) == 0
    press(opened, "\ue014", "\ue014")  # right
    opened.wait("return lidar.view.frame === 2")
    press(opened, "\ue012")  # left
    opened.wait("return lidar.view.frame === 1")
    press(opened, "\ue010")  # End
    opened.wait("return lidar.view.frame === 5")
    press(opened, "\ue011")  # Home
    opened.wait("return lidar.view.frame === 0")
    press(opened, "[", "[")
    assert opened.js("return lidar.view.rate") == 0.25
    opened.js("lidar.view.rate = 1e-4")  # so that a frame lasts longer than the keys take
    press(opened, " ")
    assert opened.text("play") == "Pause"
    press(opened, " ")
    assert opened.text("play") == "Play"
    assert frame_of(opened) == 0
    press(opened, "]", "]", " ")
    assert opened.js("return lidar.view.rate") == 1
    opened.wait("return lidar.view.frame === 5 && !lidar.view.playing")  # stops at the end


def test_the_timeline_and_the_graph_of_speeds_show_a_frame(opened):
    box = opened.js(
        "const b = document.getElementById('graph').getBoundingClientRect(); return [b.left, b.top, b.width]"
    )
    opened.click(box[0] + 8 + (box[2] - 16) * 3 / 5, box[1] + 20)
    opened.wait("return lidar.view.frame === 3")
    assert opened.js("return document.getElementById('time').value") == "3"
    assert "frame 3" in opened.text("clock")
    opened.js("const t = document.getElementById('time'); t.value = 5; t.dispatchEvent(new Event('input'))")
    opened.wait("return lidar.view.frame === 5")


def test_images_change_with_the_frame(dataset, opened):
    for frame in (0, 5):
        show(opened, frame)
        for kind in ("rgb", "depth"):
            opened.wait(f"return document.getElementById('picture-0-{kind}').dataset.index === '{frame}'")
        shown = opened.js(
            "const c = document.getElementById('picture-0-rgb');"
            "return [c.width, c.height, [...c.getContext('2d').getImageData(0, 0, c.width, c.height).data]]"
        )
        pixels = np.reshape(shown[2], (shown[1], shown[0], 4))[..., :3]
        true = Image.open(dataset.paths.image("camera_front", frame, kind="rgb")).convert("RGB")
        assert np.abs(pixels - np.asarray(true.resize(tuple(shown[:2])), float)).mean() < 8


def test_the_range_image_has_the_colour_of_each_return(opened):
    opened.js("lidar.color('range')")
    shown = opened.js(
        "const c = document.getElementById('scan');"
        "return [c.width, c.height, [...c.getContext('2d').getImageData(0, 0, c.width, c.height).data]]"
    )
    drawn = np.reshape(shown[2], (shown[1], shown[0], 4))[..., 3] > 0
    assert shown[1] == 16
    assert drawn.mean() > 0.4
    assert drawn[0].mean() < drawn[-1].mean() + 0.5  # the upper channels look over roofs


def test_the_camera_follows_the_vehicle_or_stays(opened):
    at = opened.js("return lidar.head.position")
    target = np.array(opened.js("return lidar.camera.target"))
    show(opened, 5)
    moved = np.array(opened.js("return lidar.camera.target")) - target
    assert np.allclose(moved, np.subtract(at[5], at[0]), atol=1e-6)
    press(opened, "v")
    show(opened, 0)
    assert np.allclose(opened.js("return lidar.camera.target"), target + moved, atol=1e-6)


def test_several_sweeps_are_drawn_together(opened):
    show(opened, 4)
    one = (np.abs(picture(opened) - BACKGROUND).max(axis=2) > 30).sum()
    press(opened, ">", ">", ">")
    opened.wait("return lidar.view.shown.length === 4")
    assert (np.abs(picture(opened) - BACKGROUND).max(axis=2) > 30).sum() > 1.3 * one


def test_a_click_on_a_return_tells_what_it_is(opened):
    x, y, row = opened.js(
        "const v = lidar.view, { clientWidth: width, clientHeight: height } = v.renderer.canvas;"
        "const m = lidar.camera.matrix(width / height);"
        "for (let k = 0; k < v.sweep.count; k++) {"
        "  const [a, b, c] = lidar.placed([k])[0].map((p, axis) => p - lidar.camera.target[axis]);"
        "  const w = m[3] * a + m[7] * b + m[11] * c + m[15];"
        "  const x = ((m[0] * a + m[4] * b + m[8] * c + m[12]) / w + 1) * width / 2;"
        "  const y = (1 - (m[1] * a + m[5] * b + m[9] * c + m[13]) / w) * height / 2;"
        "  if (w > 0 && x > 300 && x < 600 && y > 250 && y < 500) return [x, y, k];"
        "}"
    )
    hit = opened.js("return lidar.pick(arguments[0], arguments[1])", round(x), round(y))
    near = opened.js("return lidar.placed([arguments[0], arguments[1]])", row, hit["row"])
    opened.click(x, y)
    opened.settle()
    told = opened.text("told")
    assert f"{opened.js('return lidar.view.sweep.range[arguments[0]]', hit['row']):.3f} m" in told
    assert np.allclose(near[1], hit["point"])
    press(opened, "\ue00c")
    assert opened.js("return document.getElementById('told').hidden")


def test_the_address_names_frame_colour_and_view(window, page):
    window.open(page, "#frame=4&color=height&view=1,2,3,40,90,30")
    window.wait("return lidar.view.frame === 4")
    assert window.js("return document.getElementById('color').value") == "height"


def test_a_served_drive_plays_as_the_page_does(dataset, window):
    with DriveServer(dataset) as server:
        thread = Thread(target=server.serve_forever)
        thread.start()
        try:
            window.complaints(), window.requests()
            window.open(server.address)
            show(window, 3)
            window.wait("return document.getElementById('picture-0-depth').dataset.index === '3'")
            assert np.array_equal(window.js("return lidar.points().ring"), recorded(dataset, 3)[0]["ring"])
            assert [text for text in window.complaints() if not any(part in text for part in SLOW)] == []
            sites = {address.split("/")[2] for address in window.requests() if address.startswith("http")}
            assert sites == {f"127.0.0.1:{server.server_port}"}
        finally:
            server.shutdown()
            thread.join()


def test_scanners_are_drawn_one_at_a_time_or_together(dataset, window, tmp_path):
    options = PlaybackOptions(sensors=("lidar_top", "lidar_front"))
    path = view_drive(dataset, tmp_path / "two.html", options=options).path
    window.complaints()
    window.open(path)
    counts = {
        name: len(read_table(dataset.path / name / "pcd" / "000000.pcd")["x"])
        for name in ("lidar_top", "lidar_front")
    }
    assert window.js("return [...document.getElementById('scanner').options].map((o) => o.textContent)") == [
        *counts,
        "all",
    ]
    assert window.js("return lidar.view.shown.map((s) => s.count)") == [counts["lidar_top"]]
    window.js("return lidar.scan('lidar_front')")
    window.wait("return lidar.view.shown.length === 1 && lidar.view.sweep.slots === lidar.view.slots[1]")
    assert window.js("return lidar.view.sweep.count") == counts["lidar_front"]
    window.js("return lidar.scan('all')")
    window.wait("return lidar.view.shown.length === 2")
    assert window.js("return lidar.view.sweep.count") == counts["lidar_top"], "clicks are on the first one"
    assert f"{sum(counts.values())} returns" in window.text("clock")
    show(window, 3)
    assert window.js("return lidar.view.shown.length") == 2
    assert [text for text in window.complaints() if not any(part in text for part in SLOW)] == []
