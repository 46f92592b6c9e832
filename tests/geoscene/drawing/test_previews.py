"""Pictures and tables that notebooks show."""

import io

import numpy as np
import shapely
from PIL import Image

from geoscene.drawing.previews import PAPER, PreviewPlan, card

RED, BLUE = (200, 0, 0), (0, 0, 200)


def pixels(png):
    """Colours (h, w, 3) of a PNG file."""
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB"))


def at(image, bounds, xy):
    """Colour of an image at a place."""
    scale = max(image.shape[:2]) / max(bounds[2] - bounds[0], bounds[3] - bounds[1])
    return tuple(image[int((bounds[3] - xy[1]) * scale), int((xy[0] - bounds[0]) * scale)].tolist())


def test_courtyards_stay_open_and_north_is_up():
    bounds = (100.0, 50.0, 200.0, 150.0)
    plan = PreviewPlan(bounds, PAPER)
    ring = shapely.box(110, 90, 190, 140).difference(shapely.box(130, 100, 150, 120))
    plan.polygons([shapely.MultiPolygon([ring]), shapely.Point(120, 60)], RED)
    image = pixels(plan.png())
    assert at(image, bounds, (120, 110)) == at(image, bounds, (170, 135)) == RED
    assert at(image, bounds, (140, 110)) == at(image, bounds, (160, 70)) == PAPER


def test_the_higher_of_two_points_is_seen():
    plan = PreviewPlan((0.0, 0.0, 10.0, 20.0), PAPER)
    xyz = [[5.0, 5.0, 3.0], [5.0, 5.0, 1.0], [2.0, 15.0, 0.0], [99.0, 5.0, 0.0]]
    plan.points(xyz, np.array([RED, BLUE, BLUE, RED], np.uint8))
    image = pixels(plan.png())
    assert image.shape == (480, 240, 3)
    for color, (x, y) in ((RED, (5, 5)), (BLUE, (2, 15))):
        row, column = np.argwhere(np.abs(image.astype(int) - color).max(axis=2) < 80).mean(axis=0)
        assert np.hypot(row - (20 - y) * 24, column - x * 24) < 3


def test_a_card_shows_names_as_they_are():
    text = card("<Rue & co>", [("a<b", 3)], picture=b"x")
    assert "&lt;Rue &amp; co&gt;" in text
    assert '<td style="text-align:left">3</td>' in text
    assert 'src="data:image/png;base64,eA=="' in text
    assert "<Rue" not in text


def test_a_scene_shows_its_buildings_where_they_are(scene):
    image = pixels(scene._repr_png_())
    assert max(image.shape) == 480
    buildings = scene.features("buildings").geometry
    places = [shapely.point_on_surface(b).coords[0][:2] for b in buildings[shapely.area(buildings) > 400]]
    near = [np.abs(np.array(at(image, scene.bounds, xy)) - (214, 150, 84)).max() < 8 for xy in places]
    assert len(near) > 10
    assert np.mean(near) > 0.9
    text = scene._repr_html_()
    assert f"{scene.manifest['counts']['solids']:,}</td>" in text
    assert "OpenStreetMap contributors" in text
