"""Kerbs: sidewalks stand above carriageways, and come down at crossings."""

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from geoscene.classes import Class, materials
from geoscene.ground import ground_tile, plan_ground
from geoscene.ground.kerbs import KERB, KERB_LOWERED, MappedKerbs, kerb_ends, lowered_kerbs
from geoscene.ground.layers import KERBS, SIDEWALKS, Layers
from geoscene.ground.relief import Kerbs

EXTENT = (0.0, 0.0, 120.0, 60.0)
STREET = shapely.LineString([(-10, 31.3), (70, 28.1), (130, 33.7)])
PATH = shapely.LineString([(10, 5), (110, 12)])
HALF, BAND, WALK = 3.5, 0.15, 2.0
CROSSING_AT = 40.0


def rows(shape, klass, material, priority):
    code = materials()[material].code
    return Layers.of([shape], klass=klass, material=code, priority=priority, feature=int(priority))


def street(line=STREET, path=PATH, *, mapped=None, ends=()):
    """A street with a crossing, and a footway away from it."""
    here, there = line.interpolate(CROSSING_AT), line.interpolate(CROSSING_AT + 3.0)
    strip = shapely.LineString([here, there]).buffer(HALF, cap_style="flat")
    surfaces = Layers.concatenate(
        [
            rows(path.buffer(1.0), Class.SIDEWALK, "paving", 105.0),
            rows(line.buffer(HALF + BAND + WALK), Class.SIDEWALK, "paving", SIDEWALKS),
            rows(line.buffer(HALF + BAND), Class.KERB, "concrete", KERBS),
            rows(line.buffer(HALF), Class.ROAD, "asphalt", 130.0),
            rows(strip, Class.CROSSING, "asphalt", 160.0),
        ]
    )
    ends = np.fromiter(ends, object)
    return Layers.concatenate([surfaces, lowered_kerbs(surfaces, mapped=mapped), kerb_ends(surfaces, ends)])


def tiles(layers, *, kerbs, height=None, ends=()):
    plan = plan_ground(EXTENT, layers, tile_size=40.0, kerbs=Kerbs.of(ends) if kerbs else None)
    return [ground_tile(plan, int(i), j=int(j), height=height) for i, j in plan.tiles]


def heights(meshes, klass):
    """Vertices (n, 3) of faces of a class."""
    return np.concatenate([m.vertices[np.unique(m.faces[m.klass == klass])] for m in meshes])


def test_sidewalks_stand_a_kerb_above_the_carriageway():
    meshes = tiles(street(), kerbs=True)
    for klass in (Class.ROAD, Class.CROSSING):
        assert (heights(meshes, klass)[:, 2] == 0).all()
    walk = heights(meshes, Class.SIDEWALK)
    beside = shapely.distance(STREET, shapely.points(walk[:, :2])) < HALF + BAND + WALK + 0.01
    far = np.abs(shapely.line_locate_point(STREET, shapely.points(walk[:, :2])) - CROSSING_AT - 1.5) > 3.0
    assert (walk[beside & far, 2] == KERB).all()
    assert (walk[~beside, 2] == 0).all()  # a footway elsewhere lies on the ground
    assert beside.sum() > 20
    assert (~beside).sum() > 4


def test_kerbs_are_lowered_at_crossings():
    kerb = heights(tiles(street(), kerbs=True), Class.KERB)
    along = shapely.line_locate_point(STREET, shapely.points(kerb[:, :2])) - CROSSING_AT
    outside = shapely.distance(STREET, shapely.points(kerb[:, :2])) > HALF + BAND - 0.01
    at = outside & (along > -0.6) & (along < 3.6)
    assert at.sum() >= 4  # both ends of the crossing on both sides
    assert (kerb[at, 2] == KERB_LOWERED).all()
    assert (kerb[outside & (np.abs(along - 1.5) > 2.9), 2] == KERB).all()
    ramps = outside & (np.abs(along - 1.5) > 2.9) & (np.abs(along - 1.5) < 3.1)
    assert ramps.sum() >= 4  # the kerb is up again a metre further
    assert (kerb[ramps, 2] == KERB).all()
    assert (kerb[~outside, 2] == 0).all()


