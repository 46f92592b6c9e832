"""Films of recorded drives: which pictures, where in the frame, and when; MP4 by PyAV, GIF by Pillow."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from geoscene.errors import need
from geoscene.support.files import atomic_path
from geoscene.support.progress import Progress, displayed, shows_progress
from geoscene.typing import Float, Ints
from lidar.dataset.layout import Dataset, DatasetLike, open_dataset
from lidar.dataset.recorded import Images, Stream, frames_within, images_of, scanner_clouds
from lidar.errors import DatasetError, InputError
from lidar.geometry.poses import Trajectory
from lidar.motion.vehicle import Vehicle, load_vehicle
from lidar.options.look import FilmOptions
from lidar.tools.films.panes import TEXT, CameraPane, MapPane, Pane, Pixels, SweepPane, Sweeps
from lidar.tools.maps.picture import BACKGROUND

Placed = list[tuple[Pane, tuple[int, int]]]

_STATUS = 28
"""Height in pixels of the line of text below the pictures."""
_CLOCK = 90_000
"""Ticks per second of the times of an MP4."""

_GIF_RATE = 100
"""Ticks per second of the times of a GIF."""

_MOST = 10**9
"""Pixels of all images of a GIF, at most."""

_QUALITY = "20"
"""Constant rate factor of H.264: visually without loss."""

SHORTEST_NS = {".mp4": 10**9 // 60, ".gif": 2 * 10**9 // _GIF_RATE}
"""Time for which an image is shown at least, by suffix: viewers show a GIF's shorter ones for longer."""


@dataclass(frozen=True, slots=True)
class FilmSummary:
    """Figures of a film.

    path     : the file
    images   : number of its images
    seconds  : its length
    size     : width and height, pixels
    shown    : what it shows
    notes    : what of the dataset it does not show
    """

    path: Path
    images: int
    seconds: float
    size: tuple[int, int]
    shown: list[str]
    notes: list[str]


@shows_progress
def film(
    dataset: DatasetLike,
    out: str | Path,
    *,
    options: FilmOptions = FilmOptions(),
    overwrite: bool = False,
    progress: Progress = displayed,
) -> FilmSummary:
    """Write a film of a dataset as MP4 or GIF, by the suffix of ``out``.

    Raises InputError for what cannot be shown, DatasetError for a dataset without it, and MissingExtraError
    for an MP4 without PyAV.
    """
    dataset = open_dataset(dataset)
    out = Path(out)
    if out.exists() and not overwrite:
        raise InputError(f"{out}: exists already; set `overwrite` to replace it")
    check_film(out)
    clouds, cameras = _chosen(dataset, options)
    lead = frames_within(clouds[0] if clouds else cameras[0].stream, options.limits, every=options.every)
    lead, notes = _slow_enough(lead, speed=options.speed, shortest_ns=SHORTEST_NS[out.suffix.lower()])
    shown_ns = _shown_ns(lead, speed=options.speed)
    names = [*(one.name for one in clouds), *(one.stream.name for one in cameras)]
    kinds = {"cameras": ("camera",), "all": ("lidar", "camera")}.get(options.show, ("lidar",))
    if left := [name for name in dataset.sensors(*kinds) if name not in names]:
        notes.append(f"sensors left out: {', '.join(left)} (name them by `sensors`)")
    trajectory = dataset.trajectory()
    sweeps = None
    if clouds:
        sweeps = Sweeps(dataset, [lead, *clouds[1:]], trajectory=trajectory, options=options)
    panes = _laid_out(dataset, sweeps, cameras=cameras, time_ns=lead.time_ns, options=options)

    def images() -> Iterator[Pixels]:
        for row in range(len(lead.frames)):
            progress("drawing", row, total=len(lead.frames))
            picture = Image.new("RGB", options.size, BACKGROUND)
            for pane, corner in panes:
                picture.paste(Image.fromarray(pane.draw(row)), corner)
            _write_status(picture, dataset, lead=lead, row=row, trajectory=trajectory)
            yield np.asarray(picture)

    with atomic_path(out, keep_suffix=True) as part:
        write_film(part, images(), shown_ns=shown_ns, size=options.size)
    seconds = float(shown_ns.sum()) / 1e9
    return FilmSummary(out, len(lead.frames), seconds, options.size, names, notes)


