"""Forged frames: a car of points on the scanner's rays, and returns that are taken away."""

from dataclasses import replace

import numpy as np

from helpers.sensor_worlds import driven
from lidar.geometry.attitude import Mount
from lidar.sensors.laser.scan import scan
from lidar.sensors.physics.settings import PLAIN
from lidar.sensors.rig.scanner import load_sensor
from lidar.tools.defences.observation import Observation

ROOF = Mount((0.76, 0.0, 1.73))
CAR = np.array([4.3, 1.8, 1.5])


def ray_box(direction, center, size, yaw):
    """Distance at which rays (n, 3) from the origin enter a box; inf for a miss."""
    c, s = np.cos(yaw), np.sin(yaw)
    turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]])
    start, along = turn @ -np.asarray(center, float), direction @ turn.T
    with np.errstate(divide="ignore", invalid="ignore"):
        one, other = (-size / 2 - start) / along, (size / 2 - start) / along
    enter, leave = np.minimum(one, other).max(axis=1), np.maximum(one, other).min(axis=1)
    return np.where((enter < leave) & (enter > 0), enter, np.inf)


def rebuilt(frame, pulse, columns, distance, intensity):
    """A frame of given returns: ``pulse`` rows of the firings, other columns (n,)."""
    order = np.argsort(pulse, kind="stable")
    fired = frame.firings
    xyz = fired.origin[pulse] + fired.direction[pulse] * distance[:, None]
    given = {name: column[order] for name, column in columns.items()}
    return replace(
        frame, xyz=xyz[order].astype(np.float32).astype(float), range=distance[order],
        intensity=intensity[order], time_ns=fired.time_ns[pulse][order],
        ring=fired.ring[pulse][order].astype(int), column=fired.column[pulse][order].astype(int), **given,
    ), order  # fmt: skip


def with_car(frame, center, *, yaw=0.0, size=CAR, points=60, seed=0, noise=0.05, window=0.175):
    """The frame with a forged car of some points, and which returns are forged.

    Each forged return replaces the genuine one of its pulse; those of the pulses that miss the car stay.
    """
    rng = np.random.default_rng(seed)
    fired = frame.firings
    away = ray_box(fired.direction, center, size, yaw)
    middle = np.arctan2(center[1], center[0])
    turn = np.abs(
        (np.arctan2(fired.direction[:, 1], fired.direction[:, 0]) - middle + np.pi) % (2 * np.pi) - np.pi
    )
    able = np.flatnonzero(np.isfinite(away) & (turn < window / 2))
    chosen = np.sort(rng.permutation(able)[:points])
    keep = ~np.isin(frame.pulse, chosen)
    pulse = np.concatenate([frame.pulse[keep], chosen])
    forged = np.concatenate([np.zeros(keep.sum(), bool), np.ones(len(chosen), bool)])
    ones = np.ones(len(chosen), int)
    columns = {name: np.concatenate([getattr(frame, name)[keep], ones]) for name in ("echo", "echoes")}
    offset = frame.sensor.pattern.range_offset
    distance = np.concatenate(
        [frame.range[keep] - offset, away[chosen] + noise * rng.standard_normal(len(chosen))]
    )
    intensity = np.concatenate([frame.intensity[keep], rng.uniform(30, 100, len(chosen))])
    made, order = rebuilt(frame, pulse, columns, distance, intensity)
    made = replace(made, range=made.range + offset)
    return made, forged[order]


def without(frame, gone):
    """The frame without some returns (n,)."""
    names = ("xyz", "time_ns", "ring", "column", "echo", "echoes", "range", "intensity")
    return replace(frame, **{name: getattr(frame, name)[~gone] for name in names})


def in_box(frame, center, *, yaw=0.0, size=CAR):
    """Which returns are in a box."""
    c, s = np.cos(yaw), np.sin(yaw)
    away = frame.xyz - center
    local = np.column_stack([c * away[:, 0] + s * away[:, 1], c * away[:, 1] - s * away[:, 0], away[:, 2]])
    return (np.abs(local) <= np.asarray(size) / 2).all(axis=1)


def observed(
    world, *, sensor="hdl32e", frames=1, trajectory=None, mount=ROOF, settings=PLAIN, seed=5, only=None
):
    """Frames that a scanner on a vehicle records in a world, or ``only`` one of them."""
    device = load_sensor(sensor, name="top")
    trajectory = trajectory or driven()
    found = []
    for frame in range(frames) if only is None else [only]:
        cloud = scan(
            device, mount, trajectory=trajectory, world=world, frame=frame, seed=seed, settings=settings
        )
        whole = {name: getattr(cloud, name).astype(int) for name in ("ring", "column", "echo", "echoes")}
        found.append(
            Observation(
                frame, cloud.start_ns, device, mount, trajectory,
                xyz=cloud.xyz.astype(float), time_ns=cloud.start_ns + cloud.time_ns.astype(int),
                range=cloud.range, intensity=cloud.intensity.astype(float), **whole,
            )
        )  # fmt: skip
    return found
