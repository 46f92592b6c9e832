"""Buildings of Overture Maps: those of the demo extract in Overture's schema, and rows with defects."""

import json
import sys

import numpy as np
import pyarrow as pa
import pytest
import shapely
from helpers.overture import overture_row, write_overture
from helpers.programs import run_program
from pyarrow import parquet
from pyproj import CRS

from geoscene.buildings import read_buildings
from geoscene.errors import InputError, MissingExtraError, SourceNotFoundError
from geoscene.geometry.frames import Frame
from geoscene.sources import SOURCES, credits_of, demo_path, merge_sources, read_osm, read_source
from geoscene.sources.data import is_building
from geoscene.sources.registry import reader_of

BLOCK = "POLYGON ((24.940 60.166, 24.941 60.166, 24.941 60.167, 24.940 60.167, 24.940 60.166))"


@pytest.fixture(scope="module")
def osm():
    return read_osm(demo_path())


@pytest.fixture(scope="module")
def demo(osm, tmp_path_factory):
    rows = [overture_row(a) for a in osm.areas if a.tags.get("building", "no") != "no"]
    return write_overture(tmp_path_factory.mktemp("overture") / "demo.parquet", rows)


def test_real_buildings_are_read_as_from_openstreetmap(osm, demo):
    data = read_source("overture", demo)
    frame = Frame.at(24.945, 60.168)
    plain = [a for a in osm.areas if a.tags.get("building", "no") != "no"]
    alone = osm.__class__(osm.bounds, [], plain, [], [])
    ours, theirs = (read_buildings(d, frame)[0] for d in (alone, data))
    ids = {f"overture:id-of-{i.replace('/', '-')}": k for k, i in enumerate(ours.osm_id)}
    assert len(theirs) > 100
    assert sum(i in ids for i in theirs.osm_id) > 0.98 * len(ours)
    assert theirs.osm_id.tolist() == sorted(theirs.osm_id)
    compared = [(row, ids[i]) for row, i in enumerate(theirs.osm_id) if i in ids]
    tagged = [(row, same) for row, same in compared if ours.height_source[same] == "tag"]
    assert len(tagged) > 5
    assert all(theirs.height[row] == pytest.approx(ours.height[same], rel=1e-6) for row, same in tagged)
    assert all(np.isclose(theirs.levels[r], int(ours.levels[s])) for r, s in compared if ours.levels[s] >= 0)
    for column in ("roof_shape", "wall_color", "wall_material", "use", "name"):
        mine, other = getattr(ours, column), getattr(theirs, column)
        assert all(np.array_equal(other[row], mine[same]) for row, same in compared), column


def test_buildings_replace_those_of_a_map(osm, demo):
    both = merge_sources(osm, read_source("overture", demo, bounds=osm.bounds))
    assert both.bounds == osm.bounds
    assert both.ways == osm.ways
    built = [a.osm_id for a in both.areas if is_building(a.tags)]
    assert len(built) > 100
    assert all(i.startswith("overture:") for i in built)
    assert [a for a in both.areas if not is_building(a.tags)] == [
        a for a in osm.areas if not is_building(a.tags)
    ]
    assert [c.kind for c in credits_of(both)] == ["osm", "overture"]
    assert both.digest != osm.digest


def test_bounds_keep_intersecting_buildings_whole(demo):
    every = read_source("overture", demo)
    box = (24.944, 60.167, 24.946, 60.168)
    some = read_source("overture", demo, bounds=box)
    assert some.bounds == box
    expected = [a.osm_id for a in every.areas if a.geometry.intersects(shapely.box(*box))]
    assert [a.osm_id for a in some.areas] == expected
    with pytest.raises(SourceNotFoundError, match="no buildings in it within the bounds"):
        read_source("overture", demo, bounds=(1.0, 1.0, 2.0, 2.0))


def test_a_building_of_impossible_length_is_dropped(tmp_path):
    rows = [
        {"id": "a", "geometry": shapely.box(24.94, 60.0, 24.941, 60.0005)},
        {"id": "b", "geometry": shapely.Polygon([(24.95, 60.0), (24.951, 0.0), (24.951, 60.0005)])},
    ]
    data = read_source("overture", write_overture(tmp_path / "b.parquet", rows))
    assert data.bounds == pytest.approx((24.94, 60.0, 24.941, 60.0005))
    assert [(p.osm_id, p.action, p.reason, p.detail) for p in data.problems] == [
        ("overture:b", "dropped", "bad-coordinates", "6,672 km long")
    ]


