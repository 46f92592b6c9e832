"""Options of traffic, simulated or of a file, and their text."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite, nan
from pathlib import Path
from typing import Any, Literal

from geoscene.support.registry import Registry, unknown_name
from lidar.errors import InputError
from lidar.parameters import Item, Parameters, build, check_parameters, parameter, read_values, split_items


@dataclass(frozen=True, slots=True)
class TrafficOptions:
    """Densities of simulated road users, and the side of the road that they drive on.

    Raises InputError for values that are out of bounds.
    """

    vehicles: float = parameter(12.0, "moving vehicles", unit="per km of lane", low=0, high=60)
    cyclists: float = parameter(1.0, "cyclists", unit="per km of lane", low=0, high=30)
    pedestrians: float = parameter(15.0, "pedestrians", unit="per km of sidewalk", low=0, high=400)
    parked: float = parameter(
        0.6, "share of the spaces along kerbs and in parking lots that are occupied", low=0, high=1
    )
    radius: float = parameter(
        200.0,
        "distance from the ego vehicle within which road users are simulated",
        unit="m",
        low=50,
        high=1000,
    )
    side: Literal["right", "left"] = "right"

    def __post_init__(self) -> None:
        """Validate the values."""
        check_parameters(self)
        if self.side not in ("right", "left"):
            raise InputError(unknown_name("`side`", self.side, known=("right", "left")))


@dataclass(frozen=True, slots=True)
class TrafficFile(Parameters):
    """Traffic from a file of SUMO, with parked vehicles.

    path  : floating car data, ``.xml`` or ``.xml.gz``
    net   : SUMO network that the coordinates refer to; by default the one that the file names. Not needed
            for longitudes and latitudes (``--fcd-output.geo``)
    begin : SUMO's time in seconds at which the drive starts; the first in the file by default
    side  : driving side

    Raises InputError for values that are out of bounds.
    """

    path: Path
    net: Path | None = None
    begin: float | None = None
    parked: float = parameter(
        0.6, "share of the spaces along kerbs and in parking lots that are occupied", low=0, high=1
    )
    radius: float = parameter(
        200.0,
        "distance from the ego vehicle within which there are road users",
        unit="m",
        low=50,
        high=1000,
    )
    side: Literal["right", "left"] = "right"


SIMULATIONS: Registry[type[TrafficOptions]] = Registry("traffic", {"on": TrafficOptions}, error=InputError)
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
