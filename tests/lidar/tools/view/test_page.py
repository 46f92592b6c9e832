"""The page of a drive holds what was recorded, is reproducible, and refuses what it cannot show."""

import json
import re
import struct
import urllib.error
import urllib.request
from base64 import b64decode
from contextlib import contextmanager
from http.client import HTTPConnection
from io import BytesIO
from threading import Thread
from zlib import decompress

import numpy as np
import pytest
from helpers.programs import run_program
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from geoscene.errors import MissingExtraError
from lidar.dataset.formats import read_table
from lidar.dataset.layout import open_dataset
from lidar.errors import DatasetError, InputError
from lidar.options.look import PlaybackOptions
from lidar.tools.view import view_drive
from lidar.tools.view.live import colored_points, show_window
from lidar.tools.view.page import DriveServer
from lidar.tools.view.sweeps import planes


@pytest.fixture(scope="module")
def page(town_drive, tmp_path_factory):
    out = tmp_path_factory.mktemp("page") / "page.html"
    return view_drive(open_dataset(town_drive), out)


def elements(path):
    """Bytes of the page's elements by id, and its header."""
    text = path.read_text("utf-8")
    blobs = dict(re.findall(r'<script type="text/plain" id="([^"]+)">([^<]*)</script>', text))
    head = json.loads(re.search(r'id="head">(.*?)</script>', text)[1])
    return {name: b64decode(data) for name, data in blobs.items()}, head


def head_of(sweep):
    """The JSON of a sweep's bytes."""
    data = decompress(sweep, 31)
    (length,) = struct.unpack("<I", data[:4])
    return json.loads(data[4 : 4 + length])


@pytest.mark.full
@given(st.lists(st.integers(-(2**47), 2**47)))
def test_whole_numbers_survive_as_planes_of_bytes(numbers):
    values = np.array(numbers, np.int64)
    count, data = planes(values)
    assert len(data) == count * len(values)
    ranks = np.frombuffer(data, np.uint8).reshape(count, len(values)).astype(np.int64)
    folded = (ranks << (8 * np.arange(count))[:, None]).sum(axis=0)
    assert np.array_equal((folded >> 1) ^ -(folded & 1), values)


def test_the_page_has_every_frame_image_and_road_user(town_drive, page):
    dataset = open_dataset(town_drive)
    blobs, head = elements(page.path)
    assert [one["name"] for one in head["scanners"]] == ["lidar_top"]
    assert head["numbers"] == list(range(6))
    assert page.frames == 6
    assert page.images == 12  # colour and depth
    assert page.returns == dataset.manifest["points"]["lidar_top"]
    assert page.bytes == page.path.stat().st_size
    for frame in head["numbers"]:
        told = head_of(blobs[f"sweep-0-{frame}"])
        rows = dataset.paths.frame_boxes("lidar_top", frame).read_text("utf-8").splitlines()[1:]
        assert told["count"] == len(read_table(town_drive / "lidar_top" / "pcd" / f"{frame:06d}.pcd")["x"])
        assert len(told["boxes"]) == len(rows) > 3
        image = Image.open(BytesIO(blobs[f"image-0-rgb-{frame}"]))
        assert image.size == (640, 360)
        true = (
            Image.open(dataset.paths.image("camera_front", frame, kind="rgb"))
            .convert("RGB")
            .resize((640, 360))
        )
        assert np.abs(np.asarray(image, float) - np.asarray(true)).mean() < 8
    assert any("lidar_front" in note for note in page.notes)


def test_a_sweep_of_a_scanner_that_repeats_its_pattern_needs_little_more_than_ranges(page):
    blobs, _ = elements(page.path)
    size = sum(len(data) for name, data in blobs.items() if name.startswith("sweep-"))
    assert 8 * size / page.returns < 18  # bits, with snow; its file has 41 bytes


@pytest.mark.full
def test_equal_drives_give_equal_pages(town_drive, page, tmp_path):
    again = view_drive(open_dataset(town_drive), tmp_path / "again.html")
    assert again.path.read_bytes() == page.path.read_bytes()