def test_a_stray_building_does_not_stretch_the_bounds(tmp_path):
    rows = [
        {"id": str(k), "geometry": shapely.box(24.94, 60 + k / 1e3, 24.941, 60.0005 + k / 1e3)}
        for k in range(9)
    ]
    rows.append({"id": "stray", "geometry": shapely.box(0.0, 60.0, 0.001, 60.001)})
    data = read_source("overture", write_overture(tmp_path / "b.parquet", rows))
    assert data.bounds == pytest.approx((24.94, 60.0, 24.941, 60.0085))
    assert len(data.areas) == 9
    assert [(p.osm_id, p.action, p.reason) for p in data.problems] == [
        ("overture:stray", "dropped", "far-away")
    ]


@pytest.mark.parametrize("bounds", [None, (179.99, -17.0, -179.99, -16.9)])
def test_buildings_on_both_sides_of_180_degrees_are_neighbours(bounds, tmp_path):
    west = {"id": "a", "geometry": shapely.box(179.998, -16.95, 179.999, -16.949)}
    east = {"id": "b", "geometry": shapely.box(-179.999, -16.95, -179.998, -16.949)}
    data = read_source("overture", write_overture(tmp_path / "b.parquet", [west, east]), bounds=bounds)
    assert [area.geometry.bounds[0] for area in data.areas] == pytest.approx([179.998, 180.001])
    assert data.bounds[2] == pytest.approx(180.01 if bounds else 180.002)


def test_all_columns_become_tags(tmp_path):
    row = {
        "id": "a", "geometry": BLOCK, "names": {"primary": "Hall"}, "subtype": "education", "height": 12.5,
        "num_floors": 3, "min_height": 2.0, "min_floor": 1, "roof_height": 3.25, "roof_direction": 90.0,
        "facade_color": "#aabbcc", "facade_material": "brick", "roof_color": "#112233",
        "roof_shape": "half_hipped", "roof_material": "slate", "roof_orientation": "across",
        "is_underground": True,
    }  # fmt: skip
    (area,) = read_source("overture", write_overture(tmp_path / "a.parquet", [row])).areas
    assert area.tags == {
        "building": "education", "name": "Hall", "height": "12.5", "building:levels": "3",
        "min_height": "2.0", "building:min_level": "1", "roof:height": "3.25", "roof:direction": "90.0",
        "building:colour": "#aabbcc", "building:material": "brick", "roof:colour": "#112233",
        "roof:shape": "half_hipped", "roof:material": "slate", "roof:orientation": "across",
        "location": "underground",
    }  # fmt: skip
    table, problems = read_buildings(read_source("overture", tmp_path / "a.parquet"), Frame.at(24.94, 60.17))
    assert len(table) == 0
    assert [(p.osm_id, p.reason) for p in problems] == [("overture:a", "underground")]


def test_odd_rows_are_repaired_or_dropped_and_listed(tmp_path):
    two = "MULTIPOLYGON (((0 0, 1e-3 0, 1e-3 1e-3, 0 1e-3, 0 0)), ((2e-3 0, 3e-3 0, 3e-3 1e-3, 2e-3 0)))"
    rows = [
        {"id": "plain", "geometry": "POLYGON ((0 0, 0 1e-3, 1e-3 1e-3, 1e-3 0, 0 0))", "class": "zeppelin"},
        {"id": "multi", "geometry": two},
        {"id": "z", "geometry": "POLYGON Z ((0 0 9, 1e-3 0 9, 1e-3 1e-3 9, 0 0 9))"},
        {"id": "bow", "geometry": "POLYGON ((0 0, 1e-3 1e-3, 1e-3 0, 0 1e-3, 0 0))"},
        {"id": "null", "geometry": None},
        {"id": "noise", "geometry": b"no wkb"},
        {"id": "empty", "geometry": "POLYGON EMPTY", "bbox": None},
        {"id": "line", "geometry": "LINESTRING (0 0, 1e-3 1e-3)"},
        {"id": "metres", "geometry": "POLYGON ((500000 0, 500010 0, 500010 10, 500000 0))"},
    ]
    data = read_source("overture", write_overture(tmp_path / "a.parquet", rows))
    areas = {a.osm_id.removeprefix("overture:"): a for a in data.areas}
    assert sorted(areas) == ["bow", "multi", "plain", "z"]
    assert areas["plain"].tags == {"building": "zeppelin"}
    assert shapely.is_ccw(areas["plain"].geometry.exterior)
    assert areas["multi"].geometry.geom_type == "MultiPolygon"
    assert not any(a.geometry.has_z for a in data.areas)
    assert all(a.geometry.is_valid for a in data.areas)
    assert [(p.osm_id.removeprefix("overture:"), p.action, p.reason) for p in data.problems] == [
        ("bow", "repaired", "self-crossing"),
        ("empty", "dropped", "no-area"),
        ("line", "dropped", "no-area"),
        ("metres", "dropped", "bad-coordinates"),
        ("noise", "dropped", "no-area"),
        ("null", "dropped", "no-area"),
    ]
    near = read_source("overture", tmp_path / "a.parquet", bounds=(-1.0, -1.0, 2e-4, 2e-4))
    assert {p.osm_id for p in near.problems} >= {"overture:null", "overture:bow"}
    assert "overture:metres" not in {p.osm_id for p in near.problems}


