"""Damaged inputs: tracebacks, crashes, hangs and memory.

    python benchmarks/robustness.py --count 100000 --reading 0.8 --keep FOLDER
    python benchmarks/robustness.py --kinds maps scenes --count 1000

Each trial damages a small valid input at random (`mutations.py`) and runs a command on it, in a process
that runs many; a share of them only reads the file by the function for it (`readers.py`). Success or one
line on standard error is right; a traceback, a crash (signal), an exit code other than 0, 1 and 2, more
than --seconds or --gigabytes, a change of files outside of the output, and clouds that have other numbers of
points than their headers state are not. Inputs that went wrong are kept in FOLDER.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import importlib
import io
import multiprocessing
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import forked
from bench.measure import restart_peak
from damaged_inputs import KINDS, Inputs, Words
from mutations import mutate
from readers import readable, reader_of

from geoscene.errors import GeosceneError
from geoscene.errors import InputError as SceneInputError
from geoscene.support.console import main as main_of
from geoscene.support.digests import file_digest
from geoscene.support.processes import peak_memory
from lidar.errors import InputError, LidarError

_SHARES = {"maps": 2, "scenes": 3, "datasets": 6, "configurations": 5}
_USAGE = (InputError, SceneInputError)


@dataclass(frozen=True, slots=True)
class Trial:
    """A damaged file (None if only the words are), its name, its valid contents, and the command."""

    path: Path | None
    valid: bytes
    words: Words


class _Program:
    """A program that parses equal words once: parsing takes longer than many commands on small inputs."""

    def __init__(self, name: str) -> None:
        module = importlib.import_module(f"{name}.cli")
        self._app, self._parsed = module.app, {}
        self.name = self._app.name
        self.roots = (LidarError, GeosceneError) if name == "lidar" else (GeosceneError,)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._app, name)

    def __getitem__(self, name: str) -> Any:
        return self._app[name]

    def __contains__(self, name: object) -> bool:
        return name in self._app

    def __call__(self, words: Words, **options: Any) -> Any:
        """Run the command of the words."""
        if "--stage" in words:  # read while parsing
            return self._app(words, **options)
        key = tuple(words)
        if key not in self._parsed:
            found = self._app.parse_args(words, exit_on_error=False, print_error=False)
            self._parsed[key] = found[:2]
        command, bound = self._parsed[key]
        return command(*bound.args, **bound.kwargs)


def _share_shapes() -> None:
    """Read equal files of shapes once: reading them takes longer than most commands on a small scene."""
    layout = importlib.import_module("geoscene.scene.layout")
    read, known = layout.read_shapes, {}

    def read_once(path: Path) -> Any:
        digest = file_digest(path)
        if digest not in known:
            known[digest] = read(path)
        return known[digest]

    layout.read_shapes = read_once


@functools.cache
def _program(name: str) -> _Program:
    return _Program(name)


def reading(kind: str, path: Path) -> str:
    """Read a file by its own function; returns what is wrong, or an empty text."""
    found = reader_of(kind, path)
    try:
        if found:
            found[1](path)
    except (GeosceneError, LidarError, OSError):
        return ""
    except MemoryError:
        return "memory: out of memory"
    except BaseException as error:  # noqa: BLE001
        return _described(error)
    return ""


def _described(error: BaseException) -> str:
    frames = traceback.extract_tb(error.__traceback__)
    ours = [f for f in frames if "/geoscene/" in f.filename or "/lidar/" in f.filename] or frames
    places = " < ".join(f"{Path(f.filename).name}:{f.lineno}" for f in reversed(ours[-3:]))
    return f"traceback {type(error).__name__} {places}: {str(error)[:80]}"


def outcome(words: Words) -> str:
    """Run a command in this process; returns what is wrong, or an empty text."""
    sys.argv = words
    program = _program(words[0])
    code = 0
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()) as errors:
        try:
            main_of(program, program.roots, usage=_USAGE)
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else 0 if end.code is None else -1
        except BaseException as error:  # noqa: BLE001
            return _described(error)
    text = errors.getvalue()
    if "Traceback" in text or code not in (0, 1, 2) or (code == 2 and not text.strip()):
        return f"exit code {code}: {text[-200:]}"
    return "memory: out of memory" if "out of memory" in text else ""


class _Watch:
    """What a process changes outside of the places that the running command may write to."""

    def __init__(self) -> None:
        self.allowed: tuple[str, ...] | None = None
        self.outside = ""
        sys.addaudithook(self._hook)

    def _hook(self, event: str, details: tuple[Any, ...]) -> None:
        if self.allowed is None or event not in _CHANGES:
            return
        if event == "open" and not (isinstance(details[2], int) and details[2] & (os.O_WRONLY | os.O_RDWR)):
            return
        for place in details[: 2 if event in ("os.rename", "os.link") else 1]:
            if not isinstance(place, str | bytes | os.PathLike):
                continue
            path = os.path.realpath(os.fsdecode(place))
            known = "__pycache__" in path or (event in ("open", "os.mkdir") and Path(path).is_dir())
            by_folder = event != "open" and not Path(os.fsdecode(place)).is_absolute()  # as of shutil.rmtree
            if not (
                known or by_folder or path.startswith((*self.allowed, "/dev/null", tempfile.gettempdir()))
            ):
                self.outside = f"outside: {event} {path}"


_CHANGES = frozenset(("open", "os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.link", "os.truncate"))


def _places(words: Words, folder: Path) -> tuple[str, ...]:
    """Beginnings of the paths that a command may change: output, what is named after it, and cache."""
    cache = str(folder / "home")
    given = [word.removeprefix("--out=") for word in words if word.startswith("--out=")]
    if "-o" in words:
        given.append(words[words.index("-o") + 1])
    if not given:
        return (cache,)
    out = Path(given[-1])
    return cache, os.path.realpath(out.with_name(out.name.partition(".")[0]))


def _serve(link: Connection, folder: Path, options: argparse.Namespace) -> None:
    """Run the trials whose numbers arrive; tells of each what it is and then what was wrong."""
    os.environ["HOME"], os.environ["XDG_CACHE_HOME"] = str(folder / "home"), str(folder / "home" / "cache")
    watch = _Watch()
    resource.setrlimit(resource.RLIMIT_AS, (int(6 * options.gigabytes * 2**30),) * 2)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2**31,) * 2)
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    warnings.simplefilter("ignore")
    _share_shapes()
    inputs = Inputs.__new__(Inputs)
    object.__setattr__(inputs, "folder", folder)
    while True:
        kind, number = link.recv()
        rng = random.Random(f"{options.seed} {kind} {number}")
        if only_read := rng.random() < options.reading:
            path: Path | None = rng.choice(rng.choice(readable(kind, folder)))
            words = ["read", str(path)]
        else:
            path, words = KINDS[kind](inputs, rng)
        valid = path.read_bytes() if path else b""
        link.send(Trial(path, valid, words))
        if path:
            mutate(path, rng)
        restart_peak()
        watch.allowed, watch.outside = _places(words, folder), ""
        wrong = reading(kind, path) if only_read and path else outcome(words)
        watch.allowed, wrong = None, wrong or watch.outside
        peak = peak_memory() / 2**30
        link.send(wrong or (f"memory: {peak:.1f} GB" if peak > options.gigabytes else ""))
        if link.recv() and path:
            _restore(path, valid)


def _restore(path: Path, valid: bytes) -> None:
    """Write the valid contents of a file, whatever is there."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    elif path.is_symlink():
        path.unlink()
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(valid)


