"""Roofs with relief are still solids, and what stands on them stands on one plane, clear of all else."""

import manifold3d
import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from geoscene.buildings import build_solids, read_buildings
from geoscene.buildings.shells import PARAPET
from geoscene.geometry.frames import Frame
from geoscene.geometry.mesh import ROOF
from geoscene.geometry.watertight import validate_mesh
from geoscene.objects.rooftops import plan_rooftops, roof_objects
from geoscene.objects.shapes import DORMER_DEPTH, roof_shapes, shapes
from geoscene.pipeline.plan import take_buildings
from geoscene.sources import read_osm
from geoscene.sources.data import Area, OsmData

BERLIN, NEW_YORK = (13.43, 52.48), (-73.99, 40.72)
NAMES = list(shapes(with_relief=True))
HOUSE = {"building": "house", "roof:shape": "gabled", "building:levels": "2", "roof:angle": "45"}


def town(shape, tags, *, at=BERLIN, count=30):
    """A row of ``count`` buildings of one shape (scene metres), 60 m apart, with OSM ids of their own."""
    frame = Frame.at(*at)
    areas = []
    for k in range(count):
        ring = shapely.get_coordinates(shape) + np.array([60.0 * k, 0.0])
        lonlat = np.column_stack(frame.to_geographic(*ring.T))
        areas.append(Area(f"way/{1000 + k}", tags, shapely.Polygon(lonlat), np.empty(0, np.int64)))
    west, south = at[0] - 0.1, at[1] - 0.1
    osm = OsmData((west, south, at[0] + 0.1, at[1] + 0.1), [], areas, [], [])
    return read_buildings(osm, frame)[0]


def built(buildings, *, at=BERLIN):
    """(solids, copies, their names, rooftops) with full relief."""
    rooftops = plan_rooftops(buildings, centre=at)
    base = np.zeros(buildings.count)
    solids, problems = build_solids(buildings, base=base, parapet=rooftops.parapet)
    assert [p for p in problems if p.reason == "no-parapet"] == []
    copies, counts = roof_objects(solids, rooftops)
    names = np.array([NAMES[k] for k in copies.shape])
    assert counts == {name: int((names == name).sum()) for name in sorted(set(names))}
    return solids, copies, names, rooftops


@pytest.mark.parametrize("name", roof_shapes())
def test_shapes_are_closed_solids_facing_outward_within_the_budget(name):
    shape = roof_shapes()[name]
    part = manifold3d.Manifold(
        manifold3d.Mesh(shape.vertices.astype(np.float32), shape.faces.astype(np.uint32))
    )
    assert part.status() == manifold3d.Error.NoError
    assert all(piece.volume() > 0 for piece in part.decompose())
    assert shape.closed.all()
    assert len(shape) <= 160


def test_the_underside_of_a_dormer_is_a_plane_from_the_front_to_the_ridge():
    points = roof_shapes()["dormer"].vertices[[0, 1, 5, 6, 7]]
    np.testing.assert_allclose(points[:, 2], points[:, 0] / DORMER_DEPTH, atol=1e-12)


def test_flat_roofs_of_offices_have_parapets_within_their_footprints():
    office = {"building": "office", "height": "12", "roof:shape": "flat"}
    solids, _, _, rooftops = built(town(shapely.box(0, 0, 20, 15), office))
    assert validate_mesh(solids).ok.all()
    assert ((rooftops.parapet >= 0.3) & (rooftops.parapet <= 1.0)).all()
    for row in range(30):
        own = solids.take(solids.feature == row)
        z = own.vertices[:, 2].max()
        assert z == pytest.approx(12.0 + rooftops.parapet[row], abs=1e-4)
        assert np.ptp(own.vertices[:, :2], axis=0) == pytest.approx([20.0, 15.0], abs=1e-3)
        corners = own.vertices[own.faces[own.surface == ROOF]]
        low = shapely.union_all(shapely.polygons(corners[np.ptp(corners[:, :, 2], axis=1) < 1e-6][:, :, :2]))
        assert low.area == pytest.approx(300.0, abs=0.1)
        inner = corners[(np.abs(corners[:, :, 2] - 12.0) < 1e-4).all(axis=1)]
        room = shapely.union_all(shapely.polygons(inner[:, :, :2])).area
        assert room == pytest.approx((20 - 2 * PARAPET) * (15 - 2 * PARAPET), abs=0.05)


@pytest.mark.full
@settings(max_examples=40, deadline=None)
@given(st.lists(st.floats(2, 30), min_size=4, max_size=9))
def test_any_building_with_parapets_is_a_solid(radius):
    """Narrow ones lose them; the outline and the top of the roof stay."""
    turn = np.linspace(0, 2 * np.pi, len(radius), endpoint=False)
    shape = shapely.Polygon(np.array(radius)[:, None] * np.column_stack([np.cos(turn), np.sin(turn)]))
    buildings = town(shape, {"building": "office", "height": "9"}, count=1)
    solids, _ = build_solids(buildings, base=np.zeros(1), parapet=np.full(len(buildings), 0.8))
    plain, _ = build_solids(buildings, base=np.zeros(1))
    assert validate_mesh(solids).ok.all()
    np.testing.assert_allclose(np.ptp(solids.vertices, axis=0)[:2], np.ptp(plain.vertices, axis=0)[:2])
    assert solids.vertices[:, 2].max() in (pytest.approx(9.0), pytest.approx(9.8))


def test_blocks_and_flat_parts_have_no_parapets():
    buildings = town(shapely.box(0, 0, 20, 15), {"building": "office", "height": "12"}, count=1)
    for lod, top in ((2, 12.6), (1, 12.0), (0, 12.0)):
        solids, _ = build_solids(buildings, base=np.zeros(1), parapet=np.full(1, 0.6), lod=lod)
        assert solids.vertices[:, 2].max() == pytest.approx(top)


