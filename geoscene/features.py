"""The scene's features as tables: one layer a kind, with provenance."""

from __future__ import annotations

from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.buildings import Buildings
from geoscene.classes import Class, materials
from geoscene.ground import Layers
from geoscene.objects.barriers import Barriers
from geoscene.objects.furniture import Furniture
from geoscene.objects.vegetation import Trees
from geoscene.roadgraph.graph import RoadGraph
from geoscene.scene.geopackage import Layer
from geoscene.structures import Structures


def building_layers(buildings: Buildings, base: NDArray[np.float64]) -> list[Layer]:
    """Layers ``buildings`` and ``building_parts``; ``base`` (n,) is z of each building's base in metres."""
    count = buildings.count
    rows = np.arange(len(buildings))
    return [
        _building_layer("buildings", buildings, rows=rows[:count], base=base),
        _building_layer("building_parts", buildings, rows=rows[count:], base=base),
    ]


def _building_layer(
    name: str, b: Buildings, *, rows: NDArray[np.integer], base: NDArray[np.float64]
) -> Layer:
    columns: dict[str, NDArray[Any]] = {
        "osm_id": b.osm_id[rows],
        "use": b.use[rows],
        "name": b.name[rows],
        "base": base[b.outline[rows]],
        "height": b.height[rows],
        "height_source": b.height_source[rows],
        "height_sigma": b.height_sigma[rows],
        "min_height": b.min_height[rows],
        "min_height_source": b.min_height_source[rows],
        "levels": b.levels[rows],
        "roof_shape": b.roof_shape[rows],
        "roof_height": b.roof_height[rows],
        "roof_source": b.roof_source[rows],
        "wall_material": material_names(b.wall_material[rows]),
        "wall_source": b.wall_source[rows],
        "roof_material": material_names(b.roof_material[rows]),
        "roof_look_source": b.roof_look_source[rows],
    }
    if name == "building_parts":
        columns = {"building": b.outline[rows], **columns}
    return Layer(name, b.footprint[rows], columns)


def ground_layer(name: str, ground: Layers) -> Layer:
    """A layer of ground polygons; where they overlap, the one of higher priority shows in the scene."""
    return Layer(
        name,
        ground.polygon,
        {
            "osm_id": ground.osm_id,
            "class": np.array([Class(k).name.lower() for k in ground.klass], np.str_),
            "material": material_names(ground.material),
            "priority": ground.priority,
            "source": ground.source,
        },
    )


def road_layer(graph: RoadGraph) -> Layer:
    """Layer ``roads``: centre lines with heights, one row a directed edge."""
    lines = np.empty(len(graph), object)
    lines[:] = [shapely.linestrings(line) for line in graph.geometry]
    names = (
        "osm_id", "highway", "name", "ref", "oneway", "speed", "speed_source", "lanes", "lanes_source",
        "width", "width_source", "layer", "layer_source", "bridge", "tunnel", "length",
    )  # fmt: skip
    return Layer("roads", lines, {name: getattr(graph, name) for name in names})


def tree_layer(trees: Trees, z: NDArray[np.float64]) -> Layer:
    """Layer ``trees``: mapped ones and those of rows, at the trunk's foot."""
    return Layer(
        "trees",
        shapely.points(np.column_stack([trees.xy, z])),
        {
            "osm_id": trees.osm_id,
            "height": trees.height,
            "height_source": trees.height_source,
            "crown": trees.crown,
            "crown_source": trees.crown_source,
            "trunk": trees.trunk,
            "form": trees.form,
            "form_source": trees.form_source,
            "place_source": trees.place_source,
            "moved": trees.moved,
        },
    )


def furniture_layer(furniture: Furniture, z: NDArray[np.float64]) -> Layer:
    """Layer ``furniture``: lamps, signals, signs, benches and the like, where they stand."""
    return Layer(
        "furniture",
        shapely.points(np.column_stack([furniture.xy, z])),
        {
            "osm_id": furniture.osm_id,
            "shape": furniture.shape,
            "height": furniture.height,
            "height_source": furniture.height_source,
            "heading": furniture.heading,
            "heading_source": furniture.heading_source,
            "place_source": furniture.place_source,
            "moved": furniture.moved,
        },
    )


def barrier_layer(barriers: Barriers) -> Layer:
    """Layer ``barriers``: walls, fences and hedges in plan."""
    return Layer(
        "barriers",
        barriers.polygon,
        {
            "osm_id": barriers.osm_id,
            "class": np.array([Class(k).name.lower() for k in barriers.klass], np.str_),
            "material": material_names(barriers.material),
            "height": barriers.height,
            "height_source": barriers.height_source,
            "width_source": barriers.width_source,
        },
    )


def structure_layer(structures: Structures) -> Layer:
    """Layer ``structures``: pieces of bridges and tunnels in plan."""
    return Layer(
        "structures",
        structures.polygon,
        {
            "osm_id": structures.osm_id,
            "edge": structures.edge,
            "kind": np.where(structures.tunnel, "tunnel", "bridge"),
            "level": structures.level,
            "body": structures.body,
            "body_source": structures.body_source,
            "rise": structures.rise,
            "rise_source": structures.rise_source,
            "piers": np.array([len(shape.geoms) for shape in structures.pier], np.int64),
            "pier_spacing": structures.pier_spacing,
        },
    )


def material_names(codes: NDArray[np.integer]) -> NDArray[np.str_]:
    """Names of material codes."""
    table = np.zeros(256, "U32")
    for name, material in materials().items():
        table[material.code] = name
    names: NDArray[np.str_] = table[codes]
    return names
