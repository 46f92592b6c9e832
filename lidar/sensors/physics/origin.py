"""Causes of echoes and returns."""

from __future__ import annotations

from enum import IntEnum


class Origin(IntEnum):
    """Cause of an echo or a return."""

    SURFACE = 0
    WEATHER = 1
    INTERFERENCE = 2
    INJECTED = 3
    REPLAYED = 4
    MOVED = 5
    RECEIVER = 6  # false alarms and blooming
