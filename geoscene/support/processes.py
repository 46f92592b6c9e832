"""Runs tasks in worker processes, which stop at once when interrupted and of which some may be killed."""

from __future__ import annotations

import logging
import multiprocessing
import os
import resource
import signal
import sys
import threading
import traceback
import warnings
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.context import BaseContext
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, Generic, TypeVar, cast

from geoscene.errors import WorkersLostError

log = logging.getLogger(__name__)

_INTERRUPTIONS = (signal.SIGINT, signal.SIGTERM)
"""Signals that a terminal or ``timeout`` sends to all processes; they are for the parent process."""

_THREADS = Path("/proc/self/task")
"""Folder of an entry for each thread of this process, on Linux."""

Task = TypeVar("Task")
Result = TypeVar("Result")


@dataclass(slots=True)
class _Worker(Generic[Task]):
    """A process and its current task; None while it is idle."""

    process: BaseProcess
    task: Task | None = None

    def end(self) -> str:
        """Description of how the process ended."""
        self.process.join()
        code = self.process.exitcode or 0
        cause = f"was killed by signal {-code}" if code < 0 else f"ended with exit code {code}"
        return f"a worker process {cause}" + "; the system may be out of memory" * (-code == signal.SIGKILL)


def run_tasks(work: Callable[[Task], Result], tasks: Sequence[Task], *, workers: int) -> Iterator[Result]:
    """Yields the results of ``work`` for all tasks, in the order of their completion.

    Workers are processes started with the current method (`multiprocessing.set_start_method`), but spawned
    instead of forked if a library has threads in this process, whose locks and pools a fork would break.
    Forked ones share the memory of ``work``, spawned ones get a pickled copy each and need an importable main
    module. They are killed when the iterator is closed or raises, and end when this process ends. The task of
    a worker that was killed goes to another one.

    Raises the errors of ``work``, and WorkersLostError if all workers were killed.
    """
    waiting = deque(tasks)
    team: dict[Any, _Worker[Task]] = {}
    context = _context()
    try:
        for _ in range(min(workers, len(waiting))):
            _add_worker(team, work, context=context)
        while busy := _assign(team, waiting):
            for connection in cast("list[Connection]", wait(busy)):
                worker = team[connection]
                try:
                    error, result = connection.recv()
                except (EOFError, OSError):
                    waiting.extendleft([worker.task] if worker.task is not None else [])
                    del team[connection]
                    if not team:
                        raise WorkersLostError(
                            f"{worker.end()}, and so did all others; the finished part is kept:"
                            " repeat the command with fewer `workers`"
                        ) from None
                    log.warning("%s; its task goes to the other %d", worker.end(), len(team))
                    continue
                if error is not None:
                    raise error
                worker.task = None
                yield cast("Result", result)
    finally:
        for worker in team.values():
            worker.process.kill()
        for worker in team.values():
            worker.process.join()


def _context() -> BaseContext:
    """Start method of processes: the current one, but no fork while libraries have threads."""
    context = multiprocessing.get_context()
    forks = context.get_start_method() == "fork"
    return multiprocessing.get_context("spawn") if forks and threads_of_libraries() else context


def threads_of_libraries() -> int:
    """Number of native threads that make a fork unsafe; 0 without ``/proc``.

    They are those of pools, as of lazrs, Arrow or TBB. Those of OpenBLAS, which it ends before a fork and
    starts again when needed, do not count.
    """
    if not _THREADS.is_dir():
        return 0
    with _without_interruptions(), warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of forks with threads, from Python 3.12
        if not (child := os.fork()):  # so that libraries that care for forks end their threads
            os._exit(0)
        os.waitpid(child, 0)
    known = {thread.native_id for thread in threading.enumerate()}
    return sum(int(entry.name) not in known for entry in _THREADS.iterdir())


@contextmanager
def _without_interruptions() -> Iterator[None]:
    """Block interruptions, also in processes that are started in the block."""
    masks = hasattr(signal, "pthread_sigmask")
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _INTERRUPTIONS) if masks else None
    try:
        yield
    finally:
        if before is not None:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _add_worker(
    team: dict[Any, _Worker[Task]], work: Callable[[Task], Result], *, context: BaseContext
) -> None:
    """Start a process and add it to the team, with interruptions blocked."""
    ours, theirs = context.Pipe()
    process: BaseProcess = context.Process(target=_serve, args=(theirs, work), daemon=True)  # type: ignore[attr-defined]
    with _without_interruptions():
        process.start()
        team[ours] = _Worker(process)
    theirs.close()


def _assign(team: dict[Any, _Worker[Task]], waiting: deque[Task]) -> list[Any]:
    """Give each idle worker a task; returns the connections of the busy ones."""
    for connection, worker in team.items():
        if worker.task is None and waiting:
            worker.task = waiting.popleft()
            with suppress(OSError):  # if the process has ended, reading from it tells so
                connection.send(worker.task)
    return [connection for connection, worker in team.items() if worker.task is not None]


def _serve(connection: Connection, work: Callable[[Task], Result]) -> None:
    """Work on the tasks that arrive, in a worker process; exit when the parent process ends."""
    for interruption in _INTERRUPTIONS:
        signal.signal(interruption, signal.SIG_IGN)
    threading.Thread(target=_exit_with_parent, daemon=True).start()
    with suppress(EOFError, ConnectionError):  # the parent process has been killed
        while True:
            task = connection.recv()
            answer: tuple[Exception | None, Result | None]
            try:
                answer = None, work(task)
            except Exception as error:  # noqa: BLE001  (raised again in the parent process)
                error.add_note(traceback.format_exc())
                answer = error, None
            connection.send(answer)


def _exit_with_parent() -> None:
    if (parent := multiprocessing.parent_process()) is not None:
        wait([parent.sentinel])
        os._exit(1)


def peak_memory() -> int:
    """Peak memory of this process in bytes; Linux's own count, as a parent's may be part of the other."""
    status = Path("/proc/self/status")
    if status.exists():
        line = next(text for text in status.read_text().splitlines() if text.startswith("VmHWM"))
        return 1024 * int(line.split()[1])
    unit = 1 if sys.platform == "darwin" else 1024
    return unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
