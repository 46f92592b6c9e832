"""What users see of long tasks: bars on terminals, lines elsewhere, nothing if that is wanted."""

import io
import os
import pty
import re
import subprocess
import sys
import types

import pytest
from helpers.programs import ENVIRONMENT, command
from rich.console import Console

import geoscene
from geoscene.support.progress import Aside, displayed, progress_bar, shows_progress, silent
from geoscene.support.stages import Stages, bars_of, duration

SHOWN = {name: value for name, value in ENVIRONMENT.items() if name != "GEOSCENE_PROGRESS"}


class Clock:
    """A clock that tests set, in seconds."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def visible(monkeypatch):
    monkeypatch.delenv("GEOSCENE_PROGRESS", raising=False)


def run(clock, *reports):
    """Lines of stages that are reported at some times."""
    lines = []
    stages = Stages(lines.append, clock=clock)
    for time, stage, done, total in reports:
        clock.now = time
        stages(stage, done, total=total)
    return lines, stages


def test_a_stage_ends_with_its_last_step_or_when_the_next_one_begins(clock):
    lines, stages = run(
        clock,
        (0, "reading the map", 0, 0),
        (2, "verifying", 0, 3),
        (3, "verifying", 2, 3),
        (4, "tiles", 0, 60),
        (8, "tiles", 60, 60),
        (8, "planning", 0, 0),
    )
    clock.now = 70
    stages.close()
    assert lines == [
        "reading the map: done in 2.0 s",
        "verifying: 3 done in 2.0 s",
        "tiles: 60 done in 4.0 s",
        "planning: done in 1:02 min",
    ]


def test_stages_that_run_at_once_end_on_their_own(clock):
    lines, stages = run(clock, (0, "a", 0, 4), (1, "b", 0, 2), (2, "b", 2, 2), (3, "a", 4, 4))
    stages.close()
    assert lines == ["b: 2 done in 1.0 s", "a: 4 done in 3.0 s"]


def test_a_wait_is_said_when_it_begins_and_does_not_end_the_stage_around_it(clock):
    lines, stages = run(clock, (0, "reading the map", 0, 0), (0.1, Aside("waiting 30 s (HTTP 429)"), 0, 30))
    assert lines == ["waiting 30 s (HTTP 429)"]
    assert [stage.name for stage in stages.running()] == ["reading the map", "waiting 30 s (HTTP 429)"]
    clock.now = 30.1
    stages(Aside("waiting 30 s (HTTP 429)"), 30, total=30)
    clock.now = 40
    stages.close()
    assert lines[1:] == ["reading the map: done in 40.0 s"]


def test_compilation_counts_its_own_time_only(clock):
    compiling = Aside("compiling, once")
    lines, stages = run(
        clock,
        (0, "planning", 0, 0),
        (1, compiling, 0, 0),
        (6, "driving", 0, 2),
        (7, compiling, 5, 0),
        (9, "driving", 1, 2),
        (20, "driving", 2, 2),
    )
    stages.close()
    assert lines == [
        "planning: done in 6.0 s",
        "driving: 2 done in 14.0 s",
        "compiling, once: 5 done in 7.0 s",
    ]


def test_brief_tasks_say_nothing_and_interrupted_ones_how_far_they_came(clock):
    lines, stages = run(clock, (0, "tiles", 0, 9), (0.5, "tiles", 9, 9))
    stages.close()
    assert lines == []
    lines, stages = run(clock, (10, "tiles", 0, 9), (13, "tiles", 4, 9))
    stages.close(stopped=True)
    assert lines == ["tiles: stopped at 4 of 9 after 3.0 s"]


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.04, "0.0 s"), (59.94, "59.9 s"), (59.96, "1:00 min"), (125.4, "2:05 min"), (3725, "1:02:05 h")],
)
def test_durations_are_short_texts(seconds, text):
    assert duration(seconds) == text


def test_a_terminal_shows_steps_time_and_an_estimate(clock):
    _, stages = run(clock, (0, "reading [the] map", 0, 0), (0, "tiles", 0, 60), (0, "planning", 0, 0))
    clock.now = 3
    stages("tiles", 12, total=60)
    console = Console(force_terminal=True, record=True, file=io.StringIO(), width=100)
    console.print(bars_of(stages.running(), 3.0))
    text = console.export_text()
    assert re.search(r"tiles +━.* 12 of 60, 3\.0 s, 12\.0 s left", text)
    assert re.search(r"planning +━.* 3\.0 s *\n", text)
    assert "?" not in text
    assert not bars_of(stages.running(), 0.1).row_count  # not for a moment


@pytest.mark.usefixtures("visible")
def test_errors_leave_their_message_alone_and_interruptions_name_the_stage(capsys, monkeypatch):
    monkeypatch.setattr("geoscene.support.stages._BRIEF_S", 0.0)

    def work(error):
        with progress_bar() as progress:
            progress("tiles", 1, total=9)
            raise error

    with pytest.raises(ValueError, match="bad"):
        work(ValueError("bad"))
    assert capsys.readouterr().err == ""
    with pytest.raises(KeyboardInterrupt):
        work(KeyboardInterrupt())
    assert re.fullmatch(r"tiles: stopped at 1 of 9 after 0\.\d s\n", capsys.readouterr().err)


@shows_progress
def work(progress=displayed):
    for k in range(4):
        progress("steps", k, total=3)
    inner(progress=progress)
    inner()  # nothing of its own within the display of another


@shows_progress
def inner(progress=displayed):
    progress("inner", 1, total=1)


@pytest.mark.usefixtures("visible")
def test_python_shows_progress_by_default_and_can_be_silenced(capsys, monkeypatch):
    monkeypatch.setattr("geoscene.support.stages._BRIEF_S", 0.0)
    work()
    assert re.fullmatch(r"steps: 3 done in 0\.\d s\ninner: done in 0\.\d s\n", capsys.readouterr().err)
    work(progress=geoscene.silent)
    assert geoscene.silent is silent
    geoscene.show_progress(False)
    try:
        work()
    finally:
        geoscene.show_progress(True)
    monkeypatch.setenv("GEOSCENE_PROGRESS", "off")
    work()
    assert capsys.readouterr().err == ""


@pytest.mark.usefixtures("visible")
def test_a_notebook_shows_the_running_stages_below_the_ended_ones(monkeypatch):
    shown_texts = []

    class Handle:
        def update(self, data, *, raw):
            assert raw
            shown_texts.append(data["text/plain"])

    class ZMQInteractiveShell:
        pass

    module = types.ModuleType("IPython")
    module.get_ipython = ZMQInteractiveShell
    module.display = types.SimpleNamespace(display=lambda *_, **__: Handle())
    monkeypatch.setitem(sys.modules, "IPython", module)
    monkeypatch.setattr("geoscene.support.stages._BRIEF_S", 0.0)
    monkeypatch.setattr("geoscene.support.stages._BETWEEN_S", 0.0)
    work()
    assert re.fullmatch(r"steps: 1 of 3, 0\.\d s, 0\.\d s left", shown_texts[1])
    assert re.fullmatch(r"steps: 3 done in 0\.\d s\ninner: done in 0\.\d s", shown_texts[-1])


SCRIPT = """
import time
from geoscene.support.progress import Aside, displayed, progress_bar, shows_progress, silent
with progress_bar() as progress:
    progress("reading the map", 0, total=0)
    time.sleep(1.2)
    for k in range(6):
        progress("tiles", k, total=5)
        time.sleep(0.3)
