"""Land that the map does not describe: usual for the region, in parcels off roads and houses, marked."""

import numpy as np
import pytest
import shapely

from geoscene.buildings.guesses import palettes
from geoscene.classes import Class, material_names, materials
from geoscene.geometry.frames import Frame
from geoscene.ground import Layers, landcover
from geoscene.ground.land import PARCELS, TEMPERATE, Land, parcels
from geoscene.options import BuildOptions
from geoscene.pipeline.build import build
from geoscene.roadgraph.paths import path_surfaces
from geoscene.sources.data import Area, OsmData, Way

ARID = Land("sand", {"sand": 5.0, "soil": 3.0, "gravel": 2.0})
ROADS = np.array([shapely.LineString([(-900, 0), (900, 40)]), shapely.LineString([(0, -800), (30, 800)])])
WIDTH = np.array([7.0, 5.0])
HOUSES = np.array([shapely.box(x, 30, x + 12, 40) for x in (-300, -260, 200)])
NOTHING = np.empty(0, object)


def made(land=TEMPERATE, roads=ROADS, width=WIDTH, houses=HOUSES, cover=None):
    return parcels(land, roads=roads, width=width, buildings=houses, cover=cover or Layers.empty())


@pytest.mark.parametrize("land", [TEMPERATE, ARID])
def test_parcels_have_the_other_materials_of_the_region_and_are_marked(land):
    layers = made(land)
    assert set(material_names(layers.material)) == set(land.fields) - {land.open}
    assert set(layers.source) == {PARCELS}
    assert (layers.priority < -1).all()  # below all that is mapped
    assert (layers.osm_id == "").all()
    grass = material_names(layers.material) == "grass"
    assert (layers.klass[grass] == Class.GRASS).all()
    assert (layers.klass[~grass] != Class.GRASS).all() or land is TEMPERATE


def test_fields_leave_verges_beside_roads_and_yards_around_houses():
    fields = shapely.union_all(made().polygon)
    assert fields.area > 100_000
    road = shapely.union_all(shapely.buffer(ROADS, WIDTH / 2 + 2.5, cap_style="flat"))
    assert fields.intersection(road).area < 1.0
    assert fields.distance(shapely.union_all(HOUSES)) > 11.0


def test_land_far_from_all_roads_and_houses_is_open_ground():
    fields = shapely.union_all(made().polygon)
    seen = shapely.union_all(np.concatenate([ROADS, HOUSES])).buffer(400.0)
    assert seen.covers(fields)
    assert len(made(roads=NOTHING, width=np.empty(0), houses=NOTHING)) == 0


def test_parcels_do_not_depend_on_the_order_of_roads_nor_on_roads_far_away():
    first = made()
    turned = made(roads=ROADS[::-1], width=WIDTH[::-1], houses=HOUSES[::-1])
    far = np.append(ROADS, shapely.LineString([(9000, 9000), (9500, 9000)]))
    more = made(roads=far, width=np.append(WIDTH, 6.0))
    near = shapely.box(-2000, -2000, 2000, 2000)
    for name in ("soil", "dry_grass"):
        code = materials()[name].code
        one, two, three = (
            shapely.union_all(layers.polygon[layers.material == code]) for layers in (first, turned, more)
        )
        assert one.symmetric_difference(two).area < 1e-3
        assert one.symmetric_difference(three.intersection(near)).area < 1e-3


def test_parcels_beside_mapped_land_are_mostly_as_that():
    def share(cover):
        layers = made(cover=cover)
        area = shapely.area(layers.polygon)
        return area[layers.material == materials()["soil"].code].sum() / area.sum()

    mapped = Layers.of(
        [shapely.box(-1500, -1500, 1500, 1500)],
        klass=Class.TERRAIN,
        material=materials()["soil"].code,
        priority=20.0,
    )
    assert share(mapped) > 0.7 > share(Layers.empty())


