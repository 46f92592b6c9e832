"""OpenStreetMap over the network: Nominatim finds a place, Overpass delivers it, osmnx speaks to both."""

from __future__ import annotations

import functools
import gzip
import hashlib
import json
import math
import socket
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np

from geoscene import __version__
from geoscene.errors import InputError, NetworkError, SourceNotFoundError
from geoscene.files import write_atomically
from geoscene.sources.assemble import Bounds, checked_bounds, features
from geoscene.sources.data import OsmData
from geoscene.sources.elements import Collector
from geoscene.sources.overpass import collect_answer, query_for

Progress = Callable[[Iterable[Any]], Iterable[Any]]

_METRES_PER_DEGREE = 111_195.0  # on a sphere of 6371 km, the mean radius of the Earth (IUGG)
_SMALLEST = 400.0  # metres: a place that is a point or one house is fetched with its surroundings
_ONE_AT_A_TIME = threading.Lock()  # osmnx's settings are global
_CACHE_VERSION = 1


@dataclass(frozen=True, slots=True)
class Servers:
    """Which servers are asked, and how patiently.

    nominatim     : base address of the geocoder
    overpass      : base addresses of map servers, tried in this order
    user_agent    : what they are told of who asks
    timeout       : seconds for one answer
    rounds        : how often the whole list is tried while any server says that it is busy
    wait          : seconds between rounds, less if the servers name a shorter time (``Retry-After``)
    max_query_km2 : larger areas are asked for in parts
    max_area_km2  : larger areas are refused; the public servers ask that such work be done from extracts
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


class _RefusedError(Exception):
    """A server's answer that is no data: its HTTP status, and after how many seconds to ask again."""

    def __init__(self, status: int, reason: str, *, retry_after: float) -> None:
        super().__init__(f"HTTP {status}, {reason}" if reason else f"HTTP {status}")
        self.busy = status in {429, 502, 503, 504}
        self.retry_after = retry_after


def _refuse(response: Any, *_: Any, **__: Any) -> None:
    """Raise for an HTTP error, before osmnx sleeps or parses; handed to requests as a hook."""
    if response.status_code >= 400:
        stated = response.headers.get("Retry-After", "")
        raise _RefusedError(
            response.status_code,
            response.reason or "",
            retry_after=float(stated) if stated.isdigit() else math.inf,
        )


@contextmanager
def _osmnx(servers: Servers, overpass: str) -> Iterator[Any]:
    """The osmnx package with these servers set; whatever it changes is put back afterwards."""
    import osmnx  # noqa: PLC0415 - heavy

    wanted = {
        "doh_url_template": None,
        "http_referer": servers.user_agent,
        "http_user_agent": servers.user_agent,
        "nominatim_url": servers.nominatim,
        "overpass_rate_limit": False,  # `_ask_overpass` waits for its turn, and gives up in time
        "overpass_url": overpass,
        "requests_kwargs": {**osmnx.settings.requests_kwargs, "hooks": {"response": _refuse}},
        "requests_timeout": servers.timeout,
        "use_cache": False,  # answers are kept by `_kept`, whole or not at all
    }
    with _ONE_AT_A_TIME:
        before = {name: getattr(osmnx.settings, name) for name in wanted}
        resolver = socket.getaddrinfo  # osmnx pins the server's address by replacing it
        try:
            for name, value in wanted.items():
                setattr(osmnx.settings, name, value)
            yield osmnx
        finally:
            for name, value in before.items():
                setattr(osmnx.settings, name, value)
            socket.getaddrinfo = resolver


def _host(url: str) -> str:
    return urlsplit(url).netloc or url


def _cause(error: BaseException) -> str:
    """The innermost reason of a failed request, in few words."""
    while (inner := error.__cause__ or error.__context__) is not None:
        error = inner
    text = " ".join(str(getattr(error, "strerror", None) or error).split())
    return text[:120] or type(error).__name__


def _kept(cache_dir: Path | None, request: str, *, make: Callable[[], Any]) -> Any:
    """The answer to ``request``: from the cache, else made and put there, whole or not at all."""
    if cache_dir is None:
        return make()
    key = hashlib.sha256(f"{_CACHE_VERSION}\n{request}".encode()).hexdigest()[:24]
    path = cache_dir / f"{key}.json.gz"
    if path.exists():
        try:
            return json.loads(gzip.decompress(path.read_bytes()))
        except (OSError, EOFError, ValueError):
            path.unlink()  # damaged: ask again
    answer = make()
    cache_dir.mkdir(parents=True, exist_ok=True)
    write_atomically(path, gzip.compress(json.dumps(answer).encode(), compresslevel=6, mtime=0))
    return answer


