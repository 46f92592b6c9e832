"""Heights are interpolated bilinearly between posts, for any CRS, unit and tiling of the elevation model."""

import pickle
import zipfile

import numpy as np
import pytest
import rasterio
import shapely
from pyproj import Transformer
from rasterio.transform import Affine

from geoscene.errors import InputError, SourceNotFoundError
from geoscene.geometry.frames import Frame
from geoscene.ground.terrain import Terrain, base_heights, open_terrain

FRAME = Frame.at(9.0, 50.0)
BOUNDS = (-200.0, -200.0, 200.0, 200.0)
UTM = "EPSG:32632"  # 9 E is its meridian: easting 500,000


def write_dem(path, values, *, corner, step=25.0, crs=UTM, nodata=None, unit=None, dtype="float32"):
    """A north-up GeoTIFF with its upper left corner at ``corner``."""
    values = np.asarray(values, dtype)
    with rasterio.open(
        path, "w", driver="GTiff", width=values.shape[1], height=values.shape[0], count=1, dtype=dtype,
        crs=crs, transform=Affine(step, 0, corner[0], 0, -step, corner[1]), nodata=nodata,
    ) as target:  # fmt: skip
        target.write(values, 1)
        if unit:
            target.units = [unit]
    return path


def posts(corner, shape, step=25.0):
    rows, columns = np.indices(shape)
    return corner[0] + (columns + 0.5) * step, corner[1] - (rows + 0.5) * step


def around(shape=(60, 60), step=25.0):
    """The upper left corner of a raster of this shape centred on the frame's centre."""
    east, north = FRAME.to_crs(0.0, 0.0, crs=UTM)
    return float(east) - shape[1] * step / 2 + 3.7, float(north) + shape[0] * step / 2 - 8.1


def sample(count=500, seed=0):
    return np.random.default_rng(seed).uniform(-200, 200, (2, count))


@pytest.mark.parametrize(("posted", "reach"), [(60, 200.0), (10, 100.0)])
def test_interpolated_heights_of_a_plane_are_exact(tmp_path, posted, reach):
    """Bilinear interpolation reproduces a plane to float32 precision, up to the outermost posts."""
    corner = around((posted, posted))
    east, north = posts(corner, (posted, posted))
    path = write_dem(
        tmp_path / "a.tif", 100 + 0.1 * (east - 500000) - 0.05 * (north - 5538000), corner=corner
    )
    terrain = open_terrain([path], FRAME, bounds=(-reach, -reach, reach, reach))
    x, y = np.random.default_rng(0).uniform(-reach, reach, (2, 500))
    e, n = FRAME.to_crs(x, y, crs=UTM)
    np.testing.assert_allclose(
        terrain.height(x, y), 100 + 0.1 * (e - 500000) - 0.05 * (n - 5538000), atol=1e-4
    )
    assert terrain.spacing == pytest.approx(25.0, rel=1e-3)
    assert terrain.vertical == "orthometric"


def test_height_between_four_posts_is_bilinear(tmp_path):
    corner = around((4, 4))
    values = np.zeros((4, 4))
    values[1, 1], values[1, 2], values[2, 1], values[2, 2] = 10, 20, 30, 80
    path = write_dem(tmp_path / "a.tif", values, corner=corner)
    e, n = (grid[1, 1] for grid in posts(corner, (4, 4)))
    u, v = 0.25, 0.6
    x, y = FRAME.from_crs(e + u * 25, n - v * 25, crs=UTM)
    terrain = open_terrain([path], FRAME, bounds=(-20, -20, 20, 20))
    assert terrain.height(x, y) == pytest.approx(
        10 * 0.75 * 0.4 + 20 * 0.25 * 0.4 + 30 * 0.75 * 0.6 + 80 * 0.25 * 0.6
    )


@pytest.mark.full
def test_tiles_of_one_model_equal_one_raster_in_any_order(tmp_path):
    """The strip between the last posts of one tile and the first of the next is interpolated, too."""
    corner = around()
    values = np.random.default_rng(1).uniform(0, 50, (60, 60))
    whole = write_dem(tmp_path / "whole.tif", values, corner=corner)
    middle = corner[0] + 30 * 25.0
    left = write_dem(tmp_path / "left.tif", values[:, :30], corner=corner)
    right = write_dem(tmp_path / "right.tif", values[:, 30:], corner=(middle, corner[1]))
    x, y = sample(3000)
    assert (np.abs(FRAME.to_crs(x, y, crs=UTM)[0] - middle) < 12).sum() > 50
    expected = open_terrain([whole], FRAME, bounds=BOUNDS).height(x, y)
    for order in ([left, right], [right, left]):
        np.testing.assert_allclose(
            open_terrain(order, FRAME, bounds=BOUNDS).height(x, y), expected, atol=1e-9
        )


