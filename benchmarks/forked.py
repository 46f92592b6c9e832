"""Commands in forked processes, which need not import the programs again, and die or lack space as told."""

from __future__ import annotations

import importlib
import mmap
import os
import signal
import struct
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

Work = Sequence[object] | Callable[[], object]
"""Words of a command, of which the first is the program, or a function."""

_MODULES = (
    *(
        "geoscene.cli",
        "geoscene.pipeline.build",
        "geoscene.export",
        "geoscene.view",
        "rasterio",
        "laspy",
        "lazrs",
    ),
    *(
        "lidar.cli",
        "lidar.simulation.drive",
        "lidar.tools.apply",
        "lidar.tools.sign",
        "lidar.tools.verify",
        "lidar.tools.maps.aggregate",
    ),
    *(
        "lidar.tools.view",
        "lidar.tools.sweep",
        "lidar.tools.denoise.denoise",
        "lidar.dataset.layouts.nuscenes",
    ),
)
_CHANGES = frozenset(("os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.link", "os.truncate"))


@dataclass(frozen=True, slots=True)
class Ended:
    """How a command ended.

    code    : exit code; minus the number of the signal that ended it; None if it took too long
    errors  : what it wrote to standard error
    changes : files and folders that it was about to make, rename or delete
    seconds : from the last interruption, or else the start, to the end
    """

    code: int | None
    errors: str
    changes: int
    seconds: float


def load() -> None:
    """Import what the commands use, before the first fork."""
    for name in _MODULES:
        importlib.import_module(name)


def run(
    work: Work,
    *,
    within: Path,
    die_at: int = 0,
    interruption: tuple[float, signal.Signals] | None = None,
    before: Callable[[], Any] | None = None,
    after: Callable[[], Any] | None = None,
    at_change: Callable[[], Any] | None = None,
    limit_s: float = 300.0,
) -> Ended:
    """Run a command or a function in a forked process.

    within       : folder whose changes count
    die_at       : number, from 1, of the change before which the process kills itself; 0 for none
    interruption : seconds after which it gets a signal, SIGINT with all of its process group
    before       : called in the process before the command
    after        : called in the process after the command
    at_change    : called at the change ``die_at`` instead of killing the process
    """
    shared = mmap.mmap(-1, 8)
    with tempfile.TemporaryFile() as errors:
        child = os.fork()
        if child == 0:
            hook = _counter(shared, f"{within}{os.sep}", die_at, then=at_change or _die)
            _become(work, errors=errors.fileno(), hook=hook, before=before, after=after)
        started = time.monotonic()
        code = None
        if interruption is not None:
            after, number = interruption
            code = _wait(child, after)
            if code is None:
                whole_group = number == signal.SIGINT and os.getpgid(child) == child
                (os.killpg if whole_group else os.kill)(child, number)
                started = time.monotonic()
        if code is None:
            code = _wait(child, limit_s)
        seconds = time.monotonic() - started
        if code is None:
            os.killpg(child, signal.SIGKILL)
            os.waitpid(child, 0)
        errors.seek(0)
        text = errors.read().decode(errors="replace")
    return Ended(code, text, struct.unpack("q", shared[:8])[0], seconds)


def _wait(child: int, seconds: float) -> int | None:
    """The exit code of a process; None if it has not ended by then."""
    end = time.monotonic() + seconds
    while True:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            return os.waitstatus_to_exitcode(status)
        if time.monotonic() > end:
            return None
        time.sleep(0.002)


def _become(
    work: Work,
    *,
    errors: int,
    hook: _Hook,
    before: Callable[[], Any] | None,
    after: Callable[[], Any] | None,
) -> NoReturn:
    """Be the process of the work."""
    code = 70
    try:
        os.setsid()
        nothing = os.open(os.devnull, os.O_RDWR)
        for source, target in ((nothing, 0), (nothing, 1), (errors, 2)):
            os.dup2(source, target)
        if callable(work):
            main = work
        else:
            sys.argv = [str(word) for word in work]
            main = importlib.import_module(f"{work[0]}.cli").main
        if before is not None:
            before()
        sys.addaudithook(hook)
        main()
        code = 0
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:  # noqa: BLE001 - what a process would end with
        traceback.print_exc()
    finally:
        if after is not None:
            after()
        sys.stderr.flush()
        os._exit(code)


def _die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


_Hook = Callable[[str, tuple[Any, ...]], None]


def _counter(shared: mmap.mmap, within: str, number: int, *, then: Callable[[], Any]) -> _Hook:
    """An audit hook that counts changes of files in a folder, and does something before one of them."""
    me, count = os.getpid(), 0

    def hook(event: str, details: tuple[Any, ...]) -> None:
        nonlocal count
        if event == "open":
            if not isinstance(details[2], int) or not details[2] & (os.O_WRONLY | os.O_RDWR):
                return
        elif event not in _CHANGES:
            return
        if os.getpid() == me and str(details[0]).startswith(within):
            count += 1
            shared[:8] = struct.pack("q", count)
            if count == number:
                then()

    return hook
