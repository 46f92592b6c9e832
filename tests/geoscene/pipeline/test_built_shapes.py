"""Tables of buildings have the heights, roofs and plans of the solids."""

import numpy as np
import pytest
import shapely

import geoscene
from geoscene.export.libraries import to_trimesh
from geoscene.geometry.frames import Frame
from geoscene.options import BuildOptions
from geoscene.sources.data import Area, OsmData

FRAME = Frame.at(10.0, 50.0)


def area(number, shape, **tags):
    lonlat = shapely.transform(shape, lambda xy: np.column_stack(FRAME.to_geographic(*xy.T)))
    colon = {key.replace("__", ":"): value for key, value in tags.items()}
    return Area(f"way/{number}", colon, lonlat, np.empty(0, np.int64))


def house(number, shape, **tags):
    return area(number, shape, building="yes", **tags)


def part(number, shape, **tags):
    return area(number, shape, building__part="yes", **tags)


def tables(areas, folder, **options):
    """Rows of buildings and of parts by id, and the top and lowest z of all solids."""
    osm = OsmData((9.998, 49.999, 10.002, 50.001), [], areas, [], [])
    scene = geoscene.build(osm, folder / "scene", options=BuildOptions(relief="off", **options))
    found = []
    for name in ("buildings", "building_parts"):
        if not scene.table_length(name):
            found.append({})
            continue
        layer = scene.features(name)
        rows = [
            {k: v[n] for k, v in layer.columns.items()} | {"plan": layer.geometry[n]}
            for n in range(len(layer))
        ]
        found.append({row["osm_id"]: row for row in rows})
    z = to_trimesh(scene).geometry["building"].vertices[:, 2] if scene.has_tiles else np.zeros(1)
    return *found, scene, (z.max(), z.min())


CROSS = shapely.union_all(
    [shapely.box(-30, -5, 30, 5), shapely.box(-5, -25, 7, 20), shapely.box(10, 0, 18, 30)]
)


def test_a_replaced_roof_has_the_shape_that_was_built(tmp_path):
    areas = [
        house(1, CROSS, height="20", roof__shape="onion", roof__height="4"),
        house(2, shapely.box(60, 0, 80, 10), height="10", roof__shape="gabled", roof__height="4"),
    ]
    houses, _, scene, _ = tables(areas, tmp_path)
    problems = scene.files.problems.read_text()
    [made] = [line.rpartition(" ")[2] for line in problems.splitlines() if "roof-fallback" in line]
    assert "onion roof made" in problems
    assert (houses["way/1"]["roof_shape"], houses["way/1"]["roof_source"]) == (made, "fallback")
    assert houses["way/1"]["roof_height"] == (0 if made == "flat" else 4)
    assert (houses["way/2"]["roof_shape"], houses["way/2"]["roof_source"]) == ("gabled", "tag")


@pytest.mark.parametrize("tall", [True, False])
def test_a_building_that_its_parts_replace_is_as_high_as_they_are(tmp_path, tall):
    low = part(2, shapely.box(0, 0, 10, 10), height="12", min_height="3")
    high = part(3, shapely.box(10, 0, 20, 12), height="18", roof__shape="hipped", roof__height="3")
    outline = house(1, shapely.box(0, 0, 20, 10), height="30" if tall else "18", roof__shape="flat")
    houses, parts, scene, (top, bottom) = tables([outline, low, high], tmp_path)
    row = houses["way/1"]
    assert (row["height"], row["height_source"]) == (18, "parts" if tall else "tag")
    assert top - bottom == pytest.approx(row["height"] - row["min_height"])
    assert (row["min_height"], row["min_height_source"]) == (0, "default")
    assert (row["roof_shape"], row["roof_height"], row["roof_source"]) == ("hipped", 3, "tag")
    assert row["plan"].area == pytest.approx(220, abs=0.01)
    assert parts["way/2"]["min_height"] == 3
    assert scene.manifest["heights"] == {row["height_source"]: 1}


def test_a_building_of_hanging_parts_hangs_as_low_as_they_do(tmp_path):
    hanging = [
        part(2 + k, shapely.box(10 * k, 0, 10 * k + 10, 10), height="12", min_height=str(4 + k))
        for k in range(2)
    ]
    houses, _, _, (top, bottom) = tables([house(1, shapely.box(0, 0, 20, 10)), *hanging], tmp_path)
    row = houses["way/1"]
    assert (row["min_height"], row["min_height_source"], row["height"]) == (bottom, "tag", top)


def test_a_scene_without_tiles_has_roofs_as_mapped(tmp_path):
    houses, _, _, _ = tables([house(1, CROSS, height="20", roof__shape="onion")], tmp_path, use="gis")
    assert houses["way/1"]["roof_shape"] == "onion"
