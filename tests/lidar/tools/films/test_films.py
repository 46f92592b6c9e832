"""Films last as long as the drive, have every frame, show what was recorded, and refuse what there is not."""

import itertools
import json
import shutil
import sys
from types import SimpleNamespace

import av
import numpy as np
import pytest
from helpers.programs import run_program
from PIL import Image

from geoscene.classes import Class, class_codes
from lidar.dataset.layout import open_dataset
from lidar.dataset.recorded import images_of, scanner_clouds
from lidar.motion.vehicle import load_vehicle
from lidar.options.look import FilmOptions
from lidar.tools.films.film import film, write_film
from lidar.tools.films.panes import CameraPane, MapPane, SweepPane, Sweeps

SMALL = {"size": (320, 240)}


def decoded(path):
    """Images (n, h, w, 3) of an MP4, their times in seconds, and its length."""
    with av.open(path) as file:
        frames = list(file.decode(file.streams.video[0]))
        return (
            np.array([f.to_ndarray(format="rgb24") for f in frames]),
            [f.time for f in frames],
            file.duration / 1e6,
        )


@pytest.mark.full
def test_an_mp4_has_every_sweep_at_its_time(town_drive, tmp_path):
    made = film(open_dataset(town_drive), tmp_path / "a.mp4", options=FilmOptions(**SMALL))
    images, times, length = decoded(tmp_path / "a.mp4")
    assert images.shape == (6, 240, 320, 3)
    assert times == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4, 0.5])
    assert length == pytest.approx(0.6)
    assert (made.images, made.seconds) == (6, pytest.approx(0.6))
    assert made.shown == ["lidar_top", "camera_front"]
    assert all(len(np.unique(image.reshape(-1, 3), axis=0)) > 100 for image in images)
    assert all((a != b).any() for a, b in itertools.pairwise(images))


def test_speed_and_every_change_the_times(town_drive, tmp_path):
    film(open_dataset(town_drive), tmp_path / "a.mp4", options=FilmOptions(speed=0.5, every=2, **SMALL))
    _, times, length = decoded(tmp_path / "a.mp4")
    assert times == pytest.approx([0.0, 0.4, 0.8])
    assert length == pytest.approx(1.2)


def test_a_fast_film_leaves_frames_out_that_no_viewer_shows(town_drive, tmp_path):
    made = film(
        open_dataset(town_drive), tmp_path / "a.gif", options=FilmOptions(speed=10, show="map", **SMALL)
    )
    assert made.images == 3
    assert made.seconds == pytest.approx(0.06)
    assert "each 2nd frame" in made.notes[0]


def test_a_gif_is_the_same_bytes_again_and_lasts_as_long_as_the_drive(town_drive, tmp_path):
    for name in ("a.gif", "b.gif"):
        film(open_dataset(town_drive), tmp_path / name, options=FilmOptions(show="sweep", speed=0.3, **SMALL))
    assert (tmp_path / "a.gif").read_bytes() == (tmp_path / "b.gif").read_bytes()
    with Image.open(tmp_path / "a.gif") as gif:
        assert (gif.n_frames, gif.size) == (6, (320, 240))
        lengths = []
        for k in range(gif.n_frames):
            gif.seek(k)
            lengths.append(gif.info["duration"])
    assert sum(lengths) == 2000
    assert set(lengths) == {330, 340}


def test_films_of_cameras_follow_the_camera(town_drive, tmp_path):
    words = ("--show", "cameras", "--size", "320x240", "-o", tmp_path / "a.mp4", "--json")
    told = json.loads(run_program("lidar", "animate", town_drive, *words).stdout)
    count = len(list((town_drive / "camera_front" / "rgb").glob("*.png")))
    images, _, _ = decoded(tmp_path / "a.mp4")
    assert len(images) == told["images"] == count
    assert told["shown"] == ["camera_front"]


def sweeps_of(town_drive, **options):
    dataset = open_dataset(town_drive)
    clouds = scanner_clouds(dataset)
    return Sweeps(dataset, [clouds], trajectory=dataset.trajectory(), options=FilmOptions(**options))


def test_the_camera_pane_has_the_recorded_image(town_drive):
    dataset = open_dataset(town_drive)
    images = images_of(dataset, "camera_front")
    pane = CameraPane(dataset, [images], time_ns=images.stream.time_ns, size=(400, 400), columns=1)
    shown = pane.draw(2)
    with Image.open(images.stream.files[2]) as image:
        width, height = 398, round(398 * image.height / image.width)
        expected = np.asarray(image.convert("RGB").resize((width, height), Image.Resampling.LANCZOS))
    top = (400 - height) // 2
    below_name = slice(top + 40, top + height)
    assert (shown[below_name, 1:399] == expected[40:]).all()


