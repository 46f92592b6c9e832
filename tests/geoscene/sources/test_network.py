"""Map servers over HTTP: a server on the loopback interface answers from the demo extract."""

import gzip
import json
import re
import socket
import threading
import time
import urllib.parse
from collections.abc import Callable, Iterator
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import osmium
import pytest
from helpers.extracts import same
from helpers.programs import run_program

from geoscene.errors import InputError, NetworkError, SourceNotFoundError
from geoscene.sources import Servers, demo_path, fetch_bbox, fetch_place, fetch_point, network, read_osm
from geoscene.sources.elements import RELATIONS
from geoscene.sources.network import _parts, locate

BOX = (24.9420, 60.1658, 24.9495, 60.1696)
"""A part of the demo extract."""

KINDS = {"n": "node", "w": "way", "r": "relation"}


class Extract:
    """The demo extract as an Overpass database."""

    def __init__(self) -> None:
        self.nodes, self.ways, self.relations = {}, {}, {}
        for item in osmium.FileProcessor(demo_path()):
            tags = {tag.k: tag.v for tag in item.tags}
            if item.is_node():
                place = {"lat": item.location.lat, "lon": item.location.lon}
                self.nodes[item.id] = {"type": "node", "id": item.id, **place, "tags": tags}
            elif item.is_way():
                refs = [node.ref for node in item.nodes]
                self.ways[item.id] = {"type": "way", "id": item.id, "nodes": refs, "tags": tags}
            else:
                members = [{"type": KINDS[m.type], "ref": m.ref, "role": m.role} for m in item.members]
                self.relations[item.id] = {
                    "type": "relation",
                    "id": item.id,
                    "members": members,
                    "tags": tags,
                }

    def answer(self, query: str) -> dict:
        """Overpass's answer to the query that geoscene sends; other queries fail."""
        south, west, north, east = map(float, re.search(r"way\(([^)]*)\)", query)[1].split(","))
        box = f"({south:.7f},{west:.7f},{north:.7f},{east:.7f})"
        assert re.sub(r"timeout:\d+", "timeout:20", query) == (
            f'[out:json][timeout:20];way{box}->.w;rel{box}["type"~"^({RELATIONS})$"]->.r;'
            'rel.r["type"="multipolygon"]->.m;(.w;way(r.m););out body qt;'
            f"(node(w);node{box}(if:count_tags()>0););out body qt;.r out body qt;"
        )

        def within(node: int) -> bool:
            place = self.nodes.get(node)
            return bool(place) and west <= place["lon"] <= east and south <= place["lat"] <= north

        def meets(way: dict) -> bool:  # by its box: more than Overpass sends, never less
            known = [self.nodes[n] for n in way["nodes"] if n in self.nodes]
            lon, lat = [n["lon"] for n in known], [n["lat"] for n in known]
            return (
                bool(known)
                and min(lon) <= east
                and max(lon) >= west
                and min(lat) <= north
                and max(lat) >= south
            )

        ways = {i for i, way in self.ways.items() if meets(way)}
        relations = [
            r for r in self.relations.values()
            if any((m["type"] == "way" and m["ref"] in ways) or (m["type"] == "node" and within(m["ref"]))
                   for m in r["members"])
        ]  # fmt: skip
        for relation in relations:
            if relation["tags"]["type"] == "multipolygon":
                ways |= {m["ref"] for m in relation["members"] if m["ref"] in self.ways}
        nodes = {n for way in ways for n in self.ways[way]["nodes"] if n in self.nodes}
        nodes |= {i for i, node in self.nodes.items() if node["tags"] and within(i)}
        elements = [*map(self.ways.get, ways), *map(self.nodes.get, nodes), *relations]
        stamp = {"timestamp_osm_base": "2019-04-21T09:50:14Z"}
        return {"version": 0.6, "osm3s": stamp, "elements": elements}


PLACES = {
    "Esplanadi, Helsinki": [
        {
            "boundingbox": ["60.167", "60.167", "24.945", "24.945"],
            "importance": 0.9,
            "display_name": "a point",
        },
        {
            "boundingbox": [str(BOX[1]), str(BOX[3]), str(BOX[0]), str(BOX[2])],
            "importance": 0.5,
            "display_name": "Esplanadi, Helsinki, Finland",
            "geojson": {"type": "Polygon", "coordinates": []},
        },
    ],
    "nonsense": {"error": "unable to geocode"},
    "a bench": [{"boundingbox": ["60.167", "60.167", "24.945", "24.945"], "importance": 0.1}],
}


