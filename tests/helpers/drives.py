"""A short drive of the rig `seed` in snow, among road users and under attack, for tests of pages."""

from helpers import ROOT
from helpers.programs import run_program

ATTACK = ROOT / "examples" / "attacks" / "injected_car.toml"


def record(scene, out, *, seconds=0.6):
    """Record the drive, without relief: images take half the time. Returns its folder."""
    words = ("--route", "random", "--duration", seconds, "--seed", 3, "--rig", "seed", "--format", "pcd")
    around = ("--traffic", "vehicles=60,parked=0.8,pedestrians=30,cyclists=5", "--weather", "snow=10mm/h")
    other = ("--attack", ATTACK, "--relief", "off")
    done = run_program("lidar", "drive", scene.path, *words, *around, *other, "-o", out, "-q")
    assert done.returncode == 0, done.stderr
    return out
