"""Air under roofs, bridges and in tunnels."""

import numpy as np
import pytest
from helpers.sensor_worlds import box, world
from hypothesis import given, settings
from hypothesis import strategies as st

from lidar.world.shelter import CELL

GROUND = box((-90, -90, -1), (90, 90, 0))
HERE = np.zeros(3)


def cells(shelter, x, y):
    """Row and column of the cell at a place."""
    return int((y - shelter.corner[1]) / CELL), int((x - shelter.corner[0]) / CELL)


def test_houses_and_open_ground_shelter_nothing():
    assert world(GROUND).shelter(HERE) is None
    assert world(GROUND, box((5, 5, -1), (20, 20, 12))).shelter(HERE) is None
    stacked = box((5, 5, 0), (20, 20, 12)), box((8, 8, 12), (15, 15, 30))
    assert world(GROUND, *stacked).shelter(HERE) is None


@settings(max_examples=30, deadline=None)
@given(
    st.integers(-40, 0), st.integers(1, 40), st.floats(2.0, 60.0), st.floats(0.1, 3.0), st.floats(-20.0, 20.0)
)
def test_a_deck_covers_the_air_below_it_and_no_other(low, high, clearance, thick, ground):
    deck = box((low, -6, ground + clearance), (high, 6, ground + clearance + thick))
    found = world(box((-90, -90, ground - 1), (90, 90, ground)), deck).shelter(HERE)
    roof = np.full((120, 120), -np.inf)
    roof[54:66, low + 60 : high + 60] = ground + clearance
    np.testing.assert_allclose(found.roof, roof, atol=1e-9)


def tunnel(length, *, far_end=False):
    """Walls, a roof and the hill above, from x = 0 on; the far end is closed unless it is told."""
    parts = [
        box((0, -5, -1), (length, -4, 6)),
        box((0, 4, -1), (length, 5, 6)),
        box((0, -5, 5), (length, 5, 6)),
        box((0, -40, 9), (length, 40, 10)),
        box((0, -40, -1), (length, -5, 10)),
        box((0, 5, -1), (length, 40, 10)),
    ]
    if not far_end:
        parts.append(box((length, -40, -1), (length + 1, 40, 10)))
    return world(GROUND, *parts)


def test_the_way_out_of_a_tunnel_is_along_it():
    closed, open_ended = tunnel(40).shelter(HERE), tunnel(40, far_end=True).shelter(HERE)
    for x in (0.5, 10.5, 30.5):
        row, column = cells(closed, x, 0.5)
        assert closed.way[row, column] == pytest.approx(x - 0.5, abs=1.0)
        assert open_ended.way[row, column] == pytest.approx(min(x - 0.5, 39.5 - x), abs=1.0)


def test_a_tunnel_that_leads_out_of_sight_has_no_way_out():
    found = tunnel(200).shelter(np.array([100.0, 0.0, 0.0]))
    row, column = cells(found, 100.5, 0.5)
    assert found.roof[row, column] == pytest.approx(9.0) or found.roof[row, column] == pytest.approx(5.0)
    assert np.isinf(found.way[row, column])


def test_a_hollow_inside_a_body_is_no_shelter():
    walls = [
        box((0, 0, -1), (20, 1, 8)),
        box((0, 19, -1), (20, 20, 8)),
        box((0, 0, -1), (1, 20, 8)),
        box((19, 0, -1), (20, 20, 8)),
    ]
    assert world(GROUND, *walls, box((0, 0, 8), (20, 20, 9))).shelter(HERE) is None


def test_the_air_before_the_walls_of_a_tunnel_is_covered():
    walls = box((0, -6, 0), (40, -3.4, 5)), box((0, 3.4, 0), (40, 6, 5))
    found = world(GROUND, *walls, box((0, -6, 5), (40, 6, 6))).shelter(HERE)
    for y in (-3.3, 3.3):
        assert found.roof[cells(found, 20.5, y)] == pytest.approx(5.0)
        assert found.way[cells(found, 20.5, y)] == pytest.approx(20, abs=2.5)
