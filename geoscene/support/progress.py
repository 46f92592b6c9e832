"""Callback by which long tasks report progress."""

from __future__ import annotations

from typing import Protocol


class Progress(Protocol):
    """Progress callback; implementations must be fast and must not raise."""

    def __call__(self, stage: str, done: int, *, total: int) -> None:
        """Report that ``done`` of ``total`` steps of a stage are complete; ``total`` is 0 if unknown."""


def silent(stage: str, done: int, *, total: int) -> None:
    """A `Progress` that reports nothing."""
