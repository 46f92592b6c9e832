"""How long work says how far it is."""

from __future__ import annotations

from typing import Protocol


class Progress(Protocol):
    """Called with the name of the stage and how much of it is done; must be cheap and never raise."""

    def __call__(self, stage: str, done: int, *, total: int) -> None:
        """Take note: ``done`` of ``total`` steps of a stage; a total of 0 means it is not known."""


def silent(stage: str, done: int, *, total: int) -> None:
    """Take no note."""
