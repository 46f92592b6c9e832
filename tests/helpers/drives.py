"""Recorded drives that tests share."""

from helpers import ROOT
from helpers.programs import run_program
from lidar.options.drive import DriveOptions

PLAIN = DriveOptions(rig="vlp16", duration=1.0, seed=3, formats=("pcd", "laz"))
ATTACK = ROOT / "examples" / "attacks" / "injected_car.toml"


def small_seed(folder):
    """File of the rig `seed` with images of a quarter of the pixels."""
    rig = folder / "seed.toml"
    text = (ROOT / "lidar" / "sensors" / "rig" / "rigs" / "seed.toml").read_text("utf-8")
    rig.write_text(text.replace("= 1280", "= 640").replace("= 720", "= 360"), "utf-8")
    return rig


def record_in_town(scene, out):
    """Record a short drive of `small_seed` in snow, among road users and under attack, without relief."""
    rig = small_seed(out.parent)
    words = ("--route", "random", "--duration", 0.6, "--seed", 3, "--rig", rig, "--format", "pcd")
    around = ("--traffic", "vehicles=60,parked=0.8,pedestrians=30,cyclists=5", "--weather", "snow=2mm/h")
    other = ("--attack", ATTACK, "--relief", "off")
    done = run_program("lidar", "drive", scene.path, *words, *around, *other, "-o", out, "-q")
    assert done.returncode == 0, done.stderr
