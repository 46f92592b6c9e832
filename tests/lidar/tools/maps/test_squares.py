"""The outlier filter of all points at once, whatever the squares, and maps in tiles."""

import shutil

import laspy
import numpy as np
import pyogrio
import pytest
import shapely
from helpers.map_data import CRS_OUT, FRAME, dataset, expected
from helpers.programs import run_program
from hypothesis import given, settings
from hypothesis import strategies as st

from geoscene.classes import Class
from geoscene.errors import GeosceneError
from lidar.dataset.formats import format_of
from lidar.dataset.formats.las import LasInfo
from lidar.errors import InputError
from lidar.geometry.georeference import Georeference
from lidar.options.maps import MapOptions
from lidar.tools.maps import squares
from lidar.tools.maps.aggregate import aggregate
from lidar.tools.maps.squares import INDEX, Outliers, open_tiles

OFFSET = (500_000.0, 6_700_000.0, 0.0)


def cloud(rng, count, *, spread):
    """Points (count, 3) around a few places, and some far from all others."""
    centre = rng.uniform(-spread, spread, (4, 3))
    points = centre[rng.integers(0, 4, count)] + rng.normal(0, 2, (count, 3))
    far = rng.random(count) < 0.03
    points[far] = rng.uniform(-2 * spread, 2 * spread, (np.count_nonzero(far), 3))
    return points


def kept_of_all_pairs(points, neighbours, factor):
    """Whether each point is kept, by the distances of all pairs."""
    away = np.sort(np.linalg.norm(points[:, None] - points, axis=2), axis=1)[:, 1 : neighbours + 1]
    short = np.pad(away, ((0, 0), (0, max(0, neighbours - away.shape[1]))), constant_values=np.inf)
    spacing = np.minimum(short, squares._FARTHEST).mean(axis=1)
    return spacing <= spacing.mean() + factor * spacing.std() + 1e-6


def tables_of(points, pieces):
    number = np.arange(len(points), dtype=np.uint32)
    for part in np.array_split(number, pieces):
        xyz = points[part] + OFFSET
        yield {"x": xyz[:, 0], "y": xyz[:, 1], "z": xyz[:, 2], "frame": part}


@pytest.mark.full
@settings(deadline=None, max_examples=25)
@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(1, 300),
    neighbours=st.integers(1, 12),
    factor=st.floats(0.2, 3),
    spread=st.sampled_from([3.0, 20.0, 60.0]),
)
def test_the_points_left_are_those_by_the_distances_of_all_pairs(
    tmp_path_factory, seed, count, neighbours, factor, spread
):
    points = np.round(cloud(np.random.default_rng(seed), count, spread=spread), 3)
    out = tmp_path_factory.mktemp("outliers") / "map.laz"
    filtered = Outliers(neighbours, factor)
    left = list(filtered.without(tables_of(points, 3), out=out, offset=OFFSET))
    numbers = np.concatenate([np.zeros(0, np.uint32), *(table["frame"] for table in left)])
    expected = np.flatnonzero(kept_of_all_pairs(points, neighbours, factor))
    assert sorted(numbers) == expected.tolist()
    assert filtered.left_out == count - len(expected)
    assert not list(out.parent.iterdir())
    for table in left:
        np.testing.assert_allclose(
            np.column_stack([table[axis] for axis in "xyz"]), points[table["frame"]] + OFFSET, atol=1e-8
        )


def test_lonely_points_are_left_out_of_a_map_and_counted(tmp_path):
    data = dataset(tmp_path / "d")
    summary = aggregate(data, tmp_path / "m.laz", options=MapOptions(outliers=(8, 1.0)))
    left = len(laspy.read(tmp_path / "m.laz"))
    assert 0 < summary.left_out["outliers"] < 600
    assert summary.points == left == summary.points_in - summary.left_out["outliers"]


@pytest.mark.parametrize("given_outliers", [(0, 1.0), (5, -1.0), (501, 1.0), (5, float("nan"))])
def test_impossible_filters_are_refused(given_outliers):
    with pytest.raises(InputError, match="`outliers`"):
        MapOptions(outliers=given_outliers)


SIDE = 10


def read_index(folder):
    meta, _, geometry, columns = pyogrio.raw.read(folder / INDEX, layer="tiles")
    return meta, shapely.from_wkb(geometry), dict(zip(meta["fields"], columns, strict=True))


def points_of(path):
    las = laspy.read(path)
    return np.column_stack([las.x, las.y, las.z])


@pytest.mark.full
@pytest.mark.parametrize("form", ["laz", "las", "copc"])
def test_tiles_hold_the_points_of_their_squares_and_together_those_of_the_map(tmp_path, form):
    data = dataset(tmp_path / "d")
    aggregate(data, tmp_path / "whole.laz")
    options = MapOptions(tiles=SIDE, tile_format=form)
    summary = aggregate(data, tmp_path / "tiles", options=options)
    meta, squares, columns = read_index(tmp_path / "tiles")
    assert meta["crs"] == "EPSG:32635"
    files = sorted(path.name for path in (tmp_path / "tiles").iterdir() if format_suffix(path))
    assert sorted(columns["file"]) == files
    parts = []
    named = (columns[k] for k in ("file", "points", "low", "high"))
    for square, name, count, low, high in zip(squares, *named, strict=True):
        points = points_of(tmp_path / "tiles" / name)
        assert len(points) == count > 0
        assert (np.array(square.bounds[:2]) % SIDE == 0).all()
        assert name.startswith("{:.0f}_{:.0f}.".format(*square.bounds[:2]))
        assert (points[:, :2] >= square.bounds[:2]).all()
        assert (points[:, :2] < square.bounds[2:]).all()
        np.testing.assert_allclose([points[:, 2].min(), points[:, 2].max()], [low, high], atol=1e-6)
        parts.append(points)
    found, whole = np.concatenate(parts), points_of(tmp_path / "whole.laz")
    assert summary.points == len(found) == len(expected())
    np.testing.assert_allclose(found[np.lexsort(found.T)], whole[np.lexsort(whole.T)], atol=1e-6)
    assert summary.beside[0] == tmp_path / "tiles" / INDEX


