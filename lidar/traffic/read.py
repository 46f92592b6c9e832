"""Traffic from the text of an option."""

from __future__ import annotations

from math import isfinite, nan
from pathlib import Path
from typing import Any

from geoscene.support.registry import Registry, unknown_name
from lidar.errors import InputError
from lidar.grammar import Item, split_items
from lidar.parameters import build, read_values
from lidar.traffic.fcd import TrafficFile
from lidar.traffic.populate import TrafficOptions

SIMULATIONS: Registry[type[TrafficOptions]] = Registry(
    "traffic", {"on": "lidar.traffic.populate:TrafficOptions"}, error=InputError
)
"""Classes of simulated traffic by name."""

_SUFFIXES = (".xml", ".xml.gz")
_CHOICES = ("on", "off", "FILE.xml")
_REMOVED = {
    "sumo": "run SUMO first and give its file: geoscene export SCENE --to sumo -o roads.net.xml, then"
    " sumo -n roads.net.xml -r TRIPS.rou.xml --fcd-output fcd.xml, then `traffic` fcd.xml"
}


def read_traffic(text: str) -> TrafficOptions | TrafficFile | None:
    """Traffic from ``on``, ``off`` or a file, with parameters as in ``on:vehicles=20,parked=0.5``.

    ``on:`` may be left out, and a comma may stand for the colon. Raises InputError for another text.
    """
    if text == "off":
        return None
    items = split_items(text, SIMULATIONS, default="on")
    if len(items) != 1:
        raise InputError(f"traffic {text}: give one of {', '.join(_CHOICES)}")
    (item,) = items
    if item.name.lower().endswith(_SUFFIXES):
        return _file(item)
    if item.name not in SIMULATIONS:
        raise InputError(unknown_name("traffic", item.name, known=_CHOICES, removed=_REMOVED))
    return build(SIMULATIONS, item)


def _file(item: Item) -> TrafficFile:
    """Traffic from a file of SUMO."""
    given: dict[str, Any] = dict(item.values)
    net, begin = given.pop("net", None), given.pop("begin", None)
    try:
        values = read_values(TrafficFile, given, also=("net", "begin"))
        return TrafficFile(Path(item.name), net and Path(net), begin and _seconds(begin), **values)
    except InputError as error:
        raise InputError(f"traffic {item.name}: {error}") from None


def _seconds(text: str) -> float:
    """The number of a text; raises InputError for others."""
    try:
        seconds = float(text)
    except ValueError:
        seconds = nan
    if not isfinite(seconds):
        raise InputError(f"begin = {text!r} is not a number of seconds")
    return seconds
