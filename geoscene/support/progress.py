"""Progress of long tasks: the callback by which they report it, and what shows it by default.

Commands and the functions that Python code calls show their stages on standard error: a bar for the running
ones on terminals and in notebooks, and one line for each stage that has ended, also in files and pipes.
`show_progress` switches it off, as does the environment variable ``GEOSCENE_PROGRESS=off``.
"""

from __future__ import annotations

import functools
import os
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import parent_process
from typing import Any, ParamSpec, Protocol, TypeVar

P = ParamSpec("P")
R = TypeVar("R")

VARIABLE = "GEOSCENE_PROGRESS"
"""Environment variable; ``off`` shows nothing."""


class Progress(Protocol):
    """Progress callback; implementations must be fast and must not raise."""

    def __call__(self, stage: str, done: int, *, total: int) -> None:
        """Report that ``done`` of ``total`` steps of a stage are complete; ``total`` is 0 if unknown.

        A stage of unknown length ends when another one begins, unless that is an `Aside`.
        """


class Aside(str):
    """Name of a stage within another one, which goes on after it: a wait, or code that is compiled."""

    __slots__ = ()


def silent(stage: str, done: int, *, total: int) -> None:
    """A `Progress` that reports nothing."""


def displayed(stage: str, done: int, *, total: int) -> None:
    """The default `Progress` of functions that `shows_progress`; reports nothing elsewhere."""


class _State:
    """Whether progress is shown by default, and whether a block that may show it is under way."""

    on = True
    within = False
    lock = threading.Lock()


def show_progress(on: bool) -> None:  # noqa: FBT001 - reads as a sentence
    """Show the progress of functions by default, or not. ``progress=geoscene.silent`` silences one call."""
    _State.on = on


@contextmanager
def progress_bar(*, quiet: bool = False) -> Iterator[Progress]:
    """Yield a `Progress` that shows stages on standard error until the block ends.

    It is silent if that is not wanted, in worker processes, and within a block of another one.
    """
    with _State.lock:
        within, _State.within = _State.within, True
    unwanted = quiet or not _State.on or os.environ.get(VARIABLE, "").lower() == "off"
    try:
        if unwanted or within or parent_process() is not None or sys.stderr is None:
            yield silent
            return
        from geoscene.support.stages import opened_display  # noqa: PLC0415 - of use to few processes

        with opened_display() as progress:
            yield progress
    finally:
        _State.within = within


def shows_progress(function: Callable[P, R]) -> Callable[P, R]:
    """Decorator of functions with ``progress`` that is `displayed` by default: it is shown during calls."""

    @functools.wraps(function)
    def showing(*args: P.args, **kwargs: P.kwargs) -> R:
        if kwargs.get("progress", displayed) is not displayed:
            with progress_bar(quiet=True):
                return function(*args, **kwargs)
        with progress_bar() as progress:
            named: dict[str, Any] = {**kwargs, "progress": progress}
            return function(*args, **named)

    return showing
