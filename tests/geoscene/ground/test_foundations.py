"""Foundations: walls end below the ground and the water beside them, and at the base on level ground."""

import numpy as np
import shapely

from geoscene.classes import Class, materials
from geoscene.geometry.frames import Frame
from geoscene.ground import Layers, water_levels
from geoscene.ground.foundations import foundation_heights
from geoscene.ground.terrain import base_heights
from geoscene.sources.data import Way

HOUSE = shapely.box(0, 0, 10, 10)


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