class MapServer(ThreadingHTTPServer):
    """Nominatim and Overpass at one address.

    asked   : requests as (path, user agent)
    refuse  : HTTP statuses of the next requests for data, in order
    remark  : of Overpass, beside its answer
    body    : sent with status 200 instead of an answer, if not None, with the headers
    status  : text of the status page, with the time of the next free slot
    """

    def __init__(self, extract: Extract) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.extract = extract
        self.asked: list[tuple[str, str]] = []
        self.refuse: list[int] = []
        self.remark = ""
        self.body: bytes | None = None
        self.headers: dict[str, str] = {}
        self.status = "Connected as: 1\nCurrent time: x\nRate limit: 2\n2 slots available now.\n"

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}"

    def asked_for(self, path: str) -> int:
        return sum(p.startswith(path) for p, _ in self.asked)


class Handler(BaseHTTPRequestHandler):
    server: MapServer

    def _send(self, status: int, body: bytes, kind: str = "application/json") -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        headers = {"Content-Length": str(len(body)), **(self.server.headers if "json" in kind else {})}
        for name, value in headers.items():
            self.send_header(name, value)
        if status == 429:
            self.send_header("Retry-After", "0")
        self.end_headers()
        self.wfile.write(body)

    def _refused(self) -> bool:
        if not self.server.refuse:
            return False
        self._send(self.server.refuse.pop(0), b"<html>no</html>", "text/html")
        return True

    def do_GET(self) -> None:
        self.server.asked.append((self.path, self.headers["User-Agent"]))
        url = urllib.parse.urlsplit(self.path)
        if url.path == "/api/status":
            self._send(200, self.server.status.encode(), "text/plain")
        elif not self._refused():
            name = urllib.parse.parse_qs(url.query)["q"][0]
            found = json.dumps(PLACES.get(name, [])).encode()
            self._send(200, found if self.server.body is None else self.server.body)

    def do_POST(self) -> None:
        self.server.asked.append((self.path, self.headers["User-Agent"]))
        body = self.rfile.read(int(self.headers["Content-Length"])).decode()
        if self._refused():
            return
        if self.server.body is not None:
            self._send(200, self.server.body)
            return
        answer = self.server.extract.answer(urllib.parse.parse_qs(body)["data"][0])
        if self.server.remark:
            answer["remark"] = self.server.remark
        self._send(200, json.dumps(answer).encode())

    def log_message(self, *args: object) -> None:
        """Log nothing."""


@pytest.fixture(autouse=True)
def _at_once(monkeypatch) -> None:
    """Ask without the pause that is due to the public server."""
    monkeypatch.setattr(network, "_NOMINATIM_PAUSE", 0.0)


@pytest.fixture(scope="module")
def extract() -> Extract:
    return Extract()


@pytest.fixture
def start(extract) -> Iterator[Callable[[], MapServer]]:
    running = []

    def make() -> MapServer:
        server = MapServer(extract)
        threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()
        running.append(server)
        return server

    yield make
    for server in running:
        server.shutdown()
        server.server_close()


@pytest.fixture
def server(start) -> MapServer:
    return start()


def servers_at(*servers: MapServer) -> Servers:
    return Servers(
        nominatim=servers[0].url,
        overpass=tuple(f"{s.url}/api" for s in servers),
        timeout=20,
        wait=0.0,
    )