class _Server:
    """A process that runs trials and is replaced when it crashes or hangs."""

    def __init__(self, folder: Path, options: argparse.Namespace) -> None:
        self._start = (folder, options)
        self._seconds, self.process = options.seconds, None
        self._link: Connection

    def run(self, kind: str, number: int) -> tuple[str, Trial | None, bytes]:
        """What was wrong in a trial, the trial, and the damaged file if something was wrong."""
        if self.process is None:
            context = multiprocessing.get_context("fork")
            self._link, theirs = context.Pipe()
            self.process = context.Process(target=_serve, args=(theirs, *self._start), daemon=True)
            self.process.start()
            theirs.close()
        trial = None
        try:
            self._link.send((kind, number))
            trial = self._link.recv()
            wrong = self._link.recv() if self._link.poll(self._seconds) else f"hang: over {self._seconds:g} s"
        except EOFError:
            self.process.join()
            wrong = f"crash: exit code {self.process.exitcode}"
        bad = trial.path.read_bytes() if wrong and trial and trial.path and _is_plain(trial.path) else b""
        if wrong.startswith(("hang", "crash", "memory")):
            self.stop()
            if trial and trial.path:
                _restore(trial.path, trial.valid)
        else:
            self._link.send(True)
        return wrong, trial, bad

    def stop(self) -> None:
        """End the process."""
        if self.process is not None:
            self.process.kill()
            self.process.join()
            self.process = None


