"""The page contains the whole scene, loads nothing else, and is reproducible."""

import json
import re
from base64 import b64decode
from dataclasses import replace
from html.parser import HTMLParser
from zlib import decompress

import numpy as np
import pytest
from helpers.view_tiles import unpack_tile
from hypothesis import given, settings
from hypothesis import strategies as st

from geoscene.classes import Class
from geoscene.errors import InputError
from geoscene.geometry.frames import Frame
from geoscene.geometry.mesh import Mesh, ShapeInstances
from geoscene.options import BuildOptions, ViewOptions
from geoscene.pipeline.build import build
from geoscene.scene.tile_files import Tile
from geoscene.sources import demo_path, read_osm
from geoscene.view import view_scene
from geoscene.view.contents import ACCURACY, lonlat_grid
from geoscene.view.looks import FacadeLooks, read_looks
from geoscene.view.tiles import STEP, Groups, groups_of, pack_tile

BOX = (24.9405, 60.1655, 24.9475, 60.1690)
COLUMNS = ("feature", "klass", "material", "surface", "color")
GUESSES = ("wall_look", "roofing", "storeys", "windows")
LOADERS = ("src=", "@import", "url(", "fetch(", "XMLHttpRequest", "WebSocket", "EventSource", "import(")


class Page(HTMLParser):
    """Parsed page: text of scripts by id, URLs, and the visible attribution."""

    def __init__(self, text):
        super().__init__()
        self.scripts, self.links, self.tags, self.credit = {}, [], [], ""
        self._id = self._inside = None
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        attrs = dict(attrs)
        self.tags.append(tag)
        self.links += [value for name, value in attrs.items() if name in ("href", "src")]
        self._inside = attrs.get("id", self._inside)
        if tag == "script":
            self._id = attrs.get("id", "viewer")
            self.scripts[self._id] = ""

    def handle_endtag(self, tag):
        self._id = None if tag == "script" else self._id
        self._inside = None if tag == "div" else self._inside

    def handle_data(self, data):
        if self._id:
            self.scripts[self._id] += data
        elif self._inside == "credit":
            self.credit += data

    def bytes(self, name):
        return b64decode(self.scripts[name])

    def json(self, name):
        return json.loads(self.scripts[name] if name == "head" else decompress(self.bytes(name), 31))


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    osm = read_osm(demo_path(), bounds=BOX)
    return build(
        osm, tmp_path_factory.mktemp("view") / "demo", options=BuildOptions(name="demo", tile_size=200.0)
    )


@pytest.fixture(scope="module")
def path(scene, tmp_path_factory):
    out = tmp_path_factory.mktemp("page") / "page.html"
    view_scene(scene, out)
    return out


@pytest.fixture(scope="module")
def page(path):
    return Page(path.read_text("utf-8"))


def rows(tile):
    """Faces as sorted rows of integers: corners in quantisation steps, then all columns."""
    corners = np.rint((tile.mesh.vertices + tile.origin) / STEP).astype(np.int64)[tile.mesh.faces]
    columns = [getattr(tile.mesh, name).reshape(len(tile.mesh), -1).astype(np.int64) for name in COLUMNS]
    table = np.column_stack([corners.reshape(-1, 9), *columns])
    return table[np.lexsort(table.T)]


def copies(tile):
    """Instances as rows in scene metres, sorted by feature, shape and position."""
    moved = tile.instances.transform.copy()
    moved[:, :, 3] += tile.origin
    table = np.column_stack([tile.instances.feature, tile.instances.shape, moved.reshape(-1, 12)])
    grid = np.rint(moved[:, :, 3] / STEP)
    return table[np.lexsort([*grid.T, *table[:, :2].T])]


def moved_corners(scene, table):
    """Corners (k, 8, 3) of the bounding boxes of instances in scene metres."""
    boxes = np.array(
        [[mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)] for mesh in scene.shapes().values()]
    )
    low, high = boxes[table[:, 1].astype(int)].transpose(1, 0, 2)
    pick = np.array(list(np.ndindex(2, 2, 2)))[None]
    corners = np.where(pick, high[:, None], low[:, None])
    matrix = table[:, 2:].reshape(-1, 3, 4)
    return np.einsum("kij,kcj->kci", matrix[:, :, :3], corners) + matrix[:, None, :, 3]


def test_page_contains_every_triangle_and_instance_of_the_scene(scene, page):
    told, looks = page.json("head")["tiles"], read_looks(scene)
    assert len(told) == len(scene.tile_indices) > 4
    faces = number = 0
    for k, entry in enumerate(told):
        tile, shown = (
            looks.dressed(scene.tile(*entry["index"])),
            unpack_tile(entry, page.bytes(f"tile-{k}"))[0],
        )
        assert np.array_equal(rows(tile), rows(shown))
        here, there = copies(tile), copies(shown)
        assert np.array_equal(here[:, :2], there[:, :2])
        assert np.abs(moved_corners(scene, here) - moved_corners(scene, there)).max(initial=0) < 0.02
        faces += len(shown.mesh)
        number += len(there)
    assert faces == scene.manifest["counts"]["faces"]
    assert number == scene.manifest["counts"]["instances"] > 100


