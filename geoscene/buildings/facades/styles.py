"""The usual facade of each building: its storeys, bays and windows, from tags and by type.

What the map does not give is guessed from the building's OSM id, use and size (``geoscene/facades.toml``),
not from its neighbours or its place in the table.
"""

from __future__ import annotations

import functools
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.buildings.guesses import seeds
from geoscene.buildings.table import Buildings
from geoscene.classes import materials
from geoscene.sources.data import Tags
from geoscene.support.columns import Columns
from geoscene.support.splitmix import uniform_at
from geoscene.tags import first_value
from geoscene.typing import Bools, Float, Ints

TYPES = (
    "blank", "house", "apartments", "prewar", "tower", "office", "curtain", "retail", "school", "hotel",
    "hall", "church", "garage", "parking",
)  # fmt: skip
"""Types of facades; each is a table of ``facades.toml``."""

_USES: Mapping[str, tuple[str, ...]] = {
    "blank": (
        "shed", "hut", "roof", "kiosk", "toilets", "greenhouse", "transformer_tower", "chimney", "silo",
        "storage_tank", "water_tower", "tank", "bunker", "ruins", "construction", "container", "canopy",
        "grandstand", "service", "stadium", "carport", "glasshouse", "ship", "tent", "bridge", "wall",
        "monument", "tower", "bell_tower", "column", "atrium",
    ),
    "house": (
        "house", "detached", "semidetached_house", "terrace", "bungalow", "farm", "cabin", "static_caravan",
        "houseboat", "allotment_house", "villa", "semi",
    ),
    "apartments": ("apartments", "residential", "dormitory", "block"),
    "office": ("office", "commercial", "government", "civic", "public", "bank", "hospital", "data_center"),
    "retail": ("retail", "shop", "supermarket", "mall", "department_store"),
    "school": ("school", "kindergarten", "college", "university", "museum", "library"),
    "hotel": ("hotel", "hostel", "guest_house"),
    "hall": (
        "industrial", "warehouse", "hangar", "manufacture", "factory", "sports_hall", "train_station",
        "depot", "retail_park", "riding_hall", "barn", "stable", "farm_auxiliary", "cowshed", "sty",
        "utility",
    ),
    "church": (
        "church", "cathedral", "chapel", "mosque", "temple", "synagogue", "shrine", "monastery", "religious",
        "basilica",
    ),
    "garage": ("garage", "garages"),
    "parking": ("parking",),
}  # fmt: skip
"""Values of ``building`` by type of facade."""

_AMENITIES: Mapping[str, str] = {
    "school": "school", "kindergarten": "school", "university": "school", "college": "school",
    "library": "school", "hospital": "office", "bank": "office", "townhall": "office", "police": "office",
    "place_of_worship": "church", "parking": "parking", "marketplace": "hall", "fuel": "retail",
}  # fmt: skip
"""Type of facade of each ``amenity`` of a building whose use says nothing."""

_PLAIN = ("yes", "", "building", "mixed", "residential;retail", "pavilion")
"""Uses that say nothing about the facade."""

PARAPET = 0.3
"""Metres of wall above the ceiling of the topmost storey; assumed."""

_LEAST = 2.2
"""Metres, least height of a storey; fewer storeys than tagged fit under a lower building."""

_PANEL = {"brick": (0.02, 0.04), "stone": (0.02, 0.05), "concrete": (0.02, 0.05), "plaster": (0.01, 0.03)}
"""Metres by which the panel around a window lies behind walls of each material; none for others; assumed."""

