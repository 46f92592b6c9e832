"""Registry of detectors."""

from __future__ import annotations

import functools
from pathlib import Path

from lidar.errors import InputError
from lidar.tools.detection.detector import Detector
from lidar.tools.detection.learned import read_model
from lidar.tools.detection.rules import RULES

MODEL = Path(__file__).with_name("learned.npz")
"""The model that comes with the program."""


@functools.lru_cache(maxsize=8)
def read_detector(name: str) -> Detector:
    """The detector ``rules``, ``learned``, or that of a model's file.

    Raises InputError for another name, and FormatError for a file that is no model.
    """
    if name == RULES.name:
        return RULES
    if name == "learned":
        return read_model(MODEL, name=name)
    if not Path(name).exists():
        raise InputError(f"`detector` {name}: give rules, learned, or the file of a model (lidar train)")
    return read_model(Path(name))
