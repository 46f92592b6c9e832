"""The subjects of the benchmark, by the words of ``--only``."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from bench import casting, drives, files, helios, maps
from bench.measure import Case, Result, measured
from bench.scenes import Setup

CASES: dict[str, Callable[[Setup], Iterator[Case]]] = {
    "building": maps.building,
    "map": maps.reading_maps,
    "scene": maps.reading_scenes,
    "casting": casting.casting,
    "driving": drives.driving,
    "writing": files.writing,
    "mapping": files.mapping,
    "helios": helios.peer,
}
"""Functions that yield the cases of a subject."""

SUBJECTS = (*CASES, "growth")
"""All subjects, in the order of a run."""


def results(subject: str, setup: Setup) -> list[Result]:
    """All cases of a subject, measured."""
    return [measured(case, repetitions=setup.repetitions) for case in CASES[subject](setup)]
