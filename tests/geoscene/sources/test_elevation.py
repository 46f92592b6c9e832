"""Elevation tiles, served on the loopback interface and sampled from analytic surfaces."""

import io
import json
import socket
import threading
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pytest
import rasterio
from helpers.programs import run_program
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from geoscene.errors import InputError, NetworkError
from geoscene.geometry.frames import Frame
from geoscene.ground.terrain import open_terrain
from geoscene.scene import open_scene
from geoscene.sources import OsmData, TileServer, Way, demo_path, fetch_elevation, read_osm
from geoscene.sources.elevation import decode_terrarium, zoom_at

HALF = np.pi * 6378137.0  # metres: web Mercator is a square from -HALF to HALF (EPSG:3857)
LON, LAT = 7.42, 43.735


def encode(metres):
    """Terrarium colours of heights, as documented by the data set."""
    counts = np.round((metres + 32768.0) * 256).astype(np.int64)
    return np.stack([counts >> 16, counts >> 8 & 255, counts & 255], axis=-1).astype(np.uint8)


class TileCutter(ThreadingHTTPServer):
    """Server of tiles of ``surface``, a function of web-Mercator metres."""

    daemon_threads = True

    def __init__(self, surface):
        super().__init__(("127.0.0.1", 0), Handler)
        self.surface = surface
        self.asked = []
        self.refuse = []
        self.template = f"http://127.0.0.1:{self.server_port}/{{z}}/{{x}}/{{y}}.png"

    def tile(self, z, x, y):
        step = 2 * HALF / 2**z / 256
        east = -HALF + (x * 256 + np.arange(256) + 0.5) * step
        north = HALF - (y * 256 + np.arange(256) + 0.5) * step
        out = io.BytesIO()
        Image.fromarray(encode(self.surface(*np.meshgrid(east, north)))).save(out, "PNG")
        return out.getvalue()


class Handler(BaseHTTPRequestHandler):
    def do_GET(self):
        self.server.asked.append((self.path, self.headers["User-Agent"]))
        status = self.server.refuse.pop(0) if self.server.refuse else 200
        names = self.path.partition("?")[0].removesuffix(".png").split("/")[1:]
        body = self.server.tile(*map(int, names)) if status == 200 else b"<Error/>"
        self.send_response(status)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *args):
        """Log nothing."""


def slope(east, north):
    """A plane in web-Mercator metres, which bilinear interpolation reproduces exactly."""
    east0, north0 = HALF * LON / 180, HALF * np.arcsinh(np.tan(np.radians(LAT))) / np.pi
    return 300.0 + 0.125 * (east - east0) - 0.0625 * (north - north0)


def hills(east, north):
    return 200.0 + 60.0 * np.sin(east / 700.0) * np.cos(north / 500.0)


@pytest.fixture
def serve():
    running = []

    def start(surface):
        server = TileCutter(surface)
        threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()
        running.append(server)
        return server

    yield start
    for server in running:
        server.shutdown()
        server.server_close()


def area(half_deg=0.02, ways=()):
    return OsmData(
        bounds=(LON - half_deg, LAT - half_deg, LON + half_deg, LAT + half_deg),
        ways=list(ways),
        areas=[],
        points=[],
        relations=[],
    )


def patient(server, **changes):
    return TileServer(server.template, wait=0.0, **changes)


def heights_of(path, osm, places, crs="local"):
    west, south, east, north = osm.bounds
    frame = Frame.at((west + east) / 2, (south + north) / 2, crs=crs)
    x, y = frame.from_geographic(*places.T)
    bounds = (x.min(), y.min(), x.max(), y.max())
    terrain = open_terrain([path], frame, bounds=bounds)
    return terrain, terrain.height(x, y)


def sample(osm, count=4000):
    west, south, east, north = osm.bounds
    return np.random.default_rng(3).uniform((west, south), (east, north), (count, 2))


def mercator(lonlat):
    return HALF * lonlat[:, 0] / 180, HALF * np.arcsinh(np.tan(np.radians(lonlat[:, 1]))) / np.pi


@pytest.mark.full
def test_tiles_join_without_seams(serve, tmp_path):
    server = serve(slope)
    osm = area()
    path = fetch_elevation(osm, cache_dir=tmp_path, server=patient(server))
    tiles = {name for name, _ in server.asked}
    assert len(tiles) == len(server.asked) >= 6
    places = sample(osm)
    east, north = mercator(places)
    side = 2 * HALF / 2**14
    across = (east + HALF) / side
    near_seam = np.abs(across - np.round(across)) * 256 < 0.5  # between the last post and the first
    assert near_seam.sum() > 2
    terrain, z = heights_of(path, osm, places)
    assert np.abs(z - slope(east, north)).max() < 1 / 256
    assert np.abs(z - slope(east, north))[near_seam].max() < 1 / 256
    assert 5.0 < terrain.spacing <= 10.0
    assert terrain.vertical == "orthometric"
    assert "NAVD88" in terrain.datum
    assert "U.S. Geological Survey" in terrain.credits[0]
    assert terrain.uncovered == 0.0


