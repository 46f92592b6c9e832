"""Comparison of builds: errors and costs of settings against the full scene."""

import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import rasterio
from helpers.pages import text_of
from helpers.programs import run_program
from PIL import Image

from geoscene.errors import InputError
from geoscene.options import BuildOptions
from geoscene.sources import demo_path, read_osm
from geoscene.tradeoff.engine import BuildCost, BuildRow, BuildTradeoff, coarse_elevation, tradeoff, variants
from geoscene.tradeoff.report import document, pareto, recommendations, write_report

BOX = (24.9400, 60.1660, 24.9430, 60.1675)


@pytest.fixture(scope="module")
def found():
    """Levels of detail and kinds of features in a few blocks of the demo map."""
    return tradeoff(partial(read_osm, demo_path(), bounds=BOX), BuildOptions(), settings=("lod", "for"))


@pytest.mark.full
def test_errors_are_against_the_full_scene_and_ordered(found):
    rows = {row.label: row for row in found.rows}
    full = rows["full scene"]
    assert not any(full.error.values())
    assert not full.missing
    assert rows["lod=1"].error["height_rms_m"] < rows["lod=0"].error["height_rms_m"]
    assert rows["lod=0"].error["height_max_m"] > 1
    assert rows["lod=0"].error["area"] == 0
    assert rows["for=lidar"].error["height_max_m"] == 0
    assert rows["for=lidar"].cost.bytes < rows["for=camera"].cost.bytes < full.cost.bytes
    assert rows["for=map"].error == {}
    assert rows["for=map"].missing["solids of buildings"] > 10
    for row in found.rows:
        assert 0.1 < row.cost.cpu_s < 100
        assert 2e7 < row.cost.memory_bytes < 4e9


@pytest.mark.full
def test_report_has_table_plot_page_and_document(found, tmp_path):
    write_report(found, tmp_path)
    assert json.loads((tmp_path / "tradeoff.json").read_text()) == json.loads(json.dumps(document(found)))
    page = (tmp_path / "tradeoff.html").read_text()
    assert all(row.label in page for row in found.rows)
    assert "http" not in text_of(page)
    with Image.open(tmp_path / "pareto.png") as picture:
        assert picture.size == (1100, 700)
        assert len(np.unique(np.asarray(picture.convert("RGB")).reshape(-1, 3), axis=0)) > 3


def row(label, cpu, rms, **missing):
    error = {"height_rms_m": rms, "height_99_m": 3 * rms, "height_max_m": 9 * rms}
    return BuildRow(label, (BuildCost(cpu, 10**8, 10**6),), error, missing)


def test_recommendations_name_the_cheapest_that_is_enough():
    some = (row("a", 4.0, 0.05), row("b", 5.0, 0.06), row("c", 2.0, 0.5, trees=3), row("d", 8.5, 0.001))
    compared = BuildTradeoff("here", 1.0, (row("full scene", 9.0, 0.0), *some))
    assert [r.label for r in pareto(compared)] == ["c", "a", "d", "full scene"]
    centimetre, decimetre, metre = recommendations(compared)
    assert "no setting that was compared saves 10 %" in centimetre
    assert "cheapest setting is a: 4 instead of 9 CPU s" in decimetre
    assert "cheapest setting is c" in metre
    assert "without trees" in metre


def test_variants_change_one_setting_of_the_full_scene():
    base = BuildOptions(crs="utm")
    assert {v.options.crs for v in variants(base, ())} == {"utm"}
    assert not [v for v in variants(base, ()) if v.label.startswith("terrain")]
    labels = [v.label for v in variants(replace(base, dem=("a.tif",)), ("terrain",))]
    assert labels == ["terrain=2 x 2 posts", "terrain=4 x 4 posts", "terrain=8 x 8 posts", "terrain=level"]
    assert [v.label for v in variants(base, ("relief",))] == ["relief=off", "relief=full"]
    with pytest.raises(InputError, match=r"`settings` 'rays' is unknown .known are lod, relief"):
        variants(base, ("rays",))
    with pytest.raises(InputError, match="terrain: needs `dem`"):
        variants(base, ("terrain",))
    for change in ({"lod": 1}, {"only": ("roads",)}, {"use": "gis"}):
        with pytest.raises(InputError, match="are compared"):
            variants(replace(base, **change), ())


def test_coarse_elevation_averages_posts_and_keeps_voids(tmp_path):
    values = np.arange(64, dtype=np.float32).reshape(8, 8)
    values[:2, :2] = -9999
    path = tmp_path / "dem.tif"
    profile = {"driver": "GTiff", "count": 1, "width": 8, "height": 8, "dtype": "float32", "nodata": -9999}
    place = rasterio.Affine(30, 0, 500000, 0, -30, 6000000)
    with rasterio.open(path, "w", **profile, crs="EPSG:32632", transform=place) as out:
        out.write(values, 1)
    with rasterio.open(coarse_elevation(path, tmp_path / "coarse.tif", factor=2)) as coarse:
        assert coarse.shape == (4, 4)
        assert coarse.bounds == rasterio.coords.BoundingBox(500000, 5999760, 500240, 6000000)
        read = coarse.read(1, masked=True)
    assert read.mask.sum() == 1
    assert read[3, 3] == values[6:, 6:].mean()


def test_command_refuses_unknown_settings_and_existing_folders(tmp_path):
    for words in (["--settings", "rays"], ["--lod", "1"], ["--dem", "tiles"], ["-o", tmp_path]):
        done = run_program("geoscene", "tradeoff", "--demo", *words)
        assert done.returncode == 2
        assert len(done.stderr.splitlines()) == 1
