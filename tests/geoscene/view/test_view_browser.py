"""The page in a browser: drawing, picking, search, controls, and no network requests."""

from io import BytesIO

import numpy as np
import pytest
import shapely
from helpers.browser import browser
from PIL import Image

from geoscene.classes import Class
from geoscene.cli import app
from geoscene.geometry.frames import Frame
from geoscene.options import BuildOptions
from geoscene.pipeline.build import build
from geoscene.sources import demo_path, read_osm
from geoscene.sources.data import Area, OsmData
from geoscene.view import view_scene

BOX = (24.9405, 60.1655, 24.9450, 60.1680)
SKY = (185, 207, 228)

# Software rendering reads pixels back slowly and says so.
SLOW = "GPU stall due to ReadPixels"


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    osm = read_osm(demo_path(), bounds=BOX)
    return build(
        osm, tmp_path_factory.mktemp("browser") / "demo", options=BuildOptions(name="demo", tile_size=200.0)
    )


@pytest.fixture(scope="module")
def page(scene, tmp_path_factory):
    out = tmp_path_factory.mktemp("page") / "a page.html"
    with pytest.raises(SystemExit) as ended:
        app(["view", str(scene.path), "-o", str(out), "--json", "-q"])
    assert ended.value.code == 0
    return out


@pytest.fixture(scope="module")
def window(tmp_path_factory):
    with browser(tmp_path_factory.mktemp("chromium")) as opened:
        yield opened


@pytest.fixture
def opened(window, page):
    """The window with the page newly opened; asserts no console errors and no network requests."""
    window.complaints(), window.requests()
    window.open(page)
    yield window
    assert [text for text in window.complaints() if SLOW not in text] == []
    asked = {address.split(":")[0] for address in window.requests()}
    assert asked <= {"file", "about", "data", "blob"}


def picture(window):
    return np.asarray(Image.open(BytesIO(window.screenshot())).convert("RGB")).astype(int)


def middle(window):
    """The part of the window that no panel covers."""
    return picture(window)[100:560, 300:640]


def tall_house(scene, window):
    """(row, feature, columns) of the highest building that is mapped as a way."""
    buildings = scene.features("buildings").columns
    for row in np.argsort(-buildings["height"]):
        feature = int(buildings["feature"][row])
        if buildings["osm_id"][row].startswith("way/") and window.js(
            "return geoscene.boxes.has(arguments[0])", feature
        ):
            return row, feature, buildings
    raise AssertionError


def look_down(window, feature):
    """Look at a feature from above; returns the window position of its centre."""
    window.js(
        "const v = geoscene; v.camera.lookAt(v.boxes.middle(arguments[0]), 2.5 * v.boxes.size(arguments[0]));"
        "v.camera.tilt = 1.5; v.redraw();",
        feature,
    )
    window.settle()
    return window.js("return [innerWidth / 2, innerHeight / 2]")


def test_the_scene_is_drawn_with_many_colours_and_shades(opened):
    assert opened.js("return document.getElementById('message').hidden")
    assert "WebGL 2.0" in opened.js(
        "return document.getElementById('canvas').getContext('webgl2').getParameter(0x1F02)"
    )
    seen = middle(opened)
    assert (np.abs(seen - SKY).max(axis=2) > 12).mean() > 0.5
    assert len(np.unique(seen.reshape(-1, 3), axis=0)) > 300


def test_a_click_on_a_roof_shows_its_osm_id_and_height_source(scene, opened):
    row, feature, buildings = tall_house(scene, opened)
    opened.click(*look_down(opened, feature))
    opened.settle()
    told = opened.text("panel")
    assert int(opened.js("return document.getElementById('panel').dataset.feature")) == feature
    assert buildings["osm_id"][row] in told
    assert f"{buildings['height'][row]:.2f}".rstrip("0").rstrip(".") in told
    assert buildings["height_source"][row].replace("-", " ") in told
    assert f"± {buildings['height_sigma'][row]:.2f}".rstrip("0").rstrip(".") in told
    link = opened.js("return document.querySelector('#panel a').href")
    assert link == f"https://www.openstreetmap.org/{buildings['osm_id'][row]}"


