"""OpenStreetMap over the network: Nominatim finds a place by its name, Overpass delivers the map of a box."""

from __future__ import annotations

import functools
import gzip
import hashlib
import json
import math
import re
import time
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np

from geoscene import __version__
from geoscene.errors import InputError, NetworkError, SourceNotFoundError
from geoscene.sources.assemble import features
from geoscene.sources.data import METRES_PER_DEGREE, Bounds, OsmData
from geoscene.sources.elements import Collector, collect_answer, query_for
from geoscene.sources.extent import checked_bounds
from geoscene.support.files import write_atomically
from geoscene.support.progress import Aside, Progress, displayed, shows_progress
from geoscene.support.urls import without_secrets

_SMALLEST = 400.0  # metres: smallest side of the box of a place
_NOMINATIM_PAUSE = 1.0  # seconds before each request; the public server allows one per second
_CACHE_VERSION = 1
_WIDEST = 1e6  # metres around a point

BUSY = frozenset({429, 502, 503, 504})
"""HTTP statuses of a server that may answer the same request later."""


@dataclass(frozen=True, slots=True)
class Servers:
    """Addresses of servers, and how requests are repeated and limited.

    nominatim     : base address of the geocoder
    overpass      : base addresses of map servers, tried in this order
    user_agent    : header that names the client
    timeout       : seconds per request
    rounds        : how often the whole list is tried while any server is busy
    wait          : seconds between rounds, less if a server states a shorter time (``Retry-After``)
    max_query_km2 : larger areas are fetched in parts
    max_area_km2  : larger areas are refused; for these the public servers ask to use extracts
    """

    nominatim: str = "https://nominatim.openstreetmap.org/"
    overpass: tuple[str, ...] = (
        "https://overpass-api.de/api",
        "https://overpass.private.coffee/api",
        "https://maps.mail.ru/osm/tools/overpass/api",
    )
    user_agent: str = f"geoscene/{__version__} (builds 3D scenes from OpenStreetMap)"
    timeout: int = 180
    rounds: int = 3
    wait: float = 30.0
    max_query_km2: float = 50.0
    max_area_km2: float = 2500.0

    def __post_init__(self) -> None:
        """Raise InputError for an address of another protocol, or of none."""
        for url in (self.nominatim, *self.overpass):
            check_address(url)


def check_address(url: str) -> None:
    """Raise InputError for an address that is not of the web."""
    if not re.match(r"https?://[^/?#]", url, re.IGNORECASE):
        known = without_secrets(url.rpartition("@")[2])
        raise InputError(f"{known}: give the address of a server, which begins with https:// or http://")


@dataclass(frozen=True, slots=True)
class Answers:
    """Answers of servers by their requests, kept in a folder; those without a result are not kept.

    folder  : of the files; nothing is kept if None
    refresh : ask servers again, and replace what is kept
    """

    folder: Path | None = None
    refresh: bool = False

    def get(self, request: str, *, ask: Callable[[], Any], use: Callable[[Any], bool]) -> None:
        """Use the answer to a request: the kept one, else that of a server, which is kept.

        ask : returns the answer of a server
        use : takes an answer; returns whether it has a result. It raises InputError for one that cannot be
              read, which is then not kept
        """
        path = self._path(request)
        if path is not None and path.exists() and not self.refresh:
            try:
                if use(json.loads(gzip.decompress(path.read_bytes()))):
                    return
            except (OSError, EOFError, ValueError, zlib.error):
                pass  # damaged: ask again
            path.unlink()
        answer = ask()
        if use(answer) and path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(path, gzip.compress(json.dumps(answer).encode(), compresslevel=6, mtime=0))

    def _path(self, request: str) -> Path | None:
        key = hashlib.sha256(f"{_CACHE_VERSION}\n{request}".encode()).hexdigest()[:24]
        return None if self.folder is None else self.folder / f"{key}.json.gz"

    @property
    def advice(self) -> str:
        """Where answers are kept, and how to ask again, for messages."""
        return "" if self.folder is None else f"; answers are kept in {self.folder}, `refresh` asks again"


def host_of(url: str) -> str:
    """Host and port of an address, without user and password."""
    return urlsplit(url).netloc.rpartition("@")[2] or without_secrets(url)


