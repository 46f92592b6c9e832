"""The program ``lidar``, unless an unrelated package hides the module `lidar` of this one.

A package on the public index (lake and depression mapping) has the same module name. Installed into the same
environment it overwrites files of this one; elsewhere on the module path it may be found first.
"""

from __future__ import annotations

import sys
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

from geoscene.errors import InputError


def check_lidar() -> None:
    """Raise InputError if ``import lidar`` would not import the module of this package."""
    spec = find_spec("lidar")
    found = Path(spec.origin) if spec is not None and spec.origin else None
    beside = Path(__file__).resolve().parents[1] / "lidar" / "__init__.py"
    if found is None or found.resolve() != beside or "geoscene" not in found.read_text("utf-8"):
        raise InputError(
            f"{found or beside} is not the module `lidar` of geoscene; an unrelated package on the index"
            " has the same name: pip uninstall lidar, then install geoscene again"
        )


def main() -> None:
    """Run the program ``lidar``."""
    try:
        check_lidar()
    except InputError as error:
        sys.exit(f"lidar: {error}")
    import_module("lidar.cli").main()
