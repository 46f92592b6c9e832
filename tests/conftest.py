"""Shared fixtures, the choice of tests for `make test`, and profiles of Hypothesis."""

import logging
import os
import sys
from collections.abc import Callable, Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import pytest
from filelock import FileLock
from helpers import DEMO_BOX, ROOT
from helpers.drives import PLAIN, record_in_town
from hypothesis import HealthCheck, settings

from geoscene.options import BuildOptions
from geoscene.pipeline.build import build
from geoscene.scene import Scene, open_scene
from geoscene.sources import demo_path, read_osm
from lidar.simulation.drive import drive

# Many tests start processes, which else compile every module that they import: half a second for each.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# The same examples on every machine, however slow; `make fuzz` draws others, and ten times as many.
settings.register_profile(
    "same", derandomize=True, database=None, deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.register_profile("fuzz", settings.get_profile("same"), derandomize=False, print_blob=True)
settings.load_profile("same")
FUZZ_FACTOR = 10


FULL = (
    "extremes/test_footprints", "extremes/test_places", "extremes/test_pulses", "extremes/test_rays",
    "extremes/test_scale", "geoscene/pipeline/test_interruptions", "geoscene/pipeline/test_scale",
    "lidar/simulation/test_killed", "test_benchmarks", "test_documented_commands", "test_examples",
    "test_site",
)  # fmt: skip
"""Modules of which `make test` runs nothing but tests marked ``gate``."""

SERVERS = {"address", "cluster", "storage_server", "window"}
"""Fixtures that start servers, clusters and browsers, whose tests `make test` leaves out."""


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark tests that `make test` leaves out, and multiply the examples under ``--hypothesis-profile=fuzz``.

    Modules that use a scene and others take turns, those with the drive through a town first. While one
    worker compiles most kernels for it, another has tests that need few of them.
    """
    for item in items:
        module = item.path.relative_to(ROOT / "tests").with_suffix("").as_posix()
        is_full = module in FULL and not item.get_closest_marker("gate")
        if is_full or item.get_closest_marker("shared") or SERVERS & set(getattr(item, "fixturenames", ())):
            item.add_marker("full")
    users = (
        [i.path for i in items if name in getattr(i, "fixturenames", ())] for name in ("town_drive", "scene")
    )
    in_scenes = list(dict.fromkeys(chain(*users)))
    others = list(dict.fromkeys(item.path for item in items if item.path not in in_scenes))
    turn = {path: 2 * k + j for j, paths in enumerate((in_scenes, others)) for k, path in enumerate(paths)}
    items.sort(key=lambda item: turn[item.path])
    if config.getoption("--hypothesis-profile") == "fuzz":
        attribute = "_hypothesis_internal_use_settings"  # there is no public way to the settings of a test
        functions = (item.obj for item in items if isinstance(item, pytest.Function))
        for test in {f for f in functions if hasattr(f, attribute)}:
            own = getattr(test, attribute)
            setattr(test, attribute, settings(own, max_examples=FUZZ_FACTOR * own.max_examples))


SHARED = Path(os.environ.get("GEOSCENE_SHARED") or ROOT.parent / "shared")
"""Folder of the real extracts, which are no part of the repository."""


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Skip the tests of absent extracts, all from one line, so that the summary has one line for them."""
    if item.get_closest_marker("shared") and "GEOSCENE_SHARED" not in os.environ and not SHARED.exists():
        pytest.skip("needs real extracts, not part of the repository: set GEOSCENE_SHARED to their folder")


def _shared(folder: str, name: str) -> Path:
    path = SHARED / folder / name
    if not path.exists():
        pytest.fail(f"{path} is absent: GEOSCENE_SHARED names another folder, or the extracts are incomplete")
    return path


@pytest.fixture(scope="session")
def shared_osm() -> Callable[[str], Path]:
    """Path of a real OpenStreetMap extract by file name."""
    return lambda name: _shared("osm", name)


@pytest.fixture(scope="session")
def shared_dem() -> Callable[[str], Path]:
    """Path of a real terrain file by file name."""
    return lambda name: _shared("dem", name)


@pytest.fixture(scope="session")
def once(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, Callable[[Path], object]], Path]:
    """A function that makes a folder by name once for all worker processes of the test run; read only."""
    shared = tmp_path_factory.getbasetemp()
    shared = shared.parent if "PYTEST_XDIST_WORKER" in os.environ else shared

    def made(name: str, make: Callable[[Path], object]) -> Path:
        path = shared / name
        with FileLock(path.with_suffix(".lock")):
            if not path.exists():
                make(path)
        return path

    return made


@pytest.fixture(scope="session")
def demo_scene(once: Callable[..., Path]) -> Callable[[str], Scene]:
    """The middle of the demo map in a CRS."""

    def built(crs: str) -> Scene:
        def make(path: Path) -> None:
            build(read_osm(demo_path(), bounds=DEMO_BOX), path, options=BuildOptions(name="demo", crs=crs))

        return open_scene(once(f"demo-{crs}", make))

    return built


@pytest.fixture(scope="session")
def scene(demo_scene: Callable[[str], Scene]) -> Scene:
    """The middle of the demo map in a local transverse Mercator frame."""
    return demo_scene("local")


@pytest.fixture(scope="session")
def scene_utm(demo_scene: Callable[[str], Scene]) -> Scene:
    """The middle of the demo map in UTM."""
    return demo_scene("utm")


@pytest.fixture(scope="session")
def town_drive(scene: Scene, once: Callable[..., Path]) -> Path:
    """Folder of 0.6 s of the rig `seed`, which has cameras, in snow, among road users and under attack."""
    return once("a drive", lambda path: record_in_town(scene, path))


@pytest.fixture(scope="session")
def plain_drive(scene: Scene, once: Callable[..., Path]) -> Path:
    """Folder of the drive that `helpers.drives.PLAIN` describes: ten sweeps of a VLP-16 as PCD and LAZ."""
    return once("plain drive", lambda path: drive(scene, path, options=PLAIN))


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A home of its own, hence an empty cache."""
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    return tmp_path / "home"


@pytest.fixture(scope="session")
def storage_server() -> Iterator[str]:
    """Address of an S3-compatible server on this machine."""
    from moto.server import ThreadedMotoServer  # noqa: PLC0415 - takes a second

    logging.getLogger("werkzeug").setLevel(logging.ERROR)  # it prints every request
    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    yield f"http://{host}:{port}"
    server.stop()


@pytest.fixture
def s3(storage_server: str, home: Path, monkeypatch: pytest.MonkeyPatch) -> Any:  # noqa: ARG001
    """The file system of an empty bucket, ``s3://bucket``."""
    import fsspec  # noqa: PLC0415

    monkeypatch.setenv("AWS_ENDPOINT_URL", storage_server)
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.setenv(name, "test")
    fsspec.get_filesystem_class("s3").clear_instance_cache()
    system = fsspec.filesystem("s3", use_listings_cache=False)
    if system.exists("bucket"):
        system.rm("bucket", recursive=True)
    system.mkdir("bucket")
    return system
