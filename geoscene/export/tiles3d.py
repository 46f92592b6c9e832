"""3D Tiles 1.1: a quadtree of bounding boxes over the scene's tiles, with content as binary glTF."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from pyproj import Transformer

from geoscene.export.gltf import GlbWriter, PropertyTables, add_instances, y_up
from geoscene.export.kinds import Summary, compact_json
from geoscene.export.objects import FeatureAttributes, Part, attribution, expand, parts, pieces, read_features
from geoscene.geometry.frames import Frame
from geoscene.geometry.mesh import Mesh
from geoscene.scene import Scene
from geoscene.support.files import atomic_file, atomic_folder, write_atomically
from geoscene.support.progress import Progress, silent
from geoscene.typing import Float

_NAMES = r"tileset\.json|content/-?\d+_-?\d+(_copies)?\.glb"
"""Paths of the files of a tileset's folder, a regular expression."""

_MARGIN = 1e-3
"""Metres that boxes are larger than their content, for what float32 rounds."""


@dataclass(frozen=True, slots=True)
class _Node:
    """A tile of the tileset: the corners of its bounding box, and its JSON."""

    low: Float
    high: Float
    document: dict[str, Any]


def write_3dtiles(
    scene: Scene,
    path: Path,
    *,
    layers: Collection[str] | None = None,
    height_offset: float = 0.0,
    progress: Progress = silent,
) -> Summary:
    """Write a scene as a folder with ``tileset.json`` (3D Tiles 1.1), tile by tile.

    Coordinates are east, north, up about the scene's middle and follow the ellipsoid; the root's transform
    leads to EPSG:4978. Each tile of the scene contains its ground and solids, and has its instances (trees,
    street furniture; EXT_mesh_gpu_instancing) as a child. The geometric error of a tile is the size of what
    its children add: the diagonal of their bounding box for inner nodes, the height of the tallest instance
    for tiles with instances, else 0. Features have their attributes as property tables with a row for each
    feature and class (EXT_structural_metadata, EXT_mesh_features).

    height_offset : metres from the zero of the scene's heights up from the WGS 84 ellipsoid (for orthometric
                    heights the geoid's undulation)

    Raises InputError if the folder is not a tileset, and if the layers have no faces.
    """
    xmin, ymin, xmax, ymax = scene.bounds
    globe = Globe.at(scene.frame, (xmin + xmax) / 2, y=(ymin + ymax) / 2, lift=height_offset)
    features = read_features(scene)
    library = scene.shapes()
    objects = solids = faces = 0
    with atomic_folder(path, mark="tileset.json", names=_NAMES) as folder:
        (folder / "content").mkdir()
        nodes: dict[tuple[int, int], _Node] = {}
        for part in parts(scene, layers, stage="3D Tiles", progress=progress):
            node = _tile(folder, scene, part=part, features=features, globe=globe, library=library)
            if node is not None:
                nodes[part.index] = node
            found = pieces(part.mesh)
            objects += len(found) + len(part.instances)
            solids += sum(piece.solid for piece in found)
            faces += len(part.mesh)
        root = _quadtree(nodes)
        diagonal = float(np.linalg.norm(root.high - root.low))
        document = {
            "asset": {"version": "1.1", "extras": {"attribution": attribution(scene)}},
            "geometricError": max(diagonal, root.document["geometricError"]),
            "root": {**root.document, "transform": globe.matrix.T.ravel().tolist()},
        }
        write_atomically(folder / "tileset.json", compact_json(document))
    notes: tuple[str, ...] = ()
    if scene.frame.vertical != "ellipsoidal" and not height_offset:
        notes = (f"{scene.frame.vertical} heights stand as ellipsoidal ones; `height_offset` raises them",)
    return Summary.of(
        path, "3dtiles", objects=objects, solids=solids, faces=faces, crs="EPSG:4978", notes=notes
    )


