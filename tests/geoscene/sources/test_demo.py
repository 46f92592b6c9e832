"""The demo extract: its size and contents, and its reproducible creation."""

import subprocess
import sys

import networkx as nx
import pytest
from helpers import ROOT

from geoscene.sources import demo_path, read_osm

DRIVABLE = {"primary", "secondary", "tertiary", "unclassified", "residential", "living_street"}


@pytest.mark.full
def test_the_demo_has_features_of_all_kinds():
    assert demo_path().stat().st_size < 500_000
    data = read_osm(demo_path())
    west, south, east, north = data.bounds
    assert 0.5 < (east - west) * 111.195 * 0.4972 * (north - south) * 111.195 < 1.0
    buildings = [a for a in data.areas if "building" in a.tags]
    assert len(buildings) > 200
    assert sum(bool(len(a.geometry.interiors)) for a in buildings if a.geometry.geom_type == "Polygon") > 30
    assert len({a.tags["building:levels"] for a in buildings if "building:levels" in a.tags}) >= 8
    assert sum("building:part" in a.tags for a in data.areas) > 50
    assert sum(p.tags.get("natural") == "tree" for p in data.points) > 150


@pytest.mark.full
def test_the_streets_of_the_demo_are_connected():
    data = read_osm(demo_path())
    graph = nx.Graph()
    for way in data.ways:
        if way.tags.get("highway") in DRIVABLE:
            nx.add_path(graph, way.nodes.tolist())
    main = max(nx.connected_components(graph), key=len)
    assert len(main) > 0.9 * len(graph)
    street = graph.subgraph(main)
    assert street.number_of_edges() - street.number_of_nodes() + 1 > 20  # independent loops


@pytest.mark.shared
def test_demo_extract_is_reproducible(shared_osm, tmp_path):
    out = tmp_path / "cut.osm.pbf"
    script = ROOT / "data" / "cut_demo.py"
    source = shared_osm("helsinki_center.osm.pbf")
    subprocess.run([sys.executable, script, source, "-o", out], check=True, capture_output=True)
    assert out.read_bytes() == demo_path().read_bytes()
    wrong = subprocess.run(
        [sys.executable, script, demo_path(), "-o", tmp_path / "no.pbf"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert wrong.returncode != 0
    assert "sha256" in wrong.stderr


def test_importing_sources_does_not_import_large_libraries():
    heavy = ("osmnx", "osmium", "shapely", "pandas")
    code = f"import sys, geoscene.sources; print([m for m in {heavy} if m in sys.modules])"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"
