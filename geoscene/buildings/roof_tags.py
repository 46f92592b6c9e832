"""Shape, direction and pitch of a roof from its tags."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely

from geoscene.buildings.table import SHAPES
from geoscene.sources.data import Tags
from geoscene.tags import parse_direction, parse_number

_OTHER_NAMES = {
    "pitched": "gabled", "gable": "gabled", "hip": "hipped", "half_hipped": "half-hipped",
    "lean_to": "skillion",
    "shed": "skillion", "pyramid": "pyramidal", "conical": "cone", "monopitch": "skillion",
    "spherical": "dome",
    "barrel": "round", "vaulted": "round", "rounded": "round", "no": "flat", "yes": "flat",
}  # fmt: skip

PITCH_DEG = 30.0
"""Assumed pitch of a roof without a tagged height."""


@dataclass(frozen=True, slots=True)
class RoofTags:
    """A roof as tagged.

    shape         : one of SHAPES
    unknown       : the value of roof:shape if it is not one of them, else ""
    direction_deg : downslope azimuth of the face, clockwise from true north; NaN if not tagged
    across        : roof:orientation=across
    angle_deg     : pitch, NaN if not tagged
    """

    shape: str
    unknown: str
    direction_deg: float
    across: bool
    angle_deg: float


def read_roof_tags(tags: Tags) -> RoofTags:
    """The tagged roof; flat if nothing is tagged."""
    value = (
        (tags.get("roof:shape") or tags.get("building:roof:shape") or "flat").split(";")[0].strip().lower()
    )
    shape = _OTHER_NAMES.get(value, value.replace("_", "-"))
    unknown = "" if shape in SHAPES else value
    direction = parse_direction(tags.get("roof:direction") or tags.get("roof:slope:direction"))
    angle = parse_number((tags.get("roof:angle") or "").rstrip("° "))
    return RoofTags(
        "flat" if unknown else shape,
        unknown,
        np.nan if direction is None else direction,
        tags.get("roof:orientation") == "across",
        angle if angle is not None and 0 < angle < 90 else np.nan,
    )


def default_roof_height(roof: RoofTags, footprint: Any) -> tuple[float, str]:
    """Height of a roof in metres from its angle, else a usual pitch; its source, ``angle`` or ``default``.

    The run is the radius of the largest circle in the footprint (its diameter for a skillion roof). A dome or
    onion without height is as high as the run (onion: 1.5 runs), curved and broken shapes have 45
    degrees.
    """
    # GEOS returns the circle as a line from its centre to its rim
    run = float(shapely.length(shapely.maximum_inscribed_circle(footprint, tolerance=0.05)))
    if roof.shape == "skillion":
        run *= 2.0
    if np.isfinite(roof.angle_deg):
        return float(run * np.tan(np.radians(roof.angle_deg))), "angle"
    if roof.shape in ("dome", "onion"):
        return run * (1.5 if roof.shape == "onion" else 1.0), "default"
    pitch = 45.0 if roof.shape in ("round", "gambrel", "mansard", "cone", "pyramidal") else PITCH_DEG
    if roof.shape == "skillion":
        pitch = 10.0
    return float(min(run * np.tan(np.radians(pitch)), 8.0)), "default"
