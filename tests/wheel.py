"""Build sdist and wheels, and run both programs from a new environment of a wheel and what it declares.

python -P tests/wheel.py [LEVEL...]   (-P: tests/geoscene must not hide the package)

Needs the packages of requirements.lock. Writes to dist/ the sdist, the wheel for any platform and, on x86-64,
a wheel with machine code for the levels, by default that of this processor.
"""

import importlib
import os
import pickle
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import venv
from collections.abc import Iterable, Iterator, Mapping, Sequence
from importlib.metadata import requires
from pathlib import Path
from zipfile import ZipFile

from packaging.metadata import Metadata
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from geoscene.support import compiled

ROOT = Path(__file__).resolve().parents[1]
BACKEND = "import setuptools.build_meta as b; print(b.build_{kind}({folder!r}, {settings!r}))"
PLATFORM = "manylinux_2_28_x86_64"
"""As of the wheels of llvmlite, which links the machine code."""


def run(*words: str | Path, cwd: Path, settings: Mapping[str, str] | None = None) -> None:
    """Run a command that must succeed, without the repository on the module path."""
    print("$", *words, flush=True)  # noqa: T201
    clean = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    subprocess.run([str(word) for word in words], cwd=cwd, env=clean | dict(settings or {}), check=True)


def compile_functions(level: str) -> None:
    """Compile for a level of x86-64 what both packages list; the code is kept beside the sources."""
    settings = {"NUMBA_CPU_NAME": level, "NUMBA_CPU_FEATURES": "", "PYTHONPATH": str(ROOT)}
    run(sys.executable, "-m", "geoscene.support.kernels", cwd=ROOT, settings=settings)


def fitting_code() -> Iterator[Path]:
    """Files of machine code beside the sources of this repository that fit the sources as they are."""
    for index in sorted(
        file for package in ("geoscene", "lidar") for file in (ROOT / package).rglob("*.nbi")
    ):
        source = index.parent.with_name(f"{index.name.split('.')[0]}.py")
        if not source.exists():
            continue
        with index.open("rb") as file:
            pickle.load(file)  # noqa: S301  (the version of numba; this process's own files)
            stamp, overloads = pickle.loads(file.read())  # noqa: S301
        module = importlib.import_module(".".join(source.relative_to(ROOT).with_suffix("").parts))
        if stamp == compiled.digest(module):
            yield index
            yield from (index.with_name(name) for name in sorted(set(overloads.values())))


def build_compiled(source: Path, dist: Path) -> Path:
    """Write a wheel with the machine code that lies beside the sources of this repository."""
    project = source / "pyproject.toml"
    text = project.read_text("utf-8")
    project.write_text(text.replace('"py.typed"', '"py.typed", "**/__pycache__/*.nb[ic]"'), "utf-8")
    for file in fitting_code():
        there = source / file.relative_to(ROOT)
        there.parent.mkdir(exist_ok=True)
        shutil.copyfile(file, there)
    tag = f"cp{sys.version_info.major}{sys.version_info.minor}"
    return build("wheel", dist, cwd=source, options=[f"--plat-name={PLATFORM}", f"--python-tag={tag}"])


def build(kind: str, dist: Path, *, cwd: Path, options: Sequence[str] = ()) -> Path:
    """Write an sdist or a wheel; returns its path."""
    settings = {"--build-option": list(options)} if options else {}
    before = set(dist.iterdir())
    run(sys.executable, "-c", BACKEND.format(kind=kind, folder=str(dist), settings=settings), cwd=cwd)
    (made,) = set(dist.iterdir()) - before
    return made


def build_packages(folder: Path, levels: Sequence[str]) -> Path:
    """Write the sdist and the wheels built from it to dist/; returns the path of the last."""
    dist = ROOT / "dist"
    shutil.rmtree(dist, ignore_errors=True)
    dist.mkdir()
    sdist = build("sdist", dist, cwd=ROOT)
    with tarfile.open(sdist) as archive:
        archive.extractall(folder, filter="data")
    (unpacked,) = folder.iterdir()
    wheel = build("wheel", dist, cwd=unpacked)
    for level in levels:
        compile_functions(level)
    return build_compiled(unpacked, dist) if levels else wheel


def declared(wheel: Path) -> Iterable[Requirement]:
    """Requirements in the metadata of a wheel."""
    with ZipFile(wheel) as archive:
        (name,) = (name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
        return Metadata.from_email(archive.read(name)).requires_dist or ()


def needed(requirements: Iterable[Requirement]) -> set[str]:
    """Names of the packages that requirements bring without extras, as installed here."""
    found: set[str] = set()
    todo = list(requirements)
    while todo:
        requirement = todo.pop()
        name = canonicalize_name(requirement.name)
        if name in found or not (requirement.marker is None or requirement.marker.evaluate({"extra": ""})):
            continue
        found.add(name)
        todo += map(Requirement, requires(name) or ())
    return found


def write_lock(path: Path, *, names: set[str]) -> None:
    """Write the entries of requirements.lock for some packages."""
    entries = re.split(r"^(?=[a-z])", (ROOT / "requirements.lock").read_text(), flags=re.MULTILINE)
    path.write_text("".join(entry for entry in entries if entry.split("==")[0] in names))


def main() -> None:
    """Build, install, run."""
    with tempfile.TemporaryDirectory() as temporary:
        source, away = Path(temporary) / "source", Path(temporary) / "away"
        source.mkdir()
        levels = sys.argv[1:] or list(filter(None, [compiled.level()]))
        wheel = build_packages(source, levels)
        venv.create(away / "venv", with_pip=True)
        binaries = away / "venv" / "bin"
        pip = (binaries / "python", "-m", "pip", "install", "--quiet", "--disable-pip-version-check")
        write_lock(away / "needed.lock", names=needed(declared(wheel)))
        run(*pip, "--require-hashes", "-r", "needed.lock", cwd=away)
        run(*pip, "--no-index", wheel, cwd=away)
        brought = set(away.rglob("*.nbc"))
        run(binaries / "geoscene", "build", "--demo", "-o", "scene", "-q", cwd=away)
        run(binaries / "geoscene", "validate", "scene", cwd=away)
        words = ("scene", "--route=random", "--duration=1", "-o", "drive", "-q")
        run(binaries / "lidar", "drive", *words, cwd=away)
        run(binaries / "python", "-m", "geoscene", "info", "scene", cwd=away)
        run(binaries / "python", "-m", "lidar", "map", "drive", "-o", "map.laz", "-q", cwd=away)
        if levels and (missing := sorted(path.stem for path in set(away.rglob("*.nbc")) - brought)):
            sys.exit(f"the wheel lacks machine code of {', '.join(missing)}; run tests/kernels.py")


if __name__ == "__main__":
    main()
