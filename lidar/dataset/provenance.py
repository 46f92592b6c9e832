"""Provenance of data: scene, sources, licences, versions of programs, and the data they were made from."""

from __future__ import annotations

import json
import platform
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from geoscene.scene import Scene
from geoscene.support.files import write_json
from lidar.dataset.checksums import folder_digest
from lidar.dataset.layout import Dataset, reading_file

PROVENANCE = "provenance.json"
"""Where folders have it that are no datasets of this program; those have it in ``dataset.json``."""

_PACKAGES = ("geoscene", "numpy", "scipy", "numba", "shapely", "pyproj", "embreex", "laspy", "lazrs")
"""Packages that bytes of a drive can depend on."""

_CARRIED = (
    "generator", "scene", "attribution", "licence", "sources", "versions", "start_time", "rig", "seed",
    "recipe", "derived_from",
)  # fmt: skip


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that bytes of a drive can depend on, of those installed."""
    found = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def scene_provenance(scene: Scene) -> dict[str, Any]:
    """Entries of ``dataset.json`` about a drive's scene: digests, relief, sources, licences and attribution.

    The digest of a scene that grows with further drives is not stated: it is not the same when a drive is
    repeated. That of its map is.
    """
    manifest = scene.manifest
    sources = manifest.get("sources", [])
    digest = {} if scene.area is not None else {"digest": manifest.get("digest", "")}
    return {
        "scene": {
            "name": manifest.get("name", ""),
            "path": scene.location,
            **digest,
            "map": manifest.get("map", ""),
            **({} if scene.relief == "off" else {"relief": scene.relief}),
        },
        "attribution": manifest.get("attribution", ""),
        "licence": "; ".join(dict.fromkeys(s["licence"] for s in sources if s.get("licence"))),
        "sources": sources,
    }


def derived_from(source: Path, former: Mapping[str, Any], *, by: str) -> dict[str, Any]:
    """The entry of data that were made from others: all their ancestors, the oldest first.

    former : document with the entry of the source, if it has one
    by     : what made them, such as ``apply``
    """
    steps = [*former.get("derived_from", ()), {"by": f"lidar {by}", "from": folder_digest(source)}]
    return {"derived_from": steps}


def write_export_provenance(dataset: Dataset, folder: Path, *, by: str) -> None:
    """Write the provenance of a dataset to a folder in another layout."""
    _write_known(dataset, folder / PROVENANCE, by=by)


def write_map_provenance(dataset: Dataset, out: Path) -> None:
    """Write the provenance of a dataset beside a map that was made from it."""
    _write_known(dataset, out.with_name(f"{out.name}.{PROVENANCE}"), by="map")


def _write_known(dataset: Dataset, path: Path, *, by: str) -> None:
    manifest = dataset.manifest
    known = {name: manifest[name] for name in _CARRIED if name in manifest}
    write_json(path, known | derived_from(dataset.path, manifest, by=by))


def write_folder_provenance(source: Path, folder: Path, *, by: str) -> None:
    """Write the provenance of a folder of KITTI or nuScenes to one that was made from it."""
    known = read_folder_provenance(source)
    write_json(folder / PROVENANCE, known | derived_from(source, known, by=by))


def read_folder_provenance(folder: Path) -> dict[str, Any]:
    """Provenance of a folder of KITTI or nuScenes; empty for folders that other programs made.

    Raises DatasetError for a damaged file.
    """
    path = folder / PROVENANCE
    if not path.is_file():
        return {}
    with reading_file(path):
        known: dict[str, Any] = json.loads(path.read_text("utf-8"))
        _ = [str(step["from"]) for step in known.get("derived_from", ())], known.get("recipe", {}).keys()
    return known
