"""A scene as objects of other libraries: trimesh, Open3D, networkx. Each needs the extra of its name."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import numpy as np

from geoscene.errors import SceneFormatError, need
from geoscene.export.objects import klass_name
from geoscene.export.triangles import meshes_of
from geoscene.geometry.mesh import Mesh, concatenate
from geoscene.scene import Scene


def to_trimesh(scene: Scene, *, layers: Collection[str] | None = None) -> Any:
    """A `trimesh.Scene` with one mesh per class, named by it, in scene metres, z up.

    Faces have their colours, and ``feature`` and ``material`` in ``face_attributes``.

    layers : names of layers; all by default

    Raises MissingExtraError without trimesh.
    """
    trimesh = need("trimesh", "trimesh")
    scene_of_meshes = trimesh.Scene()
    for name, mesh in _by_class(scene, layers).items():
        scene_of_meshes.add_geometry(
            trimesh.Trimesh(
                mesh.vertices,
                mesh.faces,
                face_colors=mesh.color,
                face_attributes={"feature": mesh.feature, "material": mesh.material},
                process=False,
            ),
            geom_name=name,
        )
    return scene_of_meshes


def to_open3d(scene: Scene, *, layers: Collection[str] | None = None) -> dict[str, Any]:
    """An `open3d.t.geometry.TriangleMesh` per class, by its name, in scene metres, z up.

    Triangles have ``colors`` (0 to 1) and ``feature``; `RaycastingScene` and the viewer take such meshes.

    Raises MissingExtraError without open3d.
    """
    core, tensor = need("open3d.core", "open3d"), need("open3d.t.geometry", "open3d")
    found = {}
    for name, mesh in _by_class(scene, layers).items():
        made = tensor.TriangleMesh(core.Tensor(mesh.vertices.astype(np.float32)), core.Tensor(mesh.faces))
        made.triangle["colors"] = core.Tensor(mesh.color.astype(np.float32) / 255)
        made.triangle["feature"] = core.Tensor(mesh.feature[:, None])
        found[name] = made
    return found


def to_networkx(scene: Scene) -> Any:
    """The road graph as the `networkx.MultiDiGraph` that osmnx works with: routing, statistics, plots.

    Raises MissingExtraError without osmnx, SceneFormatError for a scene without roads.
    """
    osmnx = need("osmnx", "osmnx")
    if not scene.files.road_graph.exists():
        raise SceneFormatError(f"{scene.path}: no roads in the scene")
    return osmnx.load_graphml(scene.files.road_graph)


def _by_class(scene: Scene, layers: Collection[str] | None) -> dict[str, Mesh]:
    """The mesh of each class, copies expanded, by the class's name."""
    whole = concatenate([mesh for _, mesh in meshes_of(scene, layers)])
    return {klass_name(int(k)): whole.take(whole.klass == k) for k in np.unique(whole.klass)}
