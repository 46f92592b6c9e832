"""Drives without files: the frames are those that a drive records."""

import gc
import itertools
import threading
import weakref
import zlib
from collections import Counter
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

import lidar
import lidar.simulation.frames
from lidar.dataset.formats import read_table
from lidar.dataset.formats.table import cloud_table
from lidar.dataset.png import depth_to_counts, encode_png, flow_to_image, image_to_feature, read_png
from lidar.errors import InputError
from lidar.options.drive import DriveOptions
from lidar.signal.registry import read_attacks, read_stages
from lidar.simulation.drive import drive
from lidar.traffic.options import TrafficOptions

RIG = """
name = "several"
vehicle = "car"
source = "made up"

[[lidar]]
name = "top"
preset = "vlp16"
translation = [1.2, 0.0, 1.9]

[[lidar]]
name = "doppler"
preset = "fmcw"
translation = [3.0, 0.0, 1.0]

[[camera]]
name = "front"
translation = [2.0, 0.0, 1.5]
width = 96
height = 64
fov_deg = 90.0
rate_hz = 25.0
time_offset_ns = 3_000_000
images = ["rgb", "depth", "semantic", "instance", "flow"]

[[gnss]]
name = "gnss"
translation = [0.6, 0.0, 1.6]
rate_hz = 8.0
mode = "rtk"

[[imu]]
name = "imu"
translation = [0.0, 0.0, 0.5]
rate_hz = 90.0
"""

STAGES = (
    "cover_glass:transmission=0.5",
    "dropped_packets:loss=0.2",
    "lost_rows:loss=0.3",
    "gnss_spoof:start=0.1",
)


def options_with(stages, folder):
    """Options of a short drive in traffic of a rig with every kind of sensor."""
    (folder / "rig.toml").write_text(RIG)
    return DriveOptions(
        route="random",
        rig=str(folder / "rig.toml"),
        duration=0.45,
        seed=5,
        formats=("pcd",),
        traffic=TrafficOptions(vehicles=60.0, parked=0.8, pedestrians=20.0),
        stages=stages,
    )


def filtered_rows(png):
    """The rows of a PNG file before compression: its pixels, whatever compressed them."""
    size = int.from_bytes(png[33:37])  # of the chunk behind the header
    return zlib.decompress(png[41 : 41 + size])


@pytest.mark.parametrize(
    "altered", [pytest.param(False, marks=pytest.mark.full), True], ids=["clear", "stages"]
)
def test_simulated_frames_are_those_that_a_drive_records(altered, scene, tmp_path):
    options = options_with(read_stages(STAGES).stages if altered else (), tmp_path)
    dataset = lidar.open_dataset(drive(scene, tmp_path / "drive", options=options).path)
    simulation = lidar.simulate(scene, replace(options, workers=2))
    frames = list(simulation)
    assert len(frames) == len(simulation) == dataset.frames == 4
    measured = [one for frame in frames for one in frame.measured]
    assert Counter(one.sensor for one in measured) == dataset.manifest["sensor_frames"]
    paths = dataset.paths
    for one in measured:
        rows = pd.read_csv(paths.frame_boxes(one.sensor, one.frame), keep_default_na=False)
        for name in ("id", "x", "points", "visibility", "left", "pixels"):
            if name in rows:
                np.testing.assert_array_equal(rows[name], one.boxes[name])
        assert bool(one.truth) == altered
        if altered:
            with np.load(paths.truth(one.sensor, one.frame)) as truth:
                assert set(truth) == set(one.truth)
                for name in truth:
                    np.testing.assert_array_equal(truth[name], one.truth[name])
        if one.sensor == "front":
            rgb, depth, semantic, instance = (
                read_png(paths.image("front", one.frame, kind=kind))
                for kind in ("rgb", "depth", "semantic", "instance")
            )
            np.testing.assert_array_equal(one.image.rgb, rgb)
            np.testing.assert_array_equal(depth_to_counts(one.image.depth), depth)
            np.testing.assert_array_equal(one.image.klass, semantic)
            np.testing.assert_array_equal(one.image.feature, image_to_feature(instance))
            flow = encode_png(flow_to_image(one.flow))
            written = paths.image("front", one.frame, kind="flow").read_bytes()
            assert filtered_rows(flow) == filtered_rows(written)
            assert flow == written
            continue
        table = read_table(paths.sensor(one.sensor) / "pcd" / f"{one.frame:06d}.pcd")
        own = cloud_table(one.cloud)
        own["time_ns"] += np.uint32(one.cloud.start_ns - one.time_ns)
        assert len(own["x"]) > 1000
        assert (one.velocity is None) == (one.sensor == "top")
        if one.velocity is not None:
            own["velocity"] = one.velocity
        assert set(table) == set(own)
        for name, column in table.items():
            np.testing.assert_array_equal(column, own[name], err_msg=name)
    check_vehicle(dataset, frames)


