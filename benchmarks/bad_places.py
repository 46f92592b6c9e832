"""Commands whose output cannot be written, or whose input vanishes: one clear line, and nothing half-written.

    python benchmarks/bad_places.py
    python benchmarks/bad_places.py --only drive map --places full read-only

Each command of `kills.py` runs with its output on a disk that is full after a share of its bytes, on a
read-only disk, below a file, at the place of another thing, in a folder that another process writes, and with
a scene or dataset that is deleted meanwhile. Right are exit codes 1 and 2 (0 if the input was read by then)
with one line on standard error, and no output but one that is marked as not finished. Disks are mounted in a
namespace of the process, which takes Linux, and root or unprivileged user namespaces.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import os
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import forked
from kills import Case, cases, contents, looks_whole

from geoscene.support.files import exclusive

_NEWNS, _NEWUSER = 0x20000, 0x10000000
_READ_ONLY, _REMOUNT, _PRIVATE = 1, 32, 0x44000
_LEFT = "## left: "


def _mount(place: Path, *, size: int = 0) -> None:
    """Mount an empty disk of a size in bytes on a folder for this process; a read-only one for 0."""
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.unshare(_NEWNS) and libc.unshare(_NEWNS | _NEWUSER):
        raise OSError(ctypes.get_errno(), "no namespace of mounts")
    libc.mount(b"none", b"/", None, _PRIVATE, None)
    options = f"size={max(size, 4096)}".encode()
    if libc.mount(b"tmpfs", os.fsencode(place), b"tmpfs", 0 if size else _READ_ONLY, options):
        raise OSError(ctypes.get_errno(), "cannot mount")


@dataclass
class Trials:
    """Commands at bad places, and what was wrong."""

    folder: Path
    cases: dict[str, Case]

    def __post_init__(self) -> None:
        """Run the commands that others need, and note sizes and numbers of changes."""
        self.counts: Counter[str] = Counter()
        self.faults = 0
        self._whole: dict[str, dict[str, bytes]] = {}
        self._changes: dict[str, int] = {}

    def prepare(self, names: list[str]) -> None:
        """Run the commands at good places."""
        for name, case in self.cases.items():
            if name in (*names, "build", "drive"):
                place = self._empty(case, self.folder / "reference" / name)
                ended = forked.run(case.command(place), within=place)
                if ended.code:
                    raise SystemExit(f"{name}: {ended.errors}")
                self._whole[name], self._changes[name] = contents(place), ended.changes

    def _empty(self, case: Case, place: Path) -> Path:
        shutil.rmtree(place, ignore_errors=True)
        place.mkdir(parents=True)
        if case.given:
            shutil.copytree(self.folder / "reference" / "drive" / "data", place / case.given)
        return place

    def full(self, name: str, share: float) -> None:
        """The disk is full after a share of the bytes."""
        case, place = self.cases[name], self._empty(self.cases[name], self.folder / "run")
        before = contents(place)
        least, most = (sum(-len(d) // 4096 * -4096 for d in c.values()) for c in (before, self._whole[name]))
        size = max(int(least + share * (most - least)), 8192)

        def mount() -> None:
            _mount(place, size=size)
            if case.given:
                shutil.copytree(self.folder / "reference" / "drive" / "data", place / case.given)

        self._check(f"full to {share:.0%}", name, place, before=mount, given=before)

    def read_only(self, name: str) -> None:
        """The disk is read-only."""
        place = self._empty(self.cases[name], self.folder / "run")
        if not self.cases[name].given:
            self._check("read-only", name, place, before=lambda: _mount(place), given={})

    def below_a_file(self, name: str) -> None:
        """The folder of the output is a file."""
        place = self._empty(self.cases[name], self.folder / "run")
        if not self.cases[name].given:
            (place / "file").write_text("mine")
            self._check("below a file", name, place / "file", given=contents(place), root=place)

    def other_thing(self, name: str, *more: str) -> None:
        """The output is a file instead of a folder, or a folder with files of others instead of a file."""
        case = self.cases[name]
        place = self._empty(case, self.folder / "run")
        if case.given:
            return
        if isinstance(self._whole[name].get(case.out), bytes):
            (place / case.out).mkdir()
            (place / case.out / "thesis.txt").write_text("mine")
        else:
            (place / case.out).write_text("mine")
        self._check(
            "another thing" + " with --overwrite" * bool(more), name, place, *more, given=contents(place)
        )

    def folder_of_others(self, name: str, *more: str) -> None:
        """The output is a folder with files of others."""
        case = self.cases[name]
        place = self._empty(case, self.folder / "run")
        if case.given or case.out in self._whole[name]:
            return
        (place / case.out).mkdir()
        (place / case.out / "thesis.txt").write_text("mine")
        kept = {f"{case.out}/thesis.txt": b"mine"}
        self._check("folder of others", name, place, *more, given=contents(place), kept=kept)

    def locked(self, name: str) -> None:
        """Another process writes the output."""
        case, place = self.cases[name], self._empty(self.cases[name], self.folder / "run")
        out = place / (case.out or case.given)
        before = contents(place)
        with _held(out):
            self._check("another process", name, place, given=before, locked=True)

    def vanishing(self, name: str, share: float) -> None:
        """The input is deleted after a share of the changes."""
        case = self.cases[name]
        source = next((word for word in case.words if str(self.folder / "reference") in word), "")
        if not source:
            return
        place, moved = self._empty(case, self.folder / "run"), self.folder / "input"
        shutil.rmtree(moved, ignore_errors=True)
        shutil.copytree(source, moved)
        words = [str(moved) if word == source else word for word in case.words]
        replaced = Case(words, case.out, given=case.given)
        at = max(1, int(share * self._changes[name]))
        self._check(
            f"input vanishes at {share:.0%}", name, place, case=replaced, given={}, may_succeed=True,
            die_at=at, at_change=lambda: shutil.rmtree(moved, ignore_errors=True),
        )  # fmt: skip

    def _check(
        self,
        what: str,
        name: str,
        place: Path,
        *more: str,
        given: dict[str, bytes],
        before: Callable[[], None] | None = None,
        root: Path | None = None,
        kept: dict[str, bytes] | None = None,
        case: Case | None = None,
        may_succeed: bool = False,
        locked: bool = False,
        die_at: int = 0,
        at_change: Callable[[], None] | None = None,
    ) -> None:
        """Run the command and note what is wrong with its end."""
        case = case or self.cases[name]
        folder = root or place

        def listed() -> None:
            left = contents(folder)
            parts = [n for n in left if ".part" in n or (n.endswith(".lock") and not locked)]
            if parts and name != "build":  # which resumes from the tiles in its folder
                sys.stderr.write(f"{_LEFT}{parts[:5]}\n")
            own = {n: d for n, d in left.items() if n not in (kept or {})}
            good = [{n: d for n, d in given.items() if n not in (kept or {})}, self._whole[name]]
            if not may_succeed and (wrong := looks_whole(case, own, good)):
                sys.stderr.write(f"{_LEFT}{wrong[:5]} looks whole\n")
            if kept and any(left.get(n) != d for n, d in kept.items()):
                sys.stderr.write(f"{_LEFT}files of others are gone\n")

        ended = forked.run(
            case.command(place, *more),
            within=folder,
            before=before,
            after=listed,
            die_at=die_at,
            at_change=at_change,
            limit_s=120,
        )
        self.counts[what.partition(" to ")[0].partition(" at ")[0]] += 1
        lines = [line for line in ended.errors.splitlines() if not line.startswith(("WARNING", _LEFT))]
        lines = [line for line in lines if "this folder does not exist and is made" not in line]
        wrong = [line for line in ended.errors.splitlines() if line.startswith(_LEFT)]
        if ended.code is None:
            wrong.append("hangs")
        elif ended.code == 0:
            wrong += [] if may_succeed or kept else ["succeeds"]
        elif ended.code not in (1, 2) or len(lines) != 1 or "Traceback" in ended.errors:
            wrong.append(f"code {ended.code}, {len(lines)} lines")
        if wrong:
            self.faults += 1
            print(f"FAULT {name}, {what}: {'; '.join(wrong)}\n    {ended.errors.strip()[-600:]}", flush=True)
        else:
            print(f"{name}, {what}: {ended.code} {lines[0] if lines else ''}", flush=True)


@contextlib.contextmanager
def _held(out: Path) -> Iterator[None]:
    """Another process that writes an output."""
    child = os.fork()
    if child == 0:
        with exclusive(out):
            signal.pause()
    try:
        while not out.with_name(f"{out.name}.lock").exists():
            time.sleep(0.01)
        yield
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)


PLACES: dict[str, Callable[[Trials, str], object]] = {
    "full": lambda t, name: [t.full(name, share) for share in (0.0, 0.3, 0.6, 0.9)],
    "read-only": Trials.read_only,
    "below-a-file": Trials.below_a_file,
    "other": lambda t, name: (t.other_thing(name), t.other_thing(name, "--overwrite")),
    "others": lambda t, name: (t.folder_of_others(name), t.folder_of_others(name, "--overwrite")),
    "locked": Trials.locked,
    "vanishing": lambda t, name: [t.vanishing(name, share) for share in (0.0, 0.4, 0.9)],
}


def main() -> int:
    """Run the commands; exit code 1 if something went wrong."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", nargs="+", default=[])
    parser.add_argument("--places", nargs="+", choices=list(PLACES), default=list(PLACES))
    options = parser.parse_args()
    forked.load()
    memory = Path("/dev/shm")  # noqa: S108  (files in memory, not at a guessable name)
    with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as folder:
        trials = Trials(Path(folder), cases(Path(folder)))
        names = options.only or list(trials.cases)
        trials.prepare(names)
        for name in names:
            for place in options.places:
                PLACES[place](trials, name)
    print(f"{trials.counts.total()} commands: {dict(trials.counts)}; {trials.faults} faults")
    return int(trials.faults > 0)


if __name__ == "__main__":
    sys.exit(main())