"""


def run_shown(words):
    return subprocess.run(words, env=SHOWN, capture_output=True, text=True, check=True)


def test_pipes_have_one_line_a_stage_and_terminals_bars_above_which_the_lines_stay():
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT], env=SHOWN, capture_output=True, text=True, check=True
    )
    assert done.stdout == ""
    assert re.fullmatch(r"reading the map: done in 1\.\d s\ntiles: 5 done in 1\.\d s\n", done.stderr)
    main, side = pty.openpty()
    process = subprocess.Popen([sys.executable, "-c", SCRIPT], env=SHOWN | {"TERM": "xterm"}, stderr=side)
    os.close(side)
    seen = b""
    try:
        while part := os.read(main, 4096):
            seen += part
    except OSError:  # the terminal is closed
        pass
    assert process.wait() == 0
    text = re.sub(rb"\x1b\[[0-9;?]*[a-zA-Z]", b"", seen).decode()
    assert "of 5" in text
    assert "left" in text
    assert "?" not in text
    assert re.search(r"reading the map: done in 1\.\d s.*tiles: 5 done in 1\.\d s", text, re.DOTALL)


@pytest.mark.full
def test_programs_say_their_stages_unless_quiet(tmp_path):
    words = command("geoscene", "build", "--demo", "--bbox", "24.942,60.166,24.948,60.168", "--lod", "0")
    done = subprocess.run(
        [*words, "-o", tmp_path / "a"], env=SHOWN, capture_output=True, text=True, check=True
    )
    stages = re.findall(r"^(.+?): (?:[\d,]+ )?done in [\d.:]+ (?:s|min)$", done.stderr, re.MULTILINE)
    assert [name for name in stages if "compil" not in name] == [
        "reading the map", "buildings", "roads", "ground", "tiles",
    ]  # fmt: skip
    assert run_shown([*words, "-o", tmp_path / "b", "--quiet"]).stderr == ""
