"""Where the real extracts are."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


def _shared(folder: str, name: str) -> Path:
    base = Path(os.environ.get("GEOSCENE_SHARED", ROOT.parent / "shared"))
    path = base / folder / name
    if not path.exists():
        message = f"{path} is absent; set GEOSCENE_SHARED to the folder of real extracts"
        if os.environ.get("CI") == "true":
            pytest.fail(message)
        pytest.skip(message)
    return path


@pytest.fixture(scope="session")
def shared_osm() -> Callable[[str], Path]:
    """Path of a real OpenStreetMap extract by file name."""
    return lambda name: _shared("osm", name)


@pytest.fixture(scope="session")
def shared_dem() -> Callable[[str], Path]:
    """Path of a real terrain file by file name."""
    return lambda name: _shared("dem", name)
