"""The program `geoscene`, and the parameters and texts that its commands share."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

from cyclopts import App, Group, Parameter

from geoscene import __version__
from geoscene.support.console import DEFAULTS, Report, print_json, with_flags

app = App(
    name="geoscene",
    version=__version__,
    default_parameter=DEFAULTS,
    suppress_keyboard_interrupt=False,
    help="""Turn a real place from OpenStreetMap into a watertight 3D scene.

    A first scene, without a network:  geoscene build --demo -o scene

    Then look at it (geoscene view scene -o page.html), check it (geoscene validate scene), open
    scene/features.gpkg in QGIS, or drive through it:  lidar drive scene --route random -o drive
    """,
)
app.register_install_completion_command()

OUTPUT = Group("Output", sort_key=4)

Out = Annotated[Path, Parameter(name=["--out", "-o"], group=OUTPUT)]
Reporting = Annotated[Report, Parameter(group=OUTPUT)]


def print_file(summary: Any, contents: str, *, end: str = "", json: bool) -> None:
    """Print a summary of a written file, as JSON or as text."""
    if json:
        print_json({**asdict(summary), "path": str(summary.path)})
        return
    print(f"{summary.path}: {contents}, {summary.bytes / 1e6:.1f} MB{end}")
    for note in summary.notes:
        print(f"  {with_flags(app, note)}")
