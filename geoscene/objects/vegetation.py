"""Trees: mapped singly and in tree rows, and the copies of shapes that trees are drawn as."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.classes import Class
from geoscene.geometry.frames import Frame
from geoscene.geometry.mesh import ShapeInstances
from geoscene.ground.kinds import storey_tag
from geoscene.objects.crowns import HABITS, VARIANTS, habit_of
from geoscene.objects.shapes import place
from geoscene.support.columns import Columns
from geoscene.support.problems import Problem
from geoscene.support.splitmix import uniform_at
from geoscene.tags import parse_length, parse_number
from geoscene.typing import Float, Height

if TYPE_CHECKING:
    from geoscene.ground.partition import GroundPlan
    from geoscene.sources.data import OsmData, Tags

HEIGHT = {"broadleaved": 12.0, "needleleaved": 12.0, "palm": 8.0}
"""Default height in metres.

12 m is the median of the 19 heights given for 4,717 mapped trees of two dozen extracts; palms: assumed."""

CROWN = {"broadleaved": 0.67, "needleleaved": 0.4, "palm": 0.45}
"""Crown diameter over height: 0.67 is the median of the 13 trees with both, the others are assumed."""

TRUNK = 0.0284
"""Trunk diameter over height: the median of 17 trees with both (girth 0.089 of the height)."""

_CROWN_BASE = {"broadleaved": 0.3, "needleleaved": 0.1, "palm": 0.75}
"""Height of the crown's lower end over the height of the tree: assumed."""

_PALMS = frozenset(
    {"areca", "phoenix", "washingtonia", "trachycarpus", "chamaerops", "cocos", "roystonea", "sabal"}
)
_CONIFERS = frozenset(
    {"abies", "araucaria", "cedrus", "chamaecyparis", "cryptomeria", "cupressus", "juniperus", "larix",
     "metasequoia", "picea", "pinus", "pseudotsuga", "sequoia", "sequoiadendron", "taxodium", "taxus",
     "thuja", "tsuga"}
)  # fmt: skip

CLOUD_TREE = "cloud:tree"
"""Tag of a tree whose height and crown were measured in a point cloud."""

_PLACES = {"node": "node", "cloud": "cloud"}
"""Sources of places by the kind of the id; others are rows."""

_TALLEST, _WIDEST = 116.0, 60.0
"""Metres of the tallest known tree (Hyperion) and the widest crown."""

_THICK = {"circumference": 36.0, "diameter": 2.5}
"""Metres up to which a number without a unit is in metres; up to a hundred times that it is in centimetres,
else in millimetres. It is the greatest known girth; trunks thicker than 2.5 m are rarer than saplings."""

_THICKEST = {"circumference": 36.0, "diameter": 12.0}
"""Metres of the thickest trunk (Árbol del Tule: 36 m in girth, 11.6 m across)."""


@dataclass(frozen=True, slots=True)
class Trees(Columns):
    """Trees as columns, one row a tree.

    xy      : (n, 2) float64, scene metres
    height  : (n,) float64 metres
    crown   : (n,) float64 metres, diameter
    trunk   : (n,) float64 metres, diameter at breast height
    form    : (n,) str: ``broadleaved``, ``needleleaved`` or ``palm``
    habit   : (n,) str, growth form, of `geoscene.objects.crowns.HABITS`; "" in scenes without relief
    height_source : (n,) str: ``cloud``, ``height``, ``est_height``, ``diameter_crown``, ``circumference``,
              ``diameter``, ``default`` or ``sampled``
    crown_source : (n,) str: ``cloud``, ``diameter_crown`` or ``height`` (by its ratio to the height)
    form_source : (n,) str: ``leaf_type``, ``genus`` or ``default``
    habit_source : (n,) str: ``species`` (botanical names), ``form`` (the usual one of the form) or ""
    place_source : (n,) str: ``node`` (where it is mapped), ``cloud`` (where its crown was measured),
              ``moved`` (on a carriageway, moved to the nearest clear place), ``row`` (spaced
              along a tree row) or ``sampled``
    moved   : (n,) float64 metres from where it is mapped
    osm_id  : (n,) str: the tree's node, or its row's way; "" for a sampled one
    feature : (n,) int32: as read, consecutive
    """

    xy: Float
    height: Float
    crown: Float
    trunk: Float
    form: NDArray[np.str_]
    habit: NDArray[np.str_]
    height_source: NDArray[np.str_]
    crown_source: NDArray[np.str_]
    form_source: NDArray[np.str_]
    habit_source: NDArray[np.str_]
    place_source: NDArray[np.str_]
    moved: Float
    osm_id: NDArray[np.str_]
    feature: NDArray[np.int32]