def test_the_speeds_and_the_path_are_those_of_the_trajectory(town_drive, page):
    _, head = elements(page.path)
    trajectory = open_dataset(town_drive).trajectory()
    at = trajectory.at(np.array(head["time_ns"]))
    assert np.allclose(head["position"], at.position, atol=6e-4)
    speed = np.linalg.norm(np.diff(at.position, axis=0), axis=1) / 0.1
    assert np.allclose((np.array(head["speed"])[1:] + np.array(head["speed"])[:-1]) / 2, speed, atol=0.05)
    near = np.concatenate([np.array(road) for road in head["roads"]])
    assert np.hypot(*(near - at.position[0, :2]).T).min() < 60


def test_without_the_scene_the_plan_has_no_roads_and_says_so(town_drive, tmp_path):
    dataset = open_dataset(town_drive)
    dataset.manifest["scene"]["path"] = str(tmp_path / "gone")
    summary = view_drive(dataset, tmp_path / "page.html")
    assert elements(summary.path)[1]["roads"] == []
    assert any("no roads" in note for note in summary.notes)


@pytest.mark.full
def test_a_selection_of_frames_and_sensors_is_shown(town_drive, tmp_path):
    options = PlaybackOptions(sensors=("lidar_front",), frames="1:20", every=4)
    summary = view_drive(open_dataset(town_drive), tmp_path / "page.html", options=options)
    _, head = elements(summary.path)
    assert [one["name"] for one in head["scanners"]] == ["lidar_front"]
    assert head["numbers"] == list(range(1, 20, 4))
    assert [camera["name"] for camera in head["cameras"]] == ["camera_front"]
    assert any("5 of " in note for note in summary.notes)


def test_of_several_scanners_the_nearest_sweeps_are_shown_together(town_drive, tmp_path):
    dataset = open_dataset(town_drive)
    options = PlaybackOptions(sensors=("lidar_top", "lidar_front"), frames=":4")
    summary = view_drive(dataset, tmp_path / "page.html", options=options)
    blobs, head = elements(summary.path)
    top, front = head["scanners"]
    assert (top["name"], front["name"]) == ("lidar_top", "lidar_front")
    assert top["index"] == [0, 1, 2, 3]
    starts = dataset.sample_times("lidar_front")
    wanted = [int(np.argmin(np.abs(starts - time))) for time in head["time_ns"]]
    assert head["numbers"] == [0, 1, 2, 3]
    for place, frame in zip(front["index"], wanted, strict=True):
        returns = len(read_table(town_drive / "lidar_front" / "pcd" / f"{frame:06d}.pcd")["x"])
        assert head_of(blobs[f"sweep-1-{place}"])["count"] == returns
    assert summary.returns == sum(
        head_of(data)["count"] for name, data in blobs.items() if name.startswith("sweep-")
    )
    assert not any("lidar_front" in note for note in summary.notes)


@pytest.mark.full
def test_of_a_drive_that_is_too_large_each_nth_frame_is_shown(town_drive, tmp_path):
    data, out = open_dataset(town_drive), tmp_path / "page.html"
    whole = view_drive(data, out)
    assert not any("one frame of" in note for note in whole.notes)
    limit = 0.6 * whole.bytes / 1e6
    some = view_drive(data, out, options=PlaybackOptions(max_mb=limit), overwrite=True)
    assert some.bytes < 1e6 * limit + 2e5  # the player itself
    assert 1 <= some.frames < whole.frames
    (note,) = [note for note in some.notes if note.startswith("one frame of")]
    every = int(note.split()[3].rstrip(":"))
    assert some.frames == -(-whole.frames // every)
    size = float(re.search(r"about ([\d.]+) MB", note)[1])
    assert size == pytest.approx(whole.bytes / 1e6, abs=0.2)


def test_a_page_that_would_be_too_large_names_a_selection_that_fits(town_drive, tmp_path, monkeypatch):
    """It is refused before anything is packed."""
    out = tmp_path / "page.html"
    monkeypatch.setattr("lidar.tools.view.page.write_player", None)
    with pytest.raises(InputError, match="would have about") as caught:
        view_drive(open_dataset(town_drive), out, options=PlaybackOptions(max_mb=0.3, every=1))
    assert list(tmp_path.iterdir()) == []
    monkeypatch.undo()
    every = int(re.search(r"`every` (\d+)", str(caught.value))[1])
    frames = re.search(r"`frames` (\d+:\d+)", str(caught.value))[1]
    for options in (
        PlaybackOptions(max_mb=0.3, every=every),
        PlaybackOptions(max_mb=0.3, frames=frames, every=1),
    ):
        assert view_drive(open_dataset(town_drive), out, options=options, overwrite=True).frames >= 1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sensors": ("roof",)}, "no scanner or camera roof"),
        ({"frames": "100:200"}, "has frames 0 to 5"),
    ],
)
def test_what_the_dataset_does_not_have_is_refused(town_drive, tmp_path, options, message):
    with pytest.raises(InputError, match=message):
        view_drive(open_dataset(town_drive), tmp_path / "page.html", options=PlaybackOptions(**options))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "given", [{"frames": "5"}, {"frames": "a:b"}, {"every": 0}, {"max_mb": float("nan")}]
)
def test_options_without_sense_are_refused(given):
    with pytest.raises(InputError, match=f"`{next(iter(given))}`"):
        PlaybackOptions(**given)