def _patiently(what: str, urls: Sequence[str], *, ask: Callable[[str], Any], servers: Servers) -> Any:
    """The answer of the first server that gives one; those that are busy are asked again, for some rounds.

    Raises NetworkError, headed by ``what``, if none does.
    """
    import requests  # noqa: PLC0415 - heavy

    for round_ in range(servers.rounds):
        told: list[str] = []
        waits: list[float] = []
        for url in urls:
            try:
                return ask(url)
            except _RefusedError as error:
                told.append(f"{_host(url)}: {error}")
                if error.busy:
                    waits.append(min(error.retry_after, servers.wait))
            except (requests.exceptions.RequestException, OSError, ValueError) as error:
                told.append(f"{_host(url)}: {_cause(error)}")  # ValueError: an answer that osmnx cannot read
        if not waits or round_ == servers.rounds - 1:
            break
        time.sleep(min(waits))
    raise NetworkError(
        f"{what} ({'; '.join(told)}); without a network, build from an extract (--osm FILE)"
        " or from the one that comes along (--demo)"
    )


def _ask_overpass(query: str, servers: Servers) -> Any:
    """Overpass' answer to a query, sent when the server has a slot free."""

    def ask(url: str) -> Any:
        with _osmnx(servers, url) as osmnx:
            guarded, osmnx.settings.requests_kwargs = osmnx.settings.requests_kwargs, {}
            osmnx.settings.overpass_rate_limit = True
            pause = osmnx._overpass._get_overpass_pause(url, default_pause=0)  # noqa: SLF001
            if pause > servers.timeout:
                raise _RefusedError(429, f"no free slot for {pause:.0f} s", retry_after=pause)
            time.sleep(pause)
            osmnx.settings.overpass_rate_limit = False
            osmnx.settings.requests_kwargs = guarded
            answer = osmnx._overpass._overpass_request(OrderedDict(data=query))  # noqa: SLF001
        remark = str(answer.get("remark", ""))
        if "error" in remark:  # the query ran out of time or memory: what came is not all there is
            raise _RefusedError(200, remark.strip(), retry_after=math.inf)
        return answer

    return _patiently("no map server delivered", servers.overpass, ask=ask, servers=servers)


def _parts(bounds: Bounds, largest_km2: float) -> list[Bounds]:
    """The box cut into equal boxes of at most ``largest_km2``, each about square."""
    west, south, east, north = bounds
    width = (east - west) * _METRES_PER_DEGREE * math.cos(math.radians((south + north) / 2)) / 1000
    height = (north - south) * _METRES_PER_DEGREE / 1000
    side = math.sqrt(largest_km2)
    columns, rows = math.ceil(width / side), math.ceil(height / side)
    x = np.linspace(west, east, columns + 1).tolist()
    y = np.linspace(south, north, rows + 1).tolist()
    return [(x[i], y[j], x[i + 1], y[j + 1]) for j in range(rows) for i in range(columns)]


def _area_km2(bounds: Bounds) -> float:
    west, south, east, north = bounds
    across = (east - west) * math.cos(math.radians((south + north) / 2))
    return across * (north - south) * (_METRES_PER_DEGREE / 1000) ** 2


def _fetch(
    bounds: Bounds, source: str, *, cache_dir: Path | None, servers: Servers, progress: Progress
) -> OsmData:
    area = _area_km2(bounds)
    if area > servers.max_area_km2:
        raise InputError(
            f"{source}: {area:,.0f} km², more than the {servers.max_area_km2:,.0f} km² that map servers"
            " may be asked for; take a part of it, or an extract of the region (--osm FILE)"
        )
    taken = Collector(bounds=bounds)
    for part in progress(_parts(bounds, servers.max_query_km2)):
        query = query_for(part, timeout=servers.timeout)
        answer = _kept(cache_dir, query, make=functools.partial(_ask_overpass, query, servers))
        try:
            collect_answer(answer, taken)
        except InputError as error:
            raise NetworkError(f"{source}: the map server's answer cannot be read ({error})") from error
    if len(taken) == 0:
        raise SourceNotFoundError(f"{source}: OpenStreetMap has nothing there; are the coordinates in order?")
    return features(taken.finish(), bounds=bounds, source=source)


