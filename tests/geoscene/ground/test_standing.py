"""Walls end below the ground and the water beside them; objects stand on sidewalks, crowns and terrain."""

from __future__ import annotations

import numpy as np
import pytest
import shapely

from geoscene.classes import Class, materials
from geoscene.geometry.frames import Frame
from geoscene.ground import Layers, ground_tile, plan_ground, water_levels
from geoscene.ground.kerbs import KERB
from geoscene.ground.layers import KERBS, SIDEWALKS
from geoscene.ground.relief import Beds, Camber, Kerbs, Raised
from geoscene.ground.standing import foundation_heights, standing_height
from geoscene.ground.terrain import base_heights
from geoscene.sources.data import Way

HOUSE = shapely.box(0, 0, 10, 10)

NO_BEDS = Beds.of(np.empty(0, object), np.empty(0, object))
ROAD = shapely.LineString([(0, 20), (80, 20)])


def foundations(height, water=None):
    """Base and foundation of `HOUSE` and of an empty footprint, with a body of still water if given."""
    layers = Layers.empty()
    if water is not None:
        material = materials()["water"].code
        layers = Layers.of([water], klass=Class.WATER, material=material, priority=0.0, body="sea")
    flat = height or (lambda x, y: 0.0 * (x + y))
    levels = water_levels(layers, [], frame=Frame.at(7.0, 43.0), height=flat)
    footprints = np.array([HOUSE, shapely.Polygon()], object)
    base = base_heights(footprints, height)
    return base, foundation_heights(footprints, base, height=height, layers=layers, levels=levels)


def test_walls_on_level_ground_end_at_the_base():
    base, foot = foundations(lambda x, y: 0.0 * (x + y))
    assert base[0] == foot[0] == 0.0
    assert np.isnan(foot[1])
    np.testing.assert_array_equal((base, foot), foundations(None))


def test_walls_on_a_slope_end_below_the_ground_beside_them():
    base, foot = foundations(lambda x, y: 0.8 * x + 0.0 * y)
    assert base[0] == 0.0
    assert -2.0 < foot[0] < -0.8


def test_walls_over_a_quay_reach_the_water():
    # the ground is 20 m high up to a metre from the shore, the sea is at 0
    def height(x, y):
        return np.where(x < 12.0, 20.0, 0.0) + 0.0 * y

    base, foot = foundations(height, water=shapely.box(11, -50, 80, 50))
    assert base[0] == 20.0
    assert -1.0 < foot[0] < 0.0


def test_walls_by_a_river_reach_its_level_there():
    frame = Frame.at(7.0, 43.0)
    line = np.array([(12.0, -60.0), (12.0, 60.0)])

    def height(x, y):
        return 30.0 - 0.1 * y + 0.0 * x

    lonlat = np.column_stack(frame.to_geographic(*line.T))
    way = Way("way/1", {"waterway": "river"}, np.arange(2), lonlat)
    layers = Layers.of(
        [shapely.box(11, -60, 13, 60)],
        klass=Class.WATER,
        material=materials()["water"].code,
        priority=0.0,
        body="river",
    )
    levels = water_levels(layers, [way], frame=frame, height=height)
    levels.height[:] -= 2.5  # water below its banks
    footprints = np.array([HOUSE], object)
    base = base_heights(footprints, height)
    foot = foundation_heights(footprints, base, height=height, layers=layers, levels=levels)
    assert base[0] == 29.0
    assert 25.0 < foot[0] < 26.9


def slope(x, y):
    return 0.01 * np.asarray(x) - 0.02 * np.asarray(y) + 5.0


def street(*, kerbs):
    parts = [
        (6.15, Class.SIDEWALK, "paving", SIDEWALKS),
        (4.15, Class.KERB, "concrete", KERBS),
        (4.0, Class.ROAD, "asphalt", 130.0),
    ]
    layers = Layers.concatenate(
        [
            Layers.of(
                [ROAD.buffer(half, cap_style="flat")],
                klass=klass,
                material=materials()[material].code,
                priority=priority,
            )
            for half, klass, material, priority in parts
        ]
        + [Layers.of([shapely.box(0, 0, 10, 8)], klass=Class.WATER, material=0, priority=5.0)]
    )
    camber = Camber.of(
        np.array([[0.0, 20.0]]), np.array([[80.0, 20.0]]), half=np.array([4.0]), crown=np.array([[0.1, 0.1]])
    )
    return plan_ground(
        (0.0, 0.0, 80.0, 40.0),
        layers,
        tile_size=40.0,
        kerbs=Kerbs.of() if kerbs else None,
        raised=Raised(camber, NO_BEDS),
    )


@pytest.mark.parametrize("x", [17.0, 61.0])
def test_posts_stand_on_sidewalks_in_the_tile_and_beyond_it(x):
    plan = street(kerbs=True)
    height = standing_height(plan, slope, ground=ground_tile(plan, 0, j=0, height=slope))
    z = height(np.array([x, x]), np.array([25.0, 2.0]))
    np.testing.assert_allclose(z - slope(x, [25.0, 2.0]), [KERB, 0.0], atol=1e-3)


def test_feet_meet_the_faces_of_the_ground():
    plan = street(kerbs=True)
    ground = ground_tile(plan, 0, j=0, height=slope)
    height = standing_height(plan, slope, ground=ground)
    dry = ground.vertices[np.unique(ground.faces[ground.klass != Class.WATER])]
    np.testing.assert_allclose(height(*dry[:, :2].T), dry[:, 2], atol=1e-6)
    middle = ground.vertices[ground.faces[ground.klass == Class.TERRAIN]].mean(axis=1)
    np.testing.assert_allclose(height(*middle[:, :2].T), middle[:, 2], atol=1e-6)


def test_without_kerbs_objects_stand_at_the_planned_height():
    plan = street(kerbs=False)
    assert standing_height(plan, slope, ground=ground_tile(plan, 0, j=0)) is slope