def test_faces_are_in_the_group_of_their_layer_and_pads_lie_on_the_ground(scene, page):
    head = page.json("head")
    seen = set()
    for k, entry in enumerate(head["tiles"]):
        mesh = unpack_tile(entry, page.bytes(f"tile-{k}"))[0].mesh
        for group, (start, stop) in enumerate(zip([0, *entry["ends"]], entry["ends"], strict=False)):
            name = head["groups"][group]
            part = slice(start, stop)
            seen |= {name} if stop > start else set()
            pads = mesh.klass[part] == Class.BUILDING_PAD
            if name == "ground":
                first, last = scene.layers["landcover"]
                of = mesh.feature[part]
                assert (pads | (of < 0) | ((of >= first) & (of < last))).all()
            else:
                first, last = scene.layers[name]
                assert ((mesh.feature[part] >= first) & (mesh.feature[part] < last) & ~pads).all()
    assert {"ground", "buildings", "road_surfaces", "barriers"} <= seen


def test_the_page_makes_no_requests(path, page):
    text = path.read_text("utf-8")
    code = page.scripts["viewer"]
    assert "default-src 'none'" in text
    assert all(link.startswith(("https://www.openstreetmap.org/", "data:,")) for link in page.links)
    addresses = re.findall(r"\b[a-z]+://[^\s\"'`<>]*", text.replace(page.scripts["head"], ""))
    assert {a for a in addresses if not a.startswith("https://www.openstreetmap.org/")} == set()
    assert not [word for word in LOADERS if word in code]
    assert not {"img", "iframe", "object", "embed", "video", "audio"} & set(page.tags)


def test_page_contains_the_attribution(page):
    assert "© OpenStreetMap contributors, ODbL" in page.credit
    assert "https://www.openstreetmap.org/copyright" in page.links


@pytest.mark.full
def test_names_from_the_map_are_escaped(scene, tmp_path):
    name = '</script><script>document.title="x"</script>&amp;$title'
    odd = replace(scene, manifest={**scene.manifest, "name": name})
    view_scene(odd, tmp_path / "page.html")
    page = Page((tmp_path / "page.html").read_text("utf-8"))
    assert page.json("head")["name"] == name
    assert page.tags.count("script") == 5 + len(scene.tile_indices)
    assert "<script>document" not in (tmp_path / "page.html").read_text("utf-8")


def test_every_attribute_is_in_the_page(scene, page):
    known = {table["layer"]: table for table in page.json("attributes")}
    assert {"buildings", "building_parts", "road_surfaces", "roads", "trees", "furniture"} <= set(known)
    for name in ("buildings", "building_parts", "trees"):
        layer, table = scene.features(name), known[name]
        assert table["feature"] == layer.columns["feature"].tolist()
        added = {f"{k}{end}" for k in GUESSES for end in ("", "_source")} if name == "buildings" else set()
        assert set(table["columns"]) == (set(layer.columns) | added) - {"feature"}
        for column, told in table["columns"].items():
            if column in added:
                continue
            true = layer.columns[column]
            if isinstance(told, dict):
                values = ["" if k < 0 else told["words"][k] for k in told["index"]]
                assert values == ["" if v is None else v for v in true]
            elif true.dtype.kind == "f":
                values = np.array([np.nan if v is None else v for v in told])
                assert np.allclose(values, true, atol=5.1e-5, equal_nan=True)
            else:
                assert told == true.tolist()


def test_road_edges_come_with_the_surfaces_of_their_ways(scene, page):
    tables = {table["layer"]: table for table in page.json("attributes")}
    roads = scene.features("roads")
    surfaces = scene.features("road_surfaces")
    seen = np.isin(surfaces.columns["feature"], np.concatenate([t.mesh.feature for t in scene.tiles()]))
    ways = {way for text in surfaces.columns["osm_id"][seen] for way in text.split(";")}
    belongs = [not ways.isdisjoint(text.split(";")) for text in roads.columns["osm_id"]]
    assert tables["roads"]["feature"] == roads.columns["feature"][belongs].tolist()
    assert len(tables["roads"]["feature"]) > 20


@pytest.mark.full
def test_page_is_reproducible(scene, path, tmp_path):
    view_scene(scene, tmp_path / "again.html")
    assert (tmp_path / "again.html").read_bytes() == path.read_bytes()


