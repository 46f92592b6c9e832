"""What formats, thinned maps and projections lose: bounds that rounding sets, and known scales."""

from datetime import UTC, datetime

import laspy
import numpy as np
import pytest

from geoscene.geometry.frames import Frame
from lidar.dataset.formats import FORMATS
from lidar.dataset.formats.las import LasInfo
from lidar.options import DriveOptions, TradeoffOptions
from lidar.tools.maps.voxels import nearest_to_centre
from lidar.tools.tradeoff.engine import tradeoff
from lidar.tools.tradeoff.errors import cloud_distances
from lidar.tools.tradeoff.files import float32_bound
from lidar.tools.tradeoff.projections import frame_records
from lidar.tools.tradeoff.report import document, write_report

DRIVE = DriveOptions(route="random", rig="vlp16", duration=1.0, seed=3)
NAMES = ("files", "voxel", "frame")


@pytest.fixture(scope="module")
def found(scene):
    return tradeoff(scene, DRIVE, compared=TradeoffOptions(NAMES, frames=2))


@pytest.fixture(scope="module")
def rows(found):
    return {t.name: {r.label: r.figures for r in t.records} for t in found.listings}


def test_formats_stay_within_the_bounds_of_rounding(found, rows):
    assert found.comparisons == ()
    files = rows["files"]
    assert {name for name, form in FORMATS.items() if form.frame == "sensor"} < set(files)
    for label, figures in files.items():
        assert 0 < figures["max_m"] <= 1.001 * figures["bound_m"] + 1e-9, label
        assert figures["rms_m"] <= figures["99.9_m"] <= figures["max_m"]
    assert files["pcd"]["max_m"] < 1e-5
    assert 1e-4 < files["las in steps of 1 mm"]["max_m"] <= 0.0005 * 3**0.5 + 1e-5
    ratio = files["las in steps of 10 mm"]["rms_m"] / files["las in steps of 1 mm"]["rms_m"]
    assert ratio == pytest.approx(10, rel=0.02)
    assert files["kitti"]["per_point_bytes"] == 16
    sizes = [files[f"laz in steps of {step} mm"]["per_point_bytes"] for step in ("10", "1", "0.1")]
    assert sizes == sorted(sizes)


def test_las_steps_are_stated_and_kept(tmp_path):
    xyz = np.random.default_rng(0).uniform(-50, 50, (1000, 3)) + np.array([5e5, 4e6, 0])
    table = dict(zip("xyz", xyz.T, strict=True)) | {"label": np.ones(1000, np.uint16)}
    frame = Frame.at(9.0, 50.0, crs="utm")
    for scale in (1e-4, 1e-2):
        for name in ("las", "laz"):
            path = tmp_path / f"cloud.{name}"
            info = LasInfo(frame.crs, (5e5, 4e6, 0.0), created=datetime(2026, 6, 21, tzinfo=UTC), scale=scale)
            FORMATS[name].write(path, table, info=info)
            with laspy.open(path) as reader:
                assert reader.header.scales.tolist() == [scale] * 3
                points = reader.read()
                np.testing.assert_allclose(
                    reader.header.mins, np.column_stack([points.x, points.y, points.z]).min(axis=0)
                )
            away = np.abs(np.column_stack([points.x, points.y, points.z]) - xyz)
            assert 0.4 * scale < away.max() <= 0.5 * scale + 1e-9


def test_float32_moves_points_by_half_a_step_at_most():
    xyz = np.random.default_rng(1).uniform(-100, 100, (100_000, 3))
    away = np.linalg.norm(xyz - xyz.astype(np.float32), axis=1).max()
    assert 0.8 * float32_bound(xyz) < away <= float32_bound(xyz)


def test_thinned_maps_stay_within_the_diagonal_of_a_voxel(rows):
    voxels = rows["voxel"]
    assert list(voxels)[:2] == ["all points", "voxel=0.05"]
    for label, figures in list(voxels.items())[1:]:
        assert 0 < figures["max_m"] <= figures["bound_m"], label
        assert figures["back_max_m"] == 0
    shares = [figures["share"] for figures in voxels.values()]
    assert shares == sorted(shares, reverse=True)


def test_distances_to_a_thinned_cloud_are_known():
    points = np.zeros(3, [("x", float), ("y", float), ("z", float), ("gps_time", float)])
    points["x"] = [0.01, 0.5, 0.99]  # one voxel, whose centre's nearest is the middle point
    kept = nearest_to_centre(points, 1.0)
    assert kept["x"].tolist() == [0.5]
    there, back = cloud_distances(points["x"][:, None], kept["x"][:, None])
    np.testing.assert_allclose(there, [0.49, 0, 0.49])
    assert back.tolist() == [0]


def test_scale_of_utm_on_a_zones_meridian():
    """0.9996 by definition: 400 ppm, 40 mm of 100 m; elevation adds 0.157 ppm a metre."""
    frame = Frame.at(9.0, 50.0, crs="utm")
    start = np.array([[0.0, 0.0, 0.0]])
    end = np.array([[99.96, 0.0, 0.0]])
    rows = {r.label: r.figures for r in frame_records(frame, start, end=end, ranges=np.array([100.0]))}
    assert rows["ranges as simulated"]["max_m"] < 1e-5
    assert rows["UTM (EPSG:32632)"]["scale_ppm"] == pytest.approx(-400, abs=0.1)
    assert rows["UTM (EPSG:32632)"]["max_m"] == pytest.approx(0.04, abs=1e-4)
    assert rows["tangent plane"]["max_m"] < 1e-8
    high = np.array([[0.0, 0.0, 1000.0]])
    found = frame_records(frame, start + high, end=end + high, ranges=np.array([100.0]))
    assert found[0].figures["scale_ppm"] == pytest.approx(-156.7, abs=0.5)


def test_a_tangent_plane_falls_away_with_the_square_of_the_distance():
    frame = Frame.at(9.0, 50.0)
    start, end = np.array([[5000.0, 0.0, 0.0]]), np.array([[5000.0, 50.0, 0.0]])
    rows = frame_records(frame, start, end=end, ranges=np.array([50.0]))
    assert rows[-1].figures["height_max_m"] == pytest.approx(5000**2 / (2 * 6.39e6), rel=0.01)


def test_simulated_ranges_are_true_in_a_scene_in_utm(scene_utm):
    compared = TradeoffOptions(("frame",), frames=2)
    (listing,) = tradeoff(scene_utm, DRIVE, compared=compared).listings
    simulated, in_scene = listing.records[0].figures, listing.records[1].figures
    assert abs(simulated["scale_ppm"]) < 10 < abs(in_scene["scale_ppm"])


def test_listings_are_reported(found, tmp_path):
    write_report(found, tmp_path / "out")
    assert [table["name"] for table in document(found)["tables"]] == list(NAMES)
    page = (tmp_path / "out/tradeoff.html").read_text()
    assert "voxel=0.05" in page
    assert "below 1 nm" not in page.partition("Frames:")[0]
