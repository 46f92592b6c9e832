"""Problems: features that were repaired or dropped between the map and the scene."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

Action = Literal["repaired", "dropped"]


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


def summarise(problems: Iterable[Problem]) -> dict[str, dict[str, dict[str, int]]]:
    """Counts of problems as ``{action: {kind: {reason: n}}}``, keys sorted."""
    counts = Counter((p.action, p.kind, p.reason) for p in problems)
    out: dict[str, dict[str, dict[str, int]]] = {"repaired": {}, "dropped": {}}
    for (action, kind, reason), n in sorted(counts.items()):
        out[action].setdefault(kind, {})[reason] = n
    return out