def test_a_finer_model_takes_precedence_over_a_coarser_one(tmp_path):
    coarse = write_dem(tmp_path / "coarse.tif", np.full((60, 60), 5.0), corner=around())
    shape = (10, 10)
    fine = write_dem(tmp_path / "fine.tif", np.full(shape, 9.0), corner=around(shape, 10.0), step=10.0)
    terrain = open_terrain([coarse, fine], FRAME, bounds=BOUNDS)
    np.testing.assert_allclose(terrain.height([0.0, 150.0], [0.0, 150.0]), [9.0, 5.0])
    assert terrain.spacing == pytest.approx(10.0, rel=1e-3)


def test_voids_are_filled_from_their_surroundings_and_counted(tmp_path):
    corner = around()
    east, _ = posts(corner, (60, 60))
    slope = 0.1 * (east - 500000) + 300
    values = slope.copy()
    values[28:32, 28:32] = -9999
    values[35, 35] = np.nan
    values[33, 25] = 3e38  # a void that nothing marks
    path = write_dem(tmp_path / "a.tif", values, corner=corner, nodata=-9999)
    terrain = open_terrain([path], FRAME, bounds=BOUNDS)
    assert terrain.voids == 18
    x, y = sample(2000)
    expected = 0.1 * (FRAME.to_crs(x, y, crs=UTM)[0] - 500000) + 300
    assert np.abs(terrain.height(x, y) - expected).max() < 5.0


@pytest.mark.parametrize("spike", [8000.0, -400.0])
@pytest.mark.parametrize("width", [1, 4])
def test_spikes_are_filled_from_their_surroundings_and_listed(spike, width, tmp_path):
    corner = around()
    east, north = posts(corner, (60, 60))
    values = 300 + 0.1 * (east - 500000) + 20 * np.sin(north / 90)
    clean = open_terrain([write_dem(tmp_path / "a.tif", values, corner=corner)], FRAME, bounds=BOUNDS)
    assert clean.problems == ()
    values[28 : 28 + width, 30 : 30 + width] = spike
    terrain = open_terrain([write_dem(tmp_path / "b.tif", values, corner=corner)], FRAME, bounds=BOUNDS)
    x, y = sample()
    assert np.abs(terrain.height(x, y) - clean.height(x, y)).max() < 20 * width
    (problem,) = terrain.problems
    assert (problem.kind, problem.action, problem.reason) == ("terrain", "repaired", "spike")
    assert problem.detail.startswith(f"b.tif: {width**2} of ")


def test_cliffs_and_buttes_are_no_spikes(tmp_path):
    corner = around()
    values = np.zeros((60, 60))
    values[:, 30:] = 900.0  # a wall
    values[25:30, 20:25] = 400.0  # a butte, 125 m wide
    terrain = open_terrain([write_dem(tmp_path / "a.tif", values, corner=corner)], FRAME, bounds=BOUNDS)
    assert terrain.problems == ()


def test_voids_and_uncovered_ground_are_listed(tmp_path):
    corner = around()
    values = np.full((60, 60), 100.0)
    values[20:40, 20:40] = -9999.0
    path = write_dem(tmp_path / "a.tif", values, corner=corner, nodata=-9999.0)
    terrain = open_terrain([path], FRAME, bounds=BOUNDS)
    (problem,) = terrain.problems
    assert problem.reason == "void"
    assert problem.detail == "a.tif: 400 of 576 posts, up to 250 m from a height; filled from around"
    values[:] = 100.0
    terrain = open_terrain(
        [write_dem(tmp_path / "b.tif", values, corner=(corner[0] + 600, corner[1]))],
        FRAME,
        bounds=BOUNDS,
        outside="nearest",
    )
    assert [problem.reason for problem in terrain.problems] == ["uncovered"]


@pytest.mark.parametrize("crs", ["EPSG:4326", "EPSG:3857"])
def test_rasters_on_both_sides_of_180_degrees_meet(crs, tmp_path):
    frame = Frame.at(180.0, -16.8)
    west = Transformer.from_crs(4326, crs, always_xy=True)
    step = 0.0005 if crs == "EPSG:4326" else 60.0
    paths = []
    for name, lon in (("west", 180.0 - 0.02), ("east", -180.0)):
        left, top = west.transform(lon, -16.79)
        columns = round((west.transform(180.0, 0)[0] - west.transform(179.98, 0)[0]) / step)
        offset = 0 if name == "west" else columns
        left = left if name == "east" else west.transform(180.0, 0)[0] - columns * step
        values = np.tile(np.arange(columns) + offset, (60, 1))
        paths.append(write_dem(tmp_path / f"{name}.tif", values, corner=(left, top), step=step, crs=crs))
    terrain = open_terrain(paths, frame, bounds=BOUNDS)
    assert max(grid.values.size for grid in terrain.grids) < 5000
    x = np.linspace(-200, 200, 81)
    np.testing.assert_allclose(np.diff(terrain.height(x, 0 * x)), 5 / terrain.spacing, rtol=1e-3)


