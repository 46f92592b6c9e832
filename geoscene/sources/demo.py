"""The bundled map extract: the centre of Helsinki, about 0.6 km²."""

from __future__ import annotations

from pathlib import Path

from geoscene.errors import SourceNotFoundError

_NAME = "helsinki_demo.osm.pbf"


def demo_path() -> Path:
    """Path of the demo extract: in the installed package, else in ``data/`` of a checkout.

    Raises SourceNotFoundError if it is missing.
    """
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "demo", package.parent / "data"):
        if (folder / _NAME).is_file():
            return folder / _NAME
    raise SourceNotFoundError(
        f"the demo extract {_NAME} is in neither {package / 'demo'} nor {package.parent / 'data'};"
        " install the package again, make it with data/cut_demo.py, or read an extract of yours (`osm` FILE)"
    )
