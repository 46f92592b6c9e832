"""The page that plays a drive: one HTML file, or a server on this machine for larger drives."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from tempfile import SpooledTemporaryFile
from typing import IO, Any

import numpy as np

from geoscene.support.files import atomic_file, exclusive, spool
from geoscene.support.progress import Progress, displayed, shows_progress
from geoscene.view.assembly import check_page, write_blob, write_page
from lidar.dataset.layout import Dataset, DatasetLike, open_dataset
from lidar.errors import InputError, LidarError
from lidar.options.look import PlaybackOptions
from lidar.tools.view.drive import Drive
from lidar.tools.view.sweeps import pack_slots

_SCRIPTS = ("sweep.js", "draw.js", "panels.js", "player.js")
"""The player's own scripts, in the order in which they are joined."""
HOST = "127.0.0.1"
"""Only programs of this machine reach the server."""

_LOOKED_AT = 12
"""Frames from which the size of a page is estimated."""
_FILLED = 0.9
"""Share of the largest size that frames are chosen to fill: those that were looked at may be small ones."""

_KEPT = 256
"""Packed sweeps and images that are kept."""


@dataclass(frozen=True, slots=True)
class PageSummary:
    """Summary of a page.

    path    : the file
    bytes   : of it
    frames  : sweeps
    images  : of cameras
    returns : in the sweeps
    notes   : what a user must know of it, one line each
    """

    path: Path
    bytes: int
    frames: int
    images: int
    returns: int
    notes: tuple[str, ...]


@shows_progress
def view_drive(
    dataset: DatasetLike,
    out: str | Path,
    *,
    options: PlaybackOptions = PlaybackOptions(),
    overwrite: bool = False,
    progress: Progress = displayed,
) -> PageSummary:
    """Write a drive as one web page that a browser opens from disk and plays; returns its contents.

    Of a drive that is too large for ``max_mb``, each n-th frame is shown, and a note says so.

    The page loads nothing: data, style and player (WebGL 2) are in it. Its bytes depend on the dataset, the
    scene's roads and the options alone.

    Raises InputError for a file that exists or is not named as a page, for sensors and frames that the
    dataset does not have, and for a page that would be larger than ``max_mb`` with an `every` that is given;
    the message then names a selection that would fit. Raises DatasetError for damaged files and a dataset
    without clouds in the sensor frame.
    """
    dataset = open_dataset(dataset)
    out = Path(out)
    check_page(out, overwrite=overwrite)
    drive, limit = Drive(dataset, options), options.max_mb * 1e6
    (fixed, whole), every = _estimated_bytes(drive), options.every
    if whole > limit:
        if every is not None:
            raise InputError(_too_large(drive, options, fixed=fixed, size=whole))
        every = min(math.ceil((whole - fixed) / max(_FILLED * limit - fixed, 1.0)), len(drive))
        drive = Drive(dataset, replace(options, every=every))
    head = drive.head()
    with exclusive(out), atomic_file(out) as file, spool(out) as blobs:
        _write_slots(blobs, drive)
        returns = images = 0
        for k, parts in enumerate(_parts(drive)):
            progress("page", k, total=len(drive))
            for name, count, data in parts:
                returns, images = returns + count, images + name.startswith("image")
                write_blob(blobs, name, data=data)
            if blobs.tell() > limit:
                size = max(1.01 * limit, blobs.tell() / (k + 1) * len(drive))
                raise InputError(_too_large(drive, options, fixed=fixed, size=size))
        write_player(file, drive, head=head, blobs=blobs)
    notes = [*drive.notes, *_left_out(drive)]
    if every != options.every:
        notes.append(
            f"one frame of {every}: all would take about {whole / 1e6:.3g} MB, more than the"
            f" {options.max_mb:g} of `max_mb`; raise it, or see all of them with --serve"
        )
    return PageSummary(out, out.stat().st_size, len(drive), images, returns, tuple(notes))


def _parts(drive: Drive) -> Iterator[Iterator[tuple[str, int, bytes]]]:
    """Name, number of returns and bytes of what each frame adds to the page."""
    written: set[str] = set()

    def of(k: int) -> Iterator[tuple[str, int, bytes]]:
        for number, scanner in enumerate(drive.scanners):
            row = int(scanner.index[k])
            if (name := f"sweep-{number}-{row}") not in written:
                written.add(name)
                yield name, *drive.sweep(row, scanner=number)
        for number, camera in enumerate(drive.cameras):
            image = int(camera.index[k])
            for kind in camera.kinds:
                if (name := f"image-{number}-{kind}-{image}") not in written:
                    written.add(name)
                    yield name, 0, drive.image(number, image, kind=kind)

    yield from map(of, range(len(drive)))


def _estimated_bytes(drive: Drive) -> tuple[float, float]:
    """Bytes of the page without frames, and with all, from a few frames and the sizes of all clouds."""
    with SpooledTemporaryFile() as blobs:
        _write_slots(blobs, drive)
        size = fixed = float(blobs.tell())
        for number, scanner in enumerate(drive.scanners):
            clouds = np.array([drive.cloud(scanner, k).stat().st_size for k in range(len(scanner.rows))])
            few, before = _few(len(clouds)), blobs.tell()
            for k in few:
                write_blob(blobs, "sweep", data=drive.sweep(k, scanner=number)[1])
            size += (blobs.tell() - before) * clouds.sum() / max(clouds[few].sum(), 1)
        for number, camera in enumerate(drive.cameras):
            few, before = _few(len(camera.frame)), blobs.tell()
            for k in few:
                for kind in camera.kinds:
                    write_blob(blobs, "image", data=drive.image(number, k, kind=kind))
            size += (blobs.tell() - before) * len(camera.frame) / len(few)
    return fixed, size