def _is_plain(path: Path) -> bool:
    return path.is_file() and not path.is_symlink()


def _name(kind: str, trial: Trial | None) -> str:
    """What a trial counts as: a reader of files, or a command."""
    if trial is None:
        return kind
    if trial.words[0] == "read" and trial.path and (found := reader_of(kind, trial.path)):
        return f"read {found[0]}"
    return " ".join(trial.words[:2])


def run_trials(options: argparse.Namespace, folder: Path) -> Counter[str]:
    """Run the trials; returns the number of each kind, and of those with a fault by kind and fault."""
    forked.load()
    inputs = Inputs(folder / "inputs")
    server = _Server(inputs.folder, options)
    counts: Counter[str] = Counter()
    shares = [_SHARES[kind] for kind in options.kinds]
    stop = time.monotonic() + 60 * options.minutes
    for number in range(options.first, options.first + options.count):
        kind = random.Random(f"{options.seed} {number}").choices(options.kinds, shares)[0]
        wrong, trial, bad = server.run(kind, number)
        counts[name := _name(kind, trial)] += 1
        if wrong and trial:
            counts[f"{name}: {wrong.partition(':')[0]}"] += 1
            print(f"{number} {wrong}\n    {trial.path} | {' '.join(trial.words)}", flush=True)
            if options.keep and trial.path:
                options.keep.mkdir(parents=True, exist_ok=True)
                (options.keep / f"{number}_{trial.path.name}").write_bytes(bad)
        if (number + 1) % 1000 == 0:
            print(f"{number + 1}: {sum(n for name, n in counts.items() if ':' in name)} wrong", flush=True)
        if time.monotonic() > stop:
            break
    server.stop()
    return counts


def main() -> int:
    """Run the trials; exit code 1 if something went wrong."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kinds", nargs="+", choices=list(KINDS), default=list(KINDS))
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--first", type=int, default=0, help="number of the first trial")
    parser.add_argument("--reading", type=float, default=0.0, help="share of trials that only read a file")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=60.0, help="limit of a trial")
    parser.add_argument("--gigabytes", type=float, default=2.0, help="limit of a trial")
    parser.add_argument("--minutes", type=float, default=1e6, help="at most, in all")
    parser.add_argument("--keep", type=Path)
    options = parser.parse_args()
    memory = Path("/dev/shm")  # noqa: S108  (files in memory, not at a guessable name)
    with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as folder:
        counts = run_trials(options, Path(folder))
    wrong = sum(n for name, n in counts.items() if ":" in name)
    for name, number in sorted(counts.items()):
        print(f"{number:7,}  {name}")
    print(f"{sum(counts.values()) - wrong:,} trials, {wrong} wrong")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