def _around(lon: float, lat: float, *, half_width: float, half_height: float) -> Bounds:
    """The box of so many metres to each side of a point."""
    dy = half_height / _METRES_PER_DEGREE
    dx = half_width / (_METRES_PER_DEGREE * math.cos(math.radians(lat)))
    return lon - dx, lat - dy, lon + dx, lat + dy


def fetch_bbox(
    bbox: tuple[float, float, float, float],
    *,
    cache_dir: Path | None = None,
    servers: Servers | None = None,
    progress: Progress = iter,
) -> OsmData:
    """The features that meet a box, from Overpass; the same as `read_osm` gives for an extract.

    bbox      : west, south, east, north in degrees
    cache_dir : folder where answers are kept; the same request is then sent once. None keeps nothing
    servers   : which servers, and how patiently; the public ones if None
    progress  : wraps the parts in which a large area is asked for

    Raises InputError for a box that is none or too large, SourceNotFoundError if nothing is there,
    NetworkError if no server delivers.
    """
    bounds = checked_bounds(bbox)
    source = f"OpenStreetMap, {','.join(f'{v:g}' for v in bounds)}"
    return _fetch(bounds, source, cache_dir=cache_dir, servers=servers or Servers(), progress=progress)


def fetch_point(
    lat: float,
    lon: float,
    *,
    radius: float,
    cache_dir: Path | None = None,
    servers: Servers | None = None,
    progress: Progress = iter,
) -> OsmData:
    """The features that meet the square of ``radius`` metres to each side of a point (degrees).

    Options and errors are those of `fetch_bbox`.
    """
    if not (math.isfinite(lat) and math.isfinite(lon) and abs(lat) < 90 and abs(lon) <= 180):
        raise InputError(f"point {lat:g},{lon:g}: give latitude, longitude in degrees, in this order")
    if not (math.isfinite(radius) and radius > 0):
        raise InputError(f"radius {radius:g}: give metres, more than 0")
    bounds = checked_bounds(_around(lon, lat, half_width=radius, half_height=radius))
    source = f"OpenStreetMap, {radius:g} m around {lat:g},{lon:g}"
    return _fetch(bounds, source, cache_dir=cache_dir, servers=servers or Servers(), progress=progress)


def locate(name: str, *, cache_dir: Path | None = None, servers: Servers | None = None) -> tuple[Bounds, str]:
    """The box of a place (west, south, east, north, degrees) and its full name, from Nominatim.

    The first result that has an outline counts, else the first; a box below 400 m a side is widened to that.

    Raises SourceNotFoundError for a place that is not known, NetworkError if the server does not answer.
    """
    servers = servers or Servers()
    if not name.strip():
        raise InputError("the place has no name")

    def ask(_: str) -> Any:
        with _osmnx(servers, servers.overpass[0]) as osmnx:
            return osmnx._nominatim._download_nominatim_element(name, limit=10)  # noqa: SLF001

    results = _kept(
        cache_dir,
        f"{servers.nominatim} {name}",
        make=lambda: _patiently(f"cannot look up {name!r}", [servers.nominatim], ask=ask, servers=servers),
    )
    if not results:
        raise SourceNotFoundError(
            f"no place called {name!r} in OpenStreetMap; try another spelling,"
            " or --point LAT,LON, or --bbox W,S,E,N"
        )
    outlined = [r for r in results if r.get("geojson", {}).get("type") in {"Polygon", "MultiPolygon"}]
    found = (outlined or results)[0]
    south, north, west, east = (float(v) for v in found["boundingbox"])
    lat, lon = (south + north) / 2, (west + east) / 2
    least = _around(lon, lat, half_width=_SMALLEST / 2, half_height=_SMALLEST / 2)
    bounds = (min(west, least[0]), min(south, least[1]), max(east, least[2]), max(north, least[3]))
    return checked_bounds(bounds), str(found.get("display_name", name))


def fetch_place(
    name: str,
    *,
    cache_dir: Path | None = None,
    servers: Servers | None = None,
    progress: Progress = iter,
) -> OsmData:
    """The features that meet the box of a place, found by its name as Nominatim knows it ("Norfolk, VA").

    Options and errors are those of `fetch_bbox` and `locate`.
    """
    servers = servers or Servers()
    bounds, full_name = locate(name, cache_dir=cache_dir, servers=servers)
    return _fetch(
        bounds, f"OpenStreetMap, {full_name}", cache_dir=cache_dir, servers=servers, progress=progress
    )
