"""Plans of drives: the longest drive, frames in order of time, memory that planning frees."""

import os
import platform
from pathlib import Path

import numpy as np
import pytest
from helpers.roadgrids import grid

from geoscene.geometry.frames import Frame
from lidar.errors import InputError, RouteError
from lidar.geometry import time_scales
from lidar.motion.road_drive import plan_route_and_path
from lidar.motion.vehicle import load_vehicle
from lidar.options.drive import DriveOptions
from lidar.sensors.rig.devices import scanners
from lidar.sensors.rig.specs import load_rig
from lidar.simulation.drive import trim_memory
from lidar.simulation.plan import schedule

FRAME = Frame.at(-76.3, 36.88)


def test_drives_of_more_than_four_hours_are_refused_with_the_remedy(monkeypatch):
    assert DriveOptions(route="random", duration=14_400.0).duration == 14_400.0
    with pytest.raises(InputError, match=r"`duration` 14401.*several drives"):
        DriveOptions(route="random", duration=14_401.0)
    graph, car = grid(gap=80.0), load_vehicle("car")
    xy = graph.node_xyz[[0, -1], :2]
    lon, lat = FRAME.to_geographic(*xy.T)
    corners = list(zip(lat.tolist(), lon.tolist(), strict=True))
    monkeypatch.setattr(time_scales, "LONGEST_S", 3.0)
    with pytest.raises(RouteError, match=r"the route takes .* hours.*several drives"):
        plan_route_and_path(graph, FRAME, spec=corners, vehicle=car)


def test_frames_are_in_order_of_time():
    sensors = scanners(load_rig("seed"))
    jobs = schedule(sensors, 3_000_000_000)
    order = [(job.start_ns, job.order, job.frame) for job in jobs]
    assert order == sorted(order)
    assert len(jobs) == sum(sensor.frame_count(3_000_000_000) for sensor in sensors)
    assert sum(job.frame == 7 for job in jobs) == len(sensors)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other C libraries keep less")
def test_memory_that_planning_freed_goes_back_to_the_system():
    def resident():
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")

    rows = [np.ones(1000) for _ in range(20_000)]
    last = rows[::1000]
    rows.clear()
    before = resident()
    trim_memory()
    assert before - resident() > 100_000_000
    assert len(last) == 20
