"""Bad values of options: one line that names the option and the value, exit code 1 or 2, nothing written."""

import re
import shutil
from contextlib import suppress

import numpy as np
import pytest
from helpers.grammar import PROGRAMS, declared_options
from helpers.programs import run_program

PYTHON = re.compile(
    r"Traceback|NoneType|ufunc|could not convert|invalid literal|<class|dtype|\[Errno|codec|object (is|has)"
    r"|\b(int|float|str|bool)\b|\w+(Error|Exception)\b"
)
"""Words of Python and its libraries."""

OTHER = re.compile(r"does not go with|no effect|together|needs|give one of|is for maps|does not take it")
"""Words of messages about two options, which do not need their values."""

INPUTS = {
    "geoscene build": "--demo --bbox 24.9435,60.1665,24.9445,60.1675 --workers 1",
    "geoscene tradeoff": "--demo --bbox 24.9435,60.1665,24.9445,60.1675 --settings lod",
    "lidar drive": "scene --route random --duration 0.1 --rig vlp16 --format pcd",
    "lidar tradeoff": "scene --route random --duration 0.1 --rig vlp16 --settings rays",
    "lidar sweep": "sweep.toml", "lidar redteam": "sweep.toml", "lidar plot": "speed drive",
    "lidar animate": "drive --size 160x160", "lidar convert": "drive --to tum",
    "lidar apply": "drive --stage dropped_packets", "lidar denoise": "drive --method dror",
    "lidar odometry": "drive --method small_gicp", "lidar detect": "drive --to nuscenes",
    "lidar evaluate": "drive/poses.csv --against drive", "lidar defend": "drive --defence occlusion",
    "lidar sign": "drive --chain secret.key", "lidar verify": "drive",
    "lidar selftest": "--only places",
    **{f"lidar {name}": "" for name in ("rigs", "sensors", "settings", "stages", "defences", "classes")},
    **{f"lidar {name}": "drive" for name in ("info", "view", "map", "train")},
    **{f"geoscene {name}": "scene" for name in ("info", "validate", "export", "view")},
}  # fmt: skip
"""Words with which each command succeeds, but for its output."""

OUTPUTS = {
    "map": "out.laz",
    "view": "out.html",
    "plot": "out.png",
    "animate": "out.gif",
    "export": "out.geojson",
}
"""Outputs of commands that are not called ``out``."""

REFUSED = {
    "switch": ("maybe",), "choice": ("quux",), "number": ("quux", "nan", "5parsec", "inf", "", "1e400"),
    "whole": ("1.5", "nan", "quux", "1e400"), "path": ("", " "), "text": ("", " "),
}  # fmt: skip
"""Values that no option of a kind takes, whatever the inputs."""

DOUBTFUL = {
    "switch": (), "choice": ("Zürich",), "number": ("-1", "0", "1e30"), "whole": ("-1", "0", "9" * 30),
    "path": ("quux", "folder", "random.bin", "none/missing.xyz", "Zürich-日本"),
    "text": ("quux", "folder", "random.bin", "none/missing.xyz", "Zürich-日本", "a,,b", "-1", "nan"),
}  # fmt: skip
"""Values that some options take."""

WRITING = {(option.program, option.command) for option in declared_options() if option.flag == "--out"}
"""Commands with an output."""


def words_of(option, value):
    """Words of the option's command with a value of it."""
    given = INPUTS[f"{option.program} {option.command}"].split()
    output = OUTPUTS.get(option.command, "out")
    given += ["--out", output] if (option.program, option.command) in WRITING else []
    if not option.flag:
        at = 1 if (option.command, option.name) == ("plot", "dataset") else 0
        return [option.command, *given[:at], value, *given[at + 1 :]]
    if option.flag in given:
        at = given.index(option.flag)
        given[at : at + 2] = []
    return [option.command, *given, f"{option.flag}={value}"]


def fault_of(option, value, folder, *, refused):
    """What is wrong with the answer to a value; empty if nothing is.

    refused : the value is never valid
    """
    before = set(folder.rglob("*"))
    words = words_of(option, value)
    done = run_program(option.program, *words, cwd=folder)
    new = set(folder.rglob("*")) - before
    for path in new:
        path.unlink(missing_ok=True) if not path.is_dir() else shutil.rmtree(path)
    if done.returncode == 0 and not refused:
        return ""
    text = done.stderr
    faults = [
        "exit code" * (done.returncode not in (1, 2)),
        "lines" * (text.count("\n") != 1),
        "Python" * bool(PYTHON.search(text)),
        "no option" * (option.flag not in text and option.flag != "--out" and done.returncode == 2),
        "no value" * (not names(value, text) and not OTHER.search(text)),
        "written" * bool(new),
    ]
    found = ", ".join(filter(None, faults))
    return f"{option.program} {' '.join(words)}: {found}: {done.returncode} {text}" if found else ""


def names(value, text):
    """Whether a message names a value, a number in any form."""
    with suppress(ValueError):
        if f"{float(value):g}" in text:
            return True
    return value.casefold() in text.casefold() if value.strip() else "is empty" in text


@pytest.mark.parametrize("program", PROGRAMS)
def test_values_that_no_option_takes_are_refused_before_anything_is_read(program, tmp_path):
    seen, faults = set(), []
    for option in declared_options(program):
        key = option.kind, option.kind in ("path", "text") or option.name
        if key not in seen:
            seen.add(key)
            values = REFUSED[option.kind]
            faults.append(fault_of(option, values[len(seen) % len(values)], tmp_path, refused=True))
    if found := "".join(faults):
        pytest.fail(found)


@pytest.fixture
def inputs(scene, plain_drive, tmp_path):
    """A folder with the inputs of `INPUTS`."""
    (tmp_path / "scene").symlink_to(scene.path)
    (tmp_path / "drive").symlink_to(plain_drive)
    (tmp_path / "folder").mkdir()
    (tmp_path / "random.bin").write_bytes(np.random.default_rng(0).bytes(3000))
    (tmp_path / "secret.key").write_text("00112233445566778899aabbccddeeff")
    (tmp_path / "sweep.toml").write_text('[drive]\nscene = "scene"\nroute = "random"\nduration = 0.1\n')
    return tmp_path


COMMANDS = sorted({(option.program, option.command) for option in declared_options()})


@pytest.mark.full
@pytest.mark.parametrize(("program", "command"), COMMANDS)
def test_bad_values_are_refused_in_one_line_that_names_the_option(program, command, inputs):
    """Options that commands share are tried with doubtful values at the first of them alone."""
    first = {}
    for option in declared_options():
        first.setdefault((option.program, option.name, option.kind), option)
    faults = []
    for option in declared_options(program):
        if option.command == command:
            doubtful = DOUBTFUL[option.kind] if option in first.values() else ()
            faults += [fault_of(option, value, inputs, refused=True) for value in REFUSED[option.kind]]
            faults += [fault_of(option, value, inputs, refused=False) for value in doubtful]
    if found := "".join(faults):
        pytest.fail(found)
