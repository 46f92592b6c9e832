"""Pages of one file: their parts, compressed bytes in them, and the template that joins both."""

from __future__ import annotations

import html
import re
import zlib
from base64 import b64encode
from importlib import resources
from pathlib import Path
from string import Template
from typing import IO

from geoscene.errors import InputError
from geoscene.support.files import append

_COPYRIGHT = "https://www.openstreetmap.org/copyright"


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


def part(name: str, *, package: str = "geoscene.view") -> str:
    """A file of a package's folder ``page``."""
    return resources.files(package).joinpath("page", name).read_text("utf-8")


def script_text(text: str) -> str:
    """JSON text that cannot end the element of the page that holds it."""
    return text.replace("<", "\\u003c")


def link_credits(text: str) -> str:
    """Text as HTML with a link to OpenStreetMap's copyright page."""
    link = f'<a href="{_COPYRIGHT}" target="_blank" rel="noopener">openstreetmap.org/copyright</a>'
    return re.sub(re.escape(_COPYRIGHT), link, html.escape(text)).replace("(c)", "©")


def write_blob(file: IO[bytes], name: str, *, data: bytes) -> None:
    """Write bytes as an element of the page that browsers neither run nor display."""
    file.write(f'<script type="text/plain" id="{name}">'.encode() + b64encode(data) + b"</script>\n")


def write_page(file: IO[bytes], template: str, *, words: dict[str, str], blobs: IO[bytes]) -> None:
    """Write a template with its words filled in, and elements of bytes at ``$blobs``."""
    before, after = (Template(half).substitute(words).encode() for half in template.split("$blobs"))
    file.write(before)
    append(file, blobs)
    file.write(after)
