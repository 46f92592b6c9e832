"""Flight lines of surveys: strips, scan angles and edges of scan lines, as LAS states them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.typing import Float, Ints
from lidar.geometry.attitude import Mount
from lidar.geometry.poses import Trajectory


def strip_numbers(time_ns: Ints, scanning_ns: Ints) -> NDArray[np.uint16]:
    """Number (n,) of the strip of each time, from 1; 0 before the first.

    scanning_ns : (k, 2) times from and until which scanners work, a strip each
    """
    return np.searchsorted(scanning_ns[:, 0], time_ns, side="right").astype(np.uint16)


def scan_angles(placed: Float, trajectory: Trajectory, *, mount: Mount, time_ns: Ints) -> Float:
    """Angle (n,) of each pulse from the vertical about the flight direction, degrees, positive to the right.

    The roll of the aircraft is in it (LAS 1.4 R15, Scan Angle).

    placed  : (n, 3) returns, scene coordinates
    time_ns : (n,) of their pulses
    """
    pose = trajectory.at(time_ns)
    sensor = pose.mounted(mount.translation, mount.rotation)
    sight = (placed - sensor.position) / sensor.scale
    ahead = pose.rotation[:, :2, 0]
    right = np.column_stack([ahead[:, 1], -ahead[:, 0]]) / np.linalg.norm(ahead, axis=1)[:, None]
    angle: Float = np.degrees(np.arctan2((sight[:, :2] * right).sum(axis=1), -sight[:, 2]))
    return angle


def edge_times(direction: Float, *, mount: Mount, time_ns: Ints, ring: NDArray[np.integer]) -> Ints:
    """Times (k,) of the last pulse of each scan line, where the scan turns back or begins anew.

    direction, time_ns, ring : (n,) of all pulses of a frame, in the sensor frame

    None of scanners with several rings, whose pulses at a time have many angles.
    """
    times, first = np.unique(time_ns, return_index=True)
    if len(times) < 3 or np.ptp(ring):
        return times[:0]
    _, left, up = mount.rotation @ direction[first].T
    angle = np.arctan2(-left, -up)
    step = np.diff(angle)
    turns = np.append(np.append(False, step[1:] * step[:-1] < 0), False)
    turns[1:][np.abs(step) > np.ptp(angle) / 2] = False  # the first pulse of a line, on the other side
    found: Ints = times[turns]
    return found


def flight_columns(
    placed: Float, trajectory: Trajectory, *, mount: Mount, time_ns: Ints, strips: Ints, edges: Ints
) -> dict[str, NDArray[Any]]:
    """Columns source (strip), scan_angle (degrees) and edge of the returns of a survey, for LAS.

    strips : as of `strip_numbers`
    edges  : as of `edge_times`
    """
    angle = scan_angles(placed, trajectory, mount=mount, time_ns=time_ns)
    return {
        "source": strip_numbers(time_ns, strips),
        "scan_angle": angle,
        "edge": np.isin(time_ns, edges),
    }