@pytest.mark.full
def test_bounds_select_the_tiles_that_they_intersect(scene, tmp_path):
    x, y = scene.tile_size * 0.25, scene.tile_size * 0.25
    lon, lat = scene.frame.to_geographic([x, x + 10], [y, y + 10])
    summary = view_scene(
        scene, tmp_path / "part.html", options=ViewOptions(bounds_deg=(lon[0], lat[0], lon[1], lat[1]))
    )
    page = Page((tmp_path / "part.html").read_text("utf-8"))
    assert summary.faces == len(scene.tile(0, 0).mesh)
    assert rows(unpack_tile(page.json("head")["tiles"][0], page.bytes("tile-0"))[0]).tolist() == (
        rows(read_looks(scene).dressed(scene.tile(0, 0))).tolist()
    )
    present = set(np.unique(scene.tile(0, 0).mesh.feature)) | set(scene.tile(0, 0).instances.feature)
    shown = {table["layer"]: table["feature"] for table in page.json("attributes")}
    assert set(shown["buildings"]) <= present
    assert set(shown["buildings"]) > set()
    assert "1 of the scene's" in summary.notes[0]


def test_a_page_that_is_too_large_is_refused_with_the_bounds_of_a_part_that_fits(scene, path, tmp_path):
    whole = path.stat().st_size / 1e6
    out = tmp_path / "page.html"
    with pytest.raises(InputError, match="`max_mb`") as caught:
        view_scene(scene, out, options=ViewOptions(max_mb=0.7 * whole))
    assert not list(tmp_path.iterdir())
    told = re.search(r"`bounds_deg`=(\S+)", str(caught.value))
    west, south, east, north = map(float, told[1].split(","))
    summary = view_scene(
        scene, out, options=ViewOptions(bounds_deg=(west, south, east, north), max_mb=0.7 * whole)
    )
    assert 0 < summary.faces < scene.manifest["counts"]["faces"]
    with pytest.raises(InputError, match="give more"):
        view_scene(scene, tmp_path / "none.html", options=ViewOptions(max_mb=0.01))


def test_a_page_must_be_named_as_one(scene, tmp_path):
    for name in ("page.txt", "page.glb"):
        with pytest.raises(InputError, match=r"unknown suffix; a page is a file such as page\.html"):
            view_scene(scene, tmp_path / name)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"bounds_deg": (0.0, 0.0, 1.0, 1.0)}, "nothing there"),
        ({"bounds_deg": (25.0, 60.2, 24.9, 60.1)}, "west, south, east, north"),
        ({"max_mb": 0.0}, "above 0"),
        ({"max_mb": float("nan")}, "finite"),
    ],
)
def test_invalid_options_are_refused(scene, tmp_path, options, message):
    with pytest.raises(InputError, match=message):
        view_scene(scene, tmp_path / "page.html", options=ViewOptions(**options))


def test_a_page_is_replaced_only_with_overwrite(scene, path, tmp_path):
    with pytest.raises(InputError, match="overwrite"):
        view_scene(scene, path)
    with pytest.raises(InputError, match="overwrite"):
        view_scene(scene, tmp_path)
    (tmp_path / "page.html").write_text("old")
    view_scene(scene, tmp_path / "page.html", overwrite=True)
    assert (tmp_path / "page.html").read_bytes() == path.read_bytes()


COORDINATES = st.floats(-300, 300, allow_nan=False)


@settings(max_examples=40, deadline=None)
@given(
    st.lists(st.tuples(COORDINATES, COORDINATES, COORDINATES), min_size=3, max_size=40),
    st.sampled_from([1.0, 30.0, 4000.0]),
    st.tuples(st.integers(-9999, 9999), st.integers(-9999, 9999)),
)
def test_quantisation_moves_a_vertex_by_at_most_half_a_step(points, scale, place):
    vertices = np.array(points) * scale
    faces = np.arange(len(points) // 3 * 3).reshape(-1, 3)
    tile = Tile(np.array([*place, 0.0]), Mesh.of(vertices, faces))
    told, data = pack_tile(tile, Groups(("ground",), np.zeros(1, np.uint8)), facades=FacadeLooks.none())
    back, _ = unpack_tile(told, data)
    step = told["step"]
    assert np.abs(back.mesh.vertices + back.origin - vertices - tile.origin).max() <= step / 2 + 1e-9
    assert step == STEP or np.ptp(vertices, axis=0).max() > 32_000 * step


@settings(max_examples=30, deadline=None)
@given(COORDINATES, COORDINATES, COORDINATES)
def test_adjacent_tiles_quantise_shared_vertices_equally(x, y, z):
    groups = Groups(("ground",), np.zeros(1, np.uint8))
    corner = np.array([x, y, z])
    found = []
    for origin in (np.zeros(3), np.array([250.0, -500.0, 0.0])):
        apart = np.array([[7.3, 0, 0], [0, 11.1, 3.7]]) * (1 if origin.any() else -1)
        vertices = np.vstack([corner, corner + apart]) - origin
        told, data = pack_tile(
            Tile(origin, Mesh.of(vertices, [[0, 1, 2]])), groups, facades=FacadeLooks.none()
        )
        back, _ = unpack_tile(told, data)
        found.append(back.mesh.vertices[0] + back.origin)
    assert np.array_equal(*found)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.booleans())
