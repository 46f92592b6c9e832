"""Rasters of maps: each cell is made of the points in it, north up, in the map's CRS."""

import numpy as np
import pytest
import rasterio
from hypothesis import given, settings
from hypothesis import strategies as st
from pyproj import CRS

from geoscene.classes import Class
from lidar.errors import InputError
from lidar.options.maps import RASTERS, MapOptions
from lidar.tools.maps.rasters import Rasters

UTM = CRS.from_epsg(32635)
EAST, NORTH = 385_000.0, 6_671_000.0


def table(rng, count, *, wide=40.0):
    return {
        "x": EAST + rng.uniform(-wide, wide, count),
        "y": NORTH + rng.uniform(-wide, wide / 2, count),
        "z": rng.uniform(-5, 30, count),
        "intensity": rng.uniform(0, 255, count).astype(np.float32),
        "label": rng.choice([Class.ROAD, Class.BUILDING, Class.WATER], count).astype(np.uint8),
    }


def written(tables, folder, *, resolution):
    rasters = Rasters(RASTERS, resolution)
    list(rasters.measured(iter(tables)))
    return {path.suffixes[0][1:]: path for path in rasters.write(folder / "m.laz", crs=UTM)}


@settings(max_examples=6)
@given(seed=st.integers(0, 2**32 - 1), resolution=st.sampled_from([0.5, 0.3, 2.0, 25.0]))
def test_each_cell_is_made_of_the_points_in_it(tmp_path_factory, seed, resolution):
    rng = np.random.default_rng(seed)
    tables = [table(rng, 300), table(rng, 1), table(rng, 500)]
    paths = written(tables, tmp_path_factory.mktemp("r"), resolution=resolution)
    whole = {k: np.concatenate([t[k] for t in tables]) for k in tables[0]}
    read = {}
    for kind, path in paths.items():
        with rasterio.open(path) as raster:
            assert raster.crs.to_epsg() == 32635
            assert raster.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
            row, column = rasterio.transform.rowcol(raster.transform, whole["x"], whole["y"])
            read[kind] = raster.read(1, masked=True)
            west, _, _, north = raster.bounds
    cells = np.stack([row, column], axis=1)
    assert west <= whole["x"].min() < west + resolution * (1 + 1e-9)
    assert north - resolution * (1 + 1e-9) <= whole["y"].max() <= north
    for cell in np.unique(cells, axis=0)[:60]:
        mine = (cells == cell).all(axis=1)
        at = tuple(cell)
        ground = mine & (whole["label"] == Class.ROAD)
        assert read["dsm"][at] == pytest.approx(whole["z"][mine].max(), abs=1e-4)
        assert read["density"][at] == pytest.approx(mine.sum() / resolution**2, rel=1e-5)
        assert read["intensity"][at] == pytest.approx(whole["intensity"][mine].mean(), rel=1e-4)
        assert read["dtm"].mask[at] == (not ground.any())
        if ground.any():
            assert read["dtm"][at] == pytest.approx(whole["z"][ground].mean(), abs=1e-4)
    assert read["dsm"].count() == len(np.unique(cells, axis=0)) == read["density"].count()


def test_a_map_without_points_has_no_rasters(tmp_path):
    empty = {k: v[:0] for k, v in table(np.random.default_rng(0), 3).items()}
    assert written([empty], tmp_path, resolution=0.5) == {}
    assert list(tmp_path.iterdir()) == []


def test_rasters_that_no_file_can_hold_are_refused(tmp_path):
    one = table(np.random.default_rng(0), 2, wide=30_000.0)
    one["x"][:], one["y"][:] = [EAST, EAST + 6e4], [NORTH, NORTH + 6e4]
    with pytest.raises(InputError, match="`resolution`"):
        written([one], tmp_path, resolution=0.5)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"raster": ("dsn",)}, "`raster` 'dsn'"),
        ({"resolution": 0.0}, "`resolution` 0"),
        ({"resolution": float("nan")}, "nan"),
    ],
)
def test_bad_options_of_rasters_are_named(change, words):
    with pytest.raises(InputError, match=words):
        MapOptions(**change)
