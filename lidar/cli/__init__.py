"""The `lidar` program: drive through scenes, and make maps of what was recorded."""

from geoscene.errors import GeosceneError
from geoscene.errors import InputError as SceneInputError
from geoscene.support.console import main as run
from lidar.cli.data import apply, convert, denoise, map_, odometry
from lidar.cli.drives import drive, redteam, sweep, tradeoff
from lidar.cli.evaluation import detect, evaluate
from lidar.cli.lists import classes, rigs, selftest, sensors, settings, stages
from lidar.cli.look import animate, info, plot, view
from lidar.cli.program import app
from lidar.cli.security import defences, defend, sign, tamper, train, verify
from lidar.errors import InputError, LidarError

__all__ = ["app", "main"]

for _command in (
    drive,
    sweep,
    redteam,
    tradeoff,
    detect,
    evaluate,
    info,
    map_,
    view,
    convert,
    apply,
    plot,
    animate,
    denoise,
    odometry,
    defend,
    train,
    defences,
    tamper,
    sign,
    verify,
    stages,
    rigs,
    sensors,
    classes,
    settings,
    selftest,
):
    app.command(_command)


def main() -> None:
    """Run the program."""
    run(app, (LidarError, GeosceneError), usage=(InputError, SceneInputError))
