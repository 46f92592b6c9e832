"""Buildings of real extracts: all are valid solids, and landmarks have their known shapes."""

import manifold3d as m3
import numpy as np
import pytest
import shapely

from geoscene.buildings import BuildingOptions, build_solids, read_buildings
from geoscene.buildings.features import is_building, is_building_part
from geoscene.buildings.footprints import project
from geoscene.geometry.frames import Frame
from geoscene.geometry.watertight import validate_mesh
from geoscene.sources import read_osm

pytestmark = pytest.mark.shared


def scene(path):
    osm = read_osm(path)
    west, south, east, north = osm.bounds
    table, problems = read_buildings(osm, Frame.at((west + east) / 2, (south + north) / 2))
    mesh, more = build_solids(table, base=np.zeros(table.count))
    return table, mesh, problems + more


@pytest.mark.parametrize(
    "name",
    [
        "nyc_lower_east_side.osm.pbf", "helsinki_center.osm.pbf", "singapore_bayfront.osm.pbf",
        "krems.osm.gz",
        "berlin_siegessaeule.osm.gz", "moscow_ostankino.osm.gz",
        "norfolk_east_28th_buildings.osm.gz",
        "st_petersburg_galernaya.osm.gz", "berlin_neukoelln.osm.gz",
    ],
)  # fmt: skip
def test_every_building_is_a_solid(shared_osm, name):
    table, mesh, problems = scene(shared_osm(name))
    verdict = validate_mesh(mesh)
    assert verdict.feature.tolist() == list(range(table.count))
    assert verdict.ok.all()
    assert not [p for p in problems if p.reason == "no-solid"]
    # manifold3d reads a closed mesh of several bodies as one
    whole = m3.Manifold(m3.Mesh64(mesh.vertices, mesh.faces.astype(np.uint64)))
    assert whole.status() == m3.Error.NoError
    assert whole.volume() == pytest.approx(verdict.volume.sum(), rel=1e-9)


@pytest.mark.parametrize("name", ["helsinki_center.osm.pbf", "monaco.osm.pbf", "berlin_neukoelln.osm.gz"])
def test_no_building_and_no_area_vanishes_without_a_problem(shared_osm, name):
    osm = read_osm(shared_osm(name))
    west, south, east, north = osm.bounds
    frame = Frame.at((west + east) / 2, (south + north) / 2)
    table, problems = read_buildings(osm, frame)
    reported = {p.osm_id for p in problems}
    mapped = [a for a in osm.areas if is_building(a.tags) or is_building_part(a.tags)]
    assert {a.osm_id for a in mapped} <= reported | set(table.osm_id)
    quiet = [a for a in mapped if is_building(a.tags) and a.osm_id not in reported]
    built = table.footprint[table.drawn]
    tree = shapely.STRtree(built)
    for footprint in project(np.fromiter([a.geometry for a in quiet], object), frame):
        union = shapely.union_all(built[tree.query(footprint)])
        assert shapely.area(shapely.difference(footprint, union)) < BuildingOptions().min_area


def test_the_victory_column_is_one_body_of_stacked_parts(shared_osm):
    table, mesh, _ = scene(shared_osm("berlin_siegessaeule.osm.gz"))
    parts = np.bincount(table.outline[table.is_part], minlength=table.count)
    column = int(np.argmax(parts))
    z = mesh.take(mesh.feature == column).vertices[:, 2]
    assert parts[column] > 100
    assert z.max() == pytest.approx(58.59, abs=0.01)
    # the drum's open colonnade: at half its height there is less than at its foot
    verdict = validate_mesh(mesh)
    assert 2000 < verdict.volume[verdict.feature.tolist().index(column)] < 20000


def test_the_ostankino_tower_is_540_metres_high_and_slender(shared_osm):
    table, mesh, _ = scene(shared_osm("moscow_ostankino.osm.gz"))
    tower = int(np.argmax(table.height[: table.count]))
    assert table.name[tower] == "Останкинская телевизионная башня"
    assert table.height[tower] == 540.0
    body = mesh.take(mesh.feature == tower)
    assert body.vertices[:, 2].max() == 540.0
    widths = [np.ptp(body.vertices[np.abs(body.vertices[:, 2] - z) < 15][:, 0]) for z in (10, 150, 500)]
    assert widths == sorted(widths, reverse=True)
    assert widths[-1] < 10