def read_trees(
    osm: OsmData, frame: Frame, *, spacing: float = 8.0, with_relief: bool = False
) -> tuple[Trees, list[Problem]]:
    """The single trees and tree rows on the map, and problems: tags that could not be used.

    Sizes come from ``height``, else ``est_height``, from ``diameter_crown`` and, of the trunk, from
    ``circumference``, else ``diameter``. Numbers without a unit are metres, but centimetres or millimetres
    where a trunk would be thicker than `_THICK`. Missing sizes are derived from the others by `CROWN`
    and `TRUNK`; the form comes from ``leaf_type``, else the genus. With relief, habits come from the
    botanical names, and the crowns of some are more slender. Trees on roofs and upper storeys are left out.

    spacing : metres between trees of a row
    with_relief : trees have habits
    """
    problems: list[Problem] = []
    lonlat: list[tuple[float, float]] = []
    tags: list[Tags] = []
    ids: list[str] = []
    for point in osm.points:
        if point.tags.get("natural") == "tree":
            if where := storey_tag(point.tags):
                problems.append(Problem(point.osm_id, "tree", "dropped", "off-ground", where))
                continue
            lonlat.append((point.lon, point.lat))
            tags.append(point.tags)
            ids.append(point.osm_id)
    x, y = frame.from_geographic(*np.array(lonlat).reshape(-1, 2).T)
    places = [np.column_stack([x, y])]
    for way in osm.ways:
        if way.tags.get("natural") == "tree_row" and len(way.lonlat) > 1:
            if where := storey_tag(way.tags):
                problems.append(Problem(way.osm_id, "tree", "dropped", "off-ground", where))
                continue
            row = _along(np.column_stack(frame.from_geographic(*way.lonlat.T)), spacing)
            places.append(row)
            tags += [way.tags] * len(row)
            ids += [way.osm_id] * len(row)
    rows = [_sizes(tag, osm_id, problems=problems) for tag, osm_id in zip(tags, ids, strict=True)]
    columns: list[Any] = list(zip(*rows, strict=True)) if rows else [[]] * 6
    height, crown, trunk = (np.array(columns[k], float) for k in range(3))
    height_source, form, form_source = (np.array(columns[k], np.str_) for k in range(3, 6))
    mapped = np.isfinite(crown)
    ratio = np.array([CROWN[str(f)] for f in form])
    habit, habit_source = np.full((2, len(ids)), "", object)
    if with_relief:
        pairs = [habit_of(_botanical(tag), form=str(f)) for tag, f in zip(tags, form, strict=True)]
        habit[:] = [name for name, _ in pairs]
        habit_source[:] = ["species" if told else "form" for _, told in pairs]
        ratio = np.array([HABITS[name].crown for name, _ in pairs])
    return Trees(
        np.concatenate(places),
        height,
        np.where(mapped, crown, height * ratio),
        np.where(np.isfinite(trunk), trunk, height * TRUNK),
        form,
        habit.astype(np.str_),
        height_source,
        np.where(height_source == "cloud", "cloud", np.where(mapped, "diameter_crown", "height")),
        form_source,
        habit_source.astype(np.str_),
        np.array([_PLACES.get(osm_id.partition("/")[0], "row") for osm_id in ids], np.str_),
        np.zeros(len(ids)),
        np.array(ids, np.str_),
        np.arange(len(ids), dtype=np.int32),
    ), list(dict.fromkeys(problems))  # the tags of a row are read once per tree


def clear_of(plan: GroundPlan, trees: Trees) -> tuple[Trees, list[Problem]]:
    """Trees within the ground's extent on free places, and dropped ones, by id.

    A tree that is mapped on a carriageway, a crossing or a track is taken for imprecise and moves to the
    nearest clear place. Dropped are mapped trees in buildings or without such a place, and the trees that a
    row would put on a road, a track, water or a building.
    """
    from geoscene.objects.siting import Sites  # noqa: PLC0415  (not for readers of scenes)

    xmin, ymin, xmax, ymax = plan.extent
    x, y = trees.xy.T
    trees = trees.take((x >= xmin) & (x < xmax) & (y >= ymin) & (y < ymax))
    sites = Sites.of(plan)
    klass, driven = sites.classes(trees.xy), sites.driven(trees.xy)
    single = trees.place_source != "row"
    amid = single & driven
    xy, source, lost = trees.xy.copy(), trees.place_source.astype("U7"), np.zeros(len(trees), np.bool_)
    xy[amid], found = sites.nearest_clear(trees.xy[amid])
    lost[amid] = ~found
    source[amid] = "moved"
    built = klass == Class.BUILDING_PAD
    blocked = built | lost | (~single & (driven | (klass == Class.WATER)))
    problems = [
        Problem(str(osm_id), "tree", "dropped", "in-building" if b else "on-road")
        for osm_id, b in zip(trees.osm_id[blocked], built[blocked], strict=True)
    ]
    placed = replace(trees, xy=xy, place_source=source, moved=np.hypot(*(xy - trees.xy).T))
    return placed.take(~blocked), list(dict.fromkeys(problems))  # the tags of a row are read once per tree


