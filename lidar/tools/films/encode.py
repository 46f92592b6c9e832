"""Films as files: MP4 (H.264) by PyAV, GIF by Pillow."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from geoscene.errors import need
from geoscene.typing import Float, Ints
from lidar.errors import InputError

Pixels = NDArray[np.uint8]

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
