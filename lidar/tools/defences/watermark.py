"""The keyed watermark of `lidar sign`: returns that do not bear it, and gaps in it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from lidar.parameters import parameter
from lidar.tools.defences.defence import Defence, Window
from lidar.tools.defences.verdict import Gaps, Verdict
from lidar.tools.integrity.keys import read_secret
from lidar.tools.integrity.tampering import NOISE, FrameVerdict, frame_verdict
from lidar.tools.integrity.watermark import STEP, WatermarkCells
from lidar.tools.integrity.watermark import WatermarkKey as Mark


@dataclass(frozen=True)
class WatermarkDefence(Defence):
    """Returns without the watermark that was embedded with a key (Changalvala and Malik 2019)."""

    needs: ClassVar[frozenset[str]] = frozenset({"watermark"})

    key: str = parameter("", "file with the key")
    step: float = parameter(STEP, "step with which it was embedded", unit="m", low=1e-4, high=1)
    noise: float = parameter(NOISE, "standard deviation of noise since", unit="m", low=0, high=1)
    false_alarms: float = parameter(
        0.01, "blocks a cloud above suspicion 0.5 without tampering", low=1e-9, high=100
    )

    def __post_init__(self) -> None:
        """Validate the parameters; the key must be readable."""
        super().__post_init__()
        if self.key:
            read_secret(Path(self.key))

    @property
    def lacks(self) -> str:
        """The key, if it was not given."""
        return "" if self.key else "needs the key of the watermark: watermark:key=FILE"

    def judge(self, window: Window) -> Verdict:
        """Judge the returns of the last frame; the frame by its block with most wrong bits for its size."""
        frame = window.frame
        cells = WatermarkCells(frame.sensor.name, frame.number, frame.ring, frame.column, frame.echo)
        mark = Mark(read_secret(Path(self.key)), self.step)
        found = frame_verdict(mark, frame.xyz, cells=cells, noise=self.noise, false_alarms=self.false_alarms)
        returns = np.where(found.forged, np.maximum(found.suspicion, 0.5), np.minimum(found.suspicion, 0.5))
        objects = np.array([returns[rows].mean() if len(rows) else 0.0 for rows in frame.members])
        ratio = (found.blocks.wrong / found.blocks.least).max(initial=0.0)
        return Verdict(returns, objects, float(ratio / (1 + ratio)), _gaps(found))


def _gaps(found: FrameVerdict) -> Gaps:
    """The places of removed returns."""
    gone = [place for place in found.places if place.kind == "removed"]
    low = np.array([place.low[:2] for place in gone]).reshape(-1, 2)
    high = np.array([place.high[:2] for place in gone]).reshape(-1, 2)
    return Gaps((low + high) / 2, np.linalg.norm(high - low, axis=1) / 2, np.ones(len(gone)))
