"""Validation of all solids and surfaces of a scene on disk."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import Class
from geoscene.geometry.mesh import Mesh
from geoscene.geometry.watertight import (
    NEAR,
    degenerate_faces,
    edge_uses,
    grid_cells,
    near_vertices,
    validate_mesh,
    weld,
)
from geoscene.scene.layout import Scene, changed_files
from geoscene.typing import Ints

_STEP = 1e-5
"""Metres: the finest step of the formats with whole coordinates."""


def check_scene(scene: Scene) -> dict[str, Any]:
    """Results of the checks, tile by tile.

    ``{"changed": [path], "solids": n, "volume": cubic metres, "broken": [{"feature", "osm_id", "fault"}],
    "surfaces": n, "broken_surfaces": [{"tile": [i, j], "class", "feature", "osm_id", "fault"}]}``; a surface
    is the open faces of one feature and class in a tile. Files that differ from what the build wrote are not
    checked further.

    Raises SceneFormatError for a tile that cannot be read.
    """
    changed = changed_files(scene)
    solids, surfaces, volume = 0, 0, 0.0
    faults: dict[int, str] = {}
    broken_surfaces: list[dict[str, Any]] = []
    for index in scene.tile_indices:
        if {scene.files.tile(*index), scene.files.tile_reports} & set(changed):
            continue
        tile = scene.tile(*index, forests=False)
        verdict = validate_mesh(tile.mesh)
        solids += len(verdict)
        volume += float(verdict.volume[verdict.ok].sum())
        faults |= {int(verdict.feature[k]): verdict.fault(k) for k in (~verdict.ok).nonzero()[0].tolist()}
        checked = check_surfaces(tile.mesh)
        surfaces += len(checked)
        broken_surfaces += [
            {
                "tile": list(index),
                "class": Class(int(checked.klass[k])).name.lower(),
                "feature": int(checked.feature[k]),
                "fault": checked.fault(k),
            }
            for k in (~checked.ok).nonzero()[0].tolist()
        ]
    named = set(faults) | {row["feature"] for row in broken_surfaces}
    names = _osm_ids(scene, named) if scene.files.features not in changed else {}
    broken = [
        {"feature": k, "osm_id": names.get(k, ""), "fault": fault} for k, fault in sorted(faults.items())
    ]
    for row in broken_surfaces:
        row["osm_id"] = names.get(row["feature"], "")
    return {
        "changed": [path.relative_to(scene.path).as_posix() for path in changed],
        "solids": solids,
        "volume": volume,
        "broken": broken,
        "surfaces": surfaces,
        "broken_surfaces": broken_surfaces,
    }


def _osm_ids(scene: Scene, features: set[int]) -> dict[int, str]:
    out: dict[int, str] = {}
    for name, (start, stop) in scene.layers.items():
        if scene.table_length(name) and features & set(range(start, stop)):
            columns = scene.features(name, geometry="none").columns
            if "osm_id" in columns:  # scenes for sensors have none
                out |= dict(zip(columns["feature"].tolist(), columns["osm_id"].tolist(), strict=True))
    return out


@dataclass(frozen=True, slots=True)
class SurfaceFaults:
    """Result of the checks, one row per surface: the open faces of one feature and class in a tile.

    feature : (n,) int32, -1 for none
    klass   : (n,) uint8
    finite  : (n,) bool, no vertex is NaN or infinite
    near    : (n,) int64, pairs of vertices less than `NEAR` apart
    lines   : (n,) int64, faces whose corners are collinear
    edges   : (n,) int64, edges of more than two faces, or of two that look in opposite directions
    """

    feature: NDArray[np.int32]
    klass: NDArray[np.uint8]
    finite: NDArray[np.bool_]
    near: Ints
    lines: Ints
    edges: Ints

    def __len__(self) -> int:
        """Number of surfaces."""
        return len(self.feature)

    @property
    def ok(self) -> NDArray[np.bool_]:
        """(n,) bool, the surface passes all checks."""
        return np.asarray(self.finite & (self.near + self.lines + self.edges == 0), np.bool_)

    def fault(self, row: int) -> str:
        """The first failed check of a surface as a slug, "" if it passes all."""
        checks = (
            ("not-finite", self.finite[row]),
            ("vertices-within-1-mm", self.near[row] == 0),
            ("degenerate-faces", self.lines[row] == 0),
            ("non-manifold-edges", self.edges[row] == 0),
        )
        return next((slug for slug, passed in checks if not passed), "")


def check_surfaces(mesh: Mesh) -> SurfaceFaults:
    """Check every surface of a tile: the faces of one feature and class that bound no solid (`Mesh.closed`).

    A surface may have several parts.
    """
    rows = np.flatnonzero(~mesh.closed)
    names = np.column_stack([mesh.feature[rows], mesh.klass[rows]]).astype(np.int64)
    names, owner = np.unique(names, axis=0, return_inverse=True)
    owner, n = owner.ravel(), len(names)
    corners = mesh.vertices[mesh.faces[rows]]
    whole = np.isfinite(corners).all(axis=(1, 2))
    finite = np.bincount(owner, weights=~whole, minlength=n) == 0
    corners, owner = corners[whole], owner[whole]
    ids, first = weld(corners.reshape(-1, 3), np.repeat(owner, 3), grid=_STEP)
    points, faces = corners.reshape(-1, 3)[first], ids.reshape(-1, 3)
    cells, of = grid_cells(points, grid=_STEP), np.repeat(owner, 3)[first]
    near = near_vertices(cells, of, steps=round(NEAR / _STEP))[:, 0]
    lines = degenerate_faces(points, faces, grid=_STEP)
    edge, uses, balance = edge_uses(faces)
    edge_owner = np.zeros(len(uses), np.int64)
    edge_owner[edge] = np.repeat(owner, 3)
    bad_edge = (uses > 2) | ((uses == 2) & (balance != 0))
    return SurfaceFaults(
        names[:, 0].astype(np.int32),
        names[:, 1].astype(np.uint8),
        finite,
        np.bincount(of[near], minlength=n),
        np.bincount(owner[lines], minlength=n),
        np.bincount(edge_owner[bad_edge], minlength=n),
    )
