"""Build sdist and wheel, and run both programs from a new environment of the wheel and what it declares.

python tests/wheel.py    needs the packages of requirements.lock; writes sdist and wheel to dist/
"""

import os
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import venv
from collections.abc import Iterable
from importlib.metadata import requires
from pathlib import Path
from zipfile import ZipFile

from packaging.metadata import Metadata
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[1]
BACKEND = "import setuptools.build_meta as b; print(b.build_{kind}({folder!r}))"


def run(*words: str | Path, cwd: Path) -> None:
    """Run a command that must succeed, without the repository on the module path."""
    print("$", *words, flush=True)  # noqa: T201
    clean = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    subprocess.run([str(word) for word in words], cwd=cwd, env=clean, check=True)


def build_packages(folder: Path) -> Path:
    """Write the sdist and the wheel built from it to dist/; returns the path of the wheel."""
    dist = ROOT / "dist"
    shutil.rmtree(dist, ignore_errors=True)
    dist.mkdir()
    run(sys.executable, "-c", BACKEND.format(kind="sdist", folder=str(dist)), cwd=ROOT)
    (sdist,) = dist.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        archive.extractall(folder, filter="data")
    (unpacked,) = folder.iterdir()
    run(sys.executable, "-c", BACKEND.format(kind="wheel", folder=str(dist)), cwd=unpacked)
    (wheel,) = dist.glob("*.whl")
    return wheel


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
        wheel = build_packages(source)
        venv.create(away / "venv", with_pip=True)
        binaries = away / "venv" / "bin"
        pip = (binaries / "python", "-m", "pip", "install", "--quiet", "--disable-pip-version-check")
        write_lock(away / "needed.lock", names=needed(declared(wheel)))
        run(*pip, "--require-hashes", "-r", "needed.lock", cwd=away)
        run(*pip, "--no-index", wheel, cwd=away)
        run(binaries / "geoscene", "build", "--demo", "-o", "scene", "-q", cwd=away)
        run(binaries / "geoscene", "validate", "scene", cwd=away)
        words = ("scene", "--route=random", "--duration=1", "-o", "drive", "-q")
        run(binaries / "lidar", "drive", *words, cwd=away)
        run(binaries / "python", "-m", "geoscene", "info", "scene", cwd=away)
        run(binaries / "python", "-m", "lidar", "map", "drive", "-o", "map.laz", "-q", cwd=away)


if __name__ == "__main__":
    main()