def test_the_attribution_names_the_datasets(tmp_path):
    rows = [
        {"id": "a", "sources": [{"dataset": "OpenStreetMap"}, {"dataset": "Microsoft ML Buildings"}]},
        {"id": "b", "sources": [{"dataset": "Esri", "license": "CC-BY-4.0", "update_time": "2024-01-02"}]},
    ]
    rows = [row | {"geometry": BLOCK} for row in rows]
    data = read_source("overture", write_overture(tmp_path / "a.parquet", rows))
    (credit,) = credits_of(data)
    assert credit.licence == "ODbL-1.0"
    assert credit.timestamp == "2024-01-02"
    assert credit.attribution == (
        "(c) Overture Maps Foundation, https://overturemaps.org; buildings from Esri (CC-BY-4.0),"
        " Microsoft ML Buildings, OpenStreetMap contributors (ODbL-1.0)"
    )


def test_files_of_another_kind_are_refused_in_one_line(tmp_path, monkeypatch):
    with pytest.raises(SourceNotFoundError, match="no such file"):
        read_source("overture", tmp_path / "none.parquet")
    (tmp_path / "text.parquet").write_text("no parquet")
    with pytest.raises(InputError, match="damaged, or not Overture's GeoParquet"):
        read_source("overture", tmp_path / "text.parquet")
    parquet.write_table(pa.table({"id": ["a"]}), tmp_path / "bare.parquet")
    with pytest.raises(InputError, match="no column geometry"):
        read_source("overture", tmp_path / "bare.parquet")
    row = {"id": "a", "geometry": BLOCK}
    projected = {"type": "ProjectedCRS", "name": "x", "id": {"authority": "EPSG", "code": 3067}}
    for crs, refused in (
        (projected, True),
        (CRS(3067).to_json_dict(), True),
        (CRS(4326).to_json_dict(), False),
    ):
        path = write_overture(tmp_path / "crs.parquet", [row], geo={"crs": crs})
        if refused:
            with pytest.raises(InputError, match=r"longitude and latitude|damaged"):
                read_source("overture", path)
        else:
            assert len(read_source("overture", path).areas) == 1
    with pytest.raises(InputError, match="known are osm, overture"):
        read_source("maps", path)

    def refuse(*_args, **_options):
        raise pa.ArrowNotImplementedError("integers of 7 bits")

    monkeypatch.setattr("pyarrow.dataset.dataset", refuse)
    with pytest.raises(InputError, match="damaged, or not Overture's GeoParquet"):
        read_source("overture", path)
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(MissingExtraError, match=r"geoscene\[gis\]"):
        read_source("overture", path)


def test_every_row_of_the_registry_is_complete():
    for name, source in SOURCES.items():
        assert name == source.name
        assert source.licence
        assert source.attribution
        assert callable(reader_of(name))


@pytest.mark.full
@pytest.mark.parametrize("roads", [True, False])
def test_the_program_builds_with_buildings_of_overture(demo, tmp_path, roads):
    words = ["build", "--source", f"overture={demo}", "-o", tmp_path / "s", "--json"]
    words += ["--bbox", "24.944,60.1668,24.947,60.1680", *(["--demo"] if roads else [])]
    done = run_program("geoscene", *words)
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert report["counts"]["solids"] > 10
    assert (report["counts"]["road_km"] > 0) == roads
    assert [s["kind"] for s in report["sources"]] == (["osm", "overture"] if roads else ["overture"])
    assert all(s["licence"] == "ODbL-1.0" and s["attribution"] for s in report["sources"])
    assert "Overture Maps Foundation" in report["attribution"]
    assert ("https://www.openstreetmap.org/copyright" in report["attribution"]) == roads