def test_the_point_under_a_pixel_is_on_the_scene_and_its_degrees_are_the_frame_s(scene, opened):
    _, feature, _ = tall_house(scene, opened)
    x, y = look_down(opened, feature)
    hit = opened.js("return geoscene.pick(arguments[0], arguments[1])", x, y)
    low, high = opened.js(
        "const b = geoscene.boxes, f = 3 * arguments[0];"
        "return [[...b.low.slice(f, f + 3)], [...b.high.slice(f, f + 3)]]",
        feature,
    )
    assert hit["feature"] == feature
    assert np.all(np.array(hit["point"]) >= np.array(low) - 0.02)
    assert np.all(np.array(hit["point"]) <= np.array(high) + 0.02)
    assert np.hypot(*(np.array(hit["point"][:2]) - (np.array(low) + high)[:2] / 2)) < 3.0
    told = opened.js("return geoscene.lonLat(arguments[0], arguments[1])", *hit["point"][:2])
    true = scene.frame.to_geographic(*hit["point"][:2])
    assert np.allclose(told, np.asarray(true, float), atol=2e-7)


def test_a_layer_that_is_switched_off_is_not_drawn_and_not_picked(scene, opened):
    _, feature, _ = tall_house(scene, opened)
    x, y = look_down(opened, feature)
    before = middle(opened)
    opened.js("document.getElementById('layer-buildings').click()")
    opened.settle()
    hit = opened.js("return geoscene.pick(arguments[0], arguments[1])", x, y)
    assert hit["klass"] == Class.BUILDING_PAD  # the ground that the house stands on
    assert (np.abs(middle(opened) - before).max(axis=2) > 12).mean() > 0.2
    opened.js("document.getElementById('layer-buildings').click()")
    opened.settle()
    assert np.array_equal(middle(opened), before)


def test_search_by_id_shows_the_feature(scene, opened):
    row, feature, buildings = tall_house(scene, opened)
    opened.js("document.getElementById('search').focus()")
    opened.write(buildings["osm_id"][row])
    opened.keys("\ue007")
    opened.settle()
    assert int(opened.js("return document.getElementById('panel').dataset.feature")) == feature
    assert buildings["osm_id"][row] in opened.text("found")
    target = np.array(opened.js("return geoscene.camera.target"))
    assert np.allclose(target, opened.js("return geoscene.boxes.middle(arguments[0])", feature), atol=1e-6)


def test_search_by_name_lists_matches_or_reports_none(scene, opened):
    names = scene.features("buildings").columns["name"]
    name = next(name for name in names if name)
    assert opened.js("return geoscene.select(arguments[0])", name.upper())
    assert name in opened.text("panel")
    opened.js("document.getElementById('search').focus()")
    opened.write("way/1")
    assert "Not in this scene" in opened.text("found")


def test_assumed_values_have_their_own_colours_and_a_legend(scene, opened):
    before = middle(opened)
    opened.js("const c = document.getElementById('color'); c.value = 'source'; c.onchange();")
    assert (np.abs(middle(opened) - before).max(axis=2) > 12).mean() > 0.1
    legend = opened.text("legend")
    sources = scene.features("buildings").columns["height_source"]
    assert f"from its storeys ({(sources == 'levels').sum()})" in legend
    for mode in ("material", "class", "sigma", "guesses", "look"):
        opened.js("const c = document.getElementById('color'); c.value = arguments[0]; c.onchange();", mode)
        assert (mode == "look") == (opened.text("legend") == "")
    assert np.array_equal(middle(opened), before)


HOUSE = (
    10.0,
    50.0,
    12.0,
    30.0,
)  # metres: x, y, width, depth of a tagged house; its copy east of it is untagged


@pytest.fixture(scope="module")
def houses(tmp_path_factory):
    """A page with a house of five storeys whose colours are mapped, and one without any tags."""
    frame = Frame.at(8.7, 49.4)
    x, y, width, depth = HOUSE
    tags = {"building": "apartments", "height": "15", "building:levels": "5", "building:colour": "#ffffff"}
    areas = []
    for k, own in enumerate((tags | {"roof:colour": "#ff0000"}, {"building": "apartments", "height": "15"})):
        shape = shapely.box(x + 60 * k, y, x + 60 * k + width, y + depth)
        lonlat = shapely.transform(shape, lambda xy: np.column_stack(frame.to_geographic(xy[:, 0], xy[:, 1])))
        areas.append(Area(f"way/{k + 1}", own, lonlat, np.empty(0, np.int64)))
    lon, lat = frame.to_geographic([-50, 150], [-50, 100])
    osm = OsmData((lon[0], lat[0], lon[1], lat[1]), [], areas, [], [])
    scene = build(osm, tmp_path_factory.mktemp("houses") / "scene", options=BuildOptions(name="houses"))
    out = tmp_path_factory.mktemp("page") / "houses.html"
    view_scene(scene, out)
    return out


