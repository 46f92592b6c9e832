"""Tops that a cloud gave stay where they are on any base, and bodies that stand on others move with them."""

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from geoscene.buildings import read_buildings
from geoscene.buildings.heights import with_measured_tops
from geoscene.geometry.frames import Frame
from geoscene.sources.data import Area, OsmData

FRAME = Frame.at(8.7, 49.4)


def area(name, x, width, **tags):
    shape = shapely.box(x, 0, x + width, 10)
    lonlat = shapely.transform(shape, lambda xy: np.column_stack(FRAME.to_geographic(xy[:, 0], xy[:, 1])))
    return Area(
        name, {key.replace("__", ":"): value for key, value in tags.items()}, lonlat, np.empty(0, int)
    )


def cloud(height, top):
    return {"height": f"{height}", "cloud__height_sigma": "0.03", "cloud__top": f"{top}"}


@settings(max_examples=20, deadline=None)
@given(st.floats(-3, 3), st.floats(0.5, 4))
def test_tops_do_not_depend_on_the_base_and_nothing_comes_apart(sunk, roof):
    osm = OsmData(
        (8.6, 49.3, 8.8, 49.5),
        [],
        [
            area("way/1", 0, 20, building="yes"),
            area("way/2", 0, 20, building__part="yes", **cloud(8, 408), roof__shape="flat"),
            area("way/3", 5, 5, building__part="yes", min_height="8", height="12"),  # stands on way/2
            area("way/4", 40, 10, building="yes", height="9"),
            area("way/5", 60, 10, building="yes", **cloud(9, 411.5), roof__shape="gabled",
                 roof__height=f"{roof}"),
            area("way/6", 80, 10, building="yes", **cloud(9, 411.5)),
        ],
        [],
        [],
    )  # fmt: skip
    before, _ = read_buildings(osm, FRAME)
    row = {name: int(np.flatnonzero(before.osm_id == name)[-1]) for name in before.osm_id}
    base = np.full(before.count, 400.0 + sunk)
    base[row["way/6"]] = np.nan  # out of reach
    after = with_measured_tops(before, base)
    assert after.height[row["way/2"]] + 400 + sunk == pytest.approx(408)
    assert after.height[row["way/5"]] + 400 + sunk == pytest.approx(411.5)
    assert after.roof_height[row["way/5"]] == pytest.approx(roof, abs=1e-6)
    assert after.min_height[row["way/3"]] == pytest.approx(after.height[row["way/2"]])
    assert after.height[row["way/3"]] - after.min_height[row["way/3"]] == pytest.approx(4.0)
    for name in ("way/4", "way/6"):
        assert after.height[row[name]] == before.height[row[name]]


def test_a_base_above_the_measured_top_leaves_a_thin_body():
    osm = OsmData((8.6, 49.3, 8.8, 49.5), [], [area("way/1", 0, 9, building="yes", **cloud(2, 402))], [], [])
    table, _ = read_buildings(osm, FRAME)
    made = with_measured_tops(table, np.array([403.0]))
    assert made.height[0] == pytest.approx(0.01)
    assert made.roof_height[0] <= made.height[0]
