"""Devices by name: those that are not there are named in one line, before anything is written."""

import importlib.util

import numpy as np
import pytest

from geoscene.errors import MissingExtraError
from lidar import drive
from lidar.dataset.formats import read_cloud
from lidar.errors import BackendError, InputError
from lidar.options.drive import DriveOptions
from lidar.raycast import device
from lidar.traffic.options import TrafficOptions
from lidar.world.settings import WorldSettings

HAS_WARP = importlib.util.find_spec("warp") is not None


@pytest.mark.parametrize("name", ["gpu", "cuda:", "cuda:-1", "cuda:x", "CUDA", "", "warp"])
def test_an_unknown_name_lists_the_devices(name):
    with pytest.raises(InputError, match="choose one of cpu, cuda"):
        WorldSettings(device=name)


def test_the_cpu_needs_no_warp(monkeypatch):
    monkeypatch.setattr(device, "need", lambda *_: pytest.fail("Warp is imported"))
    assert DriveOptions(device="cpu").recording_settings.world.device == "cpu"
    assert DriveOptions().recording_settings.world.device == "cpu"


@pytest.mark.skipif(HAS_WARP, reason="Warp is installed")
def test_a_drive_without_warp_names_the_extra(scene, tmp_path):
    with pytest.raises(MissingExtraError, match=r"geoscene\[gpu\]"):
        drive(scene, tmp_path / "out", options=DriveOptions(route="random", duration=0.2, device="warp-cpu"))
    assert not any(tmp_path.iterdir())


@pytest.mark.skipif(not HAS_WARP, reason="the extra gpu is not installed")
def test_a_cuda_device_that_is_not_there_is_named(scene, tmp_path, monkeypatch):
    monkeypatch.setattr(device, "_has_driver", lambda: False)
    with pytest.raises(InputError, match=r"`device` cuda:99: no CUDA driver"):
        drive(scene, tmp_path / "out", options=DriveOptions(route="random", duration=0.2, device="cuda:99"))
    assert not any(tmp_path.iterdir())


@pytest.mark.skipif(not HAS_WARP, reason="the extra gpu is not installed")
def test_a_drive_with_warp_has_the_clouds_of_the_cpu(scene, tmp_path):
    for name in ("cpu", "warp-cpu"):
        chosen = DriveOptions(
            route="random",
            duration=0.3,
            rig="vlp16",
            formats=("pcd",),
            device=name,
            traffic=TrafficOptions(vehicles=20, pedestrians=10),
        )
        drive(scene, tmp_path / name, options=chosen)
    clouds = sorted(path.relative_to(tmp_path / "cpu") for path in (tmp_path / "cpu").rglob("*.pcd"))
    assert clouds
    for cloud in clouds:
        one, two = (read_cloud(tmp_path / name / cloud) for name in ("cpu", "warp-cpu"))
        assert abs(len(one) - len(two)) <= 5
        if len(one) == len(two):
            apart = np.linalg.norm(one.xyz - two.xyz, axis=1)
            assert (apart > 1e-4).sum() <= 5


@pytest.mark.skipif(not HAS_WARP, reason="the extra gpu is not installed")
def test_a_full_device_is_named_with_what_to_do():
    with pytest.raises(BackendError, match=r"cpu.*Failed to allocate.*fewer `workers`"):
        device.device("warp-cpu").empty((2**30, 2**15), device.need("warp", "gpu").float64)


def test_the_device_is_given_once():
    with pytest.raises(InputError, match="one of both"):
        DriveOptions(device="cpu", settings=(("device", "cpu"),))