def test_a_dataset_without_clouds_in_the_sensor_frame_is_refused(town_drive, tmp_path):
    bare = tmp_path / "bare"
    bare.mkdir()
    for name in ("dataset.json", "calibration.json", "trajectory.csv"):
        (bare / name).write_bytes((town_drive / name).read_bytes())
    with pytest.raises(DatasetError, match="--format pcd"):
        view_drive(open_dataset(bare), tmp_path / "page.html")


def test_the_command_line_wants_one_of_page_server_and_window(town_drive, tmp_path):
    for words in ((), ("-o", tmp_path / "page.html", "--serve")):
        done = run_program("lidar", "view", town_drive, *words)
        assert done.returncode == 2
        assert "--out, --serve and --open3d" in done.stderr
    done = run_program("lidar", "view", town_drive, "-o", tmp_path / "page.html")
    assert done.returncode == 0
    assert "6 frames" in done.stdout
    assert run_program("lidar", "view", town_drive, "-o", tmp_path / "page.html").returncode == 2  # exists


@contextmanager
def serving(town_drive, **options):
    with DriveServer(open_dataset(town_drive), **options) as server:
        thread = Thread(target=server.serve_forever)
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()


def fetch(url):
    with urllib.request.build_opener(urllib.request.ProxyHandler({})).open(url, timeout=60) as answer:
        return answer.read()


def test_the_server_has_the_bytes_of_the_page(town_drive, page):
    blobs, _ = elements(page.path)
    with serving(town_drive) as server:
        assert fetch(f"{server.address}sweep/0/3") == blobs["sweep-0-3"]
        assert fetch(f"{server.address}image/0/depth/2") == blobs["image-0-depth-2"]
        assert b"connect-src 'self'" in fetch(server.address)
        for path in (
            "sweep/0/6",
            "sweep/1/0",
            "image/1/rgb/0",
            "image/0/rgb/99",
            "../dataset.json",
            "sweep/0/-1",
        ):
            with pytest.raises(urllib.error.HTTPError, match="404"):
                fetch(server.address + path)


def test_the_server_answers_this_machine_only(town_drive):
    with serving(town_drive) as server:
        assert server.server_address[0] == "127.0.0.1"
        link = HTTPConnection("127.0.0.1", server.server_port, timeout=60)
        link.request("GET", "/sweep/0/0", headers={"Host": "elsewhere.example"})
        assert link.getresponse().status == 403
        link.close()
        with pytest.raises(InputError, match="`port`"):
            DriveServer(open_dataset(town_drive), port=server.server_port)


def test_a_window_without_open3d_says_what_to_install(town_drive, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "open3d", None)
    with pytest.raises(MissingExtraError, match=r"geoscene\[open3d\]"):
        show_window(town_drive)


def test_a_window_shows_a_sweep_or_a_map_in_colours(town_drive, tmp_path):
    points, colors = colored_points(town_drive, PlaybackOptions(frames="2:"))
    recorded = read_table(town_drive / "lidar_top" / "pcd" / "000002.pcd")
    assert len(points) == len(recorded["x"])
    assert np.abs(np.linalg.norm(points, axis=1) - recorded["range"]).max() < 3  # less the vehicle's motion
    assert len(np.unique(colors, axis=0)) > 3
    assert (
        run_program("lidar", "map", town_drive, "-o", tmp_path / "map.laz", "--color", "height").returncode
        == 0
    )
    points, colors = colored_points(tmp_path / "map.laz", PlaybackOptions())
    assert np.abs(points.mean(axis=0)).max() < 1e-3
    assert colors.min() >= 0
    assert colors.max() <= 1
    assert len(np.unique(colors, axis=0)) > 50