def _first_answer(
    what: str, urls: Sequence[str], *, ask: Callable[[Any, str], Any], servers: Servers, progress: Progress
) -> Any:
    """The first answer of the servers, tried in turn; busy servers are tried `Servers.rounds` times.

    what : head of the error message
    ask  : returns the answer of one server, given a session and the server's address

    Raises NetworkError if no server answers.
    """
    for round_ in range(servers.rounds):
        failures: list[str] = []
        waits: list[float] = []
        for url in urls:
            try:
                with open_session(servers.user_agent) as session:
                    return ask(session, url)
            except RefusedError as error:
                failures.append(f"{host_of(url)}: {error}")
                if error.status in BUSY:
                    waits.append(min(error.retry_after, servers.wait))
            except (OSError, ValueError) as error:  # no connection; an address that is none
                failures.append(f"{host_of(url)}: {cause(error)}")
        if not waits or round_ == servers.rounds - 1:
            break
        wait(min(waits), "; ".join(failures), progress=progress)
    raise NetworkError(
        f"{what} ({'; '.join(failures)}); without a network, build from an extract (`osm` FILE)"
        " or from the bundled one (`demo`)"
    )


def wait(seconds: float, reason: str, *, progress: Progress) -> None:
    """Wait before a request is repeated, and say so, with the reason, if it takes a second or more."""
    stage, end, whole = (
        Aside(f"waiting {seconds:.0f} s ({reason})"),
        time.monotonic() + seconds,
        round(seconds),
    )
    while (left := end - time.monotonic()) > 0:
        if whole:
            progress(stage, min(int(seconds - left), whole - 1), total=whole)
        time.sleep(min(left, 1.0))
    if whole:
        progress(stage, whole, total=whole)


def _json_of(response: Any) -> Any:
    """The document of an answer in JSON; raises RefusedError, which says what came in its place."""
    try:
        return response.json()
    except ValueError:
        text = response.text.strip()
    page = re.search(r"<title>(.*?)</title>|<p>(.*?)</p>", text, re.DOTALL | re.IGNORECASE)
    said = " ".join(re.sub(r"<[^>]*>", " ", (page[1] or page[2] or "") if page else "").split())[:80]
    if text.startswith("<"):
        what = f"but a web page{f' ({said})' if said else ''} instead of data"
    elif text[:1] in ("{", "["):
        what = f"but an answer that is cut short after {len(text):,} characters"
    else:
        what = "but an empty answer" if not text else f"but no JSON ({' '.join(text[:40].split())})"
    raise RefusedError(response.status_code, what)


def _search(name: str, servers: Servers, *, progress: Progress) -> Any:
    """Nominatim's results for a name."""
    query = {"q": name, "format": "json", "polygon_geojson": 1, "dedupe": 0, "limit": 10}

    def ask(session: Any, url: str) -> Any:
        time.sleep(_NOMINATIM_PAUSE)
        found = _json_of(session.get(f"{url.rstrip('/')}/search", params=query, timeout=servers.timeout))
        if not isinstance(found, list):
            raise RefusedError(200, "but no list of places")
        for result in found:
            _check_result(result)
        return found

    return _first_answer(
        f"cannot look up {name!r}", [servers.nominatim], ask=ask, servers=servers, progress=progress
    )


def _check_result(result: Any) -> None:
    """Raise RefusedError for a result of Nominatim without the box of a place."""
    with suppress(KeyError, TypeError, ValueError):
        south, north, west, east = map(float, result["boundingbox"])
        if -90 <= south <= north <= 90 and abs(west) <= 180 and abs(east) <= 180:
            return
    raise RefusedError(200, "but a place without a box in degrees")


_INCOMPLETE = re.compile(r"error|time[d]? ?out|memory|limit|abort|too busy", re.IGNORECASE)
"""Remarks of Overpass on an answer that is not all of the data."""


def _ask_overpass(query: str, servers: Servers, *, progress: Progress) -> Any:
    """Overpass' answer to a query, sent when the server has a free slot."""

    def ask(session: Any, url: str) -> Any:
        base = url.rstrip("/")
        pause = _seconds_to_free_slot(session, f"{base}/status", timeout=servers.timeout)
        if pause > servers.timeout:
            raise RefusedError(429, f"no free slot for {pause:.0f} s", retry_after=pause)
        if pause:
            wait(pause, f"{host_of(url)}: no free slot", progress=progress)
        answer = _json_of(session.post(f"{base}/interpreter", data={"data": query}, timeout=servers.timeout))
        if not isinstance(answer, dict) or not isinstance(answer.get("elements"), list):
            raise RefusedError(200, "but no map objects")
        remark = str(answer.get("remark", ""))
        if _INCOMPLETE.search(remark):
            raise RefusedError(200, " ".join(remark.split())[:200])
        return answer

    return _first_answer(
        "no map server delivered", servers.overpass, ask=ask, servers=servers, progress=progress
    )


