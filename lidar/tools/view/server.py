"""A server of the player on this machine, for drives that are too large for one page."""

from __future__ import annotations

import re
from functools import lru_cache
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from lidar.dataset.layout import Dataset
from lidar.errors import InputError, LidarError
from lidar.options import PlaybackOptions
from lidar.tools.view.drive import Drive
from lidar.tools.view.page import served_page

HOST = "127.0.0.1"
"""Only programs of this machine reach the server."""

_KEPT = 256
"""Packed sweeps and images that are kept."""


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
