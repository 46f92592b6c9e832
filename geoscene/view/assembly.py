"""Web pages: the shell that the pages of scenes and of drives share, and compressed bytes in it."""

from __future__ import annotations

import html
import re
import zlib
from base64 import b64encode
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from string import Template
from typing import IO, Any

from geoscene.errors import InputError
from geoscene.export.kinds import compact_json
from geoscene.support.files import append

_COPYRIGHT = "https://www.openstreetmap.org/copyright"

_SHARED = ("common.js", "blob.js", "camera.js", "gestures.js", "program.js")
"""Scripts of all pages, in the order in which they are joined."""


def gzip(data: bytes) -> bytes:
    """Gzip bytes (RFC 1952) without a time stamp: equal data give equal bytes."""
    packer = zlib.compressobj(9, zlib.DEFLATED, 31)
    return packer.compress(data) + packer.flush()


def check_page(out: Path, *, overwrite: bool) -> None:
    """Raise InputError for a file that is not named as a page, or exists and must not be replaced."""
    if out.is_dir():
        raise InputError(f"{out}: is a folder; name a file such as page.html")
    if out.suffix.lower() not in (".html", ".htm"):
        raise InputError(f"{out}: unknown suffix; a page is a file such as {out.with_suffix('.html').name}")
    if out.exists() and not overwrite:
        raise InputError(f"{out}: exists already; set `overwrite` to replace it")


def write_blob(file: IO[bytes], name: str, *, data: bytes) -> None:
    """Write bytes as an element of the page that browsers neither run nor display."""
    file.write(f'<script type="text/plain" id="{name}">'.encode() + b64encode(data) + b"</script>\n")


def write_page(
    file: IO[bytes],
    *,
    package: str,
    scripts: Sequence[str],
    title: str,
    credit: str,
    head: dict[str, Any],
    blobs: IO[bytes],
    generator: str = "geoscene",
    sources: str = "",
    connect: str = "'none'",
) -> None:
    """Write a page: the shell and the shared parts with the body, style and scripts of a package.

    head    : JSON that the page reads first
    blobs   : elements with bytes, see `write_blob`
    sources : sources of scripts besides the page itself (Content-Security-Policy)
    connect : where the page may load data from
    """
    title = html.escape(title)
    words = {
        "title": title,
        "generator": generator,
        "sources": sources,
        "connect": connect,
        "style": _part("shell.css") + _part("page.css", package),
        "body": Template(_part("body.html", package)).substitute(title=title, credit=_link_credits(credit)),
        "head": compact_json(head).decode().replace("<", "\\u003c"),  # cannot end its element
        "script": "\n".join([*map(_part, _SHARED), *(_part(name, package) for name in scripts)]),
    }
    before, after = (Template(half).substitute(words) for half in _part("shell.html").split("$blobs"))
    file.write(before.encode())
    append(file, blobs)
    file.write(after.encode())


def _part(name: str, package: str = "geoscene.view") -> str:
    """A file of a package's folder ``page``."""
    return resources.files(package).joinpath("page", name).read_text("utf-8")


def _link_credits(text: str) -> str:
    """Text as HTML with a link to OpenStreetMap's copyright page."""
    link = f'<a href="{_COPYRIGHT}" target="_blank" rel="noopener">openstreetmap.org/copyright</a>'
    return re.sub(re.escape(_COPYRIGHT), link, html.escape(text)).replace("(c)", "©")