def check_vehicle(dataset, frames):
    """Assert that poses, fixes and samples of frames are those of a dataset."""
    poses = pd.read_csv(dataset.paths.poses)
    places = [frame.pose.position[0] for frame in frames]
    np.testing.assert_allclose(poses[["x", "y", "z"]], places, atol=1e-9)
    np.testing.assert_allclose(poses[["lon", "lat"]], [frame.lonlath[:2] for frame in frames], atol=1e-12)
    assert [pd.Timestamp(text) for text in poses["timestamp"]] == [frame.utc for frame in frames]
    fixes, samples = (pd.read_csv(dataset.paths.measurements(name)) for name in ("gnss", "imu"))
    for table, name in ((fixes, "fixes"), (samples, "samples")):
        times = [readings.time_ns for frame in frames for readings in getattr(frame, name).values()]
        np.testing.assert_array_equal(table["time_ns"], np.concatenate(times))
    lonlath = np.concatenate([f.fixes["gnss"].lonlath for f in frames])
    np.testing.assert_allclose(fixes[["lon", "lat", "h"]], lonlath, atol=1e-9)
    accel = np.concatenate([f.samples["imu"].accel for f in frames])
    np.testing.assert_allclose(samples[["accel_x", "accel_y", "accel_z"]], accel, atol=1e-9)
    for frame, after in itertools.pairwise(frames):
        for times in (frame.fixes["gnss"].time_ns, frame.samples["imu"].time_ns):
            assert (times < after.time_ns).all()
        assert all(one.time_ns < after.time_ns for one in frame.measured)


def test_a_frame_has_one_cloud_and_image_of_each_sensor_with_their_boxes(scene, tmp_path):
    frame = next(iter(lidar.simulate(scene, options_with((), tmp_path))))
    assert set(frame.clouds) == {"top", "doppler"}
    assert frame.images["front"].rgb.shape == (64, 96, 3)
    assert set(frame.boxes) == {"top", "doppler", "front"}
    assert [one.frame for one in frame.measured if one.sensor == "front"] == [0, 1, 2]
    assert frame.images["front"] is next(one for one in frame.measured if one.sensor == "front").image
    scan = frame.sensors["top"]
    back = scan.pose.place(scan.deskewed("start").astype(float))
    np.testing.assert_allclose(back, scan.placed, atol=2e-5)
    with pytest.raises(InputError, match="`moment` noon: one of start, middle, end"):
        scan.deskewed("noon")


@pytest.mark.full
def test_frames_are_made_when_they_are_asked_for_and_none_is_kept(scene, monkeypatch):
    begun = []
    measure = lidar.simulation.frames.measure_frame

    def counted(*args, **words):
        begun.append(words["frame"])
        return measure(*args, **words)

    monkeypatch.setattr("lidar.simulation.frames.measure_frame", counted)
    options = DriveOptions(route="random", rig="vlp16", duration=3.0, seed=1, workers=2)
    simulation = lidar.simulate(scene, options)
    assert not begun
    threads = threading.active_count()
    frames = iter(simulation)
    clouds = [weakref.ref(next(frames).measured[0]) for _ in range(3)]
    assert len(begun) <= 3 + 2 * 2
    gc.collect()
    assert sum(cloud() is not None for cloud in clouds) <= 1
    frames.close()
    for thread in threading.enumerate():
        if thread.name.startswith("ThreadPoolExecutor"):
            thread.join(20)
    assert threading.active_count() <= threads
    assert len(begun) <= 3 + 2 * 2


@pytest.mark.full
def test_iterating_again_simulates_the_same_frames(scene):
    simulation = lidar.simulate(scene, DriveOptions(route="random", rig="vlp16", duration=0.3, seed=1))
    first, again = (list(simulation) for _ in range(2))
    for a, b in zip(first, again, strict=True):
        np.testing.assert_array_equal(a.clouds["lidar_top"].xyz, b.clouds["lidar_top"].xyz)


def test_what_has_no_frames_is_refused(scene, tmp_path):
    rig = RIG[: RIG.index("[[lidar]]")] + RIG[RIG.index("[[gnss]]") :]
    (tmp_path / "rig.toml").write_text(rig)
    options = DriveOptions(route="random", rig=str(tmp_path / "rig.toml"), duration=1.0)
    with pytest.raises(InputError, match="neither scanners nor cameras"):
        lidar.simulate(scene, options)
    with pytest.raises(InputError, match="`scheduler`"):
        lidar.simulate(scene, replace(options, scheduler="local:2"))
    hidden = read_attacks(["inject:place=0,0,0"])
    with pytest.raises(InputError, match="in the line of sight of no scanner"):
        next(iter(lidar.simulate(scene, replace(options, rig="vlp16", attacks=hidden))))
