"""Vertical order of ways that cross: bridges over the ground, the ground over tunnels, and odd tags."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike

from geoscene.roadgraph.tags import is_bridge, is_tunnel, read_layer
from geoscene.sources.data import Tags, Way
from geoscene.support.problems import Problem
from geoscene.typing import Ints

_APART = 64
"""Ranks between the ground and bridges or tunnels of layer 0: more than the layers that are read."""


def rank_ways(layer: ArrayLike, *, bridge: ArrayLike, tunnel: ArrayLike) -> Ints:
    """Rank in height (n,) where ways cross: 0 on the ground, positive on bridges, negative in tunnels.

    ``layer`` orders bridges among themselves, and tunnels; without one of them it has no effect.
    """
    level = np.asarray(layer, np.int64)
    ranks: Ints = np.where(bridge, _APART + level, np.where(tunnel, level - _APART, 0))
    return ranks


def find_odd_layers(ways: Iterable[Way]) -> list[Problem]:
    """Streets, paths and tracks whose ``layer`` or ``level`` does not fit, one row each.

    These are layers without a bridge or a tunnel (``layer-without-structure``), bridges below the ground and
    tunnels above it (``odd-layer``).
    """
    problems = []
    for way in ways:
        kind = "road" if "highway" in way.tags else "railway" if "railway" in way.tags else ""
        if kind and (found := _oddity(way.tags)):
            problems.append(Problem(way.osm_id, kind, "repaired", *found))
    return problems


def _oddity(tags: Tags) -> tuple[str, str] | None:
    """Reason and detail of a layer that does not fit, None if it does."""
    layer, source = read_layer(tags, [])
    if source not in ("layer", "level") or layer == 0:
        return None
    text = f"{source}={tags[source]}"
    if is_bridge(tags):
        return ("odd-layer", f"{text} of a bridge, which passes over the ground") if layer < 0 else None
    if is_tunnel(tags):
        return ("odd-layer", f"{text} of a tunnel, which passes under the ground") if layer > 0 else None
    return "layer-without-structure", f"{text} has no effect: no bridge, and no tunnel below the ground"