def _seconds_to_free_slot(session: Any, url: str, *, timeout: float) -> float:
    """Seconds until an Overpass server takes a query, by its status page; 0 if the page does not say."""
    try:
        page = session.get(url, timeout=timeout).text
    except (RefusedError, OSError):
        return 0.0
    waits = [float(seconds) for seconds in re.findall(r"Slot available after: .* in (\d+) seconds", page)]
    return 0.0 if re.search(r"\d+ slots? available now", page) else min(waits, default=0.0)


def _parts(bounds: Bounds, largest_km2: float) -> list[Bounds]:
    """The box cut at 180° of longitude, then into equal, about square boxes of at most ``largest_km2``."""
    west, south, east, north = bounds
    if east > 180:
        return [
            *_parts((west, south, 180.0, north), largest_km2),
            *_parts((-180.0, south, east - 360, north), largest_km2),
        ]
    width = (east - west) * METRES_PER_DEGREE * math.cos(math.radians((south + north) / 2)) / 1000
    height = (north - south) * METRES_PER_DEGREE / 1000
    side = math.sqrt(largest_km2)
    columns, rows = math.ceil(width / side), math.ceil(height / side)
    x = np.linspace(west, east, columns + 1).tolist()
    y = np.linspace(south, north, rows + 1).tolist()
    return [(x[i], y[j], x[i + 1], y[j + 1]) for j in range(rows) for i in range(columns)]


def _area_km2(bounds: Bounds) -> float:
    west, south, east, north = bounds
    across = (east - west) * math.cos(math.radians((south + north) / 2))
    return across * (north - south) * (METRES_PER_DEGREE / 1000) ** 2


def _fetch(bounds: Bounds, source: str, *, answers: Answers, servers: Servers, progress: Progress) -> OsmData:
    area = _area_km2(bounds)
    if area > servers.max_area_km2:
        raise InputError(
            f"{source}: {area:,.0f} km², more than the {servers.max_area_km2:,.0f} km² that map servers"
            " may be asked for; take a part of it, or an extract of the region (`osm` FILE)"
        )
    collector = Collector(bounds=bounds)

    def use(answer: Any) -> bool:
        collect_answer(answer, collector)
        return bool(answer["elements"])

    parts = _parts(bounds, servers.max_query_km2)
    for done, part in enumerate(parts):
        progress("fetching the map", done, total=len(parts))
        query = query_for(part, timeout=servers.timeout)
        ask = functools.partial(_ask_overpass, query, servers, progress=progress)
        try:
            answers.get(query, ask=ask, use=use)
        except InputError as error:
            raise NetworkError(f"{source}: the map server's answer cannot be read ({error})") from error
    progress("fetching the map", len(parts), total=len(parts))
    if len(collector) == 0:
        raise SourceNotFoundError(
            f"{source}: OpenStreetMap has nothing there; are the coordinates in order?{answers.advice}"
        )
    return replace(features(collector.finish(), bounds=bounds, source=source), kind="overpass")


def _around(lon: float, lat: float, *, half_width: float, half_height: float) -> Bounds:
    """The box (degrees) around a point, by its half extents in metres."""
    dy = half_height / METRES_PER_DEGREE
    dx = half_width / (METRES_PER_DEGREE * math.cos(math.radians(lat)))
    return lon - dx, lat - dy, lon + dx, lat + dy


@shows_progress
def fetch_bbox(
    bbox: Bounds,
    *,
    cache_dir: Path | None = None,
    refresh: bool = False,
    servers: Servers | None = None,
    progress: Progress = displayed,
) -> OsmData:
    """The features that intersect a box, from Overpass; the same as `read_osm` returns for an extract.

    bbox      : west, south, east, north in degrees
    cache_dir : folder for answers, so that the same request is sent once; no cache if None. Answers without
                a result are not kept
    refresh   : send requests again, and replace answers that are kept
    servers   : the public ones if None
    progress  : reports the parts in which a large area is fetched, and waits for busy servers

    Raises InputError for an invalid or too large box, SourceNotFoundError if it is empty, NetworkError if no
    server answers.
    """
    bounds = checked_bounds(bbox)
    source = f"OpenStreetMap, {','.join(f'{v:g}' for v in bounds)}"
    answers = Answers(cache_dir, refresh)
    return _fetch(bounds, source, answers=answers, servers=servers or Servers(), progress=progress)


@shows_progress
def fetch_point(
    lat: float,
    lon: float,
    *,
    radius: float,
    cache_dir: Path | None = None,
    refresh: bool = False,
    servers: Servers | None = None,
    progress: Progress = displayed,
) -> OsmData:
    """The features that intersect the square of ``radius`` metres to each side of a point (degrees).

    Options and errors are those of `fetch_bbox`.
    """
    if not (math.isfinite(lat) and math.isfinite(lon) and abs(lat) < 90 and abs(lon) <= 180):
        raise InputError(f"point {lat:g},{lon:g}: give latitude, longitude in degrees, in this order")
    if not 0 < radius < _WIDEST:
        raise InputError(f"`radius` {radius:g}: give metres, more than 0 and less than {_WIDEST:g}")
    bounds = checked_bounds(_around(lon, lat, half_width=radius, half_height=radius))
    source = f"OpenStreetMap, {radius:g} m around {lat:g},{lon:g}"
    answers = Answers(cache_dir, refresh)
    return _fetch(bounds, source, answers=answers, servers=servers or Servers(), progress=progress)