@pytest.mark.full
@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_tiles_meet_on_their_borders_and_have_no_holes(seed):
    rng = np.random.default_rng(seed)
    line = shapely.LineString(
        np.column_stack([[-10, 40, 80, 130], rng.uniform(15, 45, 4)]) + rng.uniform(-1, 1, (4, 2))
    )
    meshes = tiles(street(line), kerbs=True, height=lambda x, y: 0.02 * x - 0.01 * y)
    corners = np.concatenate([m.vertices[m.faces] for m in meshes]).reshape(-1, 3)
    places, number = np.unique(corners[:, :2], axis=0, return_inverse=True)
    low, high = np.full(len(places), np.inf), np.full(len(places), -np.inf)
    np.minimum.at(low, number.ravel(), corners[:, 2])
    np.maximum.at(high, number.ravel(), corners[:, 2])
    np.testing.assert_allclose(low, high, atol=1e-9)  # a place has one height, whichever tile it is in
    faces = number.reshape(-1, 3)
    edges = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
    edges, uses = np.unique(edges, axis=0, return_counts=True)
    ends = places[edges[uses == 1]]
    on_rim = [(ends[..., k] == v).all(axis=1) for k, v in zip((0, 1, 0, 1), EXTENT, strict=True)]
    assert np.any(on_rim, axis=0).all()
    assert uses.max() == 2


@pytest.mark.parametrize("kerbs", [True, False])
def test_relief_decides_on_kerbs(kerbs):
    z = np.concatenate([m.vertices[:, 2] for m in tiles(street(), kerbs=kerbs)])
    assert (z.max() > 0) == kerbs


@pytest.mark.parametrize(("kind", "rise"), [("raised", KERB), ("lowered", KERB_LOWERED), ("flush", 0.0)])
@pytest.mark.parametrize("crossing", [True, False])
def test_mapped_kerbs_have_the_height_of_their_tag(kind, rise, crossing):
    at = CROSSING_AT + (1.5 if crossing else 30.0)
    middle = STREET if crossing else shapely.offset_curve(STREET, HALF + BAND / 2)
    spot = middle.interpolate(at)  # the node of the crossing, or a kerb away from crossings
    mapped = MappedKerbs(np.array([spot], object), np.array([kind]), np.array([crossing]))
    kerb = heights(tiles(street(mapped=mapped), kerbs=True), Class.KERB)
    places = shapely.points(kerb[:, :2])
    outside = shapely.distance(STREET, places) > HALF + BAND - 0.01
    near = outside & (shapely.distance(spot, places) < (5.0 if crossing else 1.6))
    near &= np.abs(shapely.line_locate_point(STREET, places) - STREET.project(spot)) < 2.1
    assert near.sum() >= 2
    np.testing.assert_allclose(kerb[near, 2], rise, atol=1e-9)


def test_sidewalks_come_down_to_level_decks():
    x = 80.0
    end = shapely.LineString([(x, 20.0), (x, 38.0)])
    meshes = tiles(street(ends=[end]), kerbs=True, ends=[end])
    walk = heights(meshes, Class.SIDEWALK)
    walk = walk[shapely.distance(STREET, shapely.points(walk[:, :2])) < HALF + BAND + WALK + 0.01]
    away = np.abs(walk[:, 0] - x)
    assert (walk[away < 0.01, 2] < 1e-3).all()
    assert (away < 0.01).sum() >= 2
    far = (away > 1.99) & (away < 15.0)
    np.testing.assert_allclose(walk[far, 2], KERB, atol=1e-3)
    assert ((away > 1.99) & (away < 2.01)).sum() >= 4
