"""Problems: features that were repaired or dropped between the map and the scene."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Literal, TypeVar

import numpy as np

from geoscene.errors import GeosceneError
from geoscene.typing import Ints

Action = Literal["repaired", "dropped"]
T = TypeVar("T")


@dataclass(frozen=True, slots=True, order=True)
class Problem:
    """One feature that could not be used as mapped.

    osm_id : ``way/123``, ``relation/45`` or ``node/6``; ``name:id`` for other sources
    kind   : kind of the feature: ``building``, ``road``, ``water``, ``area`` ...
    action : ``repaired`` (changed, in the scene) or ``dropped`` (not in the scene)
    reason : a fixed slug such as ``open-ring`` or ``missing-nodes``
    detail : one line with amounts ("moved 3 vertices by up to 0.4 mm")
    """

    osm_id: str
    kind: str
    action: Action
    reason: str
    detail: str = ""


def make_without_failures(
    make: Callable[[Ints], T], rows: Ints, *, failed: Callable[[int, Exception], None]
) -> list[T]:
    """Results of ``make`` for all rows at once, or for the runs of rows between failures.

    One feature must not end a build: rows for which ``make`` raises an exception are halved until the one
    that causes it is alone; that row goes to ``failed`` and is left out. Errors that no feature causes, of
    options, files or memory, are raised.

    rows : (n,) ascending; without rows nothing is made
    """
    if not len(rows):
        return []
    try:
        return [make(rows)]
    except (GeosceneError, ImportError, MemoryError, OSError):  # no feature's fault
        raise
    except Exception as error:  # noqa: BLE001 - whatever the reason, the other features are wanted
        if len(rows) == 1:
            failed(int(rows[0]), error)
            return []
    halves = np.array_split(rows, 2)
    return [made for half in halves for made in make_without_failures(make, half, failed=failed)]


def described(error: Exception) -> str:
    """The kind and the message of an exception on one line."""
    return ": ".join(filter(None, (type(error).__name__, " ".join(str(error).split()))))


def describe_unexpected(osm_id: str, error: Exception, *, kind: str) -> Problem:
    """The problem of a feature that is dropped because of an unforeseen exception."""
    return Problem(osm_id, kind, "dropped", "unexpected-error", described(error))


def summarise(problems: Iterable[Problem]) -> dict[str, dict[str, dict[str, int]]]:
    """Counts of problems as ``{action: {kind: {reason: n}}}``, keys sorted."""
    counts = Counter((p.action, p.kind, p.reason) for p in problems)
    out: dict[str, dict[str, dict[str, int]]] = {"repaired": {}, "dropped": {}}
    for (action, kind, reason), n in sorted(counts.items()):
        out[action].setdefault(kind, {})[reason] = n
    return out
