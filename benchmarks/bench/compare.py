"""Two runs on one machine: rates of the second over those of the first."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from bench.measure import BenchError
from bench.report import Table

_PARTS = ("cpu", "cores", "memory_bytes", "system", "machine")


def compared(first: Path, second: Path) -> tuple[Table, list[str]]:
    """A table of the sides that both runs measured, and sentences about other differences.

    Raises BenchError for files of two machines, or that are no reports.
    """
    before, after = _read(first), _read(second)
    if before["machine"]["machine"] != after["machine"]["machine"]:
        pairs = ((name, before["machine"][name], after["machine"][name]) for name in _PARTS)
        parts = [f"{name} {one} and {other}" for name, one, other in pairs if one != other]
        raise BenchError(
            f"{first} and {second} are of two machines ({'; '.join(parts)}): rates of different machines have"
            " no ratio; run both on one"
        )
    old = {_key(case, side): (case, side) for case in before["cases"] for side in case["sides"]}
    rows = []
    for case in after["cases"]:
        for side, found in case["sides"].items():
            known = old.get(_key(case, side))
            if known is not None:
                was, now = known[0]["sides"][side]["rate"], found["rate"]
                rows.append(
                    (
                        f"{case['subject']}: {case['name']}",
                        side,
                        f"{was['median']:.3g}",
                        f"{now['median']:.3g}",
                        _ratio(was, now),
                    )
                )
    if not rows:
        raise BenchError(f"{first} and {second} have no case in common")
    text = "The ratio is the second run's rate over the first's; bounds from the extremes of both."
    heads = ("case", "side", "first, 1/s", "second, 1/s", "ratio")
    return Table("Two runs", text, heads, tuple(rows)), _differences(before["machine"], after["machine"])


def _ratio(was: dict[str, float], now: dict[str, float]) -> str:
    low, high = now["low"] / was["high"], now["high"] / was["low"]
    return f"{now['median'] / was['median']:.3g} ({low:.3g} to {high:.3g})"


def _differences(before: dict[str, Any], after: dict[str, Any]) -> list[str]:
    """What else differs: versions and load."""
    old, new = before["libraries"], after["libraries"]
    found = [
        f"{name} {old.get(name, 'absent')} before, {new.get(name, 'absent')} after"
        for name in dict.fromkeys((*old, *new))
        if old.get(name) != new.get(name)
    ]
    pairs = ((name, before[name], after[name]) for name in ("python", "geoscene", "load"))
    return found + [f"{name} {one} before, {other} after" for name, one, other in pairs if one != other]


def _key(case: dict[str, Any], side: str) -> tuple[Any, ...]:
    """Cases that do the same work: same subject, name, amount and clock."""
    return case["subject"], case["name"], case["amount"], case["clock"], side


def _read(path: Path) -> dict[str, Any]:
    try:
        document = json.loads(path.read_text())
    except OSError as error:
        raise BenchError(f"{path}: {error.strerror}; give a bench.json") from None
    except ValueError as error:
        raise BenchError(f"{path}: not JSON ({error})") from error
    if not isinstance(document, dict) or document.get("schema") != 1 or "cases" not in document:
        raise BenchError(f"{path}: no report of the benchmark; give a bench.json")
    return document
