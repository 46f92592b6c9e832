"""Results of a comparison of settings: rows of a sensor, and further tables of a drive."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from lidar.tools.tradeoff.errors import ErrorEstimate

Kind = Literal["scanner", "camera"]

TAILS: dict[Kind, str] = {"scanner": "range_99.9_m", "camera": "rgb_rms"}
"""The figure of an error by which settings of a kind of sensor are ranked."""


@dataclass(frozen=True, slots=True)
class VariantRow:
    """A measured variant.

    error  : of the user's settings with this one changed, against the reference; see `errors.STATISTICS`
             and `errors.IMAGE_STATISTICS`
    alone  : of the reference with this one changed; empty for the user's own settings and combinations
    cost   : CPU seconds (``cpu_s``) and bytes (``bytes``) per simulated second, peak memory
             (``memory_bytes``)
    note   : what the figures do not say, such as that a setting has no effect
    choice : whether a drive in this world may choose it: not another model, scene or traffic
    """

    label: str
    error: dict[str, ErrorEstimate]
    alone: dict[str, ErrorEstimate]
    cost: dict[str, ErrorEstimate]
    note: str = ""
    choice: bool = True


@dataclass(frozen=True, slots=True)
class SensorComparison:
    """The rows of a sensor.

    sensor    : name on the rig, with its preset or size
    reference : what errors are measured against, in words
    residual  : difference between the reference and one with another number of rays: its own uncertainty
    rows      : the user's own settings come first
    samples   : number of pulses or pixels compared
    frames    : number of frames that they are from
    """

    sensor: str
    reference: str
    residual: dict[str, ErrorEstimate]
    rows: tuple[VariantRow, ...]
    samples: int
    frames: int
    kind: Kind = "scanner"

    @property
    def tail(self) -> str:
        """The figure of an error by which the rows are ranked."""
        return TAILS[self.kind]

    @property
    def uncertainty(self) -> float:
        """Metres or levels (see `tail`) by which the reference may be off."""
        return self.residual[self.tail].value


@dataclass(frozen=True, slots=True)
class Record:
    """A row of a `Listing`: figures by name; the end of a name is its unit (m, ppm, bytes, share, s)."""

    label: str
    figures: dict[str, float]
    note: str = ""


@dataclass(frozen=True, slots=True)
class Listing:
    """A table of a drive beside those of its sensors.

    name : of the option that selects it: files, voxel or frame
    title, note : what was compared, and how
    """

    name: str
    title: str
    note: str
    records: tuple[Record, ...]
