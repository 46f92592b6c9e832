"""Street furniture with relief stands on sidewalks, apart from each other, whatever else there is."""

from dataclasses import replace

import manifold3d
import numpy as np
import pytest
import shapely
from scipy.spatial import cKDTree

from geoscene.classes import Class
from geoscene.geometry.frames import Frame
from geoscene.geometry.watertight import validate_mesh
from geoscene.ground import Layers, building_pads, plan_ground
from geoscene.objects.furniture import STANDS, read_furniture
from geoscene.objects.shapes import shapes
from geoscene.objects.sidewalks import with_details, with_guesses
from geoscene.objects.siting import Sites
from geoscene.objects.street import Taken, guess_furniture, street_shape
from geoscene.objects.street_shapes import street_shapes
from geoscene.options import BuildOptions
from geoscene.pipeline.plan import make_plan
from geoscene.sources import read_osm
from geoscene.sources.data import OsmData, TaggedNode, Way
from geoscene.support.progress import silent

FRAME = Frame.at(11.0, 50.0)
EXTENT = (-300.0, -40.0, 300.0, 40.0)


def lonlat_of(*xy):
    return np.column_stack(FRAME.to_geographic(*np.array(xy, float).T))


def osm_of(*points, ways=()):
    nodes = [TaggedNode(f"node/{k}", tags, *lonlat_of(xy)[0]) for k, (xy, tags) in enumerate(points)]
    return OsmData((10.99, 49.99, 11.01, 50.01), list(ways), [], nodes, [])


def street(length=300.0):
    return Way("way/77", {"highway": "residential"}, np.arange(2), lonlat_of((-length, 0), (length, 0)))


def town(walk=4.0):
    """A street of 7 m along x with sidewalks, and houses behind them."""
    wide = 3.5 + walk
    road = Layers.of([shapely.box(-400, -3.5, 400, 3.5)], klass=Class.ROAD, material=1, priority=100.0)
    sides = [shapely.box(-400, 3.5, 400, wide), shapely.box(-400, -wide, 400, -3.5)]
    paved = Layers.of(sides, klass=Class.SIDEWALK, material=4, priority=90.0)
    houses = building_pads(
        [shapely.box(-290, wide, 290, wide + 12), shapely.box(-290, -wide - 12, 290, -wide)]
    )
    return plan_ground(EXTENT, Layers.concatenate([road, paved, houses]))


def guessed(osm, plan, *, taken=None):
    none = Taken(np.empty((0, 2)), np.empty(0, np.str_), np.empty(0, object))
    start = read_furniture(OsmData(osm.bounds, [], [], [], []), FRAME, plan=plan, relief="full")[0]
    guesses = guess_furniture(osm, FRAME, extent=EXTENT)
    return with_guesses(start, guesses, sites=Sites.of(plan), taken=taken or none, first=100)


@pytest.mark.parametrize("name", street_shapes())
def test_shapes_are_closed_solids_facing_outward_within_the_budget(name):
    shape = street_shapes()[name]
    part = manifold3d.Manifold(
        manifold3d.Mesh(shape.vertices.astype(np.float32), shape.faces.astype(np.uint32))
    )
    assert part.status() == manifold3d.Error.NoError
    assert all(piece.volume() > 0 for piece in part.decompose())
    assert shape.closed.all()
    verdict = validate_mesh(replace(shape, feature=np.zeros(len(shape), np.int32)))  # also where bodies meet
    assert (verdict.closed & verdict.oriented & verdict.positive & (verdict.degenerate == 0)).all()
    assert len(shape) <= 420


@pytest.mark.parametrize(
    ("tags", "shape"),
    [
        ({"amenity": "waste_basket"}, "waste_basket"),
        ({"amenity": "bench", "backrest": "no"}, "bench_plain"),
        ({"amenity": "bench"}, None),
        ({"highway": "bus_stop", "shelter": "yes"}, "bus_shelter"),
        ({"highway": "bus_stop"}, "bus_stop"),
        ({"amenity": "shelter", "shelter_type": "picnic_shelter"}, None),
        ({"amenity": "bicycle_parking", "bicycle_parking": "building"}, None),
        ({"amenity": "recycling", "recycling_type": "centre"}, None),
        ({"amenity": "restaurant"}, None),
    ],
)
def test_tags_tell_the_shape(tags, shape):
    assert street_shape(tags) == shape


def test_guesses_stand_on_sidewalks_apart_from_each_other():
    plan = town()
    table = guessed(osm_of(ways=[street()]), plan)
    assert len(table) > 20
    assert (Sites.of(plan).classes(table.xy) == Class.SIDEWALK).all()
    assert (np.abs(table.xy[:, 1]) > 3.5 + 0.4).all()
    assert cKDTree(table.xy).query(table.xy, k=2)[0][:, 1].min() >= 2.0
    assert set(table.source) == {"guess"}
    assert len(np.unique(table.feature)) == len(table)


def test_guesses_leave_a_metre_to_walk_along_the_houses():
    table = guessed(osm_of(ways=[street()]), town())
    assert (np.abs(table.xy[:, 1]) < 3.5 + 4.0 - 1.0).all()


def test_on_narrow_sidewalks_nothing_is_guessed():
    assert len(guessed(osm_of(ways=[street()]), town(walk=1.2))) == 0


