"""The `lidar` program: its commands, in groups."""

from cyclopts import Group

from geoscene.errors import GeosceneError
from geoscene.errors import InputError as SceneInputError
from geoscene.support.console import main as run
from lidar.cli.data import apply, convert, denoise, map_, odometry
from lidar.cli.drives import drive, redteam, sweep, tradeoff
from lidar.cli.evaluation import detect, evaluate
from lidar.cli.lists import classes, defences, rigs, selftest, sensors, settings, stages
from lidar.cli.look import animate, info, plot, view
from lidar.cli.program import app
from lidar.cli.security import defend, sign, train, verify
from lidar.errors import InputError, LidarError

__all__ = ["app", "main"]

_COMMANDS = {
    "Record": (drive, sweep),
    "Look": (info, view, plot, animate),
    "Use recorded data": (map_, convert, apply, denoise, odometry, detect, train),
    "Measure": (evaluate, tradeoff, selftest),
    "Security": (defend, redteam, sign, verify),
    "Lists": (rigs, sensors, settings, stages, defences, classes),
}
"""Commands by the groups of ``lidar --help``, in the order in which users meet them."""

for _order, (_title, _commands) in enumerate(_COMMANDS.items(), 1):
    _group = Group(_title, sort_key=_order)
    for _command in _commands:
        app.command(_command, group=_group)


_REMOVED = {"--refine": "use lidar odometry DATASET --method fused -o EST, and --poses EST/trajectory.tum"}
"""What to write instead of former options, by flag."""


def main() -> None:
    """Run the program."""
    run(app, (LidarError, GeosceneError), usage=(InputError, SceneInputError), removed=_REMOVED)
