"""Camber: carriageways fall by 2.5 % from their middle to their edges, and are level in junctions."""

import numpy as np
import pytest
from helpers.surfaces import heights_on
from hypothesis import given, settings
from hypothesis import strategies as st

from geoscene.classes import Class
from geoscene.geometry.frames import Frame
from geoscene.ground import Layers, ground_tile, plan_ground
from geoscene.ground.kerbs import lowered_kerbs
from geoscene.ground.relief import CAMBER, Beds, Kerbs, Raised
from geoscene.roadgraph import build_road_graph
from geoscene.roadgraph.carriageways import read_carriageways
from geoscene.roadgraph.relief import camber_of, crown_rows, find_crowns
from geoscene.roadgraph.surfaces import road_surfaces
from geoscene.sources.data import OsmData, Way

FRAME = Frame.at(10.0, 50.0)
NO_BEDS = Beds.of(np.empty(0, object), np.empty(0, object))
EXTENT = (-120.0, -60.0, 120.0, 60.0)
STREET = {"highway": "residential", "width": "8", "sidewalk": "both"}
ALONG = {1: (-200, 0), 2: (0, 0), 3: (200, 0), 4: (0, 200)}


def meshes(places, ways, *, tile_size=60.0, height=None):
    """The ground, in tiles, of roads (tags, nodes) with camber."""
    lonlat = {n: np.array(FRAME.to_geographic(*xy)) for n, xy in places.items()}
    roads = [
        Way(f"way/{k}", tags, np.array(nodes, np.int64), np.array([lonlat[n] for n in nodes]))
        for k, (tags, nodes) in enumerate(ways)
    ]
    osm = OsmData(bounds=(9.9, 49.9, 10.1, 50.1), ways=roads, areas=[], points=[], relations=[])
    table = read_carriageways(osm, FRAME, sidewalks="mapped", left_hand=False)
    made = road_surfaces(osm, build_road_graph(osm, FRAME)[0], frame=FRAME, roads=table)
    layers = Layers.of(
        made.polygon, klass=made.klass, material=made.material, priority=made.priority, feature=made.number
    )
    crowns = find_crowns(table)
    halves = crown_rows(table, crowns, surfaces=layers, first=made.first)
    layers = Layers.concatenate([layers, lowered_kerbs(layers), halves])
    plan = plan_ground(
        EXTENT,
        layers,
        tile_size=tile_size,
        kerbs=Kerbs.of(),
        raised=Raised(camber_of(table, crowns), NO_BEDS),
    )
    return [ground_tile(plan, int(i), j=int(j), height=height) for i, j in plan.tiles]


def surface_at(tiles, xy):
    """Heights (n,) of the ground at points (n, 2)."""
    return heights_on(np.concatenate([mesh.vertices[mesh.faces] for mesh in tiles]), xy)


def test_carriageways_fall_from_the_middle_to_the_edges():
    tiles = meshes(ALONG, [(STREET, [1, 2, 3])])
    y = np.linspace(-3.99, 3.99, 41)
    for x in (-77.7, 13.3, 91.0):
        z = surface_at(tiles, np.column_stack([np.full(len(y), x), y]))
        np.testing.assert_allclose(z, CAMBER * (4.0 - np.abs(y)), atol=2e-3)


def test_kerbs_keep_their_height_above_the_edge():
    tiles = meshes(ALONG, [(STREET, [1, 2, 3])])
    edges = surface_at(tiles, np.array([[20.0, 4.0], [20.0, -4.0]]))
    walks = surface_at(tiles, np.array([[20.0, 5.0], [20.0, -5.0]]))
    np.testing.assert_allclose(walks - edges, 0.12, atol=1e-6)


def test_a_road_keeps_its_crown_past_a_lesser_one_that_fades():
    lesser = STREET | {"highway": "service"}
    tiles = meshes(ALONG, [(STREET, [1, 2, 3]), (lesser, [2, 4])])
    x = np.linspace(-30, 30, 31)
    np.testing.assert_allclose(surface_at(tiles, np.column_stack([x, 0 * x])), 0.1, atol=2e-3)
    y = np.linspace(7.0, 40.0, 100)
    z = surface_at(tiles, np.column_stack([0 * y, y]))
    assert z[0] == pytest.approx(0.0, abs=0.01)
    assert z[-1] == pytest.approx(0.1, abs=2e-3)
    assert (np.diff(z) > -1e-6).all()
    assert (np.diff(z) / np.diff(y)).max() < 0.015


def test_junctions_of_equal_roads_are_level():
    tiles = meshes(ALONG, [(STREET, [1, 2, 3]), (STREET, [2, 4])])
    x, y = np.meshgrid(np.linspace(-3, 3, 7), np.linspace(-3, 3, 7))
    z = surface_at(tiles, np.column_stack([x.ravel(), y.ravel()]))
    np.testing.assert_allclose(z, 0.0, atol=1e-9)


@pytest.mark.parametrize(
    "tags",
    [
        {"highway": "service", "width": "3"},
        {"highway": "track", "width": "5", "surface": "gravel"},
        {"highway": "residential", "width": "8", "bridge": "yes", "layer": "1"},
    ],
    ids=["narrow", "unpaved", "bridge"],
)
def test_narrow_unpaved_and_raised_carriageways_are_level(tags):
    tiles = meshes(ALONG, [(tags, [1, 2, 3])])
    road = np.concatenate([m.vertices[np.unique(m.faces[m.klass == Class.ROAD])] for m in tiles])
    assert (road[:, 2] == 0).all()


def test_crowns_fade_before_bridges():
    bridge = STREET | {"bridge": "yes", "layer": "1"}
    tiles = meshes(ALONG, [(STREET, [1, 2]), (bridge, [2, 3])])
    z = surface_at(tiles, np.array([[-50.0, 0.0], [-5.0, 0.0], [-0.01, 0.0]]))
    np.testing.assert_allclose(z, [0.1, 0.05, 0.0], atol=2e-3)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_tiles_meet_and_carriageways_are_no_steeper_than_their_camber(seed):
    rng = np.random.default_rng(seed)
    places = {n: (x + rng.uniform(-20, 20), rng.uniform(-40, 40)) for n, x in enumerate((-200, -60, 60, 200))}
    places[9] = (rng.uniform(-50, 50), 300.0)
    ways = [(STREET, [0, 1, 2, 3]), (STREET | {"highway": rng.choice(["residential", "service"])}, [9, 1])]
    tiles = meshes(places, ways)
    corners = np.concatenate([m.vertices[m.faces] for m in tiles]).reshape(-1, 3)
    spots, number = np.unique(corners[:, :2], axis=0, return_inverse=True)
    low, high = np.full(len(spots), np.inf), np.full(len(spots), -np.inf)
    np.minimum.at(low, number.ravel(), corners[:, 2])
    np.maximum.at(high, number.ravel(), corners[:, 2])
    np.testing.assert_allclose(low, high, atol=1e-9)  # a place has one height, whichever tile it is in
    for mesh in tiles:
        faces = mesh.faces[mesh.klass == Class.ROAD]
        step = mesh.vertices[faces] - mesh.vertices[np.roll(faces, -1, axis=1)]
        assert (np.abs(step[..., 2]) <= 1.1 * CAMBER * np.hypot(step[..., 0], step[..., 1]) + 1e-9).all()
