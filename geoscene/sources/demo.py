"""The bundled map extract: the centre of Helsinki, about 0.6 km²."""

from __future__ import annotations

from pathlib import Path

from geoscene.errors import SourceNotFoundError


def demo_path() -> Path:
    """Path of the demo map in the package.

    Raises SourceNotFoundError if it is missing.
    """
    path = Path(__file__).resolve().parents[1] / "demo" / "helsinki.osm.pbf"
    if not path.is_file():
        raise SourceNotFoundError(f"the demo map {path} is missing: install the package again")
    return path
