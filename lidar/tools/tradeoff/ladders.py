"""Numbers of rays to choose from for the scanners and the cameras of a rig."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from lidar.options import DriveOptions
from lidar.sensors.rig.devices import Camera, Scanner

Kind = Literal["scanners", "cameras"]

RAYS = (1, 7, 13, 19, 37, 61, 91, 127, 169, 217, 331, 499, 665)
"""Numbers of rays per pulse to choose from, the cheapest first.

Poses, precision and the second trace are none of the choice, as they save a few percent at most.
"""

SUPERSAMPLES = (1, 2, 3, 4, 6, 8)
"""Rays along each side of a pixel to choose from.

Images without shadows or detail are none of the choice, as they save a quarter and err by 9 levels and more.
"""

EXPOSED = ((1, 5), (2, 9), (3, 17))
"""Rays along each side of a pixel, and moments, to choose from if the exposure of a camera takes time."""


@dataclass(frozen=True, slots=True)
class Ladder:
    """Settings to choose from for the scanners or the cameras of a rig, the cheapest first.

    sensors : all of the kind
    names   : of the settings that differ; empty if none is to be picked, and the only row is the drive's own
    rows    : values of these settings
    """

    kind: Kind
    sensors: tuple[Scanner | Camera, ...]
    names: tuple[str, ...]
    rows: tuple[tuple[int, ...], ...]

    def values(self, row: int) -> dict[str, int]:
        """The settings of a row, by name."""
        return dict(zip(self.names, self.rows[row], strict=True))


def ladders_of(
    options: DriveOptions, sensors: Sequence[Scanner | Camera], *, free: Sequence[Kind]
) -> dict[Kind, Ladder]:
    """Ladders of the kinds of sensors of a drive; settings are picked for those in ``free``.

    The settings of the drive's fidelity level are among the rows.
    """
    settings = options.recording_settings
    scanner, camera = settings.scanner, settings.camera
    found: dict[Kind, Ladder] = {}
    if scanners := tuple(s for s in sensors if isinstance(s, Scanner)):
        rays = tuple((count,) for count in sorted({*RAYS, scanner.rays}))
        found["scanners"] = Ladder("scanners", scanners, ("rays",), rays)
    cameras = [s for s in sensors if isinstance(s, Camera)]
    if any(s.spec.exposure_ns for s in cameras):
        shots = sorted({*EXPOSED, (camera.supersample, camera.blur)}, key=lambda v: (v[0] ** 2 * v[1], v))
        found["cameras"] = Ladder("cameras", tuple(cameras), ("supersample", "blur"), tuple(shots))
    elif cameras:
        sides = tuple((side,) for side in sorted({*SUPERSAMPLES, camera.supersample}))
        found["cameras"] = Ladder("cameras", tuple(cameras), ("supersample",), sides)
    return {
        kind: ladder if kind in free else replace(ladder, names=(), rows=((),))
        for kind, ladder in found.items()
    }


def settings_of_rows(ladders: Mapping[Kind, Ladder], rows: Mapping[Kind, int]) -> dict[str, int]:
    """Values of all settings that are picked, by name."""
    return {name: value for kind, row in rows.items() for name, value in ladders[kind].values(row).items()}


def label_of(settings: Mapping[str, int]) -> str:
    """Settings as text, as in ``rays=7``."""
    return " ".join(f"{name}={value}" for name, value in settings.items())