def nowhere() -> str:
    """An address without a server."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"http://127.0.0.1:{probe.getsockname()[1]}"


def assert_is_the_box(data) -> None:
    expected = read_osm(demo_path(), bounds=BOX)
    same(expected, data)
    assert data.timestamp == expected.timestamp
    assert len(data.areas) > 50
    assert len(data.ways) > 200
    assert len(data.relations) > 1


@pytest.mark.full
def test_fetched_place_equals_the_same_map_from_a_file(server, tmp_path):
    data = fetch_place("Esplanadi, Helsinki", cache_dir=tmp_path, servers=servers_at(server))
    assert_is_the_box(data)
    assert data.source == "OpenStreetMap, Esplanadi, Helsinki, Finland"
    assert all(agent.startswith("geoscene/") for _, agent in server.asked)
    assert server.asked_for("/api/status") == 1


def test_answers_are_cached_and_damaged_ones_fetched_again(server, tmp_path):
    servers = servers_at(server)
    first = fetch_place("Esplanadi, Helsinki", cache_dir=tmp_path, servers=servers)
    asked = len(server.asked)
    same(first, fetch_place("Esplanadi, Helsinki", cache_dir=tmp_path, servers=servers))
    assert len(server.asked) == asked
    for path in tmp_path.iterdir():
        path.write_bytes(path.read_bytes()[:-9])  # a damaged cache is asked for again
    same(first, fetch_place("Esplanadi, Helsinki", cache_dir=tmp_path, servers=servers))
    assert len(server.asked) == 2 * asked


@pytest.mark.full
def test_large_area_fetched_in_parts_equals_one_request(server):
    reports = []
    servers = replace(servers_at(server), max_query_km2=0.05)
    data = fetch_bbox(BOX, servers=servers, progress=lambda *a, total: reports.append((*a, total)))
    parts = server.asked_for("/api/interpreter")
    assert parts >= 4
    assert reports == [("fetching the map", done, parts) for done in range(parts + 1)]
    assert_is_the_box(data)


def test_an_area_across_180_degrees_is_fetched_from_both_sides():
    parts = _parts((179.99, -17.0, 180.01, -16.98), 1.0)
    assert len(parts) > 4
    assert min(west for west, *_ in parts) == -180.0
    assert max(east for _, _, east, _ in parts) == 180.0
    assert all(west < east for west, _, east, _ in parts)
    area = sum((east - west) * (north - south) for west, south, east, north in parts)
    assert area == pytest.approx(0.02 * 0.02)


def test_a_point_is_fetched_with_its_surroundings(server):
    data = fetch_point(60.1675, 24.9455, radius=100, servers=servers_at(server))
    west, south, east, north = data.bounds
    assert (north - south) * 111_195 == pytest.approx(200)
    assert (east - west) * 111_195 * 0.4975 == pytest.approx(200, rel=1e-3)
    same(data, read_osm(demo_path(), bounds=data.bounds))


def test_a_place_that_is_a_point_is_widened_to_a_scene(server):
    (west, south, east, north), _ = locate("a bench", servers=servers_at(server))
    assert (north - south) * 111_195 == pytest.approx(400)
    assert west < 24.945 < east


@pytest.mark.full
def test_busy_server_is_retried(server):
    server.refuse = [429, 504]
    data = fetch_bbox(BOX, servers=servers_at(server))
    assert_is_the_box(data)
    assert server.asked_for("/api/interpreter") == 3


def test_retries_of_a_busy_server_are_limited(server):
    server.refuse = [429] * 99
    with pytest.raises(NetworkError, match="HTTP 429"):
        fetch_bbox(BOX, servers=servers_at(server))
    assert server.asked_for("/api/interpreter") == 3


@pytest.mark.full
def test_next_server_is_used_if_one_fails(start):
    first, second = start(), start()
    first.refuse = [500]
    data = fetch_bbox(BOX, servers=servers_at(first, second))
    assert_is_the_box(data)
    assert (first.asked_for("/api/interpreter"), second.asked_for("/api/interpreter")) == (1, 1)


def test_failed_server_is_named_and_no_answer_is_cached(server, tmp_path):
    server.refuse = [500]
    with pytest.raises(NetworkError, match=r"127\.0\.0\.1:\d+: HTTP 500.*`osm` FILE.*`demo`"):
        fetch_bbox(BOX, cache_dir=tmp_path, servers=servers_at(server))
    server.remark = "runtime error: Query run out of memory using about 2048 MB of RAM."
    with pytest.raises(NetworkError, match="out of memory"):
        fetch_bbox(BOX, cache_dir=tmp_path, servers=servers_at(server))
    assert list(tmp_path.iterdir()) == []


WHOLE = json.dumps({"elements": [{"type": "node", "id": k, "lat": 60.1, "lon": 24.9} for k in range(99)]})
CUT = gzip.compress(WHOLE.encode())[:-40]


@pytest.mark.parametrize(
    ("body", "headers", "words"),
    [
        (b"<html><title>Too busy</title></html>", {}, r"HTTP 200, but a web page \(Too busy\)"),
        (b"<html><p>dispatcher <b>timeout</b></p></html>", {}, r"a web page \(dispatcher timeout\)"),
        (WHOLE[: len(WHOLE) // 2].encode(), {}, "cut short after [0-9,]+ characters"),
        (WHOLE[: len(WHOLE) // 2].encode(), {"Content-Length": "9999"}, "an answer that is cut short"),
        (CUT, {"Content-Encoding": "gzip"}, "cut short"),
        (b"no gzip", {"Content-Encoding": "gzip"}, "damaged or cut short"),
        (b"", {}, "an empty answer"),
        (b"busy", {}, r"no JSON \(busy\)"),
        (b"{}", {}, "no (map objects|list of places)"),
        (b"7", {}, "no (map objects|list of places)"),
        (b'{"elements": [7]}', {}, "cannot be read|no list of places"),
    ],
)
def test_an_unusable_answer_is_one_line_and_not_kept(server, tmp_path, body, headers, words):
    server.body, server.headers = body, headers
    for fetch in (lambda **of: fetch_bbox(BOX, **of), lambda **of: locate("Esplanadi, Helsinki", **of)):
        with pytest.raises(NetworkError, match=words) as caught:
            fetch(cache_dir=tmp_path, servers=servers_at(server))
        text = str(caught.value)
        assert "\n" not in text
        assert not re.search("Expecting|JSONDecode|IncompleteRead|Connection broken|Error -", text)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "remark",
    [
        'runtime error: Query timed out in "query" at line 3 after 26 seconds.',
        'runtime error: Query run out of memory in "recurse" using about 512 MB of RAM.',
        "runtime remark: Timeout: the answer is incomplete",
    ],
)
def test_a_remark_on_an_incomplete_answer_is_an_error(server, tmp_path, remark):
    server.remark = remark
    with pytest.raises(NetworkError, match=r"127.0.0.1.*runtime"):
        fetch_bbox(BOX, cache_dir=tmp_path, servers=servers_at(server))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("found", [{}, {"boundingbox": ["1", "2"]}, {"boundingbox": list("abcd")}, 7])
def test_a_place_without_a_box_is_refused(server, tmp_path, found):
    server.body = json.dumps([found]).encode()
    with pytest.raises(NetworkError, match="without a box"):
        locate("Esplanadi, Helsinki", cache_dir=tmp_path, servers=servers_at(server))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.full
def test_empty_answers_are_not_kept_and_asked_for_again(server, tmp_path):
    servers = servers_at(server)
    server.body = b"[]"
    with pytest.raises(SourceNotFoundError, match=rf"no place.*kept in {tmp_path}, `refresh` asks again"):
        fetch_place("Esplanadi, Helsinki", cache_dir=tmp_path, servers=servers)
    server.body = b'{"elements": []}'
    with pytest.raises(SourceNotFoundError, match=rf"nothing there.*kept in {tmp_path}, `refresh` asks"):
        fetch_bbox(BOX, cache_dir=tmp_path, servers=servers)
    assert list(tmp_path.iterdir()) == []
    server.body = None
    assert_is_the_box(fetch_place("Esplanadi, Helsinki", cache_dir=tmp_path, servers=servers))
    for path in tmp_path.iterdir():  # as former versions kept them
        places = isinstance(json.loads(gzip.decompress(path.read_bytes())), list)
        path.write_bytes(gzip.compress(b"[]" if places else b'{"elements": []}'))
    assert_is_the_box(fetch_place("Esplanadi, Helsinki", cache_dir=tmp_path, servers=servers))


@pytest.mark.full
def test_refresh_asks_again_and_replaces_what_is_kept(server, tmp_path):
    servers = servers_at(server)
    fetch_place("Esplanadi, Helsinki", cache_dir=tmp_path, servers=servers)
    kept = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    for name in kept:
        (tmp_path / name).write_bytes(gzip.compress(json.dumps({"elements": [1]}).encode()))
    asked = len(server.asked)
    fetch_place("Esplanadi, Helsinki", cache_dir=tmp_path, refresh=True, servers=servers)
    assert len(server.asked) == 2 * asked
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == kept


@pytest.mark.full
def test_a_wait_for_a_busy_server_is_said_with_its_reason(server):
    server.refuse = [504]
    reports = []
    servers = replace(servers_at(server), wait=1.5)
    fetch_bbox(BOX, servers=servers, progress=lambda *a, total: reports.append((*a, total)))
    stage = f"waiting 2 s (127.0.0.1:{server.server_port}: HTTP 504, Gateway Timeout)"
    assert [report for report in reports if report[0] == stage] == [(stage, k, 2) for k in range(3)]


def test_neither_user_nor_key_of_an_address_is_in_errors(server):
    address = server.url.replace("//", "//me:pa55word@")
    server.refuse = [500, 500]
    servers = Servers(nominatim=f"{address}?key=pa55word", overpass=(f"{address}/api",), wait=0.0)
    with pytest.raises(NetworkError, match=r"127\.0\.0\.1:\d+: HTTP 500") as caught:
        fetch_bbox(BOX, servers=servers)
    assert "pa55word" not in str(caught.value)
    for wrong in (nowhere().replace("//", "//me:pa55word@"), "http://me:pa55word@:x/?key=pa55word"):
        with pytest.raises(NetworkError) as caught:
            locate("Esplanadi, Helsinki", servers=replace(servers, nominatim=wrong))
        assert "pa55word" not in str(caught.value)
    for wrong in ("me:pa55word@nowhere", "ftp://me:pa55word@nowhere"):
        with pytest.raises(InputError, match=r"^nowhere: give the address of a server") as caught:
            Servers(nominatim=wrong)


def test_a_query_waits_for_a_free_slot(server):
    server.status = "Rate limit: 2\nSlot available after: 2024-05-01T12:00:09Z, in 1 seconds.\n"
    start = time.monotonic()
    fetch_bbox(BOX, servers=servers_at(server))
    assert time.monotonic() - start >= 1
    server.status = "Rate limit: 2\n" + 2 * "Slot available after: 2024-05-01T12:00:09Z, in 99 seconds.\n"
    with pytest.raises(NetworkError, match="no free slot for 99 s"):
        fetch_bbox(BOX, servers=servers_at(server))
    assert server.asked_for("/api/interpreter") == 1


def test_answer_of_unexpected_content_is_refused(server):
    with pytest.raises(NetworkError, match="no list of places"):
        locate("nonsense", servers=servers_at(server))


def test_without_a_network_the_error_names_the_offline_options():
    servers = Servers(nominatim=nowhere(), overpass=(f"{nowhere()}/api", "http://map.invalid/api"), wait=0.0)
    for fetch in (
        lambda: fetch_place("Norfolk, VA", servers=servers),
        lambda: fetch_bbox(BOX, servers=servers),
    ):
        with pytest.raises(NetworkError) as caught:
            fetch()
        message = str(caught.value)
        assert "\n" not in message
        assert "Connection refused" in message
        assert "`osm` FILE" in message
        assert "`demo`" in message


def test_unknown_place_is_an_error(server):
    with pytest.raises(SourceNotFoundError, match="no place called 'Atlantis'"):
        fetch_place("Atlantis", servers=servers_at(server))
    with pytest.raises(SourceNotFoundError, match="nothing"):
        fetch_bbox((0.0, 0.0, 0.01, 0.01), servers=servers_at(server))


def test_invalid_requests_are_refused_before_they_are_sent(server):
    servers = servers_at(server)
    with pytest.raises(InputError, match="km²"):
        fetch_bbox((20, 60, 25, 65), servers=servers)
    with pytest.raises(InputError, match="latitude"):
        fetch_point(120, 24, radius=100, servers=servers)
    with pytest.raises(InputError, match="radius"):
        fetch_point(60, 24, radius=-1, servers=servers)
    with pytest.raises(InputError, match="west is not less than east"):
        fetch_bbox((25, 60, 24, 61), servers=servers)
    assert server.asked == []


def test_the_program_builds_a_place_and_fetches_it_once(server, tmp_path):
    place = next(iter(name for name, found in PLACES.items() if found))
    words = [
        "build",
        "--place",
        place,
        "--cache",
        tmp_path / "c",
        "--lod",
        "0",
        "--only",
        "buildings,roads",
        "--workers",
        "1",
    ]
    words += ["--nominatim", server.url, "--overpass", f"{server.url}/api", "--json"]
    done = run_program("geoscene", *words, "-o", tmp_path / "a")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["counts"]["buildings"] > 10
    asked = len(server.asked)
    done = run_program("geoscene", *words, "-o", tmp_path / "b")
    assert done.returncode == 0, done.stderr
    assert server.asked_for("/api/interpreter") == 1
    assert len(server.asked) == asked
    same_bytes = (tmp_path / "a" / "roads.graphml").read_bytes() == (
        tmp_path / "b" / "roads.graphml"
    ).read_bytes()
    assert same_bytes


def test_the_program_without_a_network_names_the_offline_options(tmp_path):
    words = ["build", "--place", "Norfolk, VA", "--nominatim", nowhere()]
    done = run_program("geoscene", *words, "--cache", tmp_path / "c", "-o", tmp_path / "a")
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert "--osm" in done.stderr
    assert "--demo" in done.stderr
    assert not (tmp_path / "a").exists()