def look_at_wall(window, way):
    """Look level at the wall of a house that faces east, and deselect it."""
    window.js(
        "const v = geoscene; v.select(arguments[0]);"
        "const f = +document.getElementById('panel').dataset.feature, [x, y] = v.boxes.middle(f);"
        "const c = v.camera; c.lookAt([v.boxes.high[3 * f], y, 7.5], 45);"
        "c.azimuth = -Math.PI / 2; c.tilt = 0.02;"
        "v.click(-1, -1); v.redraw();",
        way,
    )
    window.settle()


def runs(line):
    """Number of runs of true in a line."""
    return int(np.count_nonzero(np.diff(np.concatenate([[0], line.astype(int)])) == 1))


def test_windows_stand_in_the_storeys_of_a_wall_and_can_be_switched_off(window, houses):
    window.open(houses)
    look_at_wall(window, "way/1")
    drawn = picture(window)[:, 260:]
    window.js("document.getElementById('guesses').click()")
    bare = picture(window)[:, 260:]
    glass = np.abs(drawn - bare).max(axis=2) > 60
    assert max(runs(column) for column in glass.T) == 5  # building:levels
    rows = [runs(row) for row in glass]
    assert 5 <= max(rows) <= 15  # of a wall of 30 m
    assert np.ptp(bare[glass], axis=0).max() < 12  # the mapped colour lies behind the windows
    window.js("document.getElementById('guesses').click()")
    assert np.array_equal(picture(window)[:, 260:], drawn)


def test_the_inspector_says_what_is_a_guess_and_never_of_a_mapped_colour(window, houses):
    window.open(houses)
    told = {}
    for way in ("way/1", "way/2"):
        look_at_wall(window, way)
        window.js("geoscene.click(innerWidth / 2, innerHeight / 2 - 20)")
        rows = window.js(
            "const rows = [...document.querySelectorAll('#panel tr')];"
            "return rows.map((row) => [...row.children].map((cell) => cell.innerText))"
        )
        told[way] = {row[0]: row[1:] for row in rows}
        assert window.js("return [...document.querySelectorAll('#panel .guessed')].length") > 0
    assert told["way/1"]["windows"][1] == told["way/2"]["windows"][1] == "guess"
    assert not {"wall look", "roofing", "storeys", "colour"} & set(told["way/1"])
    assert told["way/1"]["levels"][0] == "5"
    for row in ("wall look", "roofing", "storeys"):
        assert told["way/2"][row][1] == "guess"
    assert told["way/2"]["colour"] == ["guess"]
    assert told["way/2"]["surface"] == ["wall"]
    window.js("const c = document.getElementById('color'); c.value = 'guesses'; c.onchange();")
    legend = window.text("legend")
    assert "walls and roof mapped (1)" in legend
    assert "walls and roof guessed (1)" in legend
    assert "windows are drawn, not mapped" in legend


def test_without_guesses_an_unmapped_house_has_its_default_colour(window, houses):
    window.open(houses, "#guesses=0")
    look_at_wall(window, "way/2")
    plaster = picture(window)[200:300, 450:550].reshape(-1, 3)
    window.js("document.getElementById('guesses').click()")
    guessed = picture(window)[200:300, 450:550].reshape(-1, 3)
    assert len(np.unique(plaster, axis=0)) <= 3
    assert np.abs(np.median(guessed, axis=0) - np.median(plaster, axis=0)).max() > 5


def test_mouse_and_keys_rotate_move_and_zoom(opened):
    def state():
        opened.settle()
        return opened.js("const c = geoscene.camera; return [c.azimuth, c.tilt, c.distance, ...c.target]")

    first = state()
    opened.drag((500, 350), (600, 380))
    turned = state()
    assert turned[0] != first[0] and turned[1] > first[1]  # noqa: PT018
    assert opened.js("return document.getElementById('panel').hidden")
    opened.drag((500, 350), (540, 380), button=2)
    moved = state()
    assert moved[:2] == turned[:2]
    assert moved[3:5] != turned[3:5]
    opened.js("document.getElementById('canvas').focus()")
    opened.keys("+", "+", "n", "t")
    zoomed = state()
    assert zoomed[2] < moved[2]
    assert zoomed[0] == 0
    assert zoomed[1] == pytest.approx(np.pi / 2)


