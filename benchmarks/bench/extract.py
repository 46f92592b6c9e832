"""Command line of the benchmarks of a route through one extract."""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

Rows = list[dict[str, Any]]


def measure_extract(
    text: str | None,
    measured: Callable[[argparse.Namespace, Path], Rows],
    options: Mapping[str, str | float | None],
) -> None:
    """Measure the extract and route of the command line in a folder and print the rows.

    text     : the program's help
    measured : rows of the options of the command line and a folder to write to
    options  : further options and their defaults: text, or numbers where the default is a number or None
    """
    parser = argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("extract", type=Path)
    parser.add_argument("--route", nargs="+", required=True)
    for name, default in options.items():
        parser.add_argument(f"--{name}", type=str if isinstance(default, str) else float, default=default)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--folder", type=Path)
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = given.folder or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        rows = measured(given, folder)
    print(json.dumps(rows, indent=1) if given.json else table(rows))


def table(rows: Rows) -> str:
    """Rows as aligned columns."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    cells = [names, *([str(row.get(name, "")) for name in names] for row in rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return "\n".join(
        "  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True)) for line in cells
    )
