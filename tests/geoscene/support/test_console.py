"""Errors of commands that are nested in other commands: one line, exit code 2, the flags of that command."""

import gc
import json
import signal
import subprocess
import sys
from pathlib import Path
from typing import Annotated, Literal

import pytest
from cyclopts import App
from helpers.programs import ENVIRONMENT

from geoscene.errors import GeosceneError, InputError
from geoscene.support.console import DEFAULTS, SEVERAL, main, note_new_folder
from geoscene.support.files import json_bytes

app = App(name="program", default_parameter=DEFAULTS, suppress_keyboard_interrupt=False)
group = App(name="detector")
app.command(group)


@group.command
def train(data: Path, /, *, epochs: int = 3, mode: Literal["a", "b"] = "a", model_file: str = "x"):
    del data, mode
    if epochs < 0:
        raise InputError(f"`epochs` {epochs}: give 0 or more, and a `model_file` ({model_file})")


@app.command
def read(*, files: Annotated[list[str], SEVERAL], words: str = "", json: bool = False):
    del json
    if words:
        raise InputError(f"word {words.rsplit(',', maxsplit=1)[-1].lower()!r} is unknown")
    raise InputError(f"{files[-1]}: no such file")


@group.command
def show():
    raise InputError("`epochs` of no such model")


@app.command
def flat(number: int):
    raise GeosceneError(f"`number` {number} failed")


@pytest.fixture
def run(monkeypatch, capsys):
    thresholds = gc.get_threshold()

    def run(*words):
        monkeypatch.setattr(sys, "argv", ["program", *words])
        with pytest.raises(SystemExit) as ended:
            main(app, (GeosceneError,), usage=(InputError,))
        return ended.value.code, capsys.readouterr().err

    yield run
    gc.set_threshold(*thresholds)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("detector train --wrong", "Unknown option: --wrong; see program detector train --help"),
        ("detector train", "parameter DATA requires an argument; see program detector train --help"),
        ("detector train d --epochs", "--epochs requires an argument; see program detector train --help"),
        ("detector train d --epochs x", "--epochs x: give a whole number; see program detector train --help"),
        ("detector train d --epochs 1 --epochs 2", "--epochs 2: is given twice; give it once"),
        ("detector train d --mode c", "--mode 'c' is unknown (known are a, b); see program detector train"),
        ("detector train d e", "see program detector train --help"),
        ("detector train d --epochs -1", "program: --epochs -1: give 0 or more, and a --model-file (x)"),
        ("detector show", "program: epochs of no such model"),
        ("detector nope", "Available commands: train, show; see program detector --help"),
        ("detector --wrong", "see program detector --help"),
        ("flat x", "NUMBER x: give a whole number; see program flat --help"),
        ("flat nowhere", "NUMBER nowhere: give a whole number"),
        ("read --files one two", "program: --files two: no such file"),
        ("read --files=two --words a,B", "program: --words: word 'b' is unknown"),
        ("read --files one --words=", "program: --words '': is empty; give a value, or leave it out"),
        ("nope", "Available commands: detector, read, flat; see program --help"),
    ],
)
def test_wrong_usage_is_one_line(run, words, message):
    code, text = run(*words.split())
    assert code == 2
    assert message in text
    assert (text.startswith("program: "), text.count("\n")) == (True, 1)


@pytest.mark.parametrize("words", [("detector", "train", "d"), ("flat", "3"), ("flat", "three")])
def test_signal_handlers_are_those_of_before_the_program(run, words):
    former = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    run(*words)
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == former


def test_failures_have_another_exit_code(run):
    assert run("flat", "7") == (1, "program: --number 7 failed\n")
    assert run("detector", "train", "d") == (0, "")


SCRIPT = """
import sys
from cyclopts import App
from geoscene.errors import GeosceneError, InputError
from geoscene.support.console import main
app = App(name="program")
@app.command
def lines(count: int):
    for k in range(count):
        print(k)
@app.command
def fail(name: str):
    raise InputError(f"{name}: is not there")
@app.command
def write(path: str):
    print(path)
    with open(path, "w") as file:
        print(file.fileno(), file=file)
@app.command
def encode(name: str):
    name.encode()
main(app, (GeosceneError,), usage=(InputError,))
"""


def in_shell(text, folder):
    """The completed process of a line of a shell, with bytes as output; PROGRAM runs the script."""
    script = folder / "program.py"
    script.write_text(SCRIPT)
    words = [b"bash", b"-c", b"set -o pipefail; " + text]
    env = ENVIRONMENT | {"PROGRAM": f"{sys.executable} {script}", "F": str(folder)}
    return subprocess.run(words, capture_output=True, check=False, env=env)


@pytest.mark.parametrize("closed", ["<&-", ">&-", "2>&-", ">&- 2>&-", "<&- >&- 2>&-"])
def test_closed_streams_end_no_program_and_take_no_file(tmp_path, closed):
    done = in_shell(f"$PROGRAM write $F/out {closed}".encode(), tmp_path)
    assert done.returncode == 0
    assert done.stderr == b""
    assert int((tmp_path / "out").read_text()) > 2
    done = in_shell(f"$PROGRAM fail it {closed}".encode(), tmp_path)
    assert done.returncode == 2
    assert done.stderr == (b"" if "2>" in closed else b"program: it: is not there\n")


@pytest.mark.parametrize("reader", ["head -1", "true"])
def test_a_reader_that_ends_early_is_no_error_to_speak_of(tmp_path, reader):
    done = in_shell(f"$PROGRAM lines 100000 | {reader}".encode(), tmp_path)
    assert done.returncode == 141  # as of programs that the signal SIGPIPE ends
    assert done.stderr == b""
    done = in_shell(f"$PROGRAM fail it 2>&1 >/dev/null | {reader}".encode(), tmp_path)
    assert done.returncode == 2
    assert done.stderr == b""


def test_names_that_are_no_utf8_are_shown_byte_by_byte(tmp_path):
    done = in_shell(b"$PROGRAM fail na\xefme", tmp_path)
    assert (done.returncode, done.stderr) == (2, b"program: na\\xefme: is not there\n")
    done = in_shell(b"$PROGRAM write $F/na\xefme", tmp_path)
    assert (done.returncode, done.stderr) == (0, b"")
    assert done.stdout.endswith(b"na\\udcefme\n")
    done = in_shell(b"$PROGRAM encode na\xefme", tmp_path)
    assert (done.returncode, done.stderr.count(b"\n")) == (2, 1)
    assert done.stderr.startswith(b"program: na\\xefme: is not UTF-8")
    with pytest.raises(InputError, match=r"`out` .*: is not UTF-8"):
        note_new_folder(Path("na\udcefme"))
    document = {"from": "na\udcefme", "to": "é"}
    assert json_bytes(document).decode("utf-8")
    assert json.loads(json_bytes(document)) == document