@pytest.fixture
def phone(window, page):
    """The page newly opened on a phone."""
    window.phone(390, 844)
    window.open(page)
    yield window
    window.phone(0, 0)


def camera_of(window):
    names = ("azimuth", "tilt", "distance", "x", "y")
    script = "const c = geoscene.camera; return [c.azimuth, c.tilt, c.distance, ...c.target.slice(0, 2)]"
    return dict(zip(names, window.js(script), strict=True))


def test_touch_gestures_rotate_move_zoom_and_select(scene, phone):
    first = camera_of(phone)
    phone.touch([(200, 400)], [(240, 420)], [(280, 440)])
    turned = camera_of(phone)
    assert turned["azimuth"] != first["azimuth"]
    assert turned["tilt"] > first["tilt"]
    phone.touch([(170, 400), (230, 400)], [(150, 400), (250, 400)], [(110, 400), (290, 400)])
    pinched = camera_of(phone)
    assert pinched["distance"] == pytest.approx(turned["distance"] / 3, rel=0.25)
    assert pinched["azimuth"] == pytest.approx(turned["azimuth"], abs=0.02)
    phone.touch([(150, 300), (250, 300)], [(150, 340), (250, 340)], [(150, 400), (250, 400)])
    moved = camera_of(phone)
    assert np.hypot(moved["x"] - pinched["x"], moved["y"] - pinched["y"]) > 3.0
    assert moved["distance"] == pytest.approx(pinched["distance"], rel=0.1)
    phone.touch([(150, 400), (250, 400)], [(160, 350), (240, 450)], [(200, 340), (200, 460)])
    twisted = camera_of(phone)
    assert abs(twisted["azimuth"] - moved["azimuth"]) > 0.7
    _, feature, _ = tall_house(scene, phone)
    phone.touch([tuple(look_down(phone, feature))])
    assert int(phone.js("return document.getElementById('panel').dataset.feature")) == feature


def test_on_a_phone_the_scene_is_visible_and_nothing_overflows(scene, phone):
    assert phone.js("return innerWidth") == 390
    assert phone.js("return document.documentElement.scrollWidth") == 390
    _, feature, _ = tall_house(scene, phone)
    phone.touch([tuple(look_down(phone, feature))])
    boxes = [
        phone.js(
            "const b = document.getElementById(arguments[0]).getBoundingClientRect();"
            "return [b.left, b.top, b.right, b.bottom]",
            name,
        )
        for name in ("controls", "panel", "foot")
    ]
    for left, top, right, bottom in boxes:
        assert left >= 0
        assert right <= 390
        assert top >= 0
        assert bottom <= 844
    controls, panel, foot = boxes
    assert panel[1] > controls[3]
    assert panel[3] <= foot[1] + 1
    covered = sum((right - left) * (bottom - top) for left, top, right, bottom in boxes)
    assert covered < 0.6 * 390 * 844
    small = phone.js(
        "document.getElementById('controls').open = true;"
        "const seen = [...document.querySelectorAll('input, select, summary, .close')];"
        "const target = (e) => (e.closest('label') || e).getBoundingClientRect().height;"
        "return seen.filter((e) => e.offsetParent).map((e) => [e.id || e.className || e.tagName, target(e)]);"
    )
    assert [name for name, height in small if height < 24] == []  # WCAG 2.2, target size


def test_shadows_darken_and_the_sun_moves_them(opened):
    with_shadows = middle(opened)
    opened.js("document.getElementById('shadows').click()")
    assert middle(opened).mean() > with_shadows.mean() + 1
    opened.js("document.getElementById('shadows').click()")
    assert np.array_equal(middle(opened), with_shadows)
    opened.js("const s = document.getElementById('sun'); s.value = 330; s.oninput();")
    assert (np.abs(middle(opened) - with_shadows).max(axis=2) > 12).mean() > 0.2


def test_a_browser_without_decompression_gets_a_message(window, page, tmp_path):
    text = page.read_text("utf-8").replace('"DecompressionStream" in window', '"Nothing" in window')
    (tmp_path / "old.html").write_text(text, "utf-8")
    with pytest.raises(AssertionError, match="too old"):
        window.open(tmp_path / "old.html")


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    """A scene of small tiles as one file, and as a folder."""
    folder = tmp_path_factory.mktemp("pages")
    osm = read_osm(demo_path(), bounds=BOX)
    scene = build(osm, folder / "scene", options=BuildOptions(name="small tiles", tile_size=50.0))
    view_scene(scene, folder / "page.html")
    view_scene(scene, folder / "a page")
    return folder / "page.html", folder / "a page"


