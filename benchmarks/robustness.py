"""Damaged inputs and killed builds: tracebacks, crashes, hangs, memory, and differences after resuming.

    python benchmarks/robustness.py inputs maps scenes datasets configurations --count 1000 --keep FOLDER
    python benchmarks/robustness.py kills --count 50

``inputs`` changes bytes or words of a valid input at random and runs a command on it, ``count`` times per
kind. One line or success is right; a traceback, a crash (signal), more than --seconds or --gigabytes is not.
Inputs that went wrong are kept in FOLDER. ``kills`` ends builds of the demo map by SIGKILL, SIGINT or
SIGTERM at random moments, repeats the command and compares the scene with that of an uninterrupted build.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import io
import json
import multiprocessing
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Connection
from pathlib import Path

from geoscene.scene import SceneFiles

BOX = "--bbox=24.9425,60.1665,24.9445,60.1680"
WORDS = (
    "nan", "inf", "-inf", "0", "-1", "1e308", "-1e308", "1e-308", "99999999999999999999", "0.1", "2147483648",
    "yes", "no", ";", ";;", ":", "null", "None", "[]", "{}", "", " ", "é", "\ufffd", "🏠", "\x01", "1;2",
    "1,5", "1'", "10ft", "--", "a=b", "true", "Infinity",
)  # fmt: skip

Case = tuple[Path, list[list[str]]]
"""A changed file, and the commands that use it."""


def changed(data: bytes, rng: random.Random) -> bytes:
    """Data with one to four changes of bytes, or of words if it is text."""
    try:
        text = data.decode()
    except UnicodeDecodeError:
        text = ""
    for _ in range(rng.randint(1, 4)):
        if text and rng.random() < 0.8:
            text = _changed_text(text, rng)
            data = text.encode(errors="replace")
        else:
            data = _changed_bytes(data, rng)
            text = ""
    return data


def _changed_text(text: str, rng: random.Random) -> str:
    lines = text.split("\n")
    kind, k = rng.randrange(5), rng.randrange(len(lines))
    if kind == 0:
        del lines[k]
    elif kind == 1:
        lines.insert(rng.randrange(len(lines)), lines[k])
    else:  # replace a word between delimiters
        line = lines[k]
        cuts = [n for n, letter in enumerate(line) if letter in "\"' ,:;=<>[](){}|"] or [0]
        start = rng.choice(cuts) + 1
        stop = min((cut for cut in cuts if cut >= start), default=len(line))
        lines[k] = line[:start] + rng.choice(WORDS) + line[stop:]
    return "\n".join(lines)


def _changed_bytes(data: bytes, rng: random.Random) -> bytes:
    at, size = rng.randrange(len(data) + 1), rng.randint(1, 64)
    return rng.choice(
        [
            data[:at],
            data[:at] + rng.randbytes(size) + data[at:],
            data[:at] + rng.randbytes(size) + data[at + size :],
            data[:at] + bytes(size) + data[at + size :],
            data[:at] + data[at + size :],
            data[:at] + bytes([data[at - 1] ^ 1 << rng.randrange(8)] if at else []) + data[at + 1 :],
        ]
    )


def _run(words: list[str]) -> str:
    """Run a command in this process; returns what is wrong, or an empty text."""
    program, *rest = words
    sys.argv = [program, *rest]
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()) as errors:
        try:
            importlib.import_module(f"{program}.cli").main()
        except SystemExit:
            pass
        except BaseException as error:  # noqa: BLE001
            place = traceback.extract_tb(error.__traceback__)[-1]
            return f"traceback {type(error).__name__} {Path(place.filename).name}:{place.lineno}"
    return "memory" if "out of memory" in errors.getvalue() else ""


def _trials(
    seed: int, cases: list[Callable[[random.Random], Case]], link: Connection, *, limit: float
) -> None:
    """Run trials whose numbers arrive; answers with what was wrong and the largest memory in gigabytes."""
    resource.setrlimit(resource.RLIMIT_AS, (int(4 * limit * 2**30),) * 2)
    while True:
        number = link.recv()
        rng = random.Random(f"{seed} {number}")
        path, commands = rng.choice(cases)(rng)
        data = path.read_bytes()
        path.write_bytes(changed(data, rng))
        wrong = ""
        try:
            for words in commands:
                wrong = wrong or _run(words)
                Path("/proc/self/clear_refs").write_text("5")
                status = Path("/proc/self/status").read_text()
                peak = int(status.partition("VmHWM:")[2].split()[0]) / 2**20
                wrong = wrong or ("memory" if peak > limit else "")
        finally:
            bad = path.read_bytes() if wrong and path.exists() else b""
            path.write_bytes(data)
        link.send((wrong, bad, path.name, commands))


def _worker(
    numbers: Iterator[int],
    seed: int,
    *,
    cases: list[Callable[[random.Random], Case]],
    options: argparse.Namespace,
) -> Counter[str]:
    """Run trials in a process that is replaced when it dies or hangs."""
    counts: Counter[str] = Counter()
    context = multiprocessing.get_context("fork")
    process = None
    stop = time.monotonic() + 60 * options.minutes
    for number in numbers:
        if time.monotonic() > stop:
            break
        if process is None:
            link, theirs = context.Pipe()
            process = context.Process(
                target=_trials, args=(seed, cases, theirs), kwargs={"limit": options.gigabytes}
            )
            process.start()
            theirs.close()
        link.send(number)
        bad, name, commands = b"", "?", []
        try:
            wrong, bad, name, commands = link.recv() if link.poll(options.seconds) else ("hang", b"", "?", [])
        except EOFError:
            process.join()
            wrong = f"crash {process.exitcode}"
        if wrong.startswith(("hang", "crash")):
            process.kill()
            process.join()
            process = None
        counts["inputs"] += 1
        if wrong:
            counts[wrong] += 1
            print(f"{number}: {wrong}: {name} {' '.join(commands[0]) if commands else ''}", flush=True)
            if options.keep and bad:
                options.keep.mkdir(parents=True, exist_ok=True)
                (options.keep / f"{number}_{name}").write_bytes(bad)
    if process is not None:
        process.kill()
    return counts


def _program(*words: object) -> None:
    subprocess.run(
        [sys.executable, "-m", f"{words[0]}.cli", *map(str, words[1:])], check=True, stdout=subprocess.DEVNULL
    )


def _small_map(path: Path) -> None:
    """The part of the demo map in the box, as XML."""
    import osmium  # noqa: PLC0415

    from geoscene.sources import demo_path  # noqa: PLC0415

    west, south, east, north = map(float, BOX.partition("=")[2].split(","))
    ways, nodes = [], set()
    places = {node.id: (node.lon, node.lat) for node in osmium.FileProcessor(demo_path(), osmium.osm.NODE)}
    for way in osmium.FileProcessor(demo_path(), osmium.osm.WAY):
        refs = [node.ref for node in way.nodes]
        if any(west < places[r][0] < east and south < places[r][1] < north for r in refs if r in places):
            ways.append(way.id)
            nodes.update(refs)
    with osmium.SimpleWriter(str(path), overwrite=True) as out:
        for item in osmium.FileProcessor(demo_path()):
            if (item.is_node() and item.id in nodes) or (item.is_way() and item.id in ways):
                out.add(item)


def _cases(kind: str, folder: Path) -> list[Callable[[random.Random], Case]]:
    """Functions that choose a file to change and the commands that use it."""
    folder.mkdir(parents=True)
    out = folder / "out"
    if kind == "maps":
        maps = [folder / name for name in ("a.osm", "a.osm.pbf", "a.osm.gz")]
        for path in maps:
            _small_map(path)

        def of_map(rng: random.Random) -> Case:
            path = rng.choices(maps, (8, 1, 1))[0]
            return path, [
                ["geoscene", "build", "--osm", str(path), "-o", str(out), "--overwrite", "--workers=1"]
            ]

        return [of_map]
    scene = folder / "scene"
    _program("geoscene", "build", "--demo", BOX, "-o", scene, "--tile-size", "100")
    if kind == "scenes":
        files = sorted(
            path for path in scene.rglob("*") if path.is_file() and path != SceneFiles(scene).problems
        )
        exports = [
            ["geoscene", "export", str(scene), "-o", str(folder / f"x.{suffix}"), "--overwrite"]
            for suffix in ("glb", "city.json", "geojson", "gpkg", "tif", "xodr", "obj")
        ]
        exports += [["geoscene", "view", str(scene), "-o", str(folder / "x.html"), "--overwrite"]]

        def of_scene(rng: random.Random) -> Case:
            path = (
                rng.choice(files)
                if rng.random() < 0.5
                else rng.choice([f for f in files if f.parent == scene])
            )
            looks = [["geoscene", "info", str(scene)], ["geoscene", "validate", str(scene)]]
            return path, [*looks, rng.choice(exports)]

        return [of_scene]
    drive = ["lidar", "drive", str(scene), "--out", str(folder / "drive"), "--duration=0.3", "--route=random"]
    if kind == "datasets":
        _program(*drive, "--rig=vlp16", "--format=pcd")
        data = folder / "drive"
        files = sorted(path for path in data.rglob("*") if path.is_file())
        uses = [
            ["lidar", "map", str(data), "-o", str(folder / "m.laz"), "--overwrite"],
            *(
                ["lidar", "export", str(data), "--to", name, "-o", str(folder / name), "--overwrite"]
                for name in ("nuscenes", "tum")
            ),
            [*drive, "--rig=vlp16", "--format=pcd"],
        ]
        return [lambda rng: (rng.choice(files), [rng.choice(uses)])]
    rigs = Path(__file__).resolve().parents[1] / "lidar" / "rig"
    own = [shutil.copy(path, folder) for path in sorted((rigs / "rigs").glob("*.toml"))[:6]]
    routes = [folder / "a.gpx", folder / "a.geojson", folder / "a.csv"]
    routes[0].write_text(
        '<gpx>\n<wpt lat="60.1670" lon="24.9430"/>\n<wpt lat="60.1676" lon="24.9440"/>\n</gpx>'
    )
    routes[1].write_text('{"type": "LineString",\n "coordinates": [[24.943, 60.167],\n [24.944, 60.1676]]}')
    routes[2].write_text("lon,lat\n24.943,60.167\n24.944,60.1676\n")
    along = [
        "geoscene",
        "build",
        "--demo",
        BOX,
        "-o",
        str(out),
        "--overwrite",
        "--workers=1",
        "--only=roads",
        "--along",
    ]
    return [
        lambda rng: (
            Path(path := rng.choice(own)),
            [[*drive, "--overwrite", "--format=pcd", "--rig", str(path)]],
        ),
        lambda rng: (path := rng.choice(routes), [[*along, str(path)]]),
        lambda rng: (
            path := rng.choice(routes),
            [[*drive[:-1], "--overwrite", "--rig=vlp16", "--route", str(path)]],
        ),
    ]


def inputs(options: argparse.Namespace) -> int:
    """Run the trials of each kind; returns the number of those that went wrong."""
    total = 0
    with tempfile.TemporaryDirectory() as folder:
        for kind in options.kinds:
            started = time.monotonic()
            shares = [range(k, options.count, options.workers) for k in range(options.workers)]
            counts: Counter[str] = Counter()
            with ThreadPoolExecutor(options.workers) as threads:
                tasks = [
                    threads.submit(
                        _worker,
                        iter(share),
                        options.seed,
                        cases=_cases(kind, Path(folder) / f"{kind}{k}"),
                        options=options,
                    )
                    for k, share in enumerate(shares)
                ]
                for task in tasks:
                    counts.update(task.result())
            wrong = sum(counts.values()) - counts["inputs"]
            total += wrong
            print(
                kind,
                json.dumps(dict(counts)),
                f"wrong {wrong}, {time.monotonic() - started:.0f} s",
                flush=True,
            )
    return total


def kills(options: argparse.Namespace) -> int:
    """Kill builds at random moments, complete them and return the number of scenes that differ."""
    rng, killed, different = random.Random(options.seed), 0, 0
    with tempfile.TemporaryDirectory() as folder:
        out, reference = Path(folder) / "scene", Path(folder) / "reference"
        words = [
            sys.executable,
            "-m",
            "geoscene.cli",
            "build",
            "--demo",
            BOX,
            "--tile-size",
            "50",
            "--workers",
            "2",
        ]
        words += ["--name", "demo", "--quiet", "--overwrite", "-o"]
        started = time.monotonic()
        subprocess.run([*words, str(reference)], check=True, stdout=subprocess.DEVNULL)
        whole = time.monotonic() - started
        while killed < options.count:
            code = None
            while code != 0:
                process = subprocess.Popen(
                    [*words, str(out)],
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.PIPE,
                    start_new_session=True,
                )
                kill = (
                    rng.choice((signal.SIGKILL, signal.SIGINT, signal.SIGTERM))
                    if rng.random() < 0.75
                    else None
                )
                if kill and killed < options.count:
                    time.sleep(rng.uniform(0.2, 0.9) * whole)
                    asked = time.monotonic()
                    if process.poll() is None:
                        killed += 1
                    with contextlib.suppress(ProcessLookupError):
                        (os.killpg if kill == signal.SIGINT else os.kill)(process.pid, kill)
                _, errors = process.communicate(timeout=600)
                code = process.returncode
                if kill and time.monotonic() - asked > 3:
                    print(f"{kill.name}: ended after {time.monotonic() - asked:.1f} s", flush=True)
                if b"Traceback" in errors or code not in (0, 130, -2, -9, -15):
                    print(f"exit code {code}: {errors.decode()[-300:]}", flush=True)
            left = sorted(path.name for path in Path(folder).iterdir())
            different += not _same(reference, out) or left != ["reference", "scene"]
            print(f"{killed} kills, {different} differences {'' if len(left) == 2 else left}", flush=True)
            if rng.random() < 0.8:  # else the next build replaces it
                shutil.rmtree(out)
    return different


def _same(one: Path, two: Path) -> bool:
    names = sorted(path.relative_to(one) for path in one.rglob("*") if path.is_file())
    return names == sorted(path.relative_to(two) for path in two.rglob("*") if path.is_file()) and all(
        (one / name).read_bytes() == (two / name).read_bytes() for name in names
    )


def main() -> int:
    """Run the chosen trials; exit code 1 if something went wrong."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(required=True)
    damaged = commands.add_parser("inputs")
    damaged.add_argument("kinds", nargs="+", choices=("maps", "scenes", "datasets", "configurations"))
    damaged.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    damaged.add_argument("--seconds", type=float, default=60.0)
    damaged.add_argument("--minutes", type=float, default=1e6, help="at most, for each kind")
    damaged.add_argument("--gigabytes", type=float, default=2.0)
    damaged.add_argument("--keep", type=Path)
    damaged.set_defaults(run=inputs, count=1000)
    killing = commands.add_parser("kills")
    killing.set_defaults(run=kills, count=50)
    for command in (damaged, killing):
        command.add_argument("--count", type=int)
        command.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    return int(options.run(options) > 0)


if __name__ == "__main__":
    sys.exit(main())
