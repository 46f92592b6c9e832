"""Commands, killed and repeated: differences, leftovers, files that only look whole, slow interruptions.

    python benchmarks/kills.py --count 400
    python benchmarks/kills.py --count 100 --only drive map

Builds, drives, maps, conversions and the other commands that write run in forked processes. Half of the kills
come at a random moment: SIGKILL, SIGINT (to the whole process group, as Ctrl-C) or SIGTERM. The others are
SIGKILL before a random change of the file system: a file opened for writing, a rename or deletion. After each
kill, the output must be absent, that of an earlier command, marked as not finished, or of files that are
whole. The same command is repeated until it succeeds, and its files are compared with those of an
uninterrupted run. An exit code or message that a kill does not explain, another file beside the output and an
interruption that takes more than two seconds are faults, too.
"""

from __future__ import annotations

import argparse
import json
import random
import shutil
import signal
import sys
import tempfile
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import forked
from forked import Ended

BOX = "--bbox=24.9425,60.1665,24.9445,60.1680"
_SIGNALS = (signal.SIGKILL, signal.SIGINT, signal.SIGTERM)
_PROMPT_S = 2.0
_EXPLAINED = {128 + signal.SIGINT, 128 + signal.SIGTERM, -signal.SIGKILL, -signal.SIGINT, -signal.SIGTERM}


@dataclass(frozen=True)
class Case:
    """A command.

    words  : without the output
    out    : name of the output; empty if the command writes into its input
    former : options that give other contents, which it then replaces; None if it replaces nothing
    given  : name of the case whose output is its input and is copied before it
    """

    words: list[str]
    out: str = ""
    former: list[str] | None = None
    given: str = ""

    def command(self, folder: Path, *more: str) -> list[object]:
        """The words of the command with its output in a folder."""
        return [*self.words, *more, *(["-o", folder / self.out] if self.out else [folder / self.given])]


def cases(folder: Path) -> dict[str, Case]:
    """The commands by name; each uses outputs of those before it, which are in ``folder``/reference."""
    place = folder / "reference"
    scene, data = str(place / "build" / "scene"), str(place / "drive" / "data")
    key = folder / "key"
    key.write_text("5f" * 32)
    drive = ["lidar", "drive", scene, "--quiet", "--route", "random", "--duration", "0.5"]
    drive += ["--traffic", "vehicles=10", "--rig", "vlp16", "--format", "pcd,laz", "--workers", "2"]
    export, view = ["geoscene", "export", scene, "--quiet"], ["geoscene", "view", scene, "--quiet"]
    convert = ["lidar", "convert", data, "--quiet", "--to"]
    return {
        "build": Case(
            ["geoscene", "build", "--demo", BOX, "--tile-size=50", "--workers=2", "--name=demo", "--quiet"],
            "scene",
            ["--lod=1"],
        ),
        "drive": Case(drive, "data", ["--seed=5"]),
        "map": Case(
            ["lidar", "map", data, "--quiet", "--voxel=0.3", "--raster=dsm,density"], "m.laz", ["--noise"]
        ),
        "map tiles": Case(["lidar", "map", data, "--quiet", "--tiles=50"], "tiles", []),
        "laz": Case([*convert, "laz"], "data", []),
        "page folder": Case(view, "pages", ["--layers=buildings"]),
        "copc": Case(["lidar", "map", data, "--quiet"], "m.copc.laz"),
        "nuscenes": Case([*convert, "nuscenes"], "out", []),
        "kitti": Case([*convert, "kitti"], "out", []),
        "mcap": Case([*convert, "mcap"], "out", []),
        "waymo": Case([*convert, "waymo"], "out", []),
        "npz": Case([*convert, "npz"], "out", []),
        "apply": Case(
            ["lidar", "apply", data, "--quiet", "--stage", "dropped_packets:loss=0.1"],
            "data",
            ["--stage", "cover_glass:transmission=0.5"],
        ),
        "denoise": Case(["lidar", "denoise", data, "--quiet", "--method=dror"], "data"),
        "sign": Case(["lidar", "sign", "--quiet", "--chain", str(key)], given="data"),
        "obj": Case(export, "city.obj", ["--layers=buildings"]),
        "3dtiles": Case([*export, "--to=3dtiles"], "tiles", ["--layers=buildings"]),
        "tif": Case(export, "city.tif", ["--resolution=2"]),
        "page": Case(view, "page.html", ["--layers=buildings"]),
        "playback": Case(["lidar", "view", data, "--quiet"], "page.html", ["--every=2"]),
    }