def tree_instances(trees: Trees, *, height: Height | None = None) -> ShapeInstances:
    """Two copies of shapes a tree, trunk then crown, in scene coordinates, standing on the terrain.

    The trunk begins 0.3 m below the ground, so that no gap opens on a slope, and ends inside the crown.
    """
    n = len(trees)
    z = np.zeros(n) if height is None else np.asarray(height(*trees.xy.T), float)
    grown = trees.habit != ""
    share = [
        HABITS[str(h)].base if h else _CROWN_BASE[str(f)]
        for h, f in zip(trees.habit, trees.form, strict=True)
    ]
    base = trees.height * np.array(share, float)
    middle = (base + trees.height) / 2
    stem = np.where(trees.form == "palm", "trunk_palm", "trunk_flared")
    trunks = place(
        np.where(grown, stem, "trunk"),
        np.column_stack([trees.xy, z - 0.3]),
        size=np.column_stack([trees.trunk, trees.trunk, middle + 0.3]),
        feature=trees.feature,
    )
    column, row = np.floor(trees.xy.T * 100).astype(np.int64)
    turn, draw = uniform_at(column, row, count=2)
    variant = np.char.mod("_%d", np.floor(VARIANTS * draw).astype(np.int64))
    crowns = place(
        np.char.add("crown_", np.where(grown, np.char.add(trees.habit, variant), trees.form)),
        np.column_stack([trees.xy, z + base]),
        size=np.column_stack([trees.crown, trees.crown, trees.height - base]),
        heading=2 * np.pi * turn,
        feature=trees.feature,
    )
    return ShapeInstances.concatenate([trunks, crowns])


def _botanical(tags: Tags) -> str:
    """The botanical names of a tree in one text, genus first."""
    return " ".join(
        tags[key] for key in ("genus", "species", "taxon", "cultivar", "taxon:cultivar") if key in tags
    )


def _along(line: Float, spacing: float) -> Float:
    """Evenly spaced points (k, 2) along a line, about ``spacing`` apart, both ends included."""
    geometry = shapely.LineString(line)
    count = max(round(geometry.length / spacing), 1) + 1
    stations = np.linspace(0.0, geometry.length, count)
    places: Float = shapely.get_coordinates(shapely.line_interpolate_point(geometry, stations))
    return places


def _form(tags: Tags) -> tuple[str, str]:
    """(form, source) of a tree's tags."""
    genus = (tags.get("genus") or tags.get("species") or tags.get("taxon") or "").split(" ")[0].lower()
    if genus in _PALMS or tags.get("leaf_type") == "palm":
        return "palm", "genus" if genus in _PALMS else "leaf_type"
    if tags.get("leaf_type") in {"broadleaved", "needleleaved"}:
        return tags["leaf_type"], "leaf_type"
    if genus in _CONIFERS:
        return "needleleaved", "genus"
    return "broadleaved", "genus" if genus else "default"


def _sizes(tags: Tags, osm_id: str, *, problems: list[Problem]) -> tuple[float, float, float, str, str, str]:
    """(height, crown or NaN, trunk or NaN, height source, form, form source) of one tree's tags."""
    form, form_source = _form(tags)
    crown = _metres(tags, "diameter_crown", most=_WIDEST, osm_id=osm_id, problems=problems)
    trunk = _trunk(tags, "circumference", osm_id=osm_id, problems=problems) / np.pi
    by = "circumference"
    if not np.isfinite(trunk):
        trunk, by = _trunk(tags, "diameter", osm_id=osm_id, problems=problems), "diameter"
    height = _metres(tags, "height", most=_TALLEST, osm_id=osm_id, problems=problems)
    source = "cloud" if CLOUD_TREE in tags else "height"
    if not np.isfinite(height):
        height, source = (
            _metres(tags, "est_height", most=_TALLEST, osm_id=osm_id, problems=problems),
            "est_height",
        )
    if not np.isfinite(height):
        if np.isfinite(crown):
            height, source = crown / CROWN[form], "diameter_crown"
        elif np.isfinite(trunk):
            height, source = trunk / TRUNK, by
        else:
            height, source = HEIGHT[form], "default"
        height = float(np.clip(height, 1.5, 40.0))
    return height, crown, trunk, source, form, form_source


def _metres(tags: Tags, key: str, *, most: float, osm_id: str, problems: list[Problem]) -> float:
    """A length in metres, NaN where it is missing or out of range."""
    if key not in tags:
        return np.nan
    metres = parse_length(tags[key])
    if metres is not None and 0.0 < metres <= most:
        return metres
    problems.append(Problem(osm_id, "tree", "repaired", f"unusable-{key}", f"{key}={tags[key]!r}"))
    return np.nan


def _trunk(tags: Tags, key: str, *, osm_id: str, problems: list[Problem]) -> float:
    """Circumference or diameter of a trunk in metres; bare numbers too large for metres are smaller units."""
    number = parse_number(tags.get(key))
    if number is None or number <= _THICK[key]:
        return _metres(tags, key, most=_THICKEST[key], osm_id=osm_id, problems=problems)
    for unit, per_metre in (("centimetres", 100.0), ("millimetres", 1000.0)):
        if number <= per_metre * _THICK[key]:
            detail = f"{key}={tags[key]!r} read as {unit}"
            problems.append(Problem(osm_id, "tree", "repaired", f"{key}-in-{unit}", detail))
            return number / per_metre
    return _metres(tags, key, most=_THICKEST[key], osm_id=osm_id, problems=problems)
