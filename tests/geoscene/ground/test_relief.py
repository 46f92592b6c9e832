"""Relief of roads and tracks: carriageways fall by 2.5 % from their middle, beds of ballast come down."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.surfaces import assert_one_surface, heights_on
from hypothesis import given, settings
from hypothesis import strategies as st

from geoscene.classes import Class
from geoscene.geometry.frames import Frame
from geoscene.geometry.mesh import concatenate
from geoscene.ground import Layers, ground_tile, landcover, plan_ground
from geoscene.ground.kerbs import lowered_kerbs
from geoscene.ground.relief import CAMBER, HEIGHT, SLOPE, Beds, Camber, Kerbs, Raised
from geoscene.roadgraph import build_road_graph
from geoscene.roadgraph.carriageways import read_carriageways
from geoscene.roadgraph.relief import camber_of, crown_rows, find_crowns, read_beds
from geoscene.roadgraph.surfaces import road_surfaces
from geoscene.sources.data import OsmData, Way

FRAME = Frame.at(10.0, 50.0)
NO_BEDS = Beds.of(np.empty(0, object), np.empty(0, object))
EXTENT = (-120.0, -60.0, 120.0, 60.0)
STREET = {"highway": "residential", "width": "8", "sidewalk": "both"}
ALONG = {1: (-200, 0), 2: (0, 0), 3: (200, 0), 4: (0, 200)}

TRACK_EXTENT = (-100.0, -40.0, 100.0, 40.0)
RAIL = {"railway": "rail"}
LINE = [(-150, 0), (0, 3), (150, 0)]
FLAT = Camber.of(np.empty((0, 2)), np.empty((0, 2)), half=np.empty(0), crown=np.empty((0, 2)))


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


@pytest.mark.full
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


def ground(*ways, tile_size=50.0):
    """The tiles of the ground of ways (tags, coordinates), and their beds."""
    mapped = [
        Way(
            f"way/{k}",
            tags,
            100 * k + np.arange(len(xy)),
            np.column_stack(FRAME.to_geographic(*np.array(xy, float).T)),
        )
        for k, (tags, xy) in enumerate(ways)
    ]
    osm = OsmData(bounds=(9.9, 49.9, 10.1, 50.1), ways=mapped, areas=[], points=[], relations=[])
    made = road_surfaces(osm, build_road_graph(osm, FRAME)[0], frame=FRAME)
    surfaces = Layers.of(
        made.polygon, klass=made.klass, material=made.material, priority=made.priority, feature=made.number
    )
    cover, _ = landcover(osm, FRAME, extent=TRACK_EXTENT)
    beds, rows = read_beds(osm, FRAME, cover=cover, others=surfaces)
    layers = Layers.concatenate([cover, surfaces, rows])
    plan = plan_ground(TRACK_EXTENT, layers, tile_size=tile_size, raised=Raised(FLAT, beds))
    return [ground_tile(plan, int(i), j=int(j)) for i, j in plan.tiles], beds


def heights_at(tiles, xy):
    """Heights (n,) of the ground at points (n, 2)."""
    mesh = concatenate(tiles)
    return heights_on(mesh.vertices[mesh.faces], xy)


def test_beds_are_trapezoids_across_the_track():
    tiles, beds = ground((RAIL, [(-150, 0), (150, 0)]))
    y = np.linspace(-3.5, 3.5, 71) + 0.003
    z = heights_at(tiles, np.column_stack([np.full(len(y), 31.0), y]))
    np.testing.assert_allclose(z, HEIGHT * np.clip(1 - (np.abs(y) - 1.8) / SLOPE, 0, 1), atol=0.01)
    assert beds.square_metres(TRACK_EXTENT) == pytest.approx(200 * 3.6, rel=1e-3)


def test_tracks_side_by_side_share_a_bed():
    tiles, _ = ground((RAIL, [(-150, 0), (150, 0)]), (RAIL, [(-150, 4.5), (150, 4.5)]))
    y = np.linspace(-1.7, 6.2, 60)
    z = heights_at(tiles, np.column_stack([np.full(len(y), 31.0), y]))
    np.testing.assert_allclose(z, HEIGHT, atol=2e-3)


def test_beds_come_down_to_level_crossings():
    street = {"highway": "residential", "width": "6"}
    tiles, _ = ground((RAIL, [(-150, 0), (150, 0)]), (street, [(0, -60), (0, 60)]))
    road = np.concatenate([m.vertices[np.unique(m.faces[m.klass == Class.ROAD])] for m in tiles])
    assert (road[:, 2] == 0).all()
    x = np.linspace(5.0, 40.0, 71)
    z = heights_at(tiles, np.column_stack([x, 0 * x]))
    assert z[0] < 0.07
    assert z[-1] == pytest.approx(HEIGHT)
    assert (np.diff(z) / np.diff(x)).max() < 0.04


@pytest.mark.parametrize(
    "tags",
    [
        {"railway": "tram"},
        RAIL | {"surface": "asphalt"},
        RAIL | {"bridge": "yes", "layer": "1"},
        RAIL | {"tunnel": "yes", "layer": "-1"},
    ],
    ids=["tram", "street", "bridge", "tunnel"],
)
def test_tracks_in_streets_and_on_structures_have_no_bed(tags):
    tiles, beds = ground((tags, LINE))
    assert beds.square_metres(TRACK_EXTENT) == 0
    assert all((mesh.vertices[:, 2] == 0).all() for mesh in tiles)


def test_beds_come_down_to_bridges():
    bridge = RAIL | {"bridge": "yes", "layer": "1"}
    tiles, _ = ground((RAIL, [(-150, 0), (0, 0)]), (bridge, [(0, 0), (150, 0)]))
    z = heights_at(tiles, np.array([[-40.0, 0.0], [-7.5, 0.0], [-0.01, 0.0]]))
    np.testing.assert_allclose(z, [HEIGHT, HEIGHT / 2, 0.0], atol=0.05)


def test_the_ground_with_beds_is_one_surface():
    street = {"highway": "residential", "width": "6"}
    tiles, _ = ground((RAIL, LINE), (RAIL, [(-150, 20), (150, -20)]), (street, [(40, -60), (45, 60)]))
    mesh = concatenate(tiles)
    points, number = np.unique(mesh.vertices, axis=0, return_inverse=True)
    assert_one_surface(points, number.ravel()[mesh.faces], TRACK_EXTENT)