@pytest.mark.shared
@pytest.mark.parametrize(
    ("name", "more"), [("nyc_lower_east_side.osm.pbf", 1.2), ("berlin_siegessaeule.osm.gz", 1.0)]
)
def test_real_buildings_with_parts_are_solids_with_parapets(shared_osm, name, more):
    """A monument of a hundred parts is none with them, and is built without."""
    osm = read_osm(shared_osm(name))
    west, south, east, north = osm.bounds
    centre = (west + east) / 2, (south + north) / 2
    buildings, _ = read_buildings(osm, Frame.at(*centre))
    some = np.arange(min(buildings.count, 250))
    parts = np.flatnonzero(buildings.is_part & np.isin(buildings.outline, some))
    chosen = take_buildings(buildings, some, parts=parts)
    solids, _ = build_solids(chosen, base=np.zeros(len(some)), parapet=np.full(len(chosen), 0.7))
    plain, _ = build_solids(chosen, base=np.zeros(len(some)))
    assert len(solids) >= more * len(plain)
    assert set(solids.feature) == set(plain.feature)
    assert validate_mesh(solids).ok.all()


def test_houses_with_pitched_roofs_in_a_cold_region_have_chimneys_and_some_dormers():
    solids, copies, names, _ = built(town(shapely.box(0, 0, 14, 10), HOUSE))
    chimneys = copies.take(names == "chimney")
    assert 20 <= len(chimneys) <= 30
    assert 2 <= len(set(copies.feature[names == "dormer"])) <= 18
    for k, row in enumerate(chimneys.feature):
        ridge = solids.take(solids.feature == row).vertices[:, 2].max()
        top = chimneys.transform[k, 2, 3] + chimneys.transform[k, 2, 2]
        assert top == pytest.approx(ridge + 0.7)


def test_dormers_lie_on_the_roof_and_within_the_footprint():
    solids, copies, names, _ = built(town(shapely.box(0, 0, 14, 10), HOUSE))
    for k in np.flatnonzero(names == "dormer"):
        shape = roof_shapes()["dormer"].vertices
        placed = shape @ copies.transform[k, :, :3].T + copies.transform[k, :, 3]
        row = copies.feature[k]
        x = placed[:, 0] - solids.take(solids.feature == row).vertices[:, 0].min()
        y = placed[:, 1] - solids.take(solids.feature == row).vertices[:, 1].min()
        assert (x > 0).all()
        assert (x < 14).all()
        assert (y > 0).all()
        assert (y < 10).all()
        under = placed[[0, 1, 5, 6, 7]]
        rise = np.minimum(y, 10 - y)[[0, 1, 5, 6, 7]]
        eaves = solids.take(solids.feature == row).vertices[:, 2].max() - 5.0
        np.testing.assert_allclose(under[:, 2], eaves + rise, atol=2e-3)


def test_dormers_and_the_chimney_of_a_house_keep_clear_of_each_other():
    _, copies, names, _ = built(town(shapely.box(0, 0, 20, 10), HOUSE))
    assert (names == "dormer").sum() > 3
    for row in np.unique(copies.feature):
        own = copies.feature == row
        boxes = []
        for k in np.flatnonzero(own):
            points = shapes(with_relief=True)[names[k]].vertices @ copies.transform[k, :, :3].T
            boxes.append(shapely.MultiPoint((points + copies.transform[k, :, 3])[:, :2]).convex_hull)
        overlap = sum(b.area for b in boxes) - shapely.union_all(boxes).area
        assert overlap == pytest.approx(0.0, abs=1e-6)


@pytest.mark.full
def test_plant_on_a_flat_roof_is_off_its_edges_and_apart():
    hall = {"building": "warehouse", "height": "8", "roof:shape": "flat"}
    solids, copies, names, _ = built(town(shapely.box(0, 0, 50, 40), hall))
    assert len(copies) > 100
    for row in np.unique(copies.feature):
        low = solids.take(solids.feature == row).vertices[:, :2].min(axis=0)
        boxes = []
        for k in np.flatnonzero(copies.feature == row):
            assert copies.transform[k, 2, 3] == pytest.approx(8.0, abs=0.011)
            points = shapes(with_relief=True)[names[k]].vertices @ copies.transform[k, :, :3].T
            boxes.append(shapely.MultiPoint((points + copies.transform[k, :, 3])[:, :2] - low).convex_hull)
        assert shapely.box(0.4, 0.4, 49.6, 39.6).contains(shapely.union_all(boxes))
        assert sum(b.area for b in boxes) == pytest.approx(shapely.union_all(boxes).area, abs=1e-6)


def test_water_tanks_stand_on_high_roofs_of_new_york_alone():
    tall = {"building": "apartments", "height": "30", "roof:shape": "flat"}
    low = {"building": "apartments", "height": "15", "roof:shape": "flat"}
    for tags, at, some in ((tall, NEW_YORK, True), (low, NEW_YORK, False), (tall, BERLIN, False)):
        _, _, names, _ = built(town(shapely.box(0, 0, 20, 15), tags, at=at), at=at)
        assert ("water_tank" in names) is some


def test_what_stands_on_a_roof_depends_on_its_building_alone():
    every = town(shapely.box(0, 0, 14, 10), HOUSE)
    _, copies, _, _ = built(every)
    one = every.take(np.array([7]))
    one.outline[:] = 0
    _, alone, _, _ = built(one)
    same = copies.take(copies.feature == 7)
    np.testing.assert_allclose(np.sort(alone.transform.ravel()), np.sort(same.transform.ravel()), atol=1e-6)