def test_tiles_on_both_sides_of_180_degrees_join(serve, tmp_path):
    server = serve(lambda east, north: 4000.0 - 0.125 * (HALF - np.abs(east)) + 0.0 * north)
    osm = replace(area(), bounds=(180 - 0.02, LAT - 0.02, 180 + 0.02, LAT + 0.02))
    path = fetch_elevation(osm, cache_dir=tmp_path, server=patient(server))
    with rasterio.open(path) as file:
        assert file.width < 2000
    places = sample(osm)
    away = np.abs(places[:, 0] - 180) * HALF / 180
    bounds = (-1000, -1000, 1000, 1000)
    frame = Frame.at(180.0, LAT)
    z = open_terrain([path], frame, bounds=bounds).height(*frame.from_geographic(*places.T))
    near = (away > 20) & (away < 1000)
    assert near.sum() > 300
    assert np.abs(z - (4000 - 0.125 * away))[near].max() < 0.1


@pytest.mark.full
def test_hills_have_the_accuracy_of_ten_metre_posts(serve, tmp_path):
    osm = area()
    path = fetch_elevation(osm, cache_dir=tmp_path, server=patient(serve(hills)))
    places = sample(osm)
    _, z = heights_of(path, osm, places)
    # A bilinear cell of side h misses by at most h^2 / 8 of each second derivative.
    bound = 9.6**2 / 8 * 60 * (1 / 700**2 + 1 / 500**2 + 2 / (700 * 500)) + 1 / 256
    assert np.abs(z - hills(*mercator(places))).max() < bound


@pytest.mark.full
def test_tiles_cover_the_rectangle_of_a_scene_with_another_grid_north(serve, tmp_path):
    server = serve(hills)
    osm = replace(area(0.05), bounds=(11.90, 43.70, 12.00, 43.80))  # 3 degrees off the meridian of UTM 32
    frame = Frame.at(11.95, 43.75, crs="EPSG:32632")
    west, south, east, north = osm.bounds
    x, y = frame.from_geographic([west, east, east, west], [south, south, north, north])
    path = fetch_elevation(osm, cache_dir=tmp_path, crs="EPSG:32632", server=patient(server))
    terrain = open_terrain([path], frame, bounds=(x.min(), y.min(), x.max(), y.max()))
    assert terrain.uncovered == 0.0


def test_sea_floor_is_raised_to_sea_level_and_polders_keep_their_depth(serve, tmp_path):
    """West of the coast the ground falls to -40 m; east of it a polder lies 3 m deep behind a dike."""
    coast_east = HALF * LON / 180

    def surface(east, north):
        x = east - coast_east
        return np.where(x < 0, np.maximum(x / 10, -40.0), np.where(x < 400, 5.0, -3.0)) + 0 * north

    line = np.column_stack([np.full(200, LON), np.linspace(LAT - 0.03, LAT + 0.03, 200)])
    coast = Way("way/1", {"natural": "coastline"}, np.arange(200), line)
    osm = area(0.01, [coast])
    server = patient(serve(surface))
    path = fetch_elevation(osm, cache_dir=tmp_path, server=server)
    places = np.array([[LON - 0.005, LAT], [LON - 0.0005, LAT], [LON + 0.002, LAT], [LON + 0.008, LAT]])
    _, z = heights_of(path, osm, np.vstack([places, sample(osm)]))
    np.testing.assert_allclose(z[:4], [0.0, 0.0, 5.0, -3.0], atol=1e-6)
    inland = area(0.01)  # no coastline: heights are as they were measured
    _, z = heights_of(
        fetch_elevation(inland, cache_dir=tmp_path, server=server),
        inland,
        np.vstack([places, sample(inland)]),
    )
    assert z[0] < -35


@pytest.mark.parametrize("lat", [0.0, 1.3, 43.7, 51.5, 60.2, 72.0, -54.8])
def test_the_zoom_gives_posts_of_five_to_ten_metres_at_any_latitude(lat):
    metres = 2 * HALF * np.cos(np.radians(lat)) / 256 / 2 ** zoom_at(lat)
    assert 5.0 <= metres <= 10.0


@given(st.integers(-11_000 * 256, 9_000 * 256))
def test_heights_are_decoded_exactly(count):
    assert decode_terrarium(encode(np.array([[count / 256]])))[0, 0] == count / 256


