"""Validation of all solids of a scene on disk."""

from __future__ import annotations

from typing import Any

from geoscene.scene.layout import Scene
from geoscene.watertight import validate_mesh


def check_scene(scene: Scene) -> dict[str, Any]:
    """``{"solids": n, "volume": cubic metres, "broken": [{"feature", "osm_id", "fault"}]}``, tile by tile.

    Raises SceneFormatError for a tile that cannot be read.
    """
    solids, volume = 0, 0.0
    faults: dict[int, str] = {}
    for tile in scene.tiles():
        verdict = validate_mesh(tile.mesh)
        solids += len(verdict)
        volume += float(verdict.volume[verdict.ok].sum())
        faults |= {int(verdict.feature[k]): verdict.fault(k) for k in (~verdict.ok).nonzero()[0].tolist()}
    names = _osm_ids(scene, set(faults)) if faults else {}
    broken = [
        {"feature": k, "osm_id": names.get(k, ""), "fault": fault} for k, fault in sorted(faults.items())
    ]
    return {"solids": solids, "volume": volume, "broken": broken}


def _osm_ids(scene: Scene, features: set[int]) -> dict[int, str]:
    out: dict[int, str] = {}
    for name, (start, stop) in scene.layers.items():
        if features & set(range(start, stop)):
            layer = scene.features(name, geometry="none")
            out |= dict(zip(layer.columns["feature"].tolist(), layer.columns["osm_id"].tolist(), strict=True))
    return out
