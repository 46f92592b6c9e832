"""What a stage is: parameters with bounds, and one method for each seam that it acts on."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import Class
from geoscene.support.columns import Columns
from geoscene.typing import Float
from lidar.errors import InputError
from lidar.parameters import Parameters
from lidar.sensors.physics.detector import receive
from lidar.sensors.physics.echoes import Echoes, TracedEchoes, artificial_echoes, trace
from lidar.sensors.physics.link import apparent_of
from lidar.sensors.physics.origin import Origin
from lidar.sensors.rig.patterns.beams import Firings
from lidar.sensors.rig.scanner import Sensor
from lidar.signal.situation import Situation

POSES = "poses and time"
ROAD_USERS = "road users (lidar drive --traffic)"
LABELS = "labelled road users (lidar drive --traffic, in a format with classes and instances)"
"""What some drives and recorded data know, and others do not."""


@dataclass(frozen=True)
class Stage(Parameters):
    """Base of all stages; a stage has a method of the name of each seam of `registry.SEAMS` it acts on.

    Of images only colours are used, of fixes and samples only measurements: depth, labels and truth stay.
    """

    def __post_init__(self) -> None:
        """Validate the parameters, and their times."""
        super().__post_init__()
        start, stop = getattr(self, "start", -inf), getattr(self, "stop", inf)
        if stop <= start:
            raise InputError(f"stop = {stop:g} is not after start = {start:g}")

    @property
    def settings(self) -> tuple[tuple[str, str], ...]:
        """Settings by name and text that a drive with the stage has by default."""
        return ()

    @property
    def image_kinds(self) -> tuple[str, ...]:
        """Kinds of image, besides colours, that the stage needs of a recorded camera."""
        return ()

    @property
    def requires(self) -> tuple[str, ...]:
        """What the stage must know of a drive: `POSES`, `ROAD_USERS`, `LABELS`."""
        return ()

    @property
    def lookback(self) -> float:
        """Seconds before a frame whose clouds the stage asks `Situation.earlier` for."""
        return 0.0

    def clearness(self, pulses: Pulses, row: int, *, distance: float, at: Situation) -> float:
        """Share of light that reaches the sensor through the stage's air, one way, along a pulse (row)."""
        del pulses, row, distance, at
        return 1.0


@dataclass(frozen=True, slots=True)
class Pulses(Columns):
    """The pulses of one frame in the order they are fired.

    sensor     : the scanner
    time_ns    : (n,) int64, nanoseconds since the drive's start
    direction  : (n, 3) unit vectors as sent, sensor frame (x forward, y left, z up) at the pulse's time
    origin     : (n, 3) metres, where the beam starts, same frame
    ring       : (n,) uint16, rank of the beam's elevation, 0 lowest
    column     : (n,) int32, firing block within the frame
    channel    : (n,) uint16, number of the laser
    power      : (n,) transmitted power over that of the sensor's nominal pulse
    noise      : standard deviation of the noise that the detector adds to echoes, over the threshold
    """

    sensor: Sensor
    time_ns: NDArray[np.int64]
    direction: Float
    origin: Float
    ring: NDArray[np.uint16]
    column: NDArray[np.int32]
    channel: NDArray[np.uint16]
    power: Float
    noise: float = 0.0

    def received(self, echoes: Echoes) -> Float:
        """Power (m,) of echoes over the detection threshold."""
        return receive(self.sensor, echoes)

    def apparent(self, power: Float, distance: Float) -> Float:
        """Apparent reflectance (m,) of echoes that arrive with a power over the detection threshold.

        distance : (m,) metres from the beam's start
        """
        return apparent_of(self.sensor, power, distance=distance + self.sensor.pattern.range_offset)


def pulses_of(sensor: Sensor, sent: Firings, *, noise: float = 0.0) -> Pulses:
    """The pulses that a sensor sends, all with its nominal power; noise as of `Pulses`."""
    columns = (sent.time_ns, sent.direction, sent.origin, sent.ring, sent.column, sent.channel)
    return Pulses(sensor, *columns, np.ones(len(sent)), noise)


def added_echoes(
    pulse: NDArray[np.integer],
    distance: Float,
    *,
    apparent: Float,
    origin: Origin,
    klass: Class = Class.NOISE,
    feature: int = -1,
) -> TracedEchoes:
    """Echoes that a stage adds; join them to others with `lidar.sensors.physics.echoes.join`.

    pulse    : (k,) row of the pulse
    distance : (k,) metres from the beam's start
    apparent : (k,) apparent reflectance, such as from `Pulses.apparent`
    """
    found = artificial_echoes(pulse, distance, apparent=apparent, klass=klass, feature=feature)
    return trace(found, origin, source=np.full(len(found), -1))
