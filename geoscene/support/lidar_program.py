"""Entry point of the installed program ``lidar``: checks that the module `lidar` is that of this package.

An unrelated package on the public index (lake and depression mapping) installs a module of the same name,
which overwrites files of this package or is found first on the module path. As a module,
the program is run by ``python -m lidar``, not by this one.
"""

from __future__ import annotations

import sys
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

from geoscene.errors import InputError


def check_lidar() -> None:
    """Raises InputError if ``import lidar`` would import the module of another package."""
    spec = find_spec("lidar")
    found = Path(spec.origin) if spec is not None and spec.origin else None
    own = Path(__file__).resolve().parents[2] / "lidar" / "__init__.py"
    if found is None or found.resolve() != own or "geoscene" not in found.read_text("utf-8"):
        raise InputError(
            f"{found or own} is not the module `lidar` of geoscene; an unrelated package on the index"
            " has the same name: pip uninstall lidar, then install geoscene again"
        )


def main() -> None:
    """Run the program ``lidar``."""
    try:
        check_lidar()
    except InputError as error:
        sys.exit(f"lidar: {error}")
    import_module("lidar.cli").main()