@shows_progress
def locate(
    name: str,
    *,
    cache_dir: Path | None = None,
    refresh: bool = False,
    servers: Servers | None = None,
    progress: Progress = displayed,
) -> tuple[Bounds, str]:
    """The box of a place (west, south, east, north, degrees) and its full name, from Nominatim.

    The first result with an outline is taken, else the first; smaller boxes are widened to 400 m a side.

    Raises SourceNotFoundError for an unknown place, NetworkError if the server does not answer.
    """
    servers = servers or Servers()
    if not name.strip():
        raise InputError("the place has no name")
    answers, results = Answers(cache_dir, refresh), list[dict[str, Any]]()

    def use(answer: Any) -> bool:
        results[:] = answer
        return bool(answer)

    request = f"{without_secrets(servers.nominatim)} {name}"
    answers.get(request, ask=functools.partial(_search, name, servers, progress=progress), use=use)
    if not results:
        raise SourceNotFoundError(
            f"no place called {name!r} in OpenStreetMap; try another spelling,"
            f" or `point` LAT,LON, or `bbox` W,S,E,N{answers.advice}"
        )
    outlined = [r for r in results if r.get("geojson", {}).get("type") in {"Polygon", "MultiPolygon"}]
    found = (outlined or results)[0]
    south, north, west, east = (float(v) for v in found["boundingbox"])
    lat, lon = (south + north) / 2, (west + east) / 2
    least = _around(lon, lat, half_width=_SMALLEST / 2, half_height=_SMALLEST / 2)
    bounds = (min(west, least[0]), min(south, least[1]), max(east, least[2]), max(north, least[3]))
    return checked_bounds(bounds), str(found.get("display_name", name))


@shows_progress
def fetch_place(
    name: str,
    *,
    cache_dir: Path | None = None,
    refresh: bool = False,
    servers: Servers | None = None,
    progress: Progress = displayed,
) -> OsmData:
    """The features that intersect the box of a place, given by a name for Nominatim ("Norfolk, VA").

    Options and errors are those of `fetch_bbox` and `locate`.
    """
    servers = servers or Servers()
    bounds, full_name = locate(name, cache_dir=cache_dir, refresh=refresh, servers=servers, progress=progress)
    source, answers = f"OpenStreetMap, {full_name}", Answers(cache_dir, refresh)
    return _fetch(bounds, source, answers=answers, servers=servers, progress=progress)


class RefusedError(Exception):
    """An answer that is not the data.

    status      : HTTP status
    retry_after : seconds to wait before a retry (header ``Retry-After``), infinite if not stated
    """

    def __init__(self, status: int, reason: str, *, retry_after: float = math.inf) -> None:
        super().__init__(f"HTTP {status}, {reason}" if reason else f"HTTP {status}")
        self.status = status
        self.retry_after = retry_after


@contextmanager
def open_session(user_agent: str) -> Iterator[Any]:
    """A `requests.Session` that raises RefusedError for every HTTP error."""
    import requests  # noqa: PLC0415 - heavy

    with requests.Session() as session:
        session.headers.update({"User-Agent": user_agent, "Accept-Language": "en"})
        session.hooks["response"].append(_raise_refusal)
        yield session


def _raise_refusal(response: Any, *_: Any, **__: Any) -> None:
    if response.status_code >= 400:
        stated = response.headers.get("Retry-After", "")
        wait = float(stated) if stated.isdigit() else math.inf
        raise RefusedError(response.status_code, response.reason or "", retry_after=wait)


def cause(error: BaseException) -> str:
    """The reason of a failed request in at most 120 characters, without secrets of its address."""
    from requests import exceptions  # noqa: PLC0415 - heavy

    if isinstance(error, exceptions.ContentDecodingError):
        return "an answer that is damaged or cut short (its compression cannot be undone)"
    if isinstance(error, exceptions.ChunkedEncodingError):
        return "an answer that is cut short"
    if isinstance(error, exceptions.Timeout):
        return "no answer in time"
    while (inner := error.__cause__ or error.__context__) is not None:
        error = inner
    text = without_secrets(" ".join(str(getattr(error, "strerror", None) or error).split()))
    return text[:120] or "no answer"