def at_rest(window):
    """The picture when everything that the view wants is loaded and drawn."""
    window.wait("return geoscene.settled()")
    return picture(window)


def nodes_asked(window):
    """Numbers of the nodes that the page has asked for."""
    return {int(url.split("/")[-1][:-3]) for url in window.requests() if "/nodes/" in url}


NEAR = "#view=0,0,5,80,0,60&shadows=0"


def test_a_folder_shows_the_same_near_view_as_a_file_from_parts_of_the_scene(window, pages):
    file, folder = pages
    window.open(file, NEAR)
    whole = at_rest(window)
    window.complaints(), window.requests()
    window.open(folder / "index.html", NEAR)
    assert np.array_equal(at_rest(window), whole)
    assert [text for text in window.complaints() if SLOW not in text] == []
    entries = window.js("return geoscene.tiles().map(([number]) => geoscene.head.nodes[number][6])")
    assert 0.0 in entries
    assert max(entries) > 0.0  # far away it is coarse
    asked = nodes_asked(window)
    assert len(asked) < len(window.js("return geoscene.head.nodes"))


def test_a_folder_looks_from_afar_as_the_file_with_fewer_triangles(window, pages):
    file, folder = pages
    far = "#view=0,0,5,900,-28,43&shadows=0"
    window.open(file, far)
    whole, faces = at_rest(window), sum(n for _, n in window.js("return geoscene.tiles()"))
    window.open(folder / "index.html", far)
    coarse = at_rest(window)
    assert sum(n for _, n in window.js("return geoscene.tiles()")) < 0.8 * faces
    assert window.js("return geoscene.tiles().length === geoscene.head.roots.length")
    assert np.abs(coarse - whole).mean() < 3
    assert (np.abs(coarse - whole).max(axis=2) > 60).mean() < 0.02


def test_search_in_a_folder_finds_what_is_not_loaded_and_goes_there(window, pages):
    _, folder = pages
    window.open(folder / "index.html", "#view=0,0,5,900,-28,43")
    at_rest(window)
    window.requests()
    way = window.js(
        "const table = geoscene.attributes.tables.find((t) => t.layer === 'buildings');"
        "return geoscene.attributes.ids(table.feature[0])[0]"
    )
    assert window.js("return geoscene.select(arguments[0])", way)
    feature = int(window.js("return document.getElementById('panel').dataset.feature"))
    target = window.js("return geoscene.camera.target")
    assert np.allclose(target, window.js("return geoscene.boxes.middle(arguments[0])", feature), atol=1e-6)
    window.js("const c = geoscene.camera; c.distance = 60; c.tilt = 1.5; geoscene.redraw();")
    at_rest(window)
    assert nodes_asked(window)
    hit = window.js(
        "return geoscene.click(innerWidth / 2, document.getElementById('canvas').clientHeight / 2)"
    )
    assert hit["feature"] == feature
    assert way in window.text("panel")


def test_a_folder_gives_up_what_is_not_needed_and_loads_it_again(window, pages, tmp_path):
    _, folder = pages
    window.open(folder / "index.html", NEAR)
    first = at_rest(window)
    small = tmp_path / "small"
    small.mkdir()
    for name in ("nodes", "attributes.js"):
        (small / name).symlink_to(folder / name)
    text = (folder / "index.html").read_text("utf-8")
    assert text.count("MOST_BYTES = 768e6") == 1
    (small / "index.html").write_text(text.replace("MOST_BYTES = 768e6", "MOST_BYTES = 1e6"), "utf-8")
    window.open(small / "index.html", NEAR)
    at_rest(window)
    near = window.js("return geoscene.bytes()")
    window.requests()
    window.js("location.hash = '#view=0,0,5,5000,-28,43&shadows=0'")
    at_rest(window)
    assert window.js("return geoscene.bytes()") < near
    window.js("location.hash = arguments[0]", NEAR)
    assert np.array_equal(at_rest(window), first)
    assert nodes_asked(window)


def test_a_folder_that_lacks_a_file_says_so(window, pages, tmp_path):
    _, folder = pages
    (tmp_path / "nodes").mkdir()
    (tmp_path / "index.html").write_bytes((folder / "index.html").read_bytes())
    with pytest.raises(AssertionError, match="cannot be loaded; keep the folder of the page whole"):
        window.open(tmp_path / "index.html")
