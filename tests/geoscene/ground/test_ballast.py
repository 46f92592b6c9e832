"""Tracks lie on beds of ballast, level on top, that come down to crossings and bridges."""

import numpy as np
import pytest
from helpers.surfaces import assert_one_surface, heights_on

from geoscene.classes import Class
from geoscene.geometry.frames import Frame
from geoscene.geometry.mesh import concatenate
from geoscene.ground import Layers, ground_tile, landcover, plan_ground
from geoscene.ground.relief import HEIGHT, SLOPE, Camber, Raised
from geoscene.roadgraph import build_road_graph
from geoscene.roadgraph.relief import read_beds
from geoscene.roadgraph.surfaces import road_surfaces
from geoscene.sources.data import OsmData, Way

FRAME = Frame.at(10.0, 50.0)
EXTENT = (-100.0, -40.0, 100.0, 40.0)
RAIL = {"railway": "rail"}
LINE = [(-150, 0), (0, 3), (150, 0)]
FLAT = Camber.of(np.empty((0, 2)), np.empty((0, 2)), half=np.empty(0), crown=np.empty((0, 2)))


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
    cover, _ = landcover(osm, FRAME, extent=EXTENT)
    beds, rows = read_beds(osm, FRAME, cover=cover, others=surfaces)
    layers = Layers.concatenate([cover, surfaces, rows])
    plan = plan_ground(EXTENT, layers, tile_size=tile_size, raised=Raised(FLAT, beds))
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
    assert beds.square_metres(EXTENT) == pytest.approx(200 * 3.6, rel=1e-3)


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
    assert beds.square_metres(EXTENT) == 0
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
    assert_one_surface(points, number.ravel()[mesh.faces], EXTENT)
