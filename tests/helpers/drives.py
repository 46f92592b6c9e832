"""Recorded drives that tests share."""

from helpers import ROOT
from helpers.programs import run_program
from lidar.options import DriveOptions

PLAIN = DriveOptions(rig="vlp16", duration=1.0, seed=3, formats=("pcd", "laz"))
ATTACK = ROOT / "examples" / "attacks" / "injected_car.toml"


def record_in_town(scene, out):
    """Record a short drive of the rig `seed` in snow, among road users and under attack.

    It has no relief: images take half the time.
    """
    words = ("--route", "random", "--duration", 0.6, "--seed", 3, "--rig", "seed", "--format", "pcd")
    around = ("--traffic", "vehicles=60,parked=0.8,pedestrians=30,cyclists=5", "--weather", "snow=10mm/h")
    other = ("--attack", ATTACK, "--relief", "off")
    done = run_program("lidar", "drive", scene.path, *words, *around, *other, "-o", out, "-q")
    assert done.returncode == 0, done.stderr
