"""Binary glTF (.glb) of a whole scene: named nodes, trees as GPU instances, attributes as metadata."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np

from geoscene.export.gltf import GlbWriter, PropertyTables, add_instances, y_up
from geoscene.export.kinds import Summary
from geoscene.export.objects import (
    FeatureAttributes,
    Part,
    attribution,
    klass_name,
    parts,
    pieces,
    read_features,
)
from geoscene.scene import Scene
from geoscene.support.files import atomic_file
from geoscene.support.progress import Progress, silent


def write_glb(
    scene: Scene, path: Path, *, layers: Collection[str] | None = None, progress: Progress = silent
) -> Summary:
    """Write a scene as one binary glTF 2.0 file, tile by tile.

    Axes as in glTF: x east, y up, z south, metres. The root node's translation is the origin of the scene's
    frame in its CRS, and its ``extras`` contain the CRS; vertices are float32 relative to a whole metre near
    the middle of their object, without loss. Every object is a named node with its attributes in ``extras``;
    the same attributes are property tables (EXT_structural_metadata), one per layer, with a row for each
    feature and class, to which the vertices refer (EXT_mesh_features). Trees and street furniture are
    instances (EXT_mesh_gpu_instancing, EXT_instance_features).

    Raises InputError for more than 4 GiB.
    """
    features = read_features(scene)
    library = scene.shapes()
    objects = solids = faces = 0
    with atomic_file(path) as out, GlbWriter(path) as writer:
        tables = PropertyTables(features)
        shapes: dict[int, int] = {}
        tiles = []
        for part in parts(scene, layers, stage="GLB", progress=progress):
            first, copies = writer.nodes, part.instances
            solids += _objects(writer, part, features=features, tables=tables)
            objects += writer.nodes - first + len(copies)
            add_instances(
                writer, copies, features=features, library=library, meshes=shapes, metadata=tables.metadata
            )
            faces += len(part.mesh)
            if writer.nodes > first:
                name = f"tile {part.index[0]} {part.index[1]}"
                children = list(range(first, writer.nodes))
                place = y_up(part.origin).tolist()
                tiles.append(writer.node(name=name, translation=place, children=children))
        tables.write(writer)
        east, north = scene.frame.origin
        root = writer.node(
            name=str(scene.manifest.get("name", "")) or "scene",
            translation=[east, 0.0, -north],
            children=tiles or None,
            extras={"crs": scene.frame.name, "wkt": scene.frame.wkt, "vertical": scene.frame.vertical},
        )
        writer.finish(out, scene_nodes=[root], asset={"copyright": attribution(scene)})
    return Summary.of(path, "glb", objects=objects, solids=solids, faces=faces, crs=scene.frame.name)


def _objects(writer: GlbWriter, part: Part, *, features: FeatureAttributes, tables: PropertyTables) -> int:
    """Add a node for every object of a tile; returns the number of solids among them."""
    solids = 0
    for piece in pieces(part.mesh):
        mesh = part.mesh.take(piece.rows)
        middle = np.round((mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2)
        metadata: dict[str, Any] = {}
        if piece.feature >= 0:
            layer = features.layers.index(features.layer(piece.feature))
            metadata = tables.metadata(layer, np.array([[piece.feature, piece.klass]]))
            metadata["rows"] = np.repeat(metadata["rows"], len(mesh.vertices))
        number = writer.mesh(mesh, y_up(mesh.vertices - middle).astype("<f4"), **metadata)
        name = features.name(piece.feature)
        writer.node(
            name=name if piece.solid else f"{name} {klass_name(piece.klass)}",
            mesh=number,
            translation=y_up(middle).tolist(),
            extras={
                "class": klass_name(piece.klass),
                "layer": features.layer(piece.feature),
                "feature": piece.feature,
                **features.attributes(piece.feature),
            },
        )
        solids += piece.solid
    return solids
