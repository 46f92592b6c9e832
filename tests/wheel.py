"""Build sdist and wheel, and run both programs from a new environment with only the wheel installed.

python tests/wheel.py    needs the packages of requirements.lock; writes sdist and wheel to dist/
"""

import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
import venv
from pathlib import Path

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


def main() -> None:
    """Build, install, run."""
    with tempfile.TemporaryDirectory() as temporary:
        source, away = Path(temporary) / "source", Path(temporary) / "away"
        source.mkdir()
        wheel = build_packages(source)
        venv.create(away / "venv", with_pip=True)
        binaries = away / "venv" / "bin"
        pip = (binaries / "python", "-m", "pip", "install", "--quiet", "--disable-pip-version-check")
        run(*pip, "--require-hashes", "-r", ROOT / "requirements.lock", cwd=away)
        run(*pip, "--no-deps", "--no-index", wheel, cwd=away)
        run(binaries / "geoscene", "build", "--demo", "-o", "scene", "-q", cwd=away)
        run(binaries / "geoscene", "validate", "scene", cwd=away)
        words = ("scene", "--route=random", "--duration=1", "-o", "drive", "-q")
        run(binaries / "lidar", "drive", *words, cwd=away)
        run(binaries / "python", "-m", "geoscene", "info", "scene", cwd=away)
        run(binaries / "python", "-m", "lidar", "map", "drive", "-o", "map.laz", "-q", cwd=away)


if __name__ == "__main__":
    main()
