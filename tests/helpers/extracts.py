"""Comparison of OpenStreetMap extracts."""

from geoscene.sources import OsmData


def same(a: OsmData, b: OsmData) -> None:
    """Assert that two extracts have the same features."""
    assert [(w.osm_id, w.tags, w.nodes.tolist()) for w in a.ways] == [
        (w.osm_id, w.tags, w.nodes.tolist()) for w in b.ways
    ]
    assert all((v.lonlat == w.lonlat).all() for v, w in zip(a.ways, b.ways, strict=True))
    assert [(x.osm_id, x.tags, x.geometry.wkb, x.nodes.tolist()) for x in a.areas] == [
        (x.osm_id, x.tags, x.geometry.wkb, x.nodes.tolist()) for x in b.areas
    ]
    assert a.points == b.points
    assert a.relations == b.relations
    assert a.problems == b.problems
    assert a.bounds == b.bounds