def _chosen(dataset: Dataset, options: FilmOptions) -> tuple[list[Stream], list[Images]]:
    """Clouds of the scanners and images of the cameras to show.

    Raises InputError for unknown sensors and those that cannot be shown, and DatasetError if there are none.
    """
    kinds = {name: sensor["kind"] for name, sensor in dataset.sensors("lidar", "camera").items()}
    if unknown := sorted(set(options.sensors) - set(kinds)):
        raise InputError(
            f"`sensors`: no scanner or camera {', '.join(unknown)} in {dataset.path}; there are"
            f" {', '.join(kinds)}"
        )
    named = {kind: [name for name in options.sensors if kinds[name] == kind] for kind in ("lidar", "camera")}
    clouds: list[Stream] = []
    cameras: list[Images] = []
    if options.show != "cameras":
        clouds = [scanner_clouds(dataset, name) for name in named["lidar"] or [""]]
    if options.show in ("cameras", "all"):
        names = named["camera"] or [name for name, kind in kinds.items() if kind == "camera"]
        cameras = [found for name in names if (found := images_of(dataset, name)) is not None]
        if not cameras and (options.show == "cameras" or named["camera"]):
            which = ", ".join(named["camera"]) or "any camera"
            raise DatasetError(f"{dataset.path}: no colour or depth images of {which}")
    return clouds, cameras


def _slow_enough(lead: Stream, *, speed: float, shortest_ns: int) -> tuple[Stream, list[str]]:
    """The frames that a viewer can show, and a note if these are not all."""
    if len(lead.frames) < 2:
        return lead, []
    step = math.ceil(shortest_ns * speed / float(np.median(np.diff(lead.time_ns))) - 1e-6)
    if step <= 1:
        return lead, []
    ending = {2: "nd", 3: "rd"}.get(step, "th")
    note = f"each {step}{ending} frame only: at this speed all would be {step} times too many a second"
    return frames_within(lead, (0, math.inf), every=step), [note]


def _shown_ns(lead: Stream, *, speed: float) -> Ints:
    """Nanoseconds (n,) for which each frame is shown: until the next one."""
    period = 1e9 / float(lead.sensor["rate_hz"])
    steps = np.diff(lead.time_ns)
    last = float(np.median(steps)) if len(steps) else period
    found: Ints = np.rint(np.append(steps, last) / speed).astype(np.int64)
    return found


def _laid_out(
    dataset: Dataset, sweeps: Sweeps | None, *, cameras: list[Images], time_ns: Ints, options: FilmOptions
) -> Placed:
    """The panes and their upper left corners."""
    width, height = options.size[0], options.size[1] - _STATUS

    def images(size: tuple[int, int], columns: int) -> Pane:
        return CameraPane(dataset, cameras, time_ns=time_ns, size=size, columns=columns)

    def sweep(size: tuple[int, int]) -> Pane:
        assert sweeps is not None  # noqa: S101
        return SweepPane(sweeps, view=options.view, size=size, vehicle=_vehicle(dataset))

    if sweeps is None:
        return [(images((width, height), math.ceil(math.sqrt(len(cameras)))), (0, 0))]
    if options.show == "sweep":
        return [(sweep((width, height)), (0, 0))]
    if options.show == "map":
        return [(MapPane(sweeps, size=(width, height), legend=True), (0, 0))]
    left = round(0.62 * width)
    if len(cameras) in (1, 2):  # above the map
        upper = height // 2
        beside = images((width - left, upper), 1)
        below = MapPane(sweeps, size=(width - left, height - upper), legend=False)
        return [(sweep((left, height)), (0, 0)), (beside, (left, 0)), (below, (left, upper))]
    upper = height
    if cameras:  # in a row below
        sensor = cameras[0].stream.sensor
        upper -= round(min(width / len(cameras) * sensor["height"] / sensor["width"], 0.4 * height))
    beside = MapPane(sweeps, size=(width - left, upper), legend=False)
    panes: Placed = [(sweep((left, upper)), (0, 0)), (beside, (left, 0))]
    if cameras:
        panes.append((images((width, height - upper), len(cameras)), (0, upper)))
    return panes


