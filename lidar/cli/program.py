"""The program `lidar`, and the parameters and texts that its commands share."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import App, Parameter

from geoscene import __version__
from geoscene.support.console import DEFAULTS, Report, print_json
from lidar.options.shared import OUTPUT

if TYPE_CHECKING:
    from lidar.signal.situation import Counts

app = App(
    name="lidar",
    version=__version__,
    default_parameter=DEFAULTS,
    suppress_keyboard_interrupt=False,
    help="""Drive vehicles with ray-cast sensors through scenes made by geoscene.

    lidar drive scene --route random --duration 20 -o drive

    lidar map drive -o map.laz
    """,
)
app.register_install_completion_command()

Out = Annotated[Path, Parameter(name=["--out", "-o"], group=OUTPUT)]
Reporting = Annotated[Report, Parameter(group=OUTPUT)]
JsonFlag = Annotated[bool, Parameter(group=OUTPUT)]
QuietFlag = Annotated[bool, Parameter(name=["--quiet", "-q"], group=OUTPUT)]


def show(document: Mapping[str, Any], text: str, *, json: bool) -> int:
    """Print a result as JSON or as text; the exit code of success."""
    if json:
        print_json(document)
    else:
        print(text)
    return 0


def print_effects(effects: Counts) -> None:
    """Say what each stage did."""
    from lidar.signal.situation import effect_lines  # noqa: PLC0415

    for line in effect_lines(effects):
        print(line)