_PAINTS: Mapping[str, Sequence[tuple[int, int, int]]] = {
    "white": ((236, 234, 228), (226, 222, 212)),
    "dark": ((58, 56, 54), (70, 62, 52), (44, 52, 48)),
    "metal": ((120, 124, 128), (84, 88, 92), (168, 170, 172)),
    "blind": ((214, 208, 196), (190, 188, 182)),
    "shutter": ((96, 110, 84), (112, 84, 62), (200, 196, 186), (92, 104, 118)),
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Styles(Columns):
    """Facades of buildings and parts, one row for each row of the table. Metres.

    type     : (n,) int64, index into `TYPES`
    seed     : (n,) int64, of the building's OSM id
    storeys  : (n,) int64 storeys between the building's base and the eaves
    tagged   : (n,) bool, the storeys are those of the map
    ground   : (n,) height of the ground floor
    storey   : (n,) height of the other storeys
    bay      : (n,) from window to window
    stretch  : (n,) bool, bays are widened to fill a wall
    window   : (n, 4) left, lower, right and upper edge of a window in a cell of one bay, zeros for none;
               above the floor
    margin   : (n,) width of the panel around windows
    panel    : (n,) depth of the panel
    reveal   : (n,) depth of the frames
    frame    : (n,) width of frames
    bars     : (n, 2) int64 vertical and horizontal bars of a window
    closed   : (n,) share of the windows behind shutters or blinds
    door     : (n, 2) width and height of a door, zeros for none
    gate     : (n, 2) likewise of a gate
    shop     : (n,) bool, the ground floor has shop fronts to the street
    shop_tagged : (n,) bool, the building's tags say so
    deep     : (n,) bool, openings without glass
    balcony  : (n,) bool
    balcony_tagged : (n,) bool, the map says so
    cornice  : (n,) bool
    trim     : (n,) uint8, material of sills and surrounds, the wall's own where 0
    frames   : (n,) uint8, material of frames
    colors   : (n, 4, 3) uint8, sRGB of frames, doors, shutters and blinds, and trim
    """

    type: Ints
    seed: Ints
    storeys: Ints
    tagged: Bools
    ground: Float
    storey: Float
    bay: Float
    stretch: Bools
    window: Float
    margin: Float
    panel: Float
    reveal: Float
    frame: Float
    bars: Ints
    closed: Float
    door: Float
    gate: Float
    shop: Bools
    shop_tagged: Bools
    deep: Bools
    balcony: Bools
    balcony_tagged: Bools
    cornice: Bools
    trim: NDArray[np.uint8]
    frames: NDArray[np.uint8]
    colors: NDArray[np.uint8]

    @property
    def names(self) -> NDArray[np.object_]:
        """(n,) str, the types by name."""
        return np.array(TYPES, object)[self.type]


@functools.cache
def usual_facades() -> Mapping[str, Mapping[str, Any]]:
    """The tables of ``geoscene/facades.toml``."""
    return tomllib.loads(resources.files("geoscene").joinpath("facades.toml").read_text("utf-8"))


def choose_styles(buildings: Buildings, tags: Mapping[str, Tags]) -> Styles:
    """The facade of each building and part (n,).

    tags : of buildings by OSM id; those not in it are as without tags
    """
    n = len(buildings)
    own = buildings.outline
    ids = buildings.osm_id[own]
    seed = seeds(ids)
    draw = uniform_at(seed, np.ones(n, np.int64), count=24)
    area = shapely.area(buildings.footprint)
    eaves = np.maximum(buildings.height - np.minimum(buildings.roof_height, buildings.height), 0.1)
    given = [tags.get(str(name), {}) for name in ids]
    type_ = _types(buildings, given, area=area[own], eaves=eaves[own], draw=draw[0])
    usual = usual_facades()

    def one(name: str, k: int) -> Float:
        """A value between the least and the most of the type, rounded to 5 cm so that buildings share it."""
        low, high = np.array([np.broadcast_to(usual[t][name], 2) for t in TYPES], float)[type_].T
        drawn: Float = low + (high - low) * draw[k]
        return drawn

    levels = np.where(np.isnan(buildings.levels), buildings.levels[own], buildings.levels)
    height = np.where(np.isnan(buildings.levels), eaves[own], eaves)  # that the storeys share
    ratio = one("ground", 1)
    storeys, tagged = _storeys(levels, height, usual=one("storey", 1), ratio=ratio)
    parapet = np.where(height > 5.0, PARAPET, 0.1)
    storey = np.maximum(height - parapet, 0.5) / (storeys - 1 + ratio)
    storeys = np.maximum(np.rint((eaves - parapet) / storey - ratio + 1), 1).astype(np.int64)

    bay = _round_size(one("bay", 2))
    width, tall, sill = one("width", 3), one("height", 4), one("sill", 5)
    width = _round_size(np.where(width <= 1, width * bay, width))
    width = np.where(width > 0, np.minimum(width, bay - 0.05), 0.0)
    tall = np.where(tall <= 1, tall * storey, tall)
    sill = np.where(sill < 0, storey + sill - tall, sill)
    tall = _round_size(np.minimum(tall, storey - sill - 0.25))
    some = (width >= 0.3) & (tall >= 0.4) & (sill > 0.15)
    sill = _round_size(sill)
    left = (bay - width) / 2
    window = np.where(some[:, None], np.stack([left, sill, left + width, sill + tall], axis=1), 0.0)

    names = {m.code: name for name, m in materials().items()}
    wall = [names[int(code)] for code in buildings.wall_material]
    depth = np.array([_PANEL.get(name, (0.0, 0.0)) for name in wall], float).reshape(-1, 2)
    ribbon = np.isin(type_, [TYPES.index(name) for name in ("office", "curtain")])
    panel = np.where(ribbon, 0.0, np.round(depth[:, 0] + (depth[:, 1] - depth[:, 0]) * draw[6], 2))
    margin = np.where(ribbon, 0.01, 0.1)
    margin = np.minimum(margin, np.maximum((bay - width) / 2 - 0.01, 0.0))
    pick = np.array(_picked([usual[TYPES[t]]["bars"] for t in type_.tolist()], draw[7]), np.int64)
    light = draw[8] < 0.65
    metal = ribbon | np.isin(type_, [TYPES.index(name) for name in ("hall", "garage", "parking", "tower")])
    paint = np.where(metal, "metal", np.where(light, "white", "dark"))
    colors = np.stack(
        [
            _paints(paint, draw[9]),
            _paints(np.where(metal, "metal", "dark"), draw[10]),
            _paints(np.where(metal | (draw[17] < 0.6), "blind", "shutter"), draw[11]),
            np.clip(buildings.wall_color * 0.6 + 90.0, 0, 255).astype(np.uint8),
        ],
        axis=1,
    )
    shop_tag = np.array([t.get("shop", "no") != "no" or _trades(t) for t in given], np.bool_)
    balcony = np.array([_yes_or_no(t.get("balcony", t.get("building:balcony", ""))) for t in given], "U3")
    return Styles(
        type=type_,
        seed=seed,
        storeys=storeys,
        tagged=tagged,
        ground=storey * ratio,
        storey=storey,
        bay=bay,
        stretch=~ribbon,
        window=window,
        margin=margin,
        panel=panel,
        reveal=np.asarray(np.round(np.maximum(one("reveal", 12), panel + 0.02), 2), float),
        frame=np.where(ribbon, 0.04, 0.06),
        bars=pick.reshape(-1, 2),
        closed=one("closed", 13),
        door=_usual("door", type_),
        gate=_usual("gate", type_),
        shop=shop_tag | (draw[14] < _usual("shop", type_)),
        shop_tagged=shop_tag,
        deep=type_ == TYPES.index("parking"),
        balcony=np.where(balcony != "", balcony == "yes", draw[15] < _usual("balcony", type_)),
        balcony_tagged=balcony != "",
        cornice=draw[16] < _usual("cornice", type_),
        trim=np.where(panel > 0, materials()["stone"].code, 0).astype(np.uint8),
        frames=np.where(metal, materials()["metal"].code, materials()["wood"].code).astype(np.uint8),
        colors=colors,
    )


def _types(buildings: Buildings, given: Sequence[Tags], *, area: Float, eaves: Float, draw: Float) -> Ints:
    """Type (n,) of each row: by the use of its building, else by its tags, else by its size."""
    use = buildings.use[buildings.outline]
    name = np.full(len(use), "", object)
    for kind, uses in _USES.items():
        name[np.isin(use, uses)] = kind
    name[(use == "tower") & (buildings.levels >= 2)] = ""  # a tower with storeys has rooms
    types = {value: kind for kind, values in _USES.items() for value in values}
    for k in np.flatnonzero((name == "") | np.isin(use, _PLAIN)).tolist():
        tags = given[k]
        kind = types.get(first_value(tags.get("building:use", "")), "")
        name[k] = name[k] or (kind if kind != "apartments" else "")  # of homes the size tells more
        amenity = _AMENITIES.get(first_value(tags.get("amenity", "")), "")
        if amenity:
            name[k] = amenity
        elif tags.get("tourism") in ("hotel", "hostel", "guest_house"):
            name[k] = "hotel"
        elif "office" in tags:
            name[k] = "office"
        elif "shop" in tags and eaves[k] < 9.0:
            name[k] = "retail"
    plain = name == ""
    name[plain & (eaves < 12.0) & (area < 400.0)] = "house"
    name[plain & (eaves < 13.0) & (area > 2500.0)] = "hall"
    name[plain & (eaves < 4.5) & (area < 20.0)] = "blank"
    name[plain & (eaves < 4.5) & (area < 40.0) & (area >= 20.0)] = "garage"
    name[(name == "")] = "apartments"
    flats = np.isin(name, ("apartments",))
    old = (draw < 0.8) & (eaves >= 12.0) & (eaves < 26.0) & (area < 900.0)
    name[flats & old & plain] = "prewar"
    name[flats & (eaves > 40.0)] = "tower"
    glass = np.isin(buildings.wall_material, [materials()[m].code for m in ("glass",)])
    name[(name == "office") & (glass | (eaves > 60.0))] = "curtain"
    name[glass & np.isin(name, ("apartments", "prewar", "tower", "retail"))] = "curtain"
    return np.array([TYPES.index(one) for one in name.tolist()], np.int64)


def _storeys(levels: Float, height: Float, *, usual: Float, ratio: Float) -> tuple[Ints, Bools]:
    """Storeys (n,) up to the eaves, at least 1, and whether they are tagged.

    levels : tagged, NaN for none; fewer where storeys would be lower than 2.2 m
    """
    fit = np.maximum(np.floor((height - PARAPET) / _LEAST), 1)
    tagged = np.isfinite(levels) & (levels >= 0.5)
    # a storey of 0 m stands for one as high as the building
    guessed = np.where(
        usual > 0, np.rint((height - PARAPET) / np.where(usual > 0, usual, 1.0) - ratio + 1), 1
    )
    some = np.where(tagged, np.minimum(np.rint(np.where(tagged, levels, 1.0)), fit), np.minimum(guessed, fit))
    return np.maximum(some, 1).astype(np.int64), tagged


def _round_size(value: Float) -> Float:
    """Values to 5 cm, so that buildings share kinds of openings."""
    return np.round(np.floor(value * 20.0 + 1e-6) / 20.0, 2)


def _usual(name: str, type_: Ints) -> Float:
    return np.array([usual_facades()[t][name] for t in TYPES], float)[type_]


def _trades(tags: Tags) -> bool:
    """Whether people live in a building over shops: ``building:use`` is ``residential;commercial``."""
    uses = [value.strip() for value in tags.get("building:use", "").split(";")]
    return "residential" in uses and bool({"commercial", "retail"} & set(uses))


def _yes_or_no(text: str) -> str:
    """``yes`` or ``no`` for a tagged value, "" for none."""
    return "" if not text else "no" if text in ("no", "none", "0") else "yes"


def _paints(names: NDArray[np.str_], draw: Float) -> NDArray[np.uint8]:
    """A colour (n, 3) of each name."""
    return np.array(_picked([_PAINTS[name] for name in names.tolist()], draw), np.uint8).reshape(-1, 3)


def _picked(choices: list[Any], draw: Float) -> list[Any]:
    """One of each list of choices."""
    return [some[int(d * len(some))] for some, d in zip(choices, draw.tolist(), strict=True)]
