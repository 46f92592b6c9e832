"""Errors of commands that are nested in other commands: one line, exit code 2, the flags of that command."""

import gc
import signal
import sys
from pathlib import Path
from typing import Literal

import pytest
from cyclopts import App

from geoscene.errors import GeosceneError, InputError
from geoscene.support.console import DEFAULTS, main

app = App(name="program", default_parameter=DEFAULTS, suppress_keyboard_interrupt=False)
group = App(name="detector")
app.command(group)


@group.command
def train(data: Path, /, *, epochs: int = 3, mode: Literal["a", "b"] = "a", model_file: str = "x"):
    del data, mode
    if epochs < 0:
        raise InputError(f"`epochs` {epochs}: give 0 or more, and a `model_file` ({model_file})")


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
        ("detector train d --epochs x", 'unable to convert "x" into int; see program detector train --help'),
        ("detector train d --mode c", 'Choose from: "a", "b"; see program detector train --help'),
        ("detector train d e", "see program detector train --help"),
        ("detector train d --epochs -1", "program: --epochs -1: give 0 or more, and a --model-file (x)"),
        ("detector show", "program: epochs of no such model"),
        ("detector nope", "Available commands: train, show; see program detector --help"),
        ("detector --wrong", "see program detector --help"),
        ("flat x", 'unable to convert "x" into int; see program flat --help'),
        ("nope", "Available commands: detector, flat; see program --help"),
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
