"""Cost of work: in this process by turns, in a process of its own, and of a command with its children."""

from __future__ import annotations

import gc
import multiprocessing
import os
import statistics
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Literal, TypeVar

from geoscene.errors import GeosceneError
from geoscene.support.processes import peak_memory

T = TypeVar("T")

SAMPLE_S = 0.2
"""Seconds between two samples of a command's memory."""

MOST_PROCESSES = 3
"""Repetitions of whole processes, at most."""


@dataclass(frozen=True, slots=True)
class Spent:
    """Cost of a piece of work.

    wall_s, cpu_s : seconds; CPU time is that of all threads and, of commands, of all processes
    peak_bytes    : greatest memory; 0 if it was not measured
    largest_bytes : greatest resident set of one process of a command
    """

    wall_s: float
    cpu_s: float
    peak_bytes: int = 0
    largest_bytes: int = 0

    def row(self) -> dict[str, float]:
        """Columns of a table: seconds, MiB of all processes and of the largest one."""
        return {
            "wall_s": round(self.wall_s, 2),
            "cpu_s": round(self.cpu_s, 2),
            "peak_mib": self.peak_bytes >> 20,
            "largest_mib": self.largest_bytes >> 20,
        }


@dataclass(frozen=True, slots=True)
class Summary:
    """Median, smallest and greatest of repeated measurements."""

    median: float
    low: float
    high: float

    @classmethod
    def of(cls, values: Sequence[float]) -> Summary:
        """The summary of at least one value."""
        return cls(statistics.median(values), min(values), max(values))


@dataclass(frozen=True, slots=True)
class Case:
    """The same work done by several sides.

    subject : what is measured, see `bench.subjects`
    name    : the case in words
    amount, unit : the work that each side does once
    sides   : functions by name, ours first; one may return its own `Spent`, else this process is timed
    note    : what the sides do differently
    clock   : of rates and ratios: CPU time of all threads, or wall time to compare workers and programs
    simulated_s : seconds of simulated time; 0 where there are none
    processes : sides are whole processes, which are not run uncounted before, and three times at most; the
                cache of compiled code must be full
    """

    subject: str
    name: str
    amount: float
    unit: str
    sides: Mapping[str, Callable[[], object]]
    note: str = ""
    clock: Literal["cpu", "wall"] = "cpu"
    simulated_s: float = 0.0
    processes: bool = False


@dataclass(frozen=True, slots=True)
class Result:
    """A measured case without its sides' functions: costs of each side, one for each repetition."""

    case: Case
    spent: dict[str, list[Spent]]

    def seconds(self, side: str) -> list[float]:
        """Seconds of each repetition by the case's clock."""
        return [s.cpu_s if self.case.clock == "cpu" else s.wall_s for s in self.spent[side]]

    def rate(self, side: str) -> Summary:
        """Work per second."""
        return Summary.of([self.case.amount / max(s, 1e-9) for s in self.seconds(side)])

    def ratio(self, side: str) -> Summary:
        """Our rate over a side's, repetition by repetition."""
        pairs = zip(self.seconds(next(iter(self.spent))), self.seconds(side), strict=True)
        return Summary.of([theirs / max(ours, 1e-9) for ours, theirs in pairs])


def measured(case: Case, *, repetitions: int) -> Result:
    """Costs of all sides by turns; each repetition begins with another side.

    Every side runs once before, uncounted, unless the case is of processes.
    """
    names = list(case.sides)
    if case.processes:
        repetitions = min(repetitions, MOST_PROCESSES)
    else:
        for name in names:
            case.sides[name]()
    spent: dict[str, list[Spent]] = {name: [] for name in names}
    for k in range(repetitions):
        first = k % len(names)
        for name in names[first:] + names[:first]:
            gc.collect()
            spent[name].append(timed(case.sides[name]))
    return Result(replace(case, sides={}), spent)  # sides hold scenes, which must not stay in memory


def timed(work: Callable[[], object]) -> Spent:
    """Cost of a function: what it returns if that is a `Spent`, else the time of this process."""
    wall, cpu = time.perf_counter(), time.process_time()
    found = work()
    cost = Spent(time.perf_counter() - wall, time.process_time() - cpu)
    return found if isinstance(found, Spent) else cost


def difference(shorter: Callable[[], Spent], longer: Callable[[], Spent]) -> Spent:
    """What a longer work takes more than a shorter one, which starts alike; memory is that of the longer.

    Raises BenchError if it does not take longer, as beside other programs.
    """
    less, more = shorter(), longer()
    if more.wall_s <= less.wall_s or more.cpu_s <= less.cpu_s:
        raise BenchError(f"the longer work took {more.wall_s:.2f} s, the shorter {less.wall_s:.2f} s")
    wall, cpu = more.wall_s - less.wall_s, more.cpu_s - less.cpu_s
    return replace(more, wall_s=wall, cpu_s=cpu)


def alone(function: Callable[..., Callable[[], object]], *arguments: object) -> Spent:
    """Cost of work in a new process; its peak is the growth of the process's memory.

    function : prepares the work and warms up, and returns the work; of a module, so that it can be imported
    """
    return apart(_in_child, function, arguments)


def apart(function: Callable[..., T], *arguments: object) -> T:
    """What a function of a module returns in a new process, where no thread of earlier work runs."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([function.__module__])  # imports once: children are forks of the server
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        return pool.submit(function, *arguments).result()


def _in_child(function: Callable[..., Callable[[], object]], arguments: tuple[object, ...]) -> Spent:
    work = function(*arguments)
    gc.collect()
    restart_peak()
    before = peak_memory()
    cost = timed(work)
    return Spent(cost.wall_s, cost.cpu_s, max(peak_memory() - before, 0))


def restart_peak() -> None:
    """Let `peak_memory` be the peak from now on; Linux only."""
    Path("/proc/self/clear_refs").write_text("5")


def command(words: Sequence[str], *, errors: IO[bytes] | None = None, cwd: Path | None = None) -> Spent:
    """Cost of a command and its children, whose standard error goes to a file.

    The peak is the greatest sum of proportional set sizes: pages shared by forked workers count once.

    Raises CalledProcessError if the command fails.
    """
    began = time.perf_counter()
    process = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=errors, cwd=cwd)
    peak = 0
    while True:
        pid, status, usage = os.wait4(process.pid, os.WNOHANG)
        if pid:
            break
        peak = max(peak, sum(map(_proportional_bytes, _family(process.pid))))
        time.sleep(SAMPLE_S)
    wall = time.perf_counter() - began
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, list(words))
    return Spent(wall, usage.ru_utime + usage.ru_stime, peak, 1024 * usage.ru_maxrss)


def _family(root: int) -> list[int]:
    """A process and all its descendants."""
    children: dict[int, list[int]] = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                parent = int((entry / "stat").read_text().rsplit(")", 1)[1].split()[1])
            except OSError:  # the process has ended
                continue
            children.setdefault(parent, []).append(int(entry.name))
    family = [root]
    for pid in family:
        family += children.get(pid, [])
    return family


def _proportional_bytes(pid: int) -> int:
    try:
        text = Path(f"/proc/{pid}/smaps_rollup").read_text()
    except OSError:  # the process has ended
        return 0
    found = [line.split()[1] for line in text.splitlines() if line.startswith("Pss:")]
    return 1024 * int(found[0]) if found else 0


class BenchError(GeosceneError):
    """A benchmark cannot be run or compared."""
