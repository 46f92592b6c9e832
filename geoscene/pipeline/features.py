"""Feature tables of a scene: one layer per kind, with the source of every value."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.buildings import Buildings
from geoscene.buildings.facades import FacadeSetting
from geoscene.classes import Class, material_names
from geoscene.ground import Layers
from geoscene.objects.barriers import Barriers
from geoscene.objects.furniture import Furniture
from geoscene.objects.vegetation import Trees
from geoscene.objects.wires import Wires
from geoscene.roadgraph.graph import RoadGraph
from geoscene.roadgraph.routing import edge_lines
from geoscene.scene.geopackage import Layer
from geoscene.structures import Passages, Structures
from geoscene.support.problems import Problem
from geoscene.typing import Bools, Ints

_SAME = 0.005
"""Metres within which heights of a building and of its parts are the same."""


def _columns(table: Any, names: str, **computed: NDArray[Any]) -> dict[str, NDArray[Any]]:
    """Columns by name: those of a table, or computed ones in their place."""
    return {name: computed[name] if name in computed else getattr(table, name) for name in names.split()}


def building_layers(
    buildings: Buildings,
    base: NDArray[np.float64],
    *,
    parapet: NDArray[np.float64] | None = None,
    facades: FacadeSetting | None = None,
) -> list[Layer]:
    """Layers ``buildings`` and ``building_parts``; ``base`` (n,) is z of each building's base in metres.

    parapet : (n,) metres, guessed heights of the parapets of all rows; no column by default
    facades : types of the facades of all rows; no columns by default
    """
    columns = _columns(
        buildings,
        "osm_id use name base height height_source height_sigma min_height min_height_source levels"
        " roof_shape roof_height roof_source wall_material wall_source roof_material roof_look_source",
        base=base[buildings.outline],
        wall_material=material_names(buildings.wall_material),
        roof_material=material_names(buildings.roof_material),
    )
    if parapet is not None:
        columns["parapet"] = parapet
        columns["parapet_source"] = np.where(parapet > 0, "guess", "")
    if facades is not None:
        columns["facade"] = facades.styles.names
        columns["facade_source"] = facades.source
    layers = []
    for name, rows in (
        ("buildings", slice(0, buildings.count)),
        ("building_parts", slice(buildings.count, None)),
    ):
        if name == "building_parts":
            columns = {"building": buildings.outline, **columns}
        layers.append(Layer(name, buildings.footprint[rows], {k: v[rows] for k, v in columns.items()}))
    return layers


def with_built_shapes(layers: Sequence[Layer], problems: Sequence[Problem]) -> list[Layer]:
    """The layers with heights, roofs and plans of buildings as they were built.

    A roof that had to be replaced has the shape of the one that was built (``roof_source`` fallback). A
    building that its parts replace has their plan, the lowest of their undersides, and top and roof of the
    highest (``height_source`` parts where the height differs).

    problems : of the build, with the replaced roofs
    """
    tables = {layer.name: layer for layer in layers}
    whole, parts = tables["buildings"], tables["building_parts"]
    of = np.asarray(parts.columns["building"], np.int64)
    replaced, flattened = {}, set()
    for problem in problems:
        if problem.reason == "roof-fallback":
            replaced[problem.osm_id] = problem.detail.partition(" roof made ")[2].partition(",")[0]
        elif problem.reason in ("flat-roof", "cleaned-footprint"):
            flattened.add(problem.osm_id)
    flat = np.isin(whole.columns["osm_id"].astype(str), sorted(flattened))
    whole = _with_roofs(whole, replaced, flat=flat)
    parts = _with_roofs(parts, replaced, flat=flat[of])
    tables |= {"buildings": _as_parts(whole, parts, of=of), "building_parts": parts}
    return list(tables.values())


def _with_roofs(layer: Layer, replaced: Mapping[str, str], *, flat: Bools) -> Layer:
    """A layer of buildings or parts with replaced roofs, by id, and flat ones (n,)."""
    ids, shape = layer.columns["osm_id"], layer.columns["roof_shape"].copy()
    pitched = layer.columns["roof_height"] > 0
    made = np.array([replaced.get(str(name), "") for name in ids], object)
    changed = pitched & (made != "") & (made != shape)
    shape[changed] = made[changed]
    shape[pitched & flat] = "flat"
    changed |= pitched & flat
    source = layer.columns["roof_source"].copy()
    source[changed & (source != "assumed")] = "fallback"
    height = np.where(changed & (shape == "flat"), 0.0, layer.columns["roof_height"])
    columns = {"roof_shape": shape, "roof_height": height, "roof_source": source}
    return replace(layer, columns={**layer.columns, **columns})


def _as_parts(whole: Layer, parts: Layer, *, of: Ints) -> Layer:
    """The layer of buildings, those with parts as these are; ``of`` (p,) is the building of each part."""
    if not len(of):
        return whole
    columns, shapes = {name: values.copy() for name, values in whole.columns.items()}, whole.geometry.copy()
    place = np.arange(len(of))
    for name, key in (("height", -parts.columns["height"]), ("min_height", parts.columns["min_height"])):
        order = np.lexsort((place, key, of))
        chosen = order[np.unique(of[order], return_index=True)[1]]
        building = of[chosen]
        own, theirs = whole.columns[name][building], parts.columns[name][chosen]
        differs = np.abs(own - theirs) > _SAME
        row, part = building[differs], chosen[differs]
        columns[name][row] = theirs[differs]
        if name == "height":
            columns["height_source"][row] = "parts"
            columns["height_sigma"][row] = parts.columns["height_sigma"][part]
            for roof in ("roof_shape", "roof_height", "roof_source"):
                columns[roof][building] = parts.columns[roof][chosen]
        else:
            columns["min_height_source"][row] = parts.columns["min_height_source"][part]
    order = np.argsort(of, kind="stable")
    rows, first = np.unique(of[order], return_index=True)
    for row, members in zip(rows.tolist(), np.split(order, first[1:]), strict=True):
        shapes[row] = shapely.union_all(parts.geometry[members])
    return Layer(whole.name, shapes, columns)


def ground_layer(name: str, ground: Layers) -> Layer:
    """A layer of ground polygons; where they overlap, the scene shows the one of higher priority."""
    return Layer(
        name,
        ground.polygon,
        _columns(
            ground,
            "feature osm_id class material priority source",
            **{"class": class_names(ground.klass)},
            material=material_names(ground.material),
        ),
    )


def road_layer(graph: RoadGraph) -> Layer:
    """Layer ``roads``: centre lines with heights, one row per directed edge."""
    columns = _columns(
        graph,
        "osm_id highway name ref oneway speed speed_source lanes lanes_source width width_source layer"
        " layer_source bridge tunnel length",
    )
    return Layer("roads", edge_lines(graph, heights=True), columns)


def tree_layer(trees: Trees, z: NDArray[np.float64], *, with_relief: bool = False) -> Layer:
    """Layer ``trees``: mapped trees and those of tree rows, as points at the foot of the trunk.

    with_relief : with habits
    """
    columns = _columns(
        trees,
        "feature osm_id height height_source crown crown_source trunk form form_source"
        + (" habit habit_source" if with_relief else "")
        + " place_source moved",
    )
    return Layer("trees", shapely.points(np.column_stack([trees.xy, z])), columns)


def furniture_layer(furniture: Furniture, z: NDArray[np.float64], *, with_relief: bool = False) -> Layer:
    """Layer ``furniture``: positions of lamps, signals, signs, benches and similar objects.

    with_relief : with the source of each object and the faces of signs
    """
    columns = _columns(
        furniture,
        "feature osm_id shape height height_source heading heading_source place_source moved"
        + (" source face" if with_relief else ""),
    )
    return Layer("furniture", shapely.points(np.column_stack([furniture.xy, z])), columns)


def barrier_layer(barriers: Barriers) -> Layer:
    """Layer ``barriers``: walls, fences and hedges in plan."""
    columns = _columns(
        barriers,
        "feature osm_id class material min_height height height_source width_source",
        **{"class": class_names(barriers.klass)},
        material=material_names(barriers.material),
    )
    return Layer("barriers", barriers.polygon, columns)


def structure_layer(structures: Structures) -> Layer:
    """Layer ``structures``: pieces of bridges and tunnels in plan."""
    columns = _columns(
        structures,
        "osm_id edge kind level body body_source rise rise_source piers pier_spacing",
        kind=np.where(structures.tunnel, "tunnel", "bridge"),
        piers=np.array([len(shape.geoms) for shape in structures.pier], np.int64),
    )
    return Layer("structures", structures.polygon, columns)


def passage_layer(passages: Passages) -> Layer:
    """Layer ``passages``: openings of buildings in plan, where ways run through them on the ground."""
    return Layer(
        "passages", passages.polygon, _columns(passages, "osm_id building width height height_source")
    )


def wire_layer(wires: Wires) -> Layer:
    """Layer ``wires``: spans of overhead wires in plan, from support to support."""
    return Layer("wires", wires.lines, _columns(wires, "feature osm_id kind"))


def class_names(codes: NDArray[np.integer]) -> NDArray[np.str_]:
    """Names of class codes in lower case."""
    return np.array([Class(k).name.lower() for k in codes], np.str_)
