"""Drives on the roads of a scene: what is said about places that no drive reaches."""

import pytest

from geoscene.errors import InputError
from geoscene.pipeline.build import build
from geoscene.roadgraph.routing import route_line
from geoscene.sources import read_osm
from lidar.errors import RouteError
from lidar.motion.road_drive import RoadDriveOptions, plan_road_drive

NODES = {1: (0, 0), 2: (300, 0), 3: (0, 200), 4: (300, 200), 5: (150, -400), 6: (150, 600)}
"""Metres east and north of 8° E, 50° N."""
WAYS = {
    (1, 2): {"highway": "residential"},
    (3, 4): {"highway": "service", "access": "private"},
    (5, 6): {"highway": "tertiary"},  # it leaves the scene at both ends
}


def lat_lon(x, y):
    return 50 + y / 111_200, 8 + x / 71_700


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("roads")
    parts = []
    for number, (x, y) in NODES.items():
        lat, lon = lat_lon(x, y)
        parts.append(f'<node id="{number}" lat="{lat:.7f}" lon="{lon:.7f}" version="1"/>')
    for number, (ends, tags) in enumerate(WAYS.items(), 1):
        inner = "".join(f'<nd ref="{end}"/>' for end in ends)
        inner += "".join(f'<tag k="{key}" v="{value}"/>' for key, value in tags.items())
        parts.append(f'<way id="{number}" version="1">{inner}</way>')
    (folder / "map.osm").write_text(f'<osm version="0.6">{"".join(parts)}</osm>', "utf-8")
    south, west = lat_lon(-50, -50)
    north, east = lat_lon(350, 300)
    osm = read_osm(folder / "map.osm", bounds=(west, south, east, north))
    return build(osm, folder / "scene")


@pytest.mark.parametrize(
    ("place", "says"),
    [
        ((50, 200), "is .* m from the nearest drivable street.*road there is not connected"),
        ((150, 250), "cannot be reached from waypoint 1 because .* are not connected within the scene"),
        ((30, 100), r"is .* m from the nearest drivable street, more than 50 m$"),
    ],
)
def test_a_waypoint_on_a_road_that_cannot_be_driven_says_why(scene, place, says):
    with pytest.raises(RouteError, match=rf"waypoint 2 .* {says}"):
        plan_road_drive(scene, [lat_lon(50, 0), lat_lon(*place)], options=RoadDriveOptions("car"))


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("a,b\n1,2\n", "has a, b; no lon and no lat"),
        ("lon,b\n1,2\n", "has lon, b; no lat"),
        ("", "has no columns"),
    ],
)
def test_a_table_without_places_says_which_columns_it_lacks(scene, tmp_path, text, says):
    (tmp_path / "w.csv").write_text(text)
    with pytest.raises(InputError, match=says):
        route_line([str(tmp_path / "w.csv")], scene.road_graph(), frame=scene.frame)


def test_waypoints_to_build_along_say_that_they_look_swapped(scene):
    words = [f"{lon},{lat}" for lat, lon in (lat_lon(50, 0), lat_lon(150, 0))]
    with pytest.raises(InputError, match=r"m from the nearest road; at most 100; .* look swapped"):
        route_line(words, scene.road_graph(), frame=scene.frame)
