"""Objects stand on the surface, whether that is a raised sidewalk, a crown or the terrain."""

import numpy as np
import pytest
import shapely

from geoscene.classes import Class, materials
from geoscene.ground import Layers, ground_tile, plan_ground
from geoscene.ground.ballast import Beds
from geoscene.ground.camber import Camber, Kerbs, Raised
from geoscene.ground.kerbs import KERB
from geoscene.ground.layers import KERBS, SIDEWALKS
from geoscene.ground.standing import standing_height

NO_BEDS = Beds.of(np.empty(0, object), np.empty(0, object))
ROAD = shapely.LineString([(0, 20), (80, 20)])


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
