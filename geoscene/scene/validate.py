"""Validation of all solids and surfaces of a scene on disk."""

from __future__ import annotations

from typing import Any

from geoscene.classes import Class
from geoscene.geometry.watertight import validate_mesh
from geoscene.scene.layout import Scene
from geoscene.scene.surfaces import check_surfaces


def check_scene(scene: Scene) -> dict[str, Any]:
    """Results of the checks, tile by tile.

    ``{"solids": n, "volume": cubic metres, "broken": [{"feature", "osm_id", "fault"}], "surfaces": n,
    "broken_surfaces": [{"tile": [i, j], "class", "feature", "osm_id", "fault"}]}``; a surface is the open
    faces of one feature and class in a tile.

    Raises SceneFormatError for a tile that cannot be read.
    """
    solids, surfaces, volume = 0, 0, 0.0
    faults: dict[int, str] = {}
    broken_surfaces: list[dict[str, Any]] = []
    for index in scene.tile_indices:
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
    names = _osm_ids(scene, set(faults) | {row["feature"] for row in broken_surfaces})
    broken = [
        {"feature": k, "osm_id": names.get(k, ""), "fault": fault} for k, fault in sorted(faults.items())
    ]
    for row in broken_surfaces:
        row["osm_id"] = names.get(row["feature"], "")
    return {
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