def _few(count: int) -> list[int]:
    """Numbers of a few frames, spread over all."""
    few: list[int] = np.unique(np.linspace(0, count - 1, _LOOKED_AT).astype(int)).tolist()
    return few


def write_player(
    file: IO[bytes], drive: Drive, *, head: dict[str, Any], blobs: IO[bytes], served: bool = False
) -> None:
    """Write the player's page.

    blobs  : elements with the bytes of frames
    served : frames come from the server of the page instead; nothing else can be loaded
    """
    write_page(
        file,
        package="lidar.tools.view",
        scripts=_SCRIPTS,
        title=f"{head['name']}, {', '.join(one['name'] for one in head['scanners'])}",
        credit=str(drive.dataset.manifest.get("attribution", "")),
        head=head | {"served": served},
        blobs=blobs,
        generator="geoscene lidar",
        connect="'self'" if served else "'none'",
    )


def _write_slots(blobs: IO[bytes], drive: Drive) -> None:
    """Write the table of directions of each scanner."""
    for number, slots in enumerate(drive.slots):
        write_blob(blobs, f"slots-{number}", data=pack_slots(slots))


def served_page(drive: Drive) -> bytes:
    """The page of a server, which asks it for frames."""
    with SpooledTemporaryFile() as blobs, SpooledTemporaryFile() as file:
        _write_slots(blobs, drive)
        write_player(file, drive, head=drive.head(), blobs=blobs, served=True)
        file.seek(0)
        return file.read()


def _left_out(drive: Drive) -> list[str]:
    """Parts of the dataset that the page leaves out."""
    names = {*(shown.clouds.name for shown in drive.scanners), *(camera.name for camera in drive.cameras)}
    notes = []
    if left := [name for name in drive.dataset.sensors("lidar", "camera") if name not in names]:
        notes.append(f"sensors left out: {', '.join(left)} (name scanners and cameras by `sensors`)")
    if len(drive) < len(drive.clouds.files):
        notes.append(f"{len(drive)} of {len(drive.clouds.files)} frames")
    return notes


def _too_large(drive: Drive, options: PlaybackOptions, *, fixed: float, size: float) -> str:
    """Error text: how many bytes the page would have, and a selection of frames that would fit.

    fixed : bytes of it without frames
    """
    limit = options.max_mb
    fits = max(1, int((_FILLED * limit * 1e6 - fixed) / max(size - fixed, 1.0) * len(drive)))
    message = f"the page would have about {size / 1e6:.3g} MB and `max_mb` is {limit:g}"
    every = (options.every or 1) * -(-len(drive) // fits)
    frames = drive.clouds.frames[drive.rows]
    end = int(frames[min(fits, len(frames) - 1)])
    return (
        f"{message}; `every` {every} fits, `frames` {int(frames[0])}:{end} too; or serve all of it (--serve)"
    )


class DriveServer(ThreadingHTTPServer):
    """Serves the player at ``/``, and sweeps and images when the player asks for them.

    Answers only requests that name this host, so that pages of other sites cannot read the drive through a
    host name of theirs that leads here.

    Raises InputError for a port that is taken or none, and as `Drive`.
    """

    daemon_threads = True

    def __init__(
        self, dataset: Dataset, *, options: PlaybackOptions = PlaybackOptions(), port: int = 0
    ) -> None:
        if not 0 <= port < 1 << 16:
            raise InputError(f"`port` {port}: give 0 to 65535")
        self.drive = Drive(dataset, options)
        self.page = served_page(self.drive)
        self.sweep = lru_cache(_KEPT)(lambda scanner, k: self.drive.sweep(k, scanner=scanner))
        self.image = lru_cache(_KEPT)(self.drive.image)
        try:
            super().__init__((HOST, port), _Handler)
        except OSError as error:
            raise InputError(f"`port` {port}: {error.strerror}; give another, or 0 for a free one") from error

    @property
    def address(self) -> str:
        """The URL of the player."""
        return f"http://{HOST}:{self.server_port}/"


class _Handler(BaseHTTPRequestHandler):
    server: DriveServer
    protocol_version = "HTTP/1.1"

    def do_GET(self) -> None:
        """Answer with the page, a sweep or an image."""
        port = self.server.server_port
        if self.headers.get("Host") not in (f"{HOST}:{port}", f"localhost:{port}"):
            self._answer(HTTPStatus.FORBIDDEN, b"another host's name")
            return
        try:
            kind, data = self._found(self.path.partition("?")[0])
        except IndexError:
            self._answer(HTTPStatus.NOT_FOUND, b"nothing here")
        except LidarError as error:
            self._answer(HTTPStatus.INTERNAL_SERVER_ERROR, str(error).encode())
        else:
            self._answer(HTTPStatus.OK, data, kind=kind)

    def _found(self, path: str) -> tuple[str, bytes]:
        """Media type and bytes at a path; raises IndexError for an unknown path."""
        server = self.server
        if path == "/":
            return "text/html; charset=utf-8", server.page
        if found := re.fullmatch(r"/sweep/(\d{1,9})/(\d{1,9})", path):
            return "application/octet-stream", server.sweep(int(found[1]), int(found[2]))[1]
        if found := re.fullmatch(r"/image/(\d{1,9})/(rgb|depth)/(\d{1,9})", path):
            camera, kind, k = int(found[1]), found[2], int(found[3])
            if kind in server.drive.cameras[camera].kinds:
                return "image/jpeg", server.image(camera, k, kind=kind)
        raise IndexError(path)

    def _answer(self, status: HTTPStatus, data: bytes, *, kind: str = "text/plain; charset=utf-8") -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(data)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.end_headers()
        self.wfile.write(data)

    def log_message(self, *_: object) -> None:
        """Requests are not logged."""
