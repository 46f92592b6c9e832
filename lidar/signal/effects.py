"""Counts of the changes that stages made to the frames of a run, by stage."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence

import numpy as np

from lidar.sensors.laser.cloud import TracedCloud
from lidar.sensors.physics.echoes import TracedEchoes

Counts = dict[str, dict[str, int]]
"""Numbers by stage, and by what was added, removed or changed, such as ``returns added``."""


class Effects:
    """Counts of what stages did; several threads may add to them."""

    def __init__(self) -> None:
        self.counts: Counts = {}
        self._lock = threading.Lock()

    def add(self, stage: str, counts: Mapping[str, int]) -> None:
        """Add what a stage did to a frame, or to the measurements of a device."""
        with self._lock:
            own = self.counts.setdefault(stage, {})
            for what, number in counts.items():
                own[what] = own.get(what, 0) + int(number)


def row_changes(
    before: TracedEchoes | TracedCloud,
    after: TracedEchoes | TracedCloud,
    *,
    unit: str,
    columns: Sequence[str],
) -> dict[str, int]:
    """Numbers of rows of a table of ``unit`` that were added, removed, and changed in some columns."""
    known, still = before.source >= 0, after.source >= 0
    most = max(before.source.max(initial=-1), after.source.max(initial=-1)) + 1
    row = np.full(most, -1)
    row[before.source[known]] = np.flatnonzero(known)
    old, new = row[after.source[still]], np.flatnonzero(still)
    differs = np.zeros(len(new), bool)
    for name in columns:
        unequal = getattr(after, name)[new] != getattr(before, name)[old]
        differs |= unequal.any(axis=tuple(range(1, unequal.ndim)))
    gained = int((~still).sum()) - int((~known).sum())  # of what stages have added
    return {
        f"{unit} added": max(gained, 0),
        f"{unit} removed": int(known.sum()) - len(new) + max(-gained, 0),
        f"{unit} changed": int(differs.sum()),
    }


def effect_lines(effects: Counts) -> list[str]:
    """A line for each stage."""
    lines = []
    for stage, counts in effects.items():
        done = ", ".join(f"{number:,} {what}" for what, number in counts.items() if number)
        lines.append(f"stage {stage}: {done or 'changed nothing; check when and where it acts'}")
    return lines
