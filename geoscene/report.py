"""Problems: what was repaired or dropped between the map and the scene."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

Action = Literal["repaired", "dropped"]


@dataclass(frozen=True, slots=True, order=True)
class Problem:
    """One feature that could not be used as mapped.

    osm_id : ``way/123``, ``relation/45`` or ``node/6``; of other sources ``name:id``
    kind   : kind of the feature: ``building``, ``road``, ``water``, ``area`` ...
    action : ``repaired`` (it is in the scene, changed) or ``dropped`` (it is not)
    reason : a short fixed slug, such as ``open-ring`` or ``missing-nodes``
    detail : one line with the amount ("moved 3 vertices by up to 0.4 mm")
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