def test_the_map_shows_the_highest_return_at_each_place(town_drive):
    sweeps = sweeps_of(town_drive)
    pane = MapPane(sweeps, size=(300, 300), legend=False)
    pane.draw(0)
    points, colors, moving = sweeps.returns(0)
    places = pane._pixels(points)
    cell = np.floor(places).astype(int)
    inside = ((cell >= 0) & (cell < 300)).all(axis=1) & ~moving
    assert inside.sum() > 0.5 * len(points)
    highest = {}
    for (u, v), z, color in zip(cell[inside], points[inside, 2], colors[inside], strict=True):
        if z >= highest.get((u, v), (-np.inf,))[0]:
            highest[u, v] = z, color
    assert all((pane._image[v, u] == color).all() for (u, v), (_, color) in highest.items())
    drawn = (pane._image != pane._image[0, 0]).any(axis=2).sum()
    pane.draw(1)
    assert (pane._image != pane._image[0, 0]).any(axis=2).sum() > drawn, "the map grows"


def test_colours_are_those_of_the_truth(town_drive):
    sweeps = sweeps_of(town_drive, color="origin")
    _, colors, _ = sweeps.returns(3)
    named = {tuple(np.asarray(color).tolist()): name for name, color in sweeps.key}
    with np.load(town_drive / "lidar_top" / "truth" / "000003.npz") as truth:
        origin = truth["origin"]
    assert {named[tuple(c)] for c in np.unique(colors, axis=0).tolist()} <= {
        "surface",
        "weather",
        "injected",
        "receiver",
    }
    assert (np.unique(colors, axis=0).shape[0]) == len(np.unique(origin))
    _, by_class, _ = sweeps_of(town_drive).returns(3)
    assert (by_class == class_codes().color[Class.ROAD]).all(axis=1).any()


@pytest.mark.parametrize("view", ["chase", "top"])
def test_ahead_is_up_and_left_is_left(view):
    """A return ahead of the vehicle, and one to its left, in the picture of a vehicle that heads west."""
    colors = np.array([(255, 0, 0), (0, 255, 0)], np.uint8)
    ground = np.stack(np.meshgrid(np.linspace(-30, 30, 7), np.linspace(-30, 30, 7)), axis=-1).reshape(-1, 2)
    fake = SimpleNamespace(
        samples=np.column_stack([ground, np.zeros(len(ground))]),
        returns=lambda _: (np.array([[12.0, 0, 0], [0, 12.0, 0]]), colors, np.zeros(2, bool)),
        in_vehicle=lambda _, points: points,
        boxes=lambda _: [],
        key=[],
    )
    image = SweepPane(fake, view=view, size=(400, 300), vehicle=load_vehicle("car")).draw(0).astype(int)

    def place(channel):
        other = image.sum(axis=2) - image[..., channel]
        down, across = np.nonzero((image[..., channel] > 120) & (other < 60))
        return across.mean(), down.mean()

    ahead, left = place(0), place(1)
    assert abs(ahead[0] - 200) < 3
    assert ahead[1] < left[1]
    assert left[0] < 200 - 20


def test_a_gif_that_would_fill_the_memory_is_refused(tmp_path):
    shown = np.full(2000, 10**8)
    with pytest.raises(Exception, match="write an MP4"):
        write_film(tmp_path / "a.gif", iter(()), shown_ns=shown, size=(1280, 720))


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("-o", "a.avi"), ".mp4 or .gif"),
        (("-o", "taken.gif"), "--overwrite"),
        (("--sensor", "lidar", "-o", "a.gif"), "there are lidar_top"),
        (("--size", "641x360", "-o", "a.gif"), "even"),
        (("--size", "big", "-o", "a.gif"), "WIDTHxHEIGHT"),
        (("--speed", "0", "-o", "a.gif"), "positive"),
        (("--show", "nothing", "-o", "a.gif"), "known are all"),
        (("--frames", "70:80", "-o", "a.gif"), "frames 0 to 5"),
    ],
)
def test_what_cannot_be_shown_ends_with_a_line(town_drive, tmp_path, words, told):
    (tmp_path / "taken.gif").write_bytes(b"")
    run = run_program("lidar", "animate", town_drive, *words, cwd=tmp_path)
    assert run.returncode == 2
    assert told in run.stderr
    assert run.stderr.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["taken.gif"]


def test_missing_data_and_extras_are_named(town_drive, tmp_path, monkeypatch):
    copy = tmp_path / "copy"
    shutil.copytree(town_drive, copy)
    for folder in [*copy.glob("*/rgb"), *copy.glob("*/depth"), *copy.glob("*/truth")]:
        shutil.rmtree(folder)
    monkeypatch.setitem(sys.modules, "av", None)
    for words, told in (
        (("--show", "cameras", "-o", tmp_path / "a.gif"), "no colour or depth images"),
        (("--color", "origin", "-o", tmp_path / "a.gif"), "no stage acted"),
        (("-o", tmp_path / "a.mp4"), "geoscene[video]"),
    ):
        run = run_program("lidar", "animate", copy, *words)
        assert run.returncode in (1, 2)
        assert told in run.stderr
        assert run.stderr.count("\n") == 1
    damaged = copy / "lidar_top" / "pcd" / "000003.pcd"
    damaged.write_bytes(damaged.read_bytes()[:2000])
    run = run_program("lidar", "animate", copy, "-o", tmp_path / "a.gif", "--size", "320x240")
    assert run.returncode in (1, 2)
    assert "000003.pcd" in run.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["copy"], "nothing is half written"