@pytest.mark.full
@pytest.mark.parametrize(("unit", "factor"), [("ft", 0.3048), ("us-ft", 1200 / 3937), ("m", 1.0)])
def test_feet_become_metres(tmp_path, unit, factor):
    path = write_dem(tmp_path / "a.tif", np.full((60, 60), 1000.0), corner=around(), unit=unit)
    assert open_terrain([path], FRAME, bounds=BOUNDS).height(0, 0) == pytest.approx(1000 * factor)
    silent = write_dem(tmp_path / "b.tif", np.full((60, 60), 1000.0), corner=around())
    assert open_terrain([silent], FRAME, bounds=BOUNDS, unit=unit).height(0, 0) == pytest.approx(
        1000 * factor
    )


def test_a_vertical_crs_gives_datum_and_unit(tmp_path):
    values = np.full((60, 60), 100.0)
    navd = write_dem(tmp_path / "navd.tif", values, corner=around(), crs="EPSG:32632+6360")  # NAVD88, US feet
    terrain = open_terrain([navd], FRAME, bounds=BOUNDS)
    assert (terrain.vertical, terrain.datum) == ("orthometric", "NAVD88 height (ftUS)")
    assert terrain.height(0, 0) == pytest.approx(100 * 1200 / 3937)
    told = open_terrain([navd], FRAME, bounds=BOUNDS, vertical="ellipsoidal")
    assert told.vertical == "ellipsoidal"


def test_incomplete_coverage_is_an_error_or_filled_with_the_nearest_height(tmp_path):
    corner = around()
    east, _ = posts(corner, (60, 20))  # its eastern edge is 250 m west of the raster's middle
    path = write_dem(tmp_path / "a.tif", east - 499000, corner=corner)
    bounds = (-350.0, -200.0, 50.0, 200.0)
    with pytest.raises(
        InputError, match=r"a\.tif: 7\d\.\d % of the scene is not covered.*W 8\.99.*`dem_gaps` nearest"
    ):
        open_terrain([path], FRAME, bounds=bounds)
    terrain = open_terrain([path], FRAME, bounds=bounds, outside="nearest")
    edge = corner[0] + 20 * 25
    west = FRAME.to_crs(bounds[0], 0, crs=UTM)[0]
    assert terrain.uncovered == pytest.approx(1 - (edge - west) / 400, abs=1e-3)
    assert terrain.height(40, 0) == pytest.approx(east.max() - 499000)
    with pytest.raises(InputError, match=r"no part of the scene is covered.*add files that cover it$"):
        open_terrain([path], FRAME, bounds=(500, 0, 600, 100), outside="nearest")


def test_unusable_files_are_named_in_the_error(tmp_path):
    with pytest.raises(SourceNotFoundError, match=r"none\.tif"):
        open_terrain([tmp_path / "none.tif"], FRAME, bounds=BOUNDS)
    text = tmp_path / "text.tif"
    text.write_text("not a raster")
    with pytest.raises(InputError, match=r"text\.tif: damaged"):
        open_terrain([text], FRAME, bounds=BOUNDS)
    bad_zip = tmp_path / "bad.hgt.zip"
    bad_zip.write_text("not an archive")
    with pytest.raises(InputError, match="not a zip"):
        open_terrain([bad_zip], FRAME, bounds=BOUNDS)
    empty = tmp_path / "empty.zip"
    with zipfile.ZipFile(empty, "w"):
        pass
    with pytest.raises(InputError, match="0 rasters"):
        open_terrain([empty], FRAME, bounds=BOUNDS)
    nowhere = write_dem(tmp_path / "nowhere.tif", np.zeros((60, 60)), corner=around(), crs=None)
    with pytest.raises(InputError, match="no CRS"):
        open_terrain([nowhere], FRAME, bounds=BOUNDS)
    odd = write_dem(tmp_path / "odd.tif", np.zeros((60, 60)), corner=around(), unit="fathom")
    with pytest.raises(InputError, match="fathom"):
        open_terrain([odd], FRAME, bounds=BOUNDS)
    site = 'LOCAL_CS["site",UNIT["metre",1],AXIS["Easting",EAST],AXIS["Northing",NORTH]]'
    local = write_dem(tmp_path / "local.tif", np.zeros((60, 60)), corner=around(), crs=site)
    with pytest.raises(InputError, match=r"local\.tif: its CRS cannot be transformed"):
        open_terrain([local], FRAME, bounds=BOUNDS)
    wide = write_dem(tmp_path / "wide.tif", np.zeros((60, 60)), corner=(9.0, 50.0), step=1e9, crs="EPSG:4326")
    with pytest.raises(InputError, match=r"wide\.tif: has pixels outside"):
        open_terrain([wide], FRAME, bounds=BOUNDS)
    void = write_dem(tmp_path / "void.tif", np.full((60, 60), -1.0), corner=around(), nodata=-1)
    with pytest.raises(InputError, match="only voids"):
        open_terrain([void], FRAME, bounds=BOUNDS)


