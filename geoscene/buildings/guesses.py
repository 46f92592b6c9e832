"""Inferred appearance of buildings without mapped colours: walls, roofs, storeys and windows.

Guesses depend on a building's OSM id, use, size and region, not on its
neighbours or its place in the table.
"""

from __future__ import annotations

import functools
import hashlib
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from importlib import resources
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.buildings.table import Buildings
from geoscene.classes import materials
from geoscene.geometry.frames import wrap_longitude
from geoscene.support.columns import Columns
from geoscene.support.splitmix import uniform_at
from geoscene.typing import Bools, Float, Ints

Names = NDArray[np.object_]

KINDS = ("small", "low", "tall", "office", "hall", "sacred")
"""Kinds of building by their looks; ``low`` are houses, ``tall`` all others without a kind of their own."""

WINDOWS = ("none", "rows", "shop and rows", "bands", "strip under the roof", "tall")
"""Arrangements of windows; their indices are known to the page."""

_SMALL = (
    "garage", "garages", "carport", "shed", "hut", "roof", "kiosk", "toilets", "greenhouse", "service",
    "transformer_tower", "barn", "stable", "farm_auxiliary", "cowshed", "sty", "chimney", "silo",
    "storage_tank", "water_tower", "tank", "bunker", "ruins", "construction", "container", "guardhouse",
    "canopy", "grandstand",
)  # fmt: skip
_LOW = (
    "house", "detached", "semidetached_house", "terrace", "bungalow", "farm", "cabin", "static_caravan",
    "houseboat", "allotment_house",
)  # fmt: skip
_OFFICE = ("office", "commercial", "hotel", "hospital", "bank", "tower", "skyscraper")
_HALL = (
    "industrial", "warehouse", "hangar", "manufacture", "supermarket", "sports_hall", "stadium", "parking",
    "train_station", "retail_park", "depot", "riding_hall",
)  # fmt: skip
_SACRED = (
    "church", "cathedral", "chapel", "mosque", "temple", "synagogue", "shrine", "bell_tower", "monastery",
    "religious",
)  # fmt: skip
_SHOPS = ("retail", "shop", "supermarket", "kiosk", "commercial")

_STOREY = {"small": 2.6, "low": 2.8, "tall": 3.1, "office": 3.6, "hall": 5.0, "sacred": 8.0}
"""Assumed metres of a storey by kind, where the map gives no storeys."""

_BAY = (3.0, 2.8, 3.4, 1.8, 4.0, 5.0)
"""Assumed metres from window to window of each arrangement."""

_SOUTH_OF_FRANCE = 45.2
"""Degrees north below which the zone of France counts as Mediterranean; assumed."""


@dataclass(frozen=True, slots=True)
class AppearanceGuesses(Columns):
    """Looks of buildings, one row each.

    kind       : (n,) str, one of `KINDS`
    wall, roof : (n,) str, names in ``palettes.toml``
    wall_color : (n, 3) uint8 sRGB
    roof_color : (n, 3) uint8 sRGB
    pitched    : (n,) bool
    storeys    : (n,) int64, at least 1: rounded tagged ones, or guessed from the walls' height
    windows    : (n,) int64, index into `WINDOWS`
    bay        : (n,) metres from window to window
    """

    kind: Names
    wall: Names
    roof: Names
    wall_color: NDArray[np.uint8]
    roof_color: NDArray[np.uint8]
    pitched: Bools
    storeys: Ints
    windows: Ints
    bay: Float


@functools.cache
def palettes() -> Mapping[str, Any]:
    """Colours, regions and kinds of ``geoscene/palettes.toml``."""
    return tomllib.loads(resources.files("geoscene").joinpath("palettes.toml").read_text("utf-8"))


def region_at(lon: float, lat: float) -> str:
    """Name of the region of ``palettes.toml`` at a place in degrees, by its time zone."""
    from tzfpy import get_tz  # noqa: PLC0415  (reads the zones' outlines)

    zone = get_tz(wrap_longitude(lon), lat)
    if zone == "Europe/Paris" and lat < _SOUTH_OF_FRANCE:
        return "mediterranean"
    starts: list[tuple[int, str]] = [
        (len(start), name)
        for name, region in palettes()["regions"].items()
        for start in region["zones"]
        if zone.startswith(start)
    ]
    return max(starts)[1]


