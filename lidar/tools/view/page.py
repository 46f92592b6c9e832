"""The page that plays a drive: one HTML file, or a server on this machine for larger drives."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import lru_cache
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from tempfile import SpooledTemporaryFile
from typing import IO, Any

from geoscene.support.files import atomic_file, exclusive, spool
from geoscene.support.progress import Progress, displayed, shows_progress
from geoscene.view.assembly import check_page, write_blob, write_page
from lidar.dataset.layout import Dataset, DatasetLike, open_dataset
from lidar.errors import InputError, LidarError
from lidar.options import PlaybackOptions
from lidar.tools.view.drive import Drive
from lidar.tools.view.sweeps import pack_slots

_SCRIPTS = ("sweep.js", "draw.js", "panels.js", "player.js")
"""The player's own scripts, in the order in which they are joined."""
HOST = "127.0.0.1"
"""Only programs of this machine reach the server."""

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

    The page loads nothing: data, style and player (WebGL 2) are in it. Its bytes depend on the dataset, the
    scene's roads and the options alone.

    Raises InputError for a file that exists or is not named as a page, for sensors and frames that the
    dataset does not have, and for a page that would be too large; the message then gives a selection that
    would fit. Raises DatasetError for damaged files and a dataset without clouds in the sensor frame.
    """
    dataset = open_dataset(dataset)
    out = Path(out)
    check_page(out, overwrite=overwrite)
    drive = Drive(dataset, options)
    head = drive.head()
    returns = 0
    written: set[str] = set()
    swept: set[str] = set()
    with exclusive(out), atomic_file(out) as file, spool(out) as blobs:
        _write_slots(blobs, drive)
        for k in range(len(drive)):
            progress("page", k, total=len(drive))
            for number, scanner in enumerate(drive.scanners):
                row = int(scanner.index[k])
                if (name := f"sweep-{number}-{row}") not in swept:
                    count, data = drive.sweep(row, scanner=number)
                    returns += count
                    write_blob(blobs, name, data=data)
                    swept.add(name)
            for number, camera in enumerate(drive.cameras):
                for kind in camera.kinds:
                    image = int(camera.index[k])
                    if (name := f"image-{number}-{kind}-{image}") not in written:
                        write_blob(blobs, name, data=drive.image(number, image, kind=kind))
                        written.add(name)
            if blobs.tell() > options.max_mb * 1e6:
                raise InputError(_too_large(drive, options, done=k + 1, size=blobs.tell()))
        write_player(file, drive, head=head, blobs=blobs)
    notes = (*drive.notes, *_left_out(drive))
    return PageSummary(out, out.stat().st_size, len(drive), len(written), returns, notes)


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


def _too_large(drive: Drive, options: PlaybackOptions, *, done: int, size: int) -> str:
    """Error text: how large the page would be, and a selection of frames that would fit."""
    limit = options.max_mb
    whole = size / done * len(drive) / 1e6
    fits = max(1, int(0.9 * limit * 1e6 / size * done))
    message = f"the page would have about {max(whole, 1.01 * limit):.3g} MB and `max_mb` is {limit:g}"
    every = options.every * -(-len(drive) // fits)
    frames = drive.clouds.frames[drive.rows]
    end = int(frames[min(fits, len(frames) - 1)])
    return (
        f"{message}; `every` {every} fits, `frames` {int(frames[0])}:{end} too; or serve all of it (--serve)"
    )


class DriveServer(ThreadingHTTPServer):
    """Serves the player at ``/``, and sweeps and images when the player asks for them.

    Answers only requests that name this host, so that pages of other sites cannot read the drive through a
    host name of theirs that leads here.

    Raises InputError for a port that is taken, and as `Drive`.
    """

    daemon_threads = True

    def __init__(
        self, dataset: Dataset, *, options: PlaybackOptions = PlaybackOptions(), port: int = 0
    ) -> None:
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