def _box(low: Float, high: Float) -> dict[str, list[float]]:
    """The bounding volume of a box, not smaller when rounded to decimals."""
    middle, half = (low + high) / 2, (high - low) / 2 + _MARGIN
    return {"box": [*middle.tolist(), *np.diag(half).ravel().tolist()]}


def _quadtree(nodes: dict[tuple[int, int], _Node]) -> _Node:
    """The root of a quadtree over nodes: neighbours are joined four by four."""
    west, south = (min(index[axis] for index in nodes) for axis in (0, 1))
    level = {(i - west, j - south): node for (i, j), node in sorted(nodes.items())}
    while len(level) > 1:
        groups: dict[tuple[int, int], list[_Node]] = {}
        for (i, j), node in level.items():
            groups.setdefault((i >> 1, j >> 1), []).append(node)
        level = {index: _join(children) for index, children in groups.items()}
    return next(iter(level.values()))


def _join(children: list[_Node]) -> _Node:
    if len(children) == 1:
        return children[0]
    low = np.min([c.low for c in children], axis=0)
    high = np.max([c.high for c in children], axis=0)
    document = {
        "boundingVolume": _box(low, high),
        "geometricError": float(np.linalg.norm(high - low)),
        "refine": "ADD",
        "children": [c.document for c in children],
    }
    return _Node(low, high, document)


def _leaf(uri: str, low: Float, *, high: Float) -> _Node:
    """A tile with content and without children."""
    box = _box(low, high)
    content = {"uri": uri, "boundingVolume": box}
    document = {"boundingVolume": box, "geometricError": 0.0, "refine": "ADD", "content": content}
    return _Node(low, high, document)


def _tile(
    folder: Path,
    scene: Scene,
    *,
    part: Part,
    features: FeatureAttributes,
    globe: Globe,
    library: dict[str, Mesh],
) -> _Node | None:
    """Write the contents of one tile; returns its node, or None for an empty tile."""
    name = f"content/{part.index[0]}_{part.index[1]}"
    copies = None
    if len(part.instances):
        uri = f"{name}_copies.glb"
        _write_copies(folder / uri, scene, part=part, features=features, globe=globe, library=library)
        points = globe.local(expand(part.instances, list(library.values())).vertices + part.origin)
        copies = _leaf(uri, points.min(axis=0) - _MARGIN, high=points.max(axis=0) + _MARGIN)
    if not len(part.mesh):
        return copies
    uri = f"{name}.glb"
    low, high = _write_mesh(folder / uri, scene, part=part, features=features, globe=globe)
    leaf = _leaf(uri, low, high=high)
    if copies is None:
        return leaf
    low, high = np.minimum(low, copies.low), np.maximum(high, copies.high)
    heights = np.array([np.ptp(shape.vertices[:, 2]) for shape in library.values()])
    scale = np.linalg.norm(part.instances.transform[:, :, 2], axis=1)
    tallest = float((heights[part.instances.shape] * scale).max())
    added = {"boundingVolume": _box(low, high), "geometricError": tallest, "children": [copies.document]}
    return _Node(low, high, leaf.document | added)


