"""Stages of long tasks as text: which ones run, since when and how far, and how each one has ended."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from geoscene.support.progress import Aside, Progress

_BRIEF_S = 1.0
"""Seconds from which on a task shows anything: shorter ones need none, and errors of input stand alone."""

_BETWEEN_S = 0.25
"""Seconds between two updates in a notebook."""


@dataclass(slots=True)
class Stage:
    """A stage of a task.

    done, total : steps; the total is 0 if it is unknown
    began       : when it was first reported, or last resumed, on the clock
    spent       : seconds before that, of an `Aside` that has run several times
    runs        : whether it has not ended
    """

    name: str
    done: int
    total: int
    began: float
    spent: float = 0.0
    runs: bool = True

    def seconds(self, now: float) -> float:
        """Seconds that it has taken."""
        return self.spent + (now - self.began if self.runs else 0.0)

    def remaining(self, now: float) -> float | None:
        """Seconds that it will take at the mean speed so far; None if that is not known."""
        if not (self.total and self.done):
            return None
        return self.seconds(now) * max(self.total - self.done, 0) / self.done

    def figures(self, now: float) -> str:
        """Steps and times: ``12 of 60, 3.4 s, 13.6 s left``."""
        parts = [duration(self.seconds(now))]
        if self.total:
            parts.insert(0, f"{self.done:,} of {self.total:,}")
        if (left := self.remaining(now)) is not None:
            parts.append(f"{duration(left)} left")
        return ", ".join(parts)

    def ended_text(self, now: float, *, stopped: bool) -> str:
        """How it ended: ``tiles: 60 done in 3.4 s`` or ``tiles: stopped at 12 of 60 after 3.4 s``."""
        took = duration(self.seconds(now))
        if stopped:
            where = f" at {self.done:,} of {self.total:,}" if self.total else ""
            return f"{self.name}: stopped{where} after {took}"
        steps = max(self.total, self.done)
        return f"{self.name}: {f'{steps:,} ' * (steps > 1)}done in {took}"


def duration(seconds: float) -> str:
    """Seconds as a short text: ``3.4 s``, ``2:05 min``, ``1:02:05 h``."""
    if seconds < 59.95:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes}:{rest:02d} min"
    return f"{minutes // 60}:{minutes % 60:02d}:{rest:02d} h"


class Stages:
    """The stages of a task by reports of its progress; a `Progress`, for several threads.

    line    : takes the text of a stage that has ended
    changed : takes the stages that run, whenever one is reported
    clock   : seconds
    """

    def __init__(
        self,
        line: Callable[[str], None],
        *,
        changed: Callable[[list[Stage]], None] = lambda _: None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._line, self._changed, self._clock = line, changed, clock
        self._began, self._held = clock(), list[str]()
        self._stages: dict[str, Stage] = {}
        self._lock = threading.RLock()

    def __call__(self, stage: str, done: int, *, total: int) -> None:
        """Take a report."""
        with self._lock:
            now, aside = self._clock(), isinstance(stage, Aside)
            known = self._stages.get(stage)
            for other in list(self._stages.values()):
                if isinstance(other.name, Aside):
                    if other.runs and other.name != stage:
                        _pause(other, now)
                elif known is None and not aside and other.done >= other.total - 1:
                    self._end(other, now)
            if known is None:
                known = self._stages[stage] = Stage(stage, done, total, now)
                if aside and total:  # the line of a wait is of no use after it
                    self._held.append(stage)
                    self._release()
            elif not known.runs:
                known.began, known.runs = now, True
            known.done, known.total = done, total
            if total and done >= total:
                self._end(known, now)
            self._changed(self.running())

    def running(self) -> list[Stage]:
        """The stages that have not ended, in the order in which they began."""
        return [stage for stage in list(self._stages.values()) if stage.runs]

    def close(self, *, stopped: bool = False) -> None:
        """End all stages; ``stopped`` if the task was interrupted before its end."""
        with self._lock:
            now = self._clock()
            for stage in list(self._stages.values()):
                self._end(stage, now, stopped=stopped and stage.runs)
            self._changed([])

    def abandon(self) -> None:
        """End all stages without a word: the message of an error says what has happened."""
        with self._lock:
            self._stages.clear()
            self._changed([])

    def _end(self, stage: Stage, now: float, *, stopped: bool = False) -> None:
        del self._stages[stage.name]
        if not (isinstance(stage.name, Aside) and stage.total):
            self._held.append(stage.ended_text(now, stopped=stopped))
        if now - self._began >= _BRIEF_S:
            self._release()

    def _release(self) -> None:
        for text in self._held:
            self._line(text)
        self._held.clear()


def _pause(stage: Stage, now: float) -> None:
    """Stop the clock of a stage that may go on later."""
    stage.spent, stage.runs = stage.seconds(now), False


@contextmanager
def opened_display() -> Iterator[Progress]:
    """Yield a `Progress` that shows stages as fits a terminal, a notebook, or a file or pipe."""
    if sys.stderr.isatty():
        shows = _on_terminal()
    elif _in_notebook():
        shows = _in_cell()
    else:
        shows = _as_lines()
    with shows as stages:
        try:
            yield stages
        except Exception:
            stages.abandon()
            raise
        except BaseException:  # interrupted
            stages.close(stopped=True)
            raise
        stages.close()


@contextmanager
def _as_lines() -> Iterator[Stages]:
    yield Stages(_print_line)


def _print_line(text: str) -> None:
    sys.stderr.write(f"{text}\n")
    sys.stderr.flush()


@contextmanager
def _on_terminal() -> Iterator[Stages]:
    """Stages as bars at the foot of a terminal, and lines above them."""
    from rich.console import Console  # noqa: PLC0415
    from rich.live import Live  # noqa: PLC0415
    from rich.text import Text  # noqa: PLC0415

    console = Console(stderr=True)
    stages = Stages(lambda line: console.print(Text(line), soft_wrap=True))
    bars = Live(
        get_renderable=lambda: bars_of(stages.running(), time.monotonic()),
        console=console,
        refresh_per_second=5,
        transient=True,
        redirect_stdout=False,  # results may go to a file
    )
    with bars:
        yield stages


def bars_of(running: list[Stage], now: float) -> Any:
    """A bar for each stage that has run for a while, with its steps and times, to be shown by rich."""
    from rich.progress_bar import ProgressBar  # noqa: PLC0415
    from rich.table import Table  # noqa: PLC0415
    from rich.text import Text  # noqa: PLC0415

    table = Table.grid(padding=(0, 1))
    for stage in running:
        if stage.seconds(now) < _BRIEF_S / 2:
            continue
        bar = ProgressBar(total=stage.total or None, completed=stage.done, width=24, pulse=not stage.total)
        table.add_row(Text(stage.name), bar, Text(stage.figures(now)))
    return table


def _in_notebook() -> bool:
    """Whether the code runs in a cell of a notebook."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return type(shell).__name__ == "ZMQInteractiveShell"


@contextmanager
def _in_cell() -> Iterator[Stages]:
    """Stages as text that changes in the output of a notebook's cell, and lines above it."""
    display: Any = sys.modules["IPython"].display.display
    lines, last, handle = list[str](), [0.0], display({"text/plain": ""}, raw=True, display_id=True)

    def show(running: list[Stage]) -> None:
        now = time.monotonic()
        if running and now - last[0] < _BETWEEN_S:
            return
        last[0] = now
        text = "\n".join([*lines, *(f"{stage.name}: {stage.figures(now)}" for stage in running)])
        handle.update({"text/plain": text}, raw=True)

    yield Stages(lines.append, changed=show)
    show([])