def test_quantisation_moves_an_instance_by_less_than_two_centimetres(seed, upright):
    rng = np.random.default_rng(seed)
    count = 30
    turn, along, lift = rng.uniform(-7, 7, count), rng.uniform(0.1, 9, count), rng.uniform(0.1, 30, count)
    matrix = np.zeros((count, 3, 4))
    matrix[:, 0, 0], matrix[:, 0, 1] = along * np.cos(turn), -along * np.sin(turn)
    matrix[:, 1, 0], matrix[:, 1, 1] = along * np.sin(turn), along * np.cos(turn)
    matrix[:, 2, 2] = lift
    matrix[:, :, 3] = rng.uniform(-250, 250, (count, 3))
    if not upright:
        matrix[:, 2, 0] += rng.uniform(0.01, 0.5, count)  # leaning
    given_copies = ShapeInstances(
        rng.integers(0, 3, count).astype(np.int32), matrix, np.arange(count, dtype=np.int32)
    )
    tile = Tile(np.array([500.0, -250.0, 3.7]), Mesh.empty(), given_copies)
    told, data = pack_tile(
        tile, Groups(("ground", "trees"), np.ones(count + 1, np.uint8)), facades=FacadeLooks.none()
    )
    back, _ = unpack_tile(told, data)
    assert told["upright"] == upright
    order = np.argsort(back.instances.feature)
    assert np.array_equal(back.instances.feature[order], np.arange(count))
    assert np.array_equal(back.instances.shape[order], given_copies.shape)
    found = back.instances.transform[order]
    rim = np.array([[0.5, 0.5, 0, 1], [-0.5, 0.5, 1, 1], [0, 0, 1, 1]]).T
    apart = found @ rim + back.origin[:, None] - matrix @ rim - tile.origin[:, None]
    assert np.linalg.norm(apart, axis=1).max() < (0.02 if upright else 0.001)


def test_an_empty_tile_can_be_packed():
    groups = Groups(("ground", "trees"), np.zeros(1, np.uint8))
    told, data = pack_tile(
        Tile(np.zeros(3), Mesh.empty(), ShapeInstances.empty()), groups, facades=FacadeLooks.none()
    )
    back, _ = unpack_tile(told, data)
    assert len(back.mesh) == len(back.instances) == 0


def test_groups_are_the_ground_and_the_visible_layers(scene):
    groups = groups_of(scene)
    assert groups.names[0] == "ground"
    assert {"building_parts", "landcover", "roads"}.isdisjoint(groups.names)
    start = scene.layers["building_parts"][0]
    assert groups.names[groups.of[start]] == "buildings"
    assert groups.names[groups.of[-1]] == "ground"


@settings(max_examples=15, deadline=None)
@given(
    st.sampled_from(
        [("local", 24.9, 60.2), ("utm", 7.4, 43.7), ("EPSG:3857", 0.5, 0.5), ("local", 179.99, -17.0)]
    ),
    st.sampled_from([300.0, 3000.0, 20_000.0]),
    st.integers(0, 2**32 - 1),
)
def test_longitude_and_latitude_are_within_the_stated_error(place, size, seed):
    crs, lon, lat = place
    frame = Frame.at(lon, lat, crs=crs)
    grid = lonlat_grid(frame, (-size, -0.7 * size, size, 0.9 * size))
    assert grid.error <= ACCURACY
    points = np.random.default_rng(seed).uniform(-0.7 * size, 0.7 * size, (50, 2))
    there = frame.from_geographic(*grid.at(points[:, 0], points[:, 1]))
    assert np.hypot(there[0] - points[:, 0], there[1] - points[:, 1]).max() <= 1.2 * grid.error + 2e-4


@pytest.mark.shared
def test_lower_manhattan_is_a_small_page(shared_osm, tmp_path):
    osm = read_osm(shared_osm("nyc_lower_east_side.osm.pbf"))
    scene = build(osm, tmp_path / "scene", options=BuildOptions(name="Lower East Side"))
    summary = view_scene(scene, tmp_path / "page.html")
    assert summary.faces == scene.manifest["counts"]["faces"] > 100_000
    assert summary.bytes == (tmp_path / "page.html").stat().st_size < 2.5e6
