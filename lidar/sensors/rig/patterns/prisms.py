"""Scanners that deflect their beams with rotating wedge prisms; the pattern does not repeat."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np

from geoscene.support.compiled import njit
from geoscene.typing import Float
from lidar.sensors.rig.patterns.beams import Firings, blocks, from_origin, numbers
from lidar.toml_table import Table


@dataclass(frozen=True, eq=False)
class Prisms:
    """Beams along the prisms' common axis that fire simultaneously.

    incident : (b, 3) unit vectors of the beams before the prisms, which stand along +y
    wedge    : (k,) radians, angle between the faces of each prism; positive if the inclined face comes first
    index    : (k,) refractive index
    turn_hz  : (k,) revolutions per second; the sign gives the direction
    pulse_hz : pulses per second of each beam
    """

    incident: Float
    wedge: Float
    index: Float
    turn_hz: Float
    pulse_hz: Fraction
    range_offset: float = 0.0

    def fire(self, frame: int, rate_hz: float, *, start_ns: int) -> Firings:
        """The pulses of frame ``frame``; the prisms' rotation continues across frames."""
        block = blocks(frame, rate_hz, block_ns=10**9 / self.pulse_hz, start_ns=start_ns)
        seconds = (block.first + np.arange(len(block))) / float(self.pulse_hz)
        beams = len(self.incident)
        phase = 2 * np.pi * np.mod(np.multiply.outer(seconds, self.turn_hz), 1.0)
        direction = np.empty((len(block) * beams, 3))
        faces = np.stack([np.sin(self.wedge), np.cos(self.wedge), self.index], axis=1)
        _steer(self.incident, faces, np.sin(phase), np.cos(phase), direction)
        column, channel = numbers(len(block), beams)
        return from_origin(np.repeat(block.time_ns, beams), direction, column=column, channel=channel)


@njit(cache=True, nogil=True)
def _steer(incident: Any, faces: Any, sine: Any, cosine: Any, direction: Any) -> None:
    """Fill ``direction`` with the beams behind the prisms, in sensor axes.

    faces : (k, 3) sine and cosine of the wedge angle, refractive index
    """
    ray = 0
    for i in range(len(sine)):
        for beam in range(len(incident)):
            x, y, z = incident[beam]
            for k in range(len(faces)):
                side, up, n = faces[k]
                nx, ny, nz = side * sine[i, k], -up, side * cosine[i, k]
                if side > 0:
                    x, y, z = _refract(x, y, z, nx, ny, nz, 1 / n)
                    x, y, z = _refract(x, y, z, 0.0, -1.0, 0.0, n)
                else:
                    x, y, z = _refract(x, y, z, 0.0, -1.0, 0.0, 1 / n)
                    x, y, z = _refract(x, y, z, nx, ny, nz, n)
            # The prisms' axis y is forward, their x is up.
            direction[ray, 0], direction[ray, 1], direction[ray, 2] = y, z, x
            ray += 1


@njit(cache=True, nogil=True)
def _refract(x: Any, y: Any, z: Any, nx: Any, ny: Any, nz: Any, ratio: Any) -> Any:
    """Unit vector behind a boundary by Snell's law; ``ratio`` of the indices before and behind."""
    c = -(x * nx + y * ny + z * nz)
    s2 = ratio * ratio * (1 - c * c)
    along = ratio * c - np.sqrt(1 - s2)
    return ratio * x + along * nx, ratio * y + along * ny, ratio * z + along * nz


def read_prisms(table: Table) -> Prisms:
    """The pattern that a ``[prism]`` table describes.

    Raises RigError for keys that are missing, unknown or out of bounds.
    """
    wedge = np.radians(table.numbers("wedge_deg"))
    k = len(wedge)
    x = np.array(table.numbers("incident_x", (0.0,)))
    if (np.abs(x) >= 1).any():
        raise table.error("incident_x", "components of unit vectors are within -1 to 1")
    pattern = Prisms(
        incident=np.stack([x, np.sqrt(1 - x * x), 0 * x], axis=1),
        wedge=wedge,
        index=np.array(table.numbers("index", count=k, spread=True)),
        turn_hz=np.array(table.numbers("turn_hz", count=k)),
        pulse_hz=Fraction(str(table.number("pulse_hz", low=1e-3, high=1e7))),
    )
    if (pattern.index < 1).any():
        raise table.error("index", "indices of refraction are 1 or more")
    if not np.isfinite(pattern.fire(0, 10.0, start_ns=0).direction).all():
        raise table.error("wedge_deg", "beams are totally reflected within these prisms")
    table.close()
    return pattern
