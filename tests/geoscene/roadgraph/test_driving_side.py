"""The driving side is that of the options, else of the map's tags, else of the country."""

import json
import zoneinfo

import numpy as np
import pytest

from geoscene.errors import InputError
from geoscene.options import BuildOptions
from geoscene.pipeline.build import build
from geoscene.roadgraph.driving_side import LEFT_HAND, driving_side, side_at
from geoscene.sources.data import OsmData, Way
from lidar.options import DriveOptions

PLACES = {
    "left": [
        (-0.1, 51.5), (-5.93, 54.6), (-6.26, 53.35), (14.5, 35.9), (33.3, 35.1), (139.7, 35.6),
        (103.86, 1.28), (114.1, 22.3), (113.54, 22.2), (77.2, 28.6), (100.5, 13.7), (106.8, -6.2),
        (151.2, -33.9), (174.8, -36.9), (18.4, -33.9), (36.8, -1.3), (32.6, -25.9), (-59.5, 3.0),
        (-76.8, 18.0), (-64.8, 18.35), (178.4, -18.1),
    ],
    "right": [
        (24.94, 60.17), (-76.3, 36.9), (7.42, 43.73), (-5.35, 36.14), (114.06, 22.55), (121.5, 31.2),
        (102.6, 17.97), (30.06, -1.95), (13.2, -8.8), (-66.1, 18.4), (-170.7, -14.3), (37.6, 55.8),
        (166.4, -22.3), (-30.0, 40.0),
    ],
}  # fmt: skip


def street(osm_id, **tags):
    line = np.array([[103.8600, 1.2800], [103.8610, 1.2800], [103.8620, 1.2805]])
    return Way(f"way/{osm_id}", {"highway": "residential"} | tags, np.arange(3) + 10 * osm_id, line)


def extract(*ways):
    return OsmData((103.859, 1.279, 103.863, 1.282), list(ways), [], [], [])


@pytest.mark.parametrize(
    ("side", "place"), [(side, place) for side, found in PLACES.items() for place in found]
)
def test_cities_keep_to_the_side_of_their_country(side, place):
    assert side_at(*place) == side


def test_left_hand_time_zones_exist():
    assert zoneinfo.available_timezones() >= LEFT_HAND


def test_driving_side_tags_override_the_country():
    assert driving_side(extract(street(1))) == ("left", "place")
    assert driving_side(extract(street(1), street(2, driving_side="right"))) == ("right", "tag")
    assert driving_side(extract(street(1, driving_side="both"))) == ("left", "place")


def test_a_street_that_is_driven_on_the_other_side_does_not_turn_its_town():
    town = extract(street(1, driving_side="right"), street(2), street(3))
    assert driving_side(town) == ("left", "place")


@pytest.mark.parametrize("given", ["", "left", "right"])
def test_scene_and_drive_use_the_same_driving_side(given, tmp_path):
    scene = build(extract(street(1)), tmp_path / "scene", options=BuildOptions(driving_side=given))
    roads = json.loads((tmp_path / "scene" / "scene.json").read_text())["roads"]
    side = given or "left"
    assert roads == {"driving_side": side, "driving_side_source": "option" if given else "place"}
    assert scene.left_hand == (side == "left")
    assert DriveOptions().side_in(scene) == side
    assert DriveOptions(side="right").side_in(scene) == "right"


def test_unknown_driving_side_is_refused():
    with pytest.raises(InputError, match="`driving_side` middle: left or right"):
        BuildOptions(driving_side="middle")