def guess_looks(
    osm_id: Names, use: Names, *, area: Float, walls: Float, levels: Float, roof_height: Float, region: str
) -> AppearanceGuesses:
    """A plausible look for each building (n,).

    area        : (n,) square metres of the footprint
    walls       : (n,) metres, height of the walls up to the eaves
    levels      : (n,) tagged storeys, NaN if not tagged
    roof_height : (n,) metres, 0 for a flat roof
    """
    draw = uniform_at(seeds(osm_id), np.zeros(len(osm_id), np.int64), count=7)
    kind = kinds_of(use, area=area, walls=walls)
    tables = palettes()
    of_region, of_kind = tables["regions"][region], tables["kinds"]
    pitched: Bools = roof_height > 0
    wall, roof = np.full(len(use), "", object), np.full(len(use), "", object)
    for name in KINDS:
        own, shelf = kind == name, of_kind.get(name, {})
        wall[own] = _chosen(shelf.get("walls", of_region["tall" if name == "tall" else "low"]), draw[1][own])
        for sloped in (False, True):
            rows = own & (pitched == sloped)
            usual = shelf.get("roofs", of_region["pitched" if sloped else "flat"])
            roof[rows] = _chosen(usual, draw[2][rows])
    heights = np.array([_STOREY[name] for name in kind.tolist()], float)
    storeys = np.where(np.isfinite(levels) & (levels >= 0.5), levels, walls / heights)
    shop = np.isin(use, _SHOPS) | ((kind == "tall") & (draw[5] < 0.35) & (walls > 8.0))
    windows = _windows(kind, wall, shop=shop)
    return AppearanceGuesses(
        kind,
        wall,
        roof,
        _colors(tables["walls"], wall, draw=draw[3]),
        _colors(tables["roofs"], roof, draw=draw[4]),
        pitched,
        np.clip(np.rint(storeys), 1, 255).astype(np.int64),
        windows,
        np.array(_BAY)[windows] * (0.85 + 0.3 * draw[6]),
    )


def with_looks(buildings: Buildings, region: str) -> Buildings:
    """The buildings, with guessed colours and materials where none are mapped; their source is ``assumed``.

    Parts look as their building would.
    """
    of = buildings.outline
    looks = guess_looks(
        buildings.osm_id[of],
        buildings.use[of],
        area=np.asarray(shapely.area(buildings.footprint[of]), float),
        walls=np.maximum(buildings.height[of] - buildings.roof_height[of], 0.0),
        levels=buildings.levels[of],
        roof_height=buildings.roof_height,
        region=region,
    )
    found: dict[str, NDArray[Any]] = {}
    for side, source, names in (
        ("wall", "wall_source", looks.wall),
        ("roof", "roof_look_source", looks.roof),
    ):
        free = getattr(buildings, source) == "default"
        made_of = np.array(
            [materials()[palettes()["materials"][name]].code for name in names.tolist()], np.uint8
        )
        found |= {
            f"{side}_color": np.where(
                free[:, None], getattr(looks, f"{side}_color"), getattr(buildings, f"{side}_color")
            ),
            f"{side}_material": np.where(free, made_of, getattr(buildings, f"{side}_material")),
            source: np.where(free, "assumed", getattr(buildings, source)).astype(object),
        }
    return replace(buildings, **found)


def seeds(osm_id: Names) -> Ints:
    """Seed (n,) of each OSM id, from which inferred values of the feature are drawn."""
    digests = [hashlib.blake2b(str(name).encode(), digest_size=8).digest() for name in osm_id]
    return np.array([int.from_bytes(some, "little", signed=True) for some in digests], np.int64)


def kinds_of(use: Names, *, area: Float, walls: Float) -> Names:
    """Kind (n,) of each building by its use, or by its size where that says little."""
    kind = np.full(len(use), "tall", object)
    plain = np.isin(use, ("yes", "residential", "", "retail"))
    kind[plain & (walls < 9.5) & (area < 350.0)] = "low"
    kind[plain & (walls < 13.0) & (area > 2500.0)] = "hall"
    kind[(use == "yes") & (walls > 45.0)] = "office"
    kind[(use == "yes") & (walls < 4.5) & (area < 40.0)] = "small"
    for uses, name in (
        (_SMALL, "small"), (_LOW, "low"), (_OFFICE, "office"), (_HALL, "hall"), (_SACRED, "sacred"),
    ):  # fmt: skip
        kind[np.isin(use, uses)] = name
    return kind


def _windows(kind: Names, wall: Names, *, shop: Bools) -> Ints:
    """Arrangement of windows (n,), an index into `WINDOWS`."""
    usual = {"small": "none", "office": "bands", "hall": "strip under the roof", "sacred": "tall"}
    names = np.array([usual.get(name, "rows") for name in kind.tolist()], object)
    names[(names == "rows") & shop] = "shop and rows"
    names[(kind == "office") & ~np.isin(wall, ("glass", "panels", "pale_concrete"))] = "rows"
    index: Ints = np.array([WINDOWS.index(name) for name in names.tolist()], np.int64)
    return index


def _chosen(weights: Mapping[str, float], draw: Float) -> Names:
    """A name for each random number, by weights."""
    names = np.array(list(weights), object)
    ends = np.cumsum(list(weights.values()))
    chosen: Names = names[np.searchsorted(ends[:-1] / ends[-1], draw, side="right")]
    return chosen


def _colors(palette: Mapping[str, Any], names: Names, *, draw: Float) -> NDArray[np.uint8]:
    """A colour (n, 3) of each name's palette, up to 7 % lighter or darker."""
    out = np.zeros((len(names), 3))
    for name in sorted(set(names.tolist())):
        rows = names == name
        colors = np.array(palette[name], float)
        place = draw[rows] * len(colors)
        index = place.astype(np.int64)
        out[rows] = colors[index] * (1.0 + 0.14 * (place - index - 0.5))[:, None]
    rounded: NDArray[np.uint8] = np.clip(np.rint(out), 0, 255).astype(np.uint8)
    return rounded