def contents(folder: Path) -> dict[str, bytes]:
    """Bytes of the files of a folder by relative path; links and empty folders as such."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.is_symlink() or path.is_dir():
            if not path.is_dir() or not any(path.iterdir()):
                found[name] = b"folder"
        else:
            found[name] = path.read_bytes()
    return found


def _temporary(name: str) -> bool:
    """Whether a path is of a temporary or lock file, by its name."""
    return any(".part" in part or part.endswith(".lock") for part in name.split("/"))


def looks_whole(case: Case, found: dict[str, bytes], allowed: list[dict[str, bytes]]) -> list[str]:
    """Files of a killed command's output that a reader would take for whole but are not.

    allowed : contents of whole outputs
    """
    final = {name: data for name, data in found.items() if not _temporary(name)}
    final = {} if final == {case.out: b"folder"} else final  # empty
    if any(final == whole for whole in [{}, *allowed]):
        return []
    manifest = final.get(f"{case.out or case.given}/dataset.json")
    if manifest is not None and case.out:
        return [] if json.loads(manifest)["frames_done"] == 0 else ["dataset.json states a finished drive"]
    if case.given:  # signed in place: the signature comes last
        own = f"{case.given}/integrity", f"{case.given}/checksums.sha256"
        same = {name: data for name, data in final.items() if not name.startswith(own)}
        if f"{own[0]}/chain.json" not in final and all(allowed[0].get(n) == d for n, d in same.items()):
            return []
    several = case.out.endswith((".laz", ".obj"))  # files, each of them whole, that of the name last
    if several and (case.out not in final or case.out in allowed[0]):
        return [name for name, data in final.items() if all(data != a.get(name) for a in allowed)]
    return sorted(name for name in final if final[name] != allowed[-1].get(name)) or ["an incomplete folder"]


@dataclass
class Trials:
    """Kills of commands, and what was wrong."""

    folder: Path
    rng: random.Random
    cases: dict[str, Case]

    def __post_init__(self) -> None:
        """Make the outputs of uninterrupted runs."""
        self.kills: Counter[str] = Counter()
        self.ends: Counter[str] = Counter()
        self.faults = 0
        self.slowest = 0.0
        self._whole: dict[str, dict[str, bytes]] = {}
        self._former: dict[str, dict[str, bytes]] = {}
        self._changes: dict[str, int] = {}
        self._seconds: dict[str, float] = {}

    def prepare(self, wanted: list[str]) -> None:
        """Run the commands without interruption."""
        for name, case in self.cases.items():
            if name not in (*wanted, "build", "drive"):
                continue
            self._start(case, place := self.folder / "reference" / name)
            ended = self._run(case, place)
            if ended.code:
                raise SystemExit(f"{name}: {ended.errors}")
            self._seconds[name], self._changes[name] = ended.seconds, ended.changes
            self._whole[name] = contents(place)
            if case.former is not None:
                self._start(case, place := self.folder / "former" / name)
                ended = self._run(case, place, *case.former)
                if ended.code:
                    raise SystemExit(f"{name}: {ended.errors}")
                self._former[name] = contents(place)
            print(f"{name}: {ended.seconds:.1f} s, {self._changes[name]} changes", flush=True)

    def _start(self, case: Case, place: Path) -> None:
        shutil.rmtree(place, ignore_errors=True)
        if case.given:
            shutil.copytree(self.folder / "reference" / "drive" / "data", place / case.given)
        place.mkdir(parents=True, exist_ok=True)

    def _run(self, case: Case, place: Path, *more: str) -> Ended:
        return forked.run(case.command(place, *more), within=place)

    def trial(self, name: str) -> None:
        """Kill a command until it is left to end, and compare its files."""
        case, place = self.cases[name], self.folder / "run" / name
        self._start(case, place)
        allowed, more = [self._whole[name]], []
        if case.given:
            allowed.insert(0, contents(place))
        if case.former is not None and self.rng.random() < 0.5:
            shutil.copytree(self.folder / "former" / name, place, dirs_exist_ok=True)
            allowed.insert(0, self._former[name])
            more = ["--overwrite"]
        words = case.command(place, *more)
        while self.rng.random() < 0.75:
            ended, kill = self._killed(name, words, place)
            if not kill:
                self.ends["before the kill"] += 1
                break
            self.kills[name] += 1
            self.ends[kill] += 1
            slow = kill == "SIGINT" and ended.seconds > _PROMPT_S
            if "Traceback" in ended.errors or ended.code not in _EXPLAINED or slow:
                self._fault(name, f"{kill}: code {ended.code}, {ended.seconds:.1f} s: {ended.errors[-300:]}")
            if wrong := looks_whole(case, contents(place), allowed):
                self._fault(name, f"{kill}: looks whole: {wrong[:5]}")
        ended = forked.run(words, within=place)
        if ended.code == 2 and "set --overwrite" in ended.errors and "--overwrite" not in words:
            self.ends["complete before the kill"] += 1  # or a file of several is there
            ended = forked.run([*words, "--overwrite"], within=place)
        found, whole = contents(place), self._whole[name]
        if ended.code or found != whole:
            changed = sorted(n for n in found.keys() | whole.keys() if found.get(n) != whole.get(n))
            self._fault(name, f"at the end: code {ended.code}: {ended.errors[-300:]} {changed[:9]}")
        shutil.rmtree(place)

    def _killed(self, name: str, words: list[object], place: Path) -> tuple[Ended, str]:
        """Start a command and kill it: how it ended, and the kill; no kill if it ended before."""
        if self.rng.random() < 0.5:
            ended = forked.run(words, within=place, die_at=self.rng.randint(1, self._changes[name] + 2))
            kill = "SIGKILL before a change" if ended.code == -signal.SIGKILL else ""
            return ended, kill
        number = self.rng.choice(_SIGNALS)
        after = self.rng.uniform(0.0, 1.0) * self._seconds[name]
        ended = forked.run(words, within=place, interruption=(after, number))
        kill = number.name if ended.code not in (0, 2) else ""
        if kill == "SIGINT":
            self.slowest = max(self.slowest, ended.seconds)
        return ended, kill

    def _fault(self, name: str, text: str) -> None:
        self.faults += 1
        print(f"{name}: {text}", flush=True)


def main() -> int:
    """Run the kills; exit code 1 if something went wrong."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", nargs="+", default=[])
    options = parser.parse_args()
    forked.load()
    memory = Path("/dev/shm")  # noqa: S108  (files in memory, not at a guessable name)
    with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as folder:
        trials = Trials(Path(folder), random.Random(options.seed), cases(Path(folder)))
        names = options.only or list(trials.cases)
        trials.prepare(names)
        while trials.kills.total() < options.count:
            trials.trial(trials.rng.choice(names))
            if (total := trials.kills.total()) and trials.rng.random() < 0.1:
                print(f"{total} kills, {trials.faults} faults", flush=True)
    print(f"{trials.kills.total()} kills: {dict(trials.kills)}; {dict(trials.ends)}")
    print(f"{trials.faults} faults; slowest interruption {trials.slowest:.1f} s")
    return int(trials.faults > 0)


if __name__ == "__main__":
    sys.exit(main())