def _vehicle(dataset: Dataset) -> Vehicle | None:
    """The vehicle of a drive; None if its file is not here."""
    with suppress(InputError, OSError):
        return load_vehicle(str(dataset.manifest["recipe"].get("vehicle", "")))
    return None


def _write_status(
    picture: Image.Image, dataset: Dataset, *, lead: Stream, row: int, trajectory: Trajectory
) -> None:
    """Write the time, the frame and the speed below the panes."""
    pen, font = ImageDraw.Draw(picture), ImageFont.load_default(size=14)
    seconds, at = lead.time_ns[row] / 1e9, lead.time_ns[row : row + 1]
    steps = trajectory.time_ns.astype(float)
    speed = float(np.linalg.norm([np.interp(at[0], steps, trajectory.velocity[:, k]) for k in range(3)]))
    middle = picture.height - _STATUS / 2
    fast = f"{speed:.1f} m/s ({3.6 * speed:.0f} km/h)"
    words = f"{seconds:7.2f} s    {lead.name} frame {lead.frames[row]}    {fast}"
    pen.text((10, middle), words, fill=TEXT, font=font, anchor="lm")
    name = dataset.path.resolve().name
    pen.text((picture.width - 10, middle), name, fill=TEXT, font=font, anchor="rm")


def write_film(path: Path, images: Iterable[Pixels], *, shown_ns: Ints, size: tuple[int, int]) -> None:
    """Write images (h, w, 3) as a film; not atomically.

    path     : ends with a suffix of `SHORTEST_NS`
    shown_ns : (n,) nanoseconds for which each image is shown
    size     : width and height, even

    Raises InputError for a GIF that is too long, and MissingExtraError for an MP4 without PyAV.
    """
    ends = np.cumsum(shown_ns) / 1e9
    if path.suffix.lower() == ".mp4":
        _write_mp4(path, images, ticks=_lengths(ends * _CLOCK), size=size)
        return
    if len(ends) * size[0] * size[1] > _MOST:
        most = _MOST // (size[0] * size[1])
        raise InputError(
            f"`out`: a GIF of this size has at most {most} images, which are in memory together, and the film"
            f" has {len(ends)}; write an MP4, or choose a smaller `size`, some `frames` or a larger `every`"
        )
    _write_gif(path, images, ticks=_lengths(ends * _GIF_RATE))


def check_film(path: Path) -> None:
    """Raise InputError for a suffix that is not of a film, and MissingExtraError for an MP4 without PyAV."""
    if path.suffix.lower() not in SHORTEST_NS:
        raise InputError(f"`out` {path}: films are MP4 or GIF; give a name that ends with .mp4 or .gif")
    if path.suffix.lower() == ".mp4":
        need("av", "video")


def _lengths(ends: Float) -> list[int]:
    """Whole ticks between moments, of which each is rounded, so that errors do not add up."""
    ticks: list[int] = np.diff(np.rint(ends), prepend=0).astype(int).tolist()
    return ticks


def _write_mp4(path: Path, images: Iterable[Pixels], *, ticks: list[int], size: tuple[int, int]) -> None:
    av = need("av", "video")
    with av.open(str(path), "w", format="mp4") as file:
        # One thread: the bytes of an encoder depend on their number.
        stream = file.add_stream("libx264", rate=60, options={"crf": _QUALITY, "threads": "1"})
        stream.width, stream.height = size
        stream.pix_fmt = "yuv420p"
        stream.time_base = stream.codec_context.time_base = Fraction(1, _CLOCK)
        length: dict[int, int] = {}  # by time; the encoder does not keep it

        def write(frame: Any) -> None:
            for packet in stream.encode(frame):
                packet.duration = length.pop(packet.pts)
                file.mux(packet)

        time = 0
        for image, shown in zip(images, ticks, strict=True):
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            frame.time_base, frame.pts = Fraction(1, _CLOCK), time
            length[time] = shown
            time += shown
            write(frame)
        write(None)


def _write_gif(path: Path, images: Iterable[Pixels], *, ticks: list[int]) -> None:
    first, *others = [Image.fromarray(image).quantize(256, dither=Image.Dither.NONE) for image in images]
    milliseconds = [tick * 1000 // _GIF_RATE for tick in ticks]
    first.save(path, "GIF", save_all=True, append_images=others, duration=milliseconds, loop=0)
