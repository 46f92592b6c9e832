"""The extent of a map: stray nodes, far bounds, and maps across 180° of longitude."""

from pathlib import Path

import numpy as np
import pytest

from geoscene.errors import InputError
from geoscene.options import BuildOptions
from geoscene.pipeline.build import build
from geoscene.pipeline.plan import make_plan
from geoscene.sources import OsmData, read_osm
from geoscene.sources.extent import checked_bounds
from geoscene.support.progress import silent

HOUSE = {"building": "yes", "building:levels": "2"}
ROAD = {"highway": "residential"}


class Town:
    """Rows of houses along a street, in degrees; more nodes and ways can be added."""

    def __init__(self, lat: float = 60.17, lon: float = 24.94, houses: int = 20) -> None:
        self.nodes: list[str] = []
        self.ways: list[str] = []
        for k in range(houses):
            self.house(lat + 0.0005 * (k % 4), lon + 0.001 * (k // 4))
        self.street = [self.node(lat - 0.0002, lon), self.node(lat - 0.0002, lon + 0.005)]
        self.way(self.street, ROAD)

    @staticmethod
    def _tags(tags: dict[str, str]) -> str:
        return "".join(f'<tag k="{k}" v="{v}"/>' for k, v in tags.items())

    def node(self, lat: float, lon: float, tags: dict[str, str] | None = None) -> int:
        lon = lon - 360 if lon > 180 else lon
        self.nodes.append(
            f'<node id="{len(self.nodes) + 1}" version="1" lat="{lat:.7f}" lon="{lon:.7f}">'
            f"{self._tags(tags or {})}</node>"
        )
        return len(self.nodes)

    def way(self, refs: list[int], tags: dict[str, str]) -> None:
        body = "".join(f'<nd ref="{ref}"/>' for ref in refs)
        self.ways.append(f'<way id="{len(self.ways) + 1}" version="1">{body}{self._tags(tags)}</way>')

    def house(self, lat: float, lon: float) -> list[int]:
        corners = ((0, 0), (0, 0.0003), (0.0002, 0.0003), (0.0002, 0))
        refs = [self.node(lat + dlat, lon + dlon) for dlat, dlon in corners]
        self.way([*refs, refs[0]], HOUSE)
        return refs

    def read(
        self,
        folder: Path,
        *,
        stated: tuple[float, ...] | None = None,
        bounds: tuple[float, ...] | None = None,
    ) -> OsmData:
        box = ""
        if stated:
            west, south, east, north = stated
            box = f'<bounds minlon="{west}" minlat="{south}" maxlon="{east}" maxlat="{north}"/>'
        path = folder / "town.osm"
        path.write_text(f'<osm version="0.6">{box}{"".join(self.nodes + self.ways)}</osm>')
        return read_osm(path, bounds=bounds)


def found(data: OsmData) -> list[tuple[str, str, str, str]]:
    return [(p.osm_id, p.kind, p.action, p.reason) for p in data.problems]


def size_km(data: OsmData) -> tuple[float, float]:
    west, south, east, north = data.bounds
    return (east - west) * 111.2 * np.cos(np.radians(south)), (north - south) * 111.2


@pytest.mark.parametrize("place", [(60.17, 0.0), (0.0, 0.0), (60.9, 24.94), (-60.17, 24.94), (60.17, -170.0)])
def test_a_node_far_from_all_others_does_not_stretch_the_extent(place, tmp_path):
    town = Town()
    town.node(*place, {"natural": "tree"})
    data = town.read(tmp_path)
    assert max(size_km(data)) < 0.5
    assert found(data) == [(f"node/{len(town.nodes)}", "node", "dropped", "far-away")]
    assert not data.points


@pytest.mark.parametrize("stated", [None, (24.939, 60.169, 24.946, 60.173)])
def test_a_stray_corner_costs_its_building_and_nothing_else(stated, tmp_path):
    town = Town()
    a, b, c, d = town.house(60.1703, 24.9445)
    stray = town.node(60.17, 0.0)
    town.ways[-1] = ""
    town.way([a, b, c, stray, d, a], HOUSE)
    data = town.read(tmp_path, stated=stated)
    assert max(size_km(data)) < 0.6
    assert (f"node/{stray}", "node", "dropped", "far-away") in found(data)
    plan, _ = make_plan(data, BuildOptions(relief="off"), progress=silent)
    assert max(np.abs(plan.extent)) < 400
    assert 20 <= plan.buildings.count <= 21


def test_a_street_to_a_stray_node_is_cut_there(tmp_path):
    town = Town()
    town.way([*town.street, town.node(0.0, 0.0)], ROAD)
    data = town.read(tmp_path, stated=(24.939, 60.169, 24.946, 60.173))
    assert [len(way.lonlat) for way in data.ways] == [2, 2]
    assert ("way/22", "road", "repaired", "missing-nodes") in found(data)


@pytest.mark.parametrize("stated", [None, (24.939, 60.169, 24.946, 60.173)])
def test_a_house_far_away_is_dropped_by_name(stated, tmp_path):
    town = Town()
    town.house(60.17, 2.94)
    data = town.read(tmp_path, stated=stated)
    assert len(data.areas) == 20
    assert ("way/22", "building", "dropped", "missing-nodes" if stated is None else "far-away") in found(data)


def test_two_towns_far_apart_both_count(tmp_path):
    town = Town()
    for k in range(12):
        town.house(60.17, 25.94 + 0.001 * k)
    assert size_km(town.read(tmp_path))[0] > 50


@pytest.mark.parametrize(
    "stated", [(0.0, 60.169, 24.946, 60.173), (-180.0, -90.0, 180.0, 90.0), (14.0, 10.0, 14.1, 10.1)]
)
def test_stated_bounds_are_cut_near_the_nodes(stated, tmp_path):
    data = Town().read(tmp_path, stated=stated)
    assert max(size_km(data)) < 21
    assert found(data) == [("", "bounds", "repaired", "far-from-nodes")]


def test_stated_and_given_bounds_with_empty_margins_stay(tmp_path):
    wide = (24.9, 60.15, 25.0, 60.2)
    assert Town().read(tmp_path, stated=wide).bounds == wide
    assert Town().read(tmp_path, bounds=(24.0, 60.0, 25.0, 61.0)).bounds == (24.0, 60.0, 25.0, 61.0)


@pytest.mark.full
@pytest.mark.parametrize(
    ("stated", "bounds"),
    [
        (None, None),
        ((-180.0, -16.81, 180.0, -16.79), None),
        (None, (179.996, -16.81, -179.996, -16.79)),
        (None, (179.996, -16.81, 180.004, -16.79)),
    ],
)
def test_a_map_across_180_degrees_equals_the_same_map_elsewhere(stated, bounds, tmp_path):
    across = Town(-16.8, 179.998).read(tmp_path, stated=stated, bounds=bounds)
    inland = Town(-16.8, 100.998).read(tmp_path, bounds=bounds and (100.996, -16.81, 101.004, -16.79))
    assert len(across.areas) == 20
    assert not across.problems
    here, _ = make_plan(across, BuildOptions(relief="off"), progress=silent)
    there, _ = make_plan(inland, BuildOptions(relief="off"), progress=silent)
    assert here.buildings.count == there.buildings.count
    np.testing.assert_allclose(
        [f.area for f in here.buildings.footprint], [f.area for f in there.buildings.footprint], rtol=1e-4
    )
    assert here.graph.length.sum() == pytest.approx(there.graph.length.sum(), abs=1e-3)
    if stated is None:
        np.testing.assert_allclose(here.extent, there.extent, atol=1.01)


def test_geographic_bounds_across_180_degrees_have_their_east_in_the_west(tmp_path):
    scene = build(Town(-16.8, 179.998).read(tmp_path), tmp_path / "scene")
    west, south, east, north = scene.manifest["geographic_bounds"]
    assert (west, east) == pytest.approx((179.998, -179.997), abs=1e-9)
    assert south < north


@pytest.mark.parametrize(("dlat", "dlon"), [(0.0, 0.01), (0.01, 0.0)])
def test_a_map_of_one_straight_street_has_ground_on_both_sides(dlat, dlon, tmp_path):
    town = Town(houses=0)
    town.nodes.clear()
    town.ways.clear()
    town.way([town.node(60.17, 24.94), town.node(60.17 + dlat, 24.94 + dlon)], ROAD)
    plan, _ = make_plan(town.read(tmp_path), BuildOptions(relief="off"), progress=silent)
    xmin, ymin, xmax, ymax = plan.extent
    assert min(-xmin, -ymin, xmax, ymax) >= 9
    assert min(xmax - xmin, ymax - ymin) < 25


@pytest.mark.parametrize(
    ("bounds", "canonical"),
    [
        ((1, 2, 3, 4), (1, 2, 3, 4)),
        ((179.9, -17, -179.9, -16), (179.9, -17, 180.1, -16)),
        ((179.9, -17, 180.1, -16), (179.9, -17, 180.1, -16)),
        ((-180.1, -17, -179.9, -16), (179.9, -17, 180.1, -16)),
    ],
)
def test_bounds_across_180_degrees_rise_to_the_east(bounds, canonical):
    assert checked_bounds(bounds) == pytest.approx(canonical)


@pytest.mark.parametrize("bounds", [(25, 60, 24, 61), (181, 0, 182, 1), (24, 60, 500, 61)])
def test_bounds_in_the_wrong_order_or_range_are_refused(bounds):
    with pytest.raises(InputError, match="bounds"):
        checked_bounds(bounds)
