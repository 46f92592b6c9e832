"""Whether an attacker's device is ever in the line of sight of a sensor."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import cast

import numpy as np

from lidar.errors import InputError
from lidar.sensors.physics.echoes import TracedEchoes, artificial_echoes, trace
from lidar.sensors.physics.origin import Origin
from lidar.sensors.rig.scanner import Sensor, firings
from lidar.signal.attacks.attacker import Attacker
from lidar.signal.registry import Stages
from lidar.signal.situation import Situation
from lidar.signal.stage import Pulses, pulses_of

Seen = tuple[Pulses, TracedEchoes, Situation]
"""Pulses of a frame, the echoes that are known without rays, and where it is taken."""


def check_sight(stages: Stages, frames: Iterable[tuple[Situation, Callable[[], Seen]]]) -> None:
    """Raise InputError for a device that is in the line of sight of a scanner in none of the frames.

    frames : where each is taken, without its world, and what it sees, which is asked for near the device
    """
    waiting = [named for named in stages.stages if isinstance(named.stage, Attacker)]
    rest = iter(frames)
    while waiting and (frame := next(rest, None)):
        where, seen = frame
        near = [
            named
            for named in waiting
            if named.sensor in ("", where.sensor) and cast("Attacker", named.stage).may_reach(where)
        ]
        if near:
            pulses, echoes, at = seen()
            for named in near:
                if cast("Attacker", named.stage).aim(pulses, echoes, at=at) is not None:
                    waiting.remove(named)
    for named in waiting:
        reach = cast("Attacker", named.stage).reach
        raise InputError(
            f"attack {named.name}: its device is in the line of sight of no scanner within {reach:g} m in any"
            " frame; move it, or change its reach, start or stop"
        )


def sent_only(sensor: Sensor, at: Situation) -> Seen:
    """Pulses of a drive's frame without echoes, and the situation with the world between."""
    none = artificial_echoes(np.empty(0, np.int32), np.empty(0), apparent=np.empty(0))
    nothing = trace(none, Origin.SURFACE, source=np.empty(0, np.int32))
    return pulses_of(sensor, firings(sensor, int(at.frame))), nothing, at
