"""Vehicles drive through passages of buildings that are high enough, and below raised parts."""

import numpy as np
import pytest
import shapely

import geoscene
from geoscene.geometry.frames import Frame
from geoscene.options import BuildOptions
from geoscene.pipeline.plan import make_plan
from geoscene.sources.data import Area, OsmData, Way
from geoscene.support.progress import silent
from lidar.errors import RouteError
from lidar.motion.road_drive import (
    RoadDriveOptions,
    building_obstacles,
    plan_road_drive,
    road_course,
    road_map,
)

FRAME = Frame.at(10.0, 50.0)
PLACES = ((-90, 0), (-6, 0), (6, 0), (90, 0))


def lonlat(xy):
    return np.column_stack(FRAME.to_geographic(*np.asarray(xy, float).reshape(-1, 2).T))


def area(number, shape, **tags):
    colon = {key.replace("__", ":"): value for key, value in tags.items()}
    return Area(f"way/{number}", colon, shapely.transform(shape, lonlat), np.empty(0, np.int64))


def town(inside, parts=()):
    where = lonlat(PLACES)
    ways = [
        Way(
            f"way/{k}",
            {"highway": "residential"} | (inside if k == 1 else {}),
            np.arange(k, k + 2),
            where[k : k + 2],
        )
        for k in range(3)
    ]
    house = area(900, shapely.box(-6, -40, 6, 40), building="yes", height="12")
    return OsmData((9.998, 49.999, 10.002, 50.001), ways, [house, *parts], [], [])


ROUTE = [tuple(place[::-1]) for place in lonlat([(-70, 0), (70, 0)]).tolist()]
PARTS = (
    area(901, shapely.box(-6, -40, 6, -5), building__part="yes", height="12"),
    area(902, shapely.box(-6, -5, 6, 5), building__part="yes", height="12", min_height="4"),
    area(903, shapely.box(-6, 5, 6, 40), building__part="yes", height="12"),
)


@pytest.mark.full
@pytest.mark.parametrize(
    ("inside", "parts", "vehicle", "passes"),
    [
        ({"tunnel": "building_passage"}, (), "car", True),
        ({"tunnel": "building_passage"}, (), "van", True),
        ({"tunnel": "building_passage", "maxheight": "2.2"}, (), "car", True),
        ({"tunnel": "building_passage", "maxheight": "2.2"}, (), "van", False),
        ({}, (), "car", True),
        ({"highway": "service", "service": "parking_aisle"}, (), "car", True),
        ({}, PARTS, "car", True),
        ({"tunnel": "yes"}, PARTS, "van", True),
    ],
)
def test_a_vehicle_drives_through_a_house_if_its_passage_is_high_enough(
    tmp_path, inside, parts, vehicle, passes
):
    osm, options = town(inside, parts), RoadDriveOptions(vehicle=vehicle)
    scene = geoscene.build(osm, tmp_path / "scene", options=BuildOptions(relief="off", use="lidar"))
    maps = []

    def needed(roads):
        maps.append(roads)
        return shapely.box(*roads.bounds)

    make_plan(osm, BuildOptions(relief="off"), progress=silent, needed=needed)
    for roads in (road_map(scene), *maps):
        if passes:
            path, _ = road_course(roads, ROUTE, options=options)
            assert np.ptp(path[:, 0]) > 130
        else:
            with pytest.raises(RouteError):
                road_course(roads, ROUTE, options=options)
    if passes:
        position = plan_road_drive(scene, ROUTE, options=options).path.position
        assert np.abs(position[:, 2]).max() < 0.01
    blocked = shapely.union_all(building_obstacles(scene, height=2.5))
    assert shapely.intersects_xy(blocked, 0.0, 20.0)
    assert shapely.intersects_xy(blocked, 0.0, 0.0) != (passes and "maxheight" not in inside)