def format_suffix(path):
    return path.name.endswith((".laz", ".las"))


def test_tiles_of_rasters_and_provenance_are_one_folder(tmp_path):
    options = MapOptions(tiles=SIDE, raster=("dsm",))
    summary = aggregate(dataset(tmp_path / "d"), tmp_path / "tiles", options=options)
    assert all(path.exists() and path.parent == tmp_path / "tiles" for path in summary.beside)
    names = {path.name for path in (tmp_path / "tiles").iterdir() if not format_suffix(path)}
    assert names == {INDEX, "tiles.dsm.tif", "tiles.provenance.json"}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["d", "tiles"]


@pytest.mark.full
def test_the_same_map_in_tiles_has_the_same_bytes(tmp_path):
    data = dataset(tmp_path / "d")
    for name in ("one", "two"):
        aggregate(data, tmp_path / name, options=MapOptions(tiles=SIDE))
    for path in (tmp_path / "one").iterdir():
        assert path.read_bytes() == (tmp_path / "two" / path.name).read_bytes(), path.name


def test_a_point_that_rounds_to_a_border_is_in_the_square_that_its_file_says(tmp_path):
    geo = Georeference(FRAME, CRS_OUT)
    info = LasInfo(CRS_OUT, geo.offset, dataset(tmp_path / "d").start)
    east, north = (v // 100 * 100 for v in geo.offset[:2])
    x = east + np.array([99.9997, 99.9993, 100.0, -0.0002])
    one = np.ones(4, np.uint8)
    table = {"x": x, "y": np.full(4, north + 5.0), "z": np.zeros(4), "intensity": one.astype(np.float32),
             "gps_time": np.zeros(4), "ring": one.astype(np.uint16), "label": one * int(Class.ROAD),
             "instance": one.astype(np.int32), "echo": one, "echoes": one, "source": one.astype(np.uint16),
             "frame": one.astype(np.uint32), "red": one, "green": one, "blue": one}  # fmt: skip
    form, folder = format_of(tmp_path / "a.laz"), tmp_path / "tiles"
    folder.mkdir()
    with open_tiles(folder, 100, form=form, info=info, columns=tuple(table)[3:]) as append:
        append(table)
    _, squares, columns = read_index(folder)
    for square, name in zip(squares, columns["file"], strict=True):
        found = points_of(folder / name)
        assert (found[:, 0] >= square.bounds[0]).all()
        assert (found[:, 0] < square.bounds[2]).all()
    assert sorted(columns["points"]) == [2, 2]


def test_an_empty_map_in_tiles_has_an_index_without_squares(tmp_path):
    options = MapOptions(tiles=SIDE, only=("water",))
    summary = aggregate(dataset(tmp_path / "d"), tmp_path / "tiles", options=options)
    _, squares, _ = read_index(tmp_path / "tiles")
    assert summary.points == len(squares) == 0


def test_tiles_replace_tiles_only_and_leave_nothing_when_they_fail(tmp_path):
    data, options = dataset(tmp_path / "d"), MapOptions(tiles=SIDE)
    with pytest.raises(InputError, match="folder"):
        aggregate(data, tmp_path / "map.laz", options=options)
    with pytest.raises(InputError, match="tiles"):
        aggregate(data, tmp_path / "folder")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "mine.txt").write_text("kept")
    with pytest.raises(GeosceneError, match=INDEX):
        aggregate(data, tmp_path / "other", options=options, overwrite=True)
    aggregate(data, tmp_path / "tiles", options=options)
    with pytest.raises(InputError, match="exists already"):
        aggregate(data, tmp_path / "tiles", options=options)
    before = {path.name: path.read_bytes() for path in (tmp_path / "tiles").iterdir()}
    broken = tmp_path / "d" / "top" / "laz" / "000003.laz"
    shutil.copy(broken, tmp_path / "kept.laz")
    broken.write_bytes(broken.read_bytes()[:500])
    with pytest.raises(Exception, match=r"000003"):
        aggregate(data, tmp_path / "tiles", options=options, overwrite=True)
    assert {path.name: path.read_bytes() for path in (tmp_path / "tiles").iterdir()} == before
    shutil.copy(tmp_path / "kept.laz", broken)
    aggregate(data, tmp_path / "tiles", options=MapOptions(tiles=1000), overwrite=True)
    assert len(list((tmp_path / "tiles").glob("*.laz"))) in range(1, 5)


@pytest.mark.parametrize("given", [{"tiles": 0}, {"tiles": -5}, {"tiles": 5, "tile_format": "ply"}])
def test_impossible_tiles_are_refused(given):
    with pytest.raises(InputError, match="tile"):
        MapOptions(**given)


def test_parts_of_a_metre_are_not_cut_off(tmp_path):
    data = dataset(tmp_path / "d").path
    done = run_program("lidar", "map", data, "-o", tmp_path / "tiles", "--tiles", "1.5")
    assert done.returncode == 2
    assert "--tiles" in done.stderr
    assert not (tmp_path / "tiles").exists()