def _write_mesh(
    path: Path, scene: Scene, *, part: Part, features: FeatureAttributes, globe: Globe
) -> tuple[Float, Float]:
    """Write the faces of a tile, one mesh per layer; returns the corners of the bounding box as written."""
    mesh = part.mesh
    local = globe.local(mesh.vertices + part.origin)
    middle = np.round((local.min(axis=0) + local.max(axis=0)) / 2)
    layer = np.searchsorted(features.starts, mesh.feature, side="right")
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    with atomic_file(path) as out, GlbWriter(path) as writer:
        tables, children = PropertyTables(features), []
        for number in np.unique(layer).tolist():
            rows = np.flatnonzero(layer == number)
            pair = np.column_stack([mesh.feature[rows], mesh.klass[rows]])
            pair, which = np.unique(pair, axis=0, return_inverse=True)
            which = which.ravel()
            # Vertices refer to their feature and class, so that these cannot share vertices.
            key = which[:, None] * len(mesh.vertices) + mesh.faces[rows].astype(np.int64)
            own, corners = np.unique(key, return_inverse=True)
            points = (local[own % len(mesh.vertices)] - middle).astype(np.float32)
            low = np.minimum(low, points.min(axis=0) + middle)
            high = np.maximum(high, points.max(axis=0) + middle)
            metadata: dict[str, Any] = {}
            if number:
                metadata = tables.metadata(number - 1, pair)
                metadata["rows"] = metadata["rows"][own // len(mesh.vertices)]
            faces = replace(mesh.take(rows), faces=corners.reshape(-1, 3).astype(np.int32))
            name = features.layers[number - 1] if number else "terrain"
            children.append(
                writer.node(name=name, mesh=writer.mesh(faces, y_up(points).astype("<f4"), **metadata))
            )
        tables.write(writer)
        root = writer.node(translation=y_up(middle).tolist(), children=children)
        writer.finish(out, scene_nodes=[root], asset={"copyright": attribution(scene)})
    return low, high


def _write_copies(
    path: Path,
    scene: Scene,
    *,
    part: Part,
    features: FeatureAttributes,
    globe: Globe,
    library: dict[str, Mesh],
) -> None:
    """Write the instances of a tile, one node per shape and layer."""
    anchors = part.instances.transform[:, :, 3] + part.origin
    transform = part.instances.transform.copy()
    transform[:, :, :3] = globe.jacobian(anchors) @ transform[:, :, :3]
    transform[:, :, 3] = globe.local(anchors)
    copies = replace(part.instances, transform=transform)
    with atomic_file(path) as out, GlbWriter(path) as writer:
        tables = PropertyTables(features)
        nodes = add_instances(
            writer, copies, features=features, library=library, meshes={}, metadata=tables.metadata
        )
        tables.write(writer)
        writer.finish(out, scene_nodes=nodes, asset={"copyright": attribution(scene)})


@dataclass(frozen=True)
class Globe:
    """Cartesian east, north, up coordinates about a point of the ellipsoid, metres.

    frame  : the scene's
    lift   : metres added to heights of the scene to make them ellipsoidal
    matrix : (4, 4) from east, north, up to WGS 84 Earth-centred (EPSG:4978)
    """

    frame: Frame
    lift: float
    matrix: Float

    @classmethod
    def at(cls, frame: Frame, x: float, *, y: float, lift: float = 0.0) -> Globe:
        """Local coordinates with their origin at a point of the scene."""
        lon, lat = (np.radians(float(v)) for v in frame.to_geographic(x, y))
        matrix = np.eye(4)
        matrix[:3, 0] = -np.sin(lon), np.cos(lon), 0
        matrix[:3, 1] = -np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)
        matrix[:3, 2] = np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)
        matrix[:3, 3] = to_earth_centred(frame, np.array([[x, y, 0.0]]), lift=lift)[0]
        return cls(frame, lift, matrix)

    def local(self, points: Float) -> Float:
        """East, north, up (n, 3) of points in scene metres."""
        return (to_earth_centred(self.frame, points, lift=self.lift) - self.matrix[:3, 3]) @ self.matrix[
            :3, :3
        ]

    def jacobian(self, points: Float) -> Float:
        """(n, 3, 3) derivatives of east, north, up by scene x, y, z at points in scene metres."""
        steps = np.concatenate([np.eye(3), -np.eye(3)])
        around = self.local((points[:, None] + steps).reshape(-1, 3)).reshape(-1, 6, 3)
        return ((around[:, :3] - around[:, 3:]) / 2).transpose(0, 2, 1)


def to_earth_centred(frame: Frame, points: Float, *, lift: float = 0.0) -> Float:
    """WGS 84 Earth-centred coordinates (n, 3), EPSG:4978, of points in scene metres."""
    lon, lat = frame.to_geographic(points[:, 0], points[:, 1])
    change = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    return np.column_stack(change.transform(lon, lat, points[:, 2] + lift))
