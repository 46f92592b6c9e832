"""Manhole covers, gullies and patches lie in carriageways, at the same places whatever else is mapped."""

import numpy as np
import shapely

from geoscene.classes import Class, materials
from geoscene.geometry.frames import Frame
from geoscene.ground.layers import COVERS, GULLIES, PATCHES
from geoscene.roadgraph.carriageways import read_carriageways
from geoscene.roadgraph.covers import cover_rows
from geoscene.sources.data import OsmData, TaggedNode, Way

FRAME = Frame.at(10.0, 50.0)
STREET = {"highway": "residential", "width": "8", "sidewalk": "left"}
LINE = [(0, 0), (400, 30), (800, 0)]


def covers(ways, points=(), *, guess=True):
    """Rows for ways {id: (tags, coordinates)}; ids of nodes follow from those of ways."""
    roads = [
        Way(
            f"way/{number}",
            tags,
            100 * number + np.arange(len(xy)),
            np.column_stack(FRAME.to_geographic(*np.array(xy, float).T)),
        )
        for number, (tags, xy) in ways.items()
    ]
    nodes = [TaggedNode(f"node/{k}", tags, *FRAME.to_geographic(*xy)) for k, (tags, xy) in enumerate(points)]
    osm = OsmData(bounds=(9.9, 49.9, 10.1, 50.1), ways=roads, areas=[], points=nodes, relations=[])
    table = read_carriageways(osm, FRAME, sidewalks="mapped", left_hand=False)
    return cover_rows(osm, table, frame=FRAME, guess=guess), table


def test_streets_have_covers_every_30_m_within_the_carriageway():
    rows, table = covers({7: (STREET, LINE)})
    length = shapely.length(table.line).sum()
    band = shapely.buffer(shapely.union_all(table.line), 4.001, cap_style="flat")
    assert shapely.covers(band, rows.polygon).all()
    found = rows.polygon[rows.priority == COVERS]
    assert len(found) == int(length / 30)
    assert np.ptp(shapely.area(found)) < 0.01
    assert 0.5 < 2 * np.sqrt(shapely.area(found) / np.pi).mean() < 0.7  # metres across
    apart = np.diff(np.sort(shapely.line_locate_point(table.line[0], shapely.centroid(found))))
    assert (apart > 5.0).all()
    assert (rows.klass == Class.ROAD).all()
    assert set(rows.source) == {"guess/default"}


def test_gullies_lie_at_the_kerb_of_the_side_that_has_one():
    rows, table = covers({7: (STREET, LINE)})
    gullies = shapely.centroid(rows.polygon[rows.priority == GULLIES])
    assert len(gullies) > 5
    np.testing.assert_allclose(shapely.distance(table.line[0], gullies), 4.0 - 0.15, atol=0.02)
    left = shapely.buffer(table.line[0], 4.0, single_sided=True)
    assert shapely.contains(left, gullies).all()


def test_patches_are_other_asphalt_on_one_side_of_the_crown():
    rows, table = covers({7: (STREET, LINE)})
    patches = rows.polygon[rows.priority == PATCHES]
    assert len(patches) > 5
    assert (rows.material[rows.priority == PATCHES] == materials()["asphalt_fresh"].code).all()
    assert not shapely.intersects(patches, table.line[0]).any()


def test_a_street_keeps_its_covers_when_others_are_added():
    alone, _ = covers({7: (STREET, LINE)})
    both, _ = covers({3: (STREET, [(0, 200), (500, 200)]), 7: (STREET, LINE)})
    mine = both.polygon[both.osm_id == "way/7"]
    assert sorted(map(str, mine)) == sorted(map(str, alone.polygon))
    assert len(both) > len(alone)


def test_motorways_tracks_and_bridges_have_none():
    tags = [
        {"highway": "motorway", "width": "8"},
        {"highway": "track", "width": "6"},
        STREET | {"bridge": "yes", "layer": "1"},
        STREET | {"surface": "gravel"},
    ]
    rows, _ = covers({k: (tag, [(0, 50 * k), (600, 50 * k)]) for k, tag in enumerate(tags, start=1)})
    assert len(rows) == 0


def test_mapped_manholes_are_where_the_map_has_them():
    points = [
        ({"man_made": "manhole"}, (100, 9)),
        ({"manhole": "drain"}, (200, 30)),
        ({"manhole": "no"}, (300, 20)),
        ({"man_made": "manhole", "layer": "-1"}, (310, 20)),
    ]
    rows, _ = covers({7: (STREET, LINE)}, points, guess=False)
    xy = shapely.get_coordinates(shapely.centroid(rows.polygon))
    np.testing.assert_allclose(xy, [[100, 9], [200, 30]], atol=1e-3)
    assert rows.klass.tolist() == [Class.ROAD, Class.SIDEWALK]
    assert set(rows.source) == {"manhole/default"}
