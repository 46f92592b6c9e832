"""Write the lists of compiled functions of both packages, ``kernels.json``, by what commands compile.

python -P tests/kernels.py   (-P: tests/geoscene must not hide the package)

The processor must be of the highest of `LEVELS`.
"""

import importlib
import json
import os
import pickle
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path

from geoscene.support.compiled import LEVELS
from geoscene.support.kernels import LIST, PACKAGES, Kernel, describe_type

ROOT = Path(__file__).resolve().parents[1]

DRIVE = ("lidar", "drive", "scene", "--duration=0.1", "--quiet")
ROAD = (*DRIVE, "--route=random")
BOX = "--bbox=24.940,60.168,24.944,60.171"
USES = {
    "build": [("geoscene", "build", "--demo", BOX, "-o=scene", "--quiet")],
    "drive": [(*ROAD, "--rig=vlp16", "-o=scanner")],
    "cameras": [(*ROAD, "-o=cameras")],
    "traffic": [(*ROAD, "--traffic=on", "--format=csv,laz", "--deskew=middle", "-o=town")],
    "other": [
        ("geoscene", "build", "--demo", BOX, "--relief=full", "-o=scene", "--overwrite", "--quiet"),
        ("geoscene", "export", "scene", "-o=surface.tif"),
        (*ROAD, "--traffic=on", "-o=full"),
        (*ROAD, "--weather=rain=10mm/h", "--road=by-weather", "-o=rain"),
        (*ROAD, "--rig=vlp16", "--fidelity=survey", "--weather=fog=80m", "-o=fog"),
        (*ROAD, "--rig=vlp16", "--set=footprint=1cm", "-o=footprints"),
        (
            *DRIVE,
            "--rig=drone",
            "--survey=all",
            "--altitude=80",
            "--turns",
            "--weather=snow=2mm/h",
            "-o=snow",
        ),
        ("lidar", "map", "town", "-o=map.laz", "--quiet"),
        ("lidar", "map", "town", "-o=map.copc.laz", "--quiet"),
    ],
}
"""Commands that between them call the compiled functions as users do, by use; each function is listed under
the first use that needs it."""


def compiled_kernels(cache: Path) -> Iterator[tuple[Kernel, int]]:
    """Kernels whose machine code a folder of `NUMBA_CACHE_DIR` has, and its bytes."""
    for index in sorted(cache.rglob("*.nbi")):
        with index.open("rb") as file:
            pickle.load(file)  # noqa: S301  (the version of numba; files of this run)
            _, overloads = pickle.loads(file.read())  # noqa: S301
        module, _, function = index.name.rpartition("-")[0].partition(".")
        folder = index.parent.name.rpartition("_")[0]
        for (signature, *_), code in overloads.items():
            name = f"{find_module(folder, module, function)}.{function}"
            size = (index.parent / code).stat().st_size
            yield Kernel(name, tuple(map(describe_type, signature))), size


def find_module(folder: str, module: str, function: str) -> str:
    """Name of the module in a folder of the packages that defines a function."""
    for package in PACKAGES:
        for path in (ROOT / package).rglob(f"{folder}/{module}.py"):
            name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
            if hasattr(importlib.import_module(name), function):
                return name
    raise LookupError(f"{folder}/{module}.py: no function {function}")


def record(level: str) -> dict[str, dict[str, int]]:
    """Kernels as JSON and the bytes of their machine code, by use, on processors of a level of x86-64."""
    known: set[str] = set()
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        cache = Path(folder, "cache")
        settings = {"NUMBA_CACHE_DIR": str(cache), "PYTHONPATH": str(ROOT)}
        settings |= {"NUMBA_CPU_NAME": level, "NUMBA_CPU_FEATURES": ""}
        for use, commands in USES.items():
            for program, *words in commands:
                command = [sys.executable, "-m", program, *words]
                subprocess.run(command, cwd=folder, env=os.environ | settings, check=True)
            listed = {
                json.dumps([kernel.name, *kernel.arguments]): size for kernel, size in compiled_kernels(cache)
            }
            found[use] = {entry: size for entry, size in listed.items() if entry not in known}
            known |= listed.keys()
    return found


def by_level(found: Mapping[str, Mapping[str, Mapping[str, int]]]) -> dict[str, dict[str, int]]:
    """Kernels by use, and by use and level those that not all levels have; ``found`` is by level and use."""
    keyed: dict[str, dict[str, int]] = {}
    for use in USES:
        common = set.intersection(*(set(uses[use]) for uses in found.values()))
        for level, uses in found.items():
            keyed[f"{use} {level}"] = {e: size for e, size in uses[use].items() if e not in common}
        keyed[use] = {e: size for e, size in next(iter(found.values()))[use].items() if e in common}
    return keyed


def write_lists(found: Mapping[str, Mapping[str, int]]) -> None:
    """Write the kernels of each package by use, those with most code first."""
    for package in PACKAGES:
        parts = []
        for use, sizes in found.items():
            own = [entry for entry in sizes if entry.startswith(f'["{package}.')]
            entries = sorted(own, key=lambda entry: (-sizes[entry], entry))
            if entries:
                parts.append(f'"{use}": [\n' + ",\n".join(entries) + "\n]")
        (ROOT / package / LIST).write_text("{\n" + ",\n".join(parts) + "\n}\n", "utf-8")


if __name__ == "__main__":
    write_lists(by_level({level: record(level) for level in LEVELS}))
