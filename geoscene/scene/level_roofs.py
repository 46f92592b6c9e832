"""Tiles and tables of a scene with flat roofs in place of guessed ones, for exports to be measured in."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.buildings import Buildings, build_solids
from geoscene.buildings.facades import WallRelief
from geoscene.buildings.table import Texts
from geoscene.classes import Class, materials
from geoscene.geometry.mesh import ROOF, WALL, Mesh, concatenate
from geoscene.scene.geopackage import Layer
from geoscene.scene.tile_files import FullParts, Tile
from geoscene.typing import Bools, Float


@dataclass(frozen=True, slots=True)
class GuessedRoofs:
    """Buildings with guessed pitched roofs: their rows of the table ``buildings``, by ascending number."""

    feature: NDArray[np.int64]
    footprint: NDArray[np.object_]
    columns: dict[str, NDArray[Any]]


def guessed_rows(columns: Mapping[str, NDArray[Any]]) -> Bools:
    """Whether (n,) the roof of each row of the table ``buildings`` is a guess other than flat."""
    if "roof_source" not in columns:
        return np.zeros(len(columns["feature"]), np.bool_)
    guessed: Bools = (columns["roof_source"] == "assumed") & (columns["roof_height"] > 0)
    return guessed


def find_guessed(layer: Layer) -> GuessedRoofs:
    """The buildings of a table with guessed roofs."""
    rows = np.flatnonzero(guessed_rows(layer.columns))
    rows = rows[np.argsort(layer.columns["feature"][rows], kind="stable")]
    columns = {name: values[rows] for name, values in layer.columns.items()}
    return GuessedRoofs(columns["feature"].astype(np.int64), layer.geometry[rows], columns)


def level_columns(columns: Mapping[str, NDArray[Any]]) -> Mapping[str, NDArray[Any]]:
    """The columns of the table ``buildings`` with flat roofs in place of guessed ones."""
    guessed = guessed_rows(columns)
    if not guessed.any():
        return columns
    return dict(columns) | {
        "height": np.where(guessed, level_height(columns), columns["height"]),
        "roof_height": np.where(guessed, 0.0, columns["roof_height"]),
        "roof_shape": np.where(guessed, "flat", columns["roof_shape"]).astype(object),
    }


def level_height(columns: Mapping[str, NDArray[Any]]) -> Float:
    """Height (n,) in metres without guessed roofs: storeys give that of the walls, other sources the top."""
    roof = np.where(columns["height_source"] == "levels", columns["roof_height"], 0.0)
    return np.asarray(columns["height"] - roof, float)


def level_tile(tile: Tile, guessed: GuessedRoofs) -> Tile:
    """The tile whose buildings with guessed roofs are blocks, with plane walls and nothing on their roofs."""
    mesh = tile.mesh
    solid = mesh.closed & (mesh.klass == Class.BUILDING)
    own = np.isin(guessed.feature, mesh.feature[solid])
    if not own.any():
        return tile
    feature = guessed.feature[own]
    gone = solid & np.isin(mesh.feature, feature)
    former = mesh.take(gone).shifted(tile.origin)
    columns = {name: values[own] for name, values in guessed.columns.items()}
    blocks = _blocks(former, feature, footprint=guessed.footprint[own], columns=columns)
    rest, copies = np.flatnonzero(~gone), ~np.isin(tile.instances.feature, feature)
    relief, full_parts = tile.relief, tile.full_parts
    if relief is not None:
        relief = WallRelief(
            relief.facades,
            relief.cells,
            relief.openings,
            np.concatenate([np.full(len(blocks), -1, np.int32), relief.wall[rest]]),
        )
    if full_parts is not None:
        faces = np.concatenate([np.zeros(len(blocks), np.bool_), full_parts.faces[rest]])
        full_parts = FullParts(faces, full_parts.instances[copies])
    whole = concatenate([blocks.shifted(-tile.origin), mesh.take(rest)])
    return Tile(tile.origin, whole, tile.instances.take(copies), relief, full_parts)


def _blocks(
    former: Mesh, feature: NDArray[np.int64], *, footprint: NDArray[np.object_], columns: dict[str, Any]
) -> Mesh:
    """Solids with flat roofs, scene metres, that look as the former ones."""
    n = len(feature)
    row = np.searchsorted(feature, former.feature)
    foot = np.full(n, np.inf)
    np.minimum.at(foot, np.repeat(row, 3), former.vertices[former.faces, 2].ravel())
    wall = _first(row, former.surface == WALL, count=n)
    roof = _first(row, former.surface == ROOF, count=n)
    tar = materials()["tar_roof"]
    mapped = np.isin(columns["roof_look_source"], ("tag", "outline"))

    def same(value: object) -> Texts:
        return np.full(n, value, object)

    table = Buildings(
        osm_id=columns["osm_id"],
        footprint=footprint,
        passages=np.fromiter([() for _ in range(n)], object),
        is_part=np.zeros(n, np.bool_),
        outline=np.arange(n, dtype=np.int32),
        min_height=columns["min_height"].astype(float),
        height=level_height(columns),
        roof_height=np.zeros(n),
        roof_shape=same("flat"),
        roof_direction=np.full(n, np.nan),
        roof_across=np.zeros(n, np.bool_),
        top=np.full(n, np.nan),
        height_source=columns["height_source"],
        height_sigma=columns["height_sigma"].astype(float),
        min_height_source=columns["min_height_source"],
        roof_source=same("assumed"),
        levels=columns["levels"].astype(float),
        use=columns["use"],
        name=columns["name"],
        wall_color=former.color[wall],
        roof_color=np.where(mapped[:, None], former.color[roof], np.array(tar.color, np.uint8)),
        wall_material=former.material[wall],
        roof_material=np.where(mapped, former.material[roof], np.uint8(tar.code)),
        wall_source=columns["wall_source"],
        roof_look_source=columns["roof_look_source"],
    )
    mesh, _ = build_solids(table, base=columns["base"].astype(float), foot=foot)
    return replace(mesh, feature=feature[mesh.feature].astype(mesh.feature.dtype))


def _first(row: NDArray[np.int64], chosen: Bools, *, count: int) -> NDArray[np.int64]:
    """The first chosen face (count,) of each row."""
    first = np.zeros(count, np.int64)
    faces = np.flatnonzero(chosen)[::-1]
    first[row[faces]] = faces
    return first
