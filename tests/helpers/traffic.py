"""A car, a flat frame, and the bodies of simulated traffic over time."""

from dataclasses import replace

import numpy as np

from lidar.motion.vehicle import load_vehicle
from lidar.traffic.lanes import STEP
from lidar.traffic.sweep import rectangles

CAR = load_vehicle("car")


class Plane:
    """A frame with scale 1 at its centre."""

    def scale_at(self, x, y):
        return np.ones(np.broadcast_shapes(np.shape(x), np.shape(y)))


def tracks(trips, flow):
    """Centres and headings (steps, trips, 3) of road users; NaN while they are absent."""
    out = np.full((int(flow.step.max()) + 1, len(trips), 3), np.nan)
    for k in np.unique(flow.trip):
        rows = flow.trip == k
        xy, heading = trips[k].body()
        at = flow.travelled[rows] / STEP
        for c, column in enumerate((*xy.T, heading)):
            out[flow.step[rows], k, c] = np.interp(at, np.arange(len(xy)), column)
    return out


def boxes_at(trips, poses):
    there = np.flatnonzero(np.isfinite(poses[:, 0]))
    length = np.array([trips[k].length for k in there])
    width = np.array([trips[k].width for k in there])
    return rectangles(poses[there, :2], poses[there, 2], length=length, width=width)


def with_speed(trip, desired_speed):
    """A trip with another desired speed (n,) at its stations."""
    course = replace(trip.course, desired_speed=desired_speed)
    return replace(trip, course=course)