def test_guesses_keep_away_from_trees_and_mapped_furniture():
    plan, osm = town(), osm_of(ways=[street()])
    free = guessed(osm, plan)
    trees = free.xy[::3] + 0.7
    taken = Taken(trees, np.full(len(trees), ""), np.empty(0, object))
    left = guessed(osm, plan, taken=taken)
    assert 0 < len(left) < len(free)
    assert cKDTree(trees).query(left.xy)[0].min() >= 2.0


def test_no_kind_is_guessed_beside_a_mapped_one():
    plan, osm = town(), osm_of(ways=[street()])
    kind = "street_lamp"
    assert (guessed(osm, plan).shape == kind).any()
    spots = np.column_stack([np.arange(-300, 301, 50.0), np.full(13, 30.0)])
    left = guessed(osm, plan, taken=Taken(spots, np.full(13, kind), np.empty(0, object)))
    assert not (left.shape == kind).any()
    assert len(left)


def test_a_guess_does_not_depend_on_other_streets():
    plan = town()
    other = Way("way/5", {"highway": "residential"}, np.arange(2), lonlat_of((-300, 36), (300, 36)))
    alone, among = guessed(osm_of(ways=[street()]), plan), guessed(osm_of(ways=[other, street()]), plan)
    assert set(map(tuple, alone.xy)) <= set(map(tuple, among.xy))


def test_tables_stand_before_a_restaurant_beside_its_door():
    """All four tables are within 1.5 m of the front, and 1.2 m stay free between them and the road."""
    plan = town()
    cafe = ((0.0, 9.0), {"amenity": "cafe", "outdoor_seating": "yes"})
    table = guessed(osm_of(cafe), plan)
    assert len(table) == 4
    assert set(table.source) == {"outdoor_seating"}
    np.testing.assert_allclose(np.sort(table.xy[:, 0]), [-3.6, -1.8, 1.8, 3.6], atol=0.01)
    assert ((table.xy[:, 1] > 3.5 + 1.2 + 0.55) & (table.xy[:, 1] < 7.5)).all()
    assert len(guessed(osm_of((cafe[0], {"amenity": "cafe", "outdoor_seating": "no"})), plan)) == 0


def test_a_bicycle_parking_has_a_stand_for_two_bicycles():
    plan = town()
    osm = osm_of(((0.0, 5.5), {"amenity": "bicycle_parking", "capacity": "10"}), ways=[street()])
    row, _ = read_furniture(osm, FRAME, plan=plan, relief="plain")
    assert row.shape.tolist() == ["bicycle_stand"] * 5
    np.testing.assert_allclose(np.diff(np.sort(row.xy[:, 0])), 0.9, atol=1e-6)
    np.testing.assert_allclose(row.xy[:, 1], 5.5, atol=1e-6)
    assert len(np.unique(row.feature)) == 5
    assert row.feature.max() < STANDS
    full = with_details(row, Sites.of(plan), full=True)
    assert set(full.shape) <= {"bicycle_stand", "bicycle_stand_1", "bicycle_stand_2"}
    assert len(set(full.shape)) > 1
    assert with_details(row, Sites.of(plan), full=False).shape.tolist() == row.shape.tolist()


def test_stands_on_the_carriageway_are_left_out():
    osm = osm_of(((0.0, 4.0), {"amenity": "bicycle_parking", "capacity": "40"}))
    plan = town()
    row, _ = read_furniture(osm, FRAME, plan=plan, relief="plain")
    assert (np.abs(row.xy[:, 1]) < 3.5).any()
    kept = with_details(row, Sites.of(plan), full=False)
    assert len(kept)
    assert (np.abs(kept.xy[:, 1]) > 3.5).all()


def test_a_bus_shelter_stands_back_from_the_kerb_or_is_a_pole_where_there_is_no_room():
    stop = ((0.0, 4.2), {"highway": "bus_stop", "shelter": "yes"})
    for walk, shape, y in ((4.0, "bus_shelter", 5.0), (1.5, "bus_stop", 4.2)):
        plan = town(walk)
        table, _ = read_furniture(osm_of(stop, ways=[street()]), FRAME, plan=plan, relief="plain")
        kept = with_details(table, Sites.of(plan), full=False)
        assert kept.shape.tolist() == [shape]
        assert kept.xy[0, 1] == pytest.approx(y)
        assert kept.height[0] == shapes(with_relief=True)[shape].vertices[:, 2].max()


def test_without_relief_none_of_this_is_there():
    osm = osm_of(((0.0, 5.5), {"amenity": "waste_basket"}), ways=[street()])
    assert len(read_furniture(osm, FRAME, plan=town())[0]) == 0


@pytest.mark.shared
@pytest.mark.parametrize("name", ["nyc_lower_east_side.osm.pbf", "monaco.osm.pbf"])
def test_nothing_of_a_real_place_stands_on_a_carriageway_or_in_a_building(shared_osm, name):
    plan, _ = make_plan(read_osm(shared_osm(name)), BuildOptions(relief="full"), progress=silent)
    klass = Sites.of(plan.ground).classes(plan.furniture.xy)
    assert (plan.furniture.source != "mapped").sum() > 200
    assert not np.isin(klass, [Class.ROAD, Class.CROSSING, Class.RAIL, Class.BUILDING_PAD, Class.WATER]).any()
    assert len(np.unique(plan.furniture.feature)) == len(plan.furniture)