def test_tiles_are_cached_and_damaged_ones_fetched_again(serve, tmp_path):
    server = serve(slope)
    first = fetch_elevation(area(), cache_dir=tmp_path, server=patient(server))
    content, asked = first.read_bytes(), len(server.asked)
    assert all(agent.startswith("geoscene/") for _, agent in server.asked)
    assert fetch_elevation(area(), cache_dir=tmp_path, server=patient(server)) == first
    first.unlink()
    assert fetch_elevation(area(), cache_dir=tmp_path, server=patient(server)).read_bytes() == content
    assert len(server.asked) == asked
    first.unlink()
    tile = next(tmp_path.rglob("*.png"))
    tile.write_bytes(tile.read_bytes()[:-200])
    assert fetch_elevation(area(), cache_dir=tmp_path, server=patient(server)).read_bytes() == content
    assert len(server.asked) == asked + 1


def test_retries_of_a_busy_server_are_limited(serve, tmp_path):
    server = serve(slope)
    server.refuse = [503, 429, 500]
    fetch_elevation(area(0.001), cache_dir=tmp_path / "a", server=patient(server))
    server.refuse = [503] * 99
    with pytest.raises(NetworkError, match=r"HTTP 503.*`dem` FILE"):
        fetch_elevation(area(0.001), cache_dir=tmp_path / "b", server=patient(server))
    assert len(server.refuse) == 99 - 4
    assert list((tmp_path / "b").rglob("*.*")) == []


def test_a_missing_or_invalid_tile_is_an_error_at_once(serve, tmp_path):
    server = serve(slope)
    server.refuse = [404]
    with pytest.raises(NetworkError, match="HTTP 404"):
        fetch_elevation(area(0.001), cache_dir=tmp_path, server=patient(server))
    assert len(server.asked) == 1
    server.tile = lambda *_: b"hello"
    with pytest.raises(NetworkError, match="no elevation tile"):
        fetch_elevation(area(0.001), cache_dir=tmp_path, server=patient(server))


def test_invalid_requests_are_refused_before_they_are_sent(serve, tmp_path):
    server = serve(slope)
    with pytest.raises(InputError, match="85°"):
        fetch_elevation(
            replace(area(), bounds=(0, 85.1, 0.1, 85.2)), cache_dir=tmp_path, server=patient(server)
        )
    with pytest.raises(InputError, match="more than the 3"):
        fetch_elevation(area(), cache_dir=tmp_path, server=patient(server, most=3))
    with pytest.raises(InputError, match=r"\{z\}"):
        TileServer("http://127.0.0.1/tile.png")
    assert server.asked == []


def program(*words):
    return run_program("geoscene", "build", *words)


@pytest.mark.full
def test_the_program_builds_on_tiles_and_credits_them(serve, tmp_path):
    bounds = read_osm(demo_path()).bounds
    lon, lat = (bounds[0] + bounds[2]) / 2, (bounds[1] + bounds[3]) / 2
    box = f"{lon - 0.001},{lat - 0.0005},{lon + 0.001},{lat + 0.0005}"
    server = serve(lambda east, north: 40.0 + 0 * east * north)
    words = ["--osm", demo_path(), "--bbox", box, "--dem", "tiles", "--dem-server", server.template]
    done = program(*words, "--cache", tmp_path / "c", "-o", tmp_path / "s", "--json")
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    terrain = next(s for s in report["sources"] if s["kind"] == "terrain")
    assert server.template in terrain["attribution"]
    assert report["terrain"]["vertical"] == "orthometric"
    assert 5 <= report["terrain"]["spacing_m"] <= 10
    assert report["terrain"]["voids_filled"] == 0
    assert len(server.asked) >= 1


def test_program_without_a_network_fails_with_one_line(tmp_path):
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        nowhere = f"http://127.0.0.1:{probe.getsockname()[1]}/{{z}}/{{x}}/{{y}}.png"
    words = ["--demo", "--dem", "tiles", "--dem-server", nowhere, "--cache", tmp_path / "c"]
    done = program(*words, "-o", tmp_path / "s")
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert "Connection refused" in done.stderr
    assert "--dem FILE" in done.stderr
    assert not (tmp_path / "s").exists()


@pytest.mark.full
def test_a_scene_of_tiles_of_a_server_with_a_key_does_not_record_the_key(serve, tmp_path):
    url = serve(hills).template.replace("//", "//me:pa55word@") + "?key=pa55word"
    words = ["build", "--demo", "--bbox", "24.942,60.166,24.945,60.168", "--lod", "0", "--only", "buildings"]
    words += ["--dem", "tiles", "--dem-server", url, "--cache", tmp_path / "cache", "--workers", "1"]
    done = run_program("geoscene", *words, "-o", tmp_path / "scene", "--json")
    assert done.returncode == 0, done.stderr
    recorded = json.dumps(open_scene(tmp_path / "scene").manifest)
    assert "elevation tiles: http://127.0.0.1" in recorded
    assert "key=***" in recorded
    everything = done.stdout + done.stderr + recorded
    everything += "".join(p.read_text("latin-1") for p in tmp_path.rglob("*") if p.is_file())
    assert "pa55word" not in everything
