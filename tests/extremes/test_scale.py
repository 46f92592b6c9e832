"""Scale at the extremes: the table's cases, and what `lidar selftest` prints of them."""

import json
import subprocess

import pytest
from helpers import ROOT
from helpers.programs import ENVIRONMENT, command

from lidar.tools.selftest import run
from lidar.tools.selftest.case import ExtremeCase
from lidar.tools.selftest.run import CASES, GROUPS
from lidar.tools.selftest.scale import CASES as SCALE

PAGE = ROOT / "docs" / "measurements" / "extremes.md"


@pytest.mark.parametrize("case", SCALE, ids=lambda case: case.name)
def test_scale_stays_within_the_bound(case):
    done = run.outcome(case, case.quick)
    assert done.error == ""
    assert done.measured <= case.bound


def too_much(count):
    return 2.0 * count


def broken(count):
    raise ValueError(f"no\nway in {count}")


RAY = {"group": "rays", "bound": 1.0, "unit": "m", "of": "rays", "quick": 1, "full": 1}
FAILING = (
    ExtremeCase("too much", too_much, "nothing", **RAY),
    ExtremeCase("an error", broken, "nothing", **RAY),
)


def test_bounds_that_do_not_hold_and_errors_are_told(monkeypatch):
    monkeypatch.setattr(run, "CASES", FAILING)
    done = list(run.outcomes())
    assert [one.ok for one in done] == [False, False]
    printed = run.to_text(done)
    assert "FAILS" in printed
    assert "ValueError: no way in 1" in printed
    assert "numpy" in printed
    assert json.loads(json.dumps(run.document(done), allow_nan=False))["cases"][1]["measured"] is None
    assert run.markdown(done).count("(FAILS)") == 2


def test_the_program_exits_with_0_and_prints_json():
    words = command("lidar", "selftest", "--only", "statistics", "--json")
    done = subprocess.run(words, env=ENVIRONMENT, capture_output=True, text=True, check=True)
    rows = json.loads(done.stdout)["cases"]
    assert {row["group"] for row in rows} == {"statistics"}
    assert all(row["ok"] for row in rows)


def test_the_page_has_every_case_with_its_bound():
    page = PAGE.read_text()
    for case in CASES:
        (line,) = (line for line in page.splitlines() if line.startswith(f"| {case.name} |"))
        assert f"| {run.figure(case.bound)} {case.unit} |" in line
        assert "FAILS" not in line
    assert all(f"## {group.capitalize()}" in page for group in GROUPS)