def cover_of(land, *features):
    frame = Frame.at(9.0, 50.0)
    areas = []
    for number, tags in enumerate(features, 1):
        x, y = 30.0 * (number % 20), 30.0 * (number // 20)
        shape = shapely.transform(
            shapely.box(x, y, x + 20, y + 20), lambda xy: np.column_stack(frame.to_geographic(*xy.T))
        )
        areas.append(Area(f"way/{number}", tags, shape, np.empty(0, np.int64)))
    osm = OsmData((8.9, 49.9, 9.1, 50.1), [], areas, [], [])
    return landcover(osm, frame, extent=(-10, -10, 700, 700), land=land)[0]


@pytest.mark.parametrize("land", [TEMPERATE, ARID])
def test_built_up_areas_without_surface_have_the_open_ground_of_the_region(land):
    layers = cover_of(
        land,
        {"landuse": "residential"},
        {"amenity": "school"},
        {"landuse": "residential", "surface": "gravel"},
    )
    assert material_names(layers.material).tolist() == [land.open, land.open, "gravel"]
    assert layers.source.tolist() == ["assumed", "assumed", "surface"]


def test_farmland_without_surface_is_of_the_usual_fields():
    layers = cover_of(TEMPERATE, *[{"landuse": "farmland"}] * 200)
    names = material_names(layers.material)
    total = sum(TEMPERATE.fields.values())
    for name, weight in TEMPERATE.fields.items():
        assert (names == name).mean() == pytest.approx(weight / total, abs=0.12)
    assert set(layers.source) == {"assumed"}


def test_regions_have_materials_for_open_ground_and_fields():
    for region in palettes()["regions"].values():
        assert {region["open"], *region["fields"]} <= set(materials())


@pytest.mark.full
@pytest.mark.parametrize(
    ("place", "expected"), [((24.9, 60.2), "grass"), ((46.7, 24.7), "sand"), ((25.0, 70.0), "dry_grass")]
)
def test_open_ground_of_a_scene_is_that_of_its_region(place, expected, tmp_path):
    lon, lat = place
    line = np.array([[lon - 0.004, lat], [lon + 0.004, lat]])
    road = Way("way/1", {"highway": "track"}, np.array([1, 2]), line)
    osm = OsmData((lon - 0.006, lat - 0.003, lon + 0.006, lat + 0.003), [road], [], [], [])
    scene = build(osm, tmp_path / "scene", options=BuildOptions(relief="off"))
    bare = set()
    for index in scene.tile_indices:
        mesh = scene.tile(*index).mesh
        bare |= set(material_names(mesh.material[mesh.feature < 0]))
    assert bare == {expected}
    table = scene.features("landcover").columns
    assert {PARCELS} == set(table["source"])


def test_dirt_roads_differ_from_the_soil_beside_them_in_colour_and_reflectance():
    soil, dirt = materials()["soil"], materials()["dirt"]
    rows = path_surfaces(
        OsmData((8.9, 49.9, 9.1, 50.1), [path(highway="path")], [], [], []), Frame.at(9.0, 50.0)
    )
    assert material_names(rows.material).tolist() == ["dirt"]
    assert min(np.array(dirt.color) / soil.color) > 1.2
    assert min(np.array(dirt.reflectance) / soil.reflectance) > 1.15


def path(**tags):
    return Way("way/1", tags, np.array([1, 2]), np.array([[9.0, 50.0], [9.001, 50.0]]))


def test_no_fields_lie_among_the_streets_of_a_town_whose_houses_are_not_mapped():
    grid = [
        shapely.LineString([start, end])
        for k in np.arange(0.0, 1001.0, 125.0)
        for start, end in (((k, 0), (k, 1000)), ((0, k), (1000, k)))
    ]
    fields = made(roads=np.array(grid), width=np.full(len(grid), 6.0), houses=NOTHING)
    inside = shapely.intersection(fields.polygon, shapely.box(200, 200, 800, 800))
    assert shapely.area(inside).sum() < 0.01 * 600**2


def test_dry_grass_has_the_hue_of_its_spectrum():
    """Reflectances at 650, 550 and 450 nm, of dry grass of the JHU spectral library: straw, not yellow."""
    wanted = np.array([0.402, 0.306, 0.206])
    light = ((np.array(materials()["dry_grass"].color) / 255 + 0.055) / 1.055) ** 2.4
    np.testing.assert_allclose(light / light[0], wanted / wanted[0], atol=0.04)
