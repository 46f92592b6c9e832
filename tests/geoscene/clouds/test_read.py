"""Point clouds are read in any CRS and unit, and what cannot be placed is refused with its remedy."""

import numpy as np
import pytest
from helpers.clouds import write_las
from pyproj import CRS
from scipy.spatial import cKDTree

from geoscene.clouds.read import SurveyPoints, open_cloud, spool_clouds, without_outliers
from geoscene.errors import InputError
from geoscene.geometry.frames import Frame

NEW_YORK = (-73.99, 40.72)
US_FOOT = 1200 / 3937


def placed(frame, crs, *, z_unit=1.0, count=500):
    """Points within 100 m of the scene's centre, in a CRS."""
    xyz = np.random.default_rng(7).uniform((-100, -100, 0), (100, 100, 40), (count, 3))
    east, north = frame.to_crs(xyz[:, 0], xyz[:, 1], crs=crs)
    return xyz, np.column_stack([east, north, xyz[:, 2] / z_unit])


def write_ply(path, coordinates, *, text):
    kind = "ascii" if text else "binary_little_endian"
    lines = ["ply", f"format {kind} 1.0", f"element vertex {len(coordinates)}"]
    head = "\n".join([*lines, *(f"property double {a}" for a in "xyz"), "end_header", ""]).encode()
    rows = coordinates.astype("<f8")
    body = "".join(f"{x!r} {y!r} {z!r}\n" for x, y, z in rows.tolist()).encode() if text else rows.tobytes()
    path.write_bytes(head + body)
    return path


def in_scene(path, frame, folder, *, crs="", unit=""):
    folder.mkdir()
    cloud = open_cloud(path, crs=crs, unit=unit)
    spool = spool_clouds([cloud], frame, bounds=(-200, -200, 200, 200), folder=folder)
    return spool.around((-200, -200, 200, 200)).xyz


def apart(found, expected):
    """Metres of the farthest point from its counterpart; the points are the same but for their order."""
    assert len(found) == len(expected)
    distance, counterpart = cKDTree(expected).query(found)
    assert len(set(counterpart.tolist())) == len(expected)
    return distance.max()


@pytest.mark.parametrize(
    ("crs", "z_unit", "unit"),
    [
        ("EPSG:32618", 1.0, ""),
        ("EPSG:4326", 1.0, ""),
        ("EPSG:2263+6360", US_FOOT, ""),  # feet in plan and in height
        ("EPSG:2263+5703", 1.0, ""),  # feet in plan, metres in height
        ("EPSG:2263", US_FOOT, "us-ft"),
        ("EPSG:3857", 1.0, ""),
    ],
)
def test_a_cloud_has_the_same_place_in_any_crs(tmp_path, crs, z_unit, unit):
    frame = Frame.at(*NEW_YORK)
    plane = (CRS.from_user_input(crs).sub_crs_list or [crs])[0]
    xyz, coordinates = placed(frame, plane, z_unit=z_unit)
    path = write_las(tmp_path / "cloud.laz", coordinates, crs=crs)
    found = in_scene(path, frame, tmp_path / "spool", unit=unit)
    assert apart(found, xyz) < 0.003


@pytest.mark.parametrize("text", [True, False])
def test_a_ply_file_holds_the_same_points_as_a_las_file(tmp_path, text):
    frame = Frame.at(*NEW_YORK)
    xyz, coordinates = placed(frame, "EPSG:32618")
    path = write_ply(tmp_path / "cloud.ply", coordinates, text=text)
    found = in_scene(path, frame, tmp_path / "spool", crs="EPSG:32618")
    assert apart(found, xyz) < 0.002


def test_feet_whose_unit_of_height_is_not_stated_are_refused(tmp_path):
    _, coordinates = placed(Frame.at(*NEW_YORK), "EPSG:2263")
    path = write_las(tmp_path / "cloud.las", coordinates, crs="EPSG:2263")
    with pytest.raises(InputError, match="`cloud_unit` m, ft or us-ft"):
        open_cloud(path)


def test_a_cloud_without_crs_is_refused(tmp_path):
    _, coordinates = placed(Frame.at(*NEW_YORK), "EPSG:32618")
    with pytest.raises(InputError, match="`cloud_crs`"):
        open_cloud(write_las(tmp_path / "cloud.las", coordinates))
    with pytest.raises(InputError, match="`cloud_crs`"):
        open_cloud(write_ply(tmp_path / "cloud.ply", coordinates, text=False))
    with pytest.raises(InputError, match="unknown to pyproj"):
        open_cloud(tmp_path / "cloud.las", crs="EPSG:1")


def test_a_cloud_beside_the_map_is_refused_with_both_extents(tmp_path):
    _, coordinates = placed(Frame.at(*NEW_YORK), "EPSG:32618")
    path = write_las(tmp_path / "cloud.las", coordinates, crs="EPSG:32618")
    with pytest.raises(InputError, match=r"no point within the map, which spans W 9\..*spans W -73\.99"):
        in_scene(path, Frame.at(9.5, 47.1), tmp_path / "spool")


@pytest.mark.parametrize("name", ["cloud.las", "cloud.laz", "cloud.ply"])
def test_a_damaged_cloud_is_refused_in_one_line(tmp_path, name):
    _, coordinates = placed(Frame.at(*NEW_YORK), "EPSG:32618", count=60_000)
    path = tmp_path / name
    if name.endswith("ply"):
        write_ply(path, coordinates, text=False)
    else:
        write_las(path, coordinates, crs="EPSG:32618")
    path.write_bytes(path.read_bytes()[:-20_000])
    with pytest.raises(InputError, match=name) as caught:
        list(open_cloud(path, crs="EPSG:32618").chunks())
    assert "\n" not in str(caught.value)
    path.write_bytes(b"")
    with pytest.raises(InputError, match=name):
        open_cloud(path, crs="EPSG:32618")


def test_birds_and_low_noise_are_left_out_and_nothing_else():
    rng = np.random.default_rng(3)
    ground = rng.uniform((0, 0, 0), (60, 60, 0.1), (4000, 3))
    birds = np.array([[10, 10, 50], [30, 40, -20], [31, 40.5, -20.2]], float)
    xyz = np.concatenate([ground, birds])
    points = SurveyPoints(xyz, np.zeros(len(xyz), np.uint8), np.ones(len(xyz), bool))
    assert np.array_equal(without_outliers(points).xyz, ground)


def test_points_come_back_once_from_squares_of_any_bounds(tmp_path):
    frame = Frame.at(*NEW_YORK)
    xyz, coordinates = placed(frame, "EPSG:32618", count=3000)
    path = write_las(tmp_path / "cloud.las", coordinates, crs="EPSG:32618")
    (tmp_path / "s").mkdir()
    spool = spool_clouds([open_cloud(path)], frame, bounds=(-50, -80, 60, 70), folder=tmp_path / "s")
    inside = ((xyz[:, :2] >= (-50, -80)) & (xyz[:, :2] < (60, 70))).all(axis=1).sum()
    halves = [spool.around((-50, -80, 5, 70)), spool.around((5, -80, 60, 70))]
    assert sum(len(half) for half in halves) == pytest.approx(inside, abs=2)
    assert spool.outside == 3000 - sum(len(half) for half in halves)