def test_a_terrain_can_be_pickled(tmp_path):
    path = write_dem(tmp_path / "a.tif", np.random.default_rng(2).uniform(0, 9, (60, 60)), corner=around())
    terrain = open_terrain([path], FRAME, bounds=BOUNDS)
    x, y = sample(50)
    before = terrain.height(x, y)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(terrain)).height(x, y), before)  # noqa: S301


def test_flat_terrain_has_height_zero():
    terrain = Terrain(FRAME)
    assert (terrain.height(np.zeros((2, 3)), 7.0) == np.zeros((2, 3))).all()
    assert terrain.vertical == "flat"
    assert terrain.lines == 0.0


def test_a_building_stands_on_the_lowest_ground_along_its_outline(tmp_path):
    corner = around()
    east, _ = posts(corner, (60, 60))
    path = write_dem(tmp_path / "a.tif", np.abs(east - east[0, 30]), corner=corner)
    terrain = open_terrain([path], FRAME, bounds=BOUNDS)
    x0 = float(FRAME.from_crs(east[0, 30], FRAME.to_crs(0, 0, crs=UTM)[1], crs=UTM)[0])
    across = shapely.box(x0 - 30, -10, x0 + 50, 10)  # no corner lies in the valley, its sides cross it
    base = base_heights([across, None, shapely.box(x0 + 20, 0, x0 + 30, 5)], terrain.height)
    assert base[0] == pytest.approx(0.0, abs=1.1)
    assert np.isnan(base[1])
    assert base[2] == pytest.approx(20.0, abs=0.1)


SPOTS = [
    ("N43E007.hgt.zip", 7.42, 43.735, 19),
    ("N43E007.hgt.zip", 7.41, 43.74, 225),
    ("heidelberg_srtm3_utm32n.tif", 8.71, 49.412, 132),
    ("N49E011.hgt.zip", 11.58, 49.985, 413),
    ("N50E011.hgt.zip", 11.55, 50.02, 360),
]


@pytest.mark.shared
@pytest.mark.parametrize(("name", "lon", "lat", "metres"), SPOTS)
def test_known_heights_of_real_places(shared_dem, name, lon, lat, metres):
    terrain = open_terrain([shared_dem(name)], Frame.at(lon, lat), bounds=(-100, -100, 100, 100))
    assert terrain.height(0, 0) == pytest.approx(metres, abs=0.5)


@pytest.mark.shared
def test_two_srtm_tiles_meet_without_a_seam_at_50_north(shared_dem):
    """Height differences along a line are as small across the tiles' border as elsewhere."""
    frame = Frame.at(11.55, 50.0)
    paths = [shared_dem("N49E011.hgt.zip"), shared_dem("N50E011.hgt.zip")]
    terrain = open_terrain(paths, frame, bounds=(-1500, -1500, 1500, 1500))
    assert len(terrain.grids) == 1
    assert (terrain.vertical, terrain.datum) == ("orthometric", "EGM96")
    x, y = np.meshgrid(np.linspace(-1400, 1400, 30), np.arange(-200, 200, 1.0))
    step = np.abs(np.diff(terrain.height(x, y), axis=0))
    assert step.max() < 0.5
    with pytest.raises(InputError, match=r"48\.\d % of the scene is not covered"):
        open_terrain(paths[:1], frame, bounds=(-1500, -1500, 1500, 1500))


def test_a_format_that_names_other_files_is_refused(tmp_path):
    """GDAL recognises a VRT by its contents, and reads it from where it says, such as the network."""
    source = tmp_path / "heights.tif"
    source.write_text(
        '<VRTDataset rasterXSize="9" rasterYSize="9"><SRS>EPSG:4326</SRS>'
        "<GeoTransform>24.9, 0.01, 0, 60.2, 0, -0.01</GeoTransform>"
        '<VRTRasterBand dataType="Float32" band="1"><SimpleSource>'
        "<SourceFilename>/vsicurl/http://127.0.0.1:9/a.tif</SourceFilename><SourceBand>1</SourceBand>"
        "</SimpleSource></VRTRasterBand></VRTDataset>"
    )
    with pytest.raises(InputError, match=r"heights\.tif: damaged .*give GeoTIFF or \.hgt"):
        open_terrain([source], Frame.at(24.945, 60.168), bounds=(-100, -100, 100, 100))
