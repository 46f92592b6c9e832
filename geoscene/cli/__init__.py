"""The `geoscene` program: build, inspect, check, export and show scenes."""

from geoscene.cli.build import build, tradeoff
from geoscene.cli.look import export, info, validate, view
from geoscene.cli.program import app
from geoscene.errors import GeosceneError, InputError
from geoscene.support.console import main as run

__all__ = ["app", "main"]

for _command in (build, tradeoff, info, validate, export, view):
    app.command(_command)


def main() -> None:
    """Run the program."""
    run(app, (GeosceneError,), usage=(InputError,))
