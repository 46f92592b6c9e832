"""Data made from recorded data: directories outside of it, written atomically, and provenance.

Provenance is scene, sources, licences, versions of programs, and the data that others were made from.
"""

from __future__ import annotations

import json
import platform
import shutil
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from geoscene.errors import NotWrittenError
from geoscene.scene import Scene
from geoscene.support.files import replaced_folder, write_json
from lidar.dataset.checksums import folder_digest
from lidar.dataset.layout import Dataset, Paths, own_files, reading_file
from lidar.errors import DatasetError, InputError


def check_target(out: Path, *, source: Path, overwrite: bool) -> None:
    """Check that ``out`` can be made from ``source``.

    Raises InputError for a directory within the source or around it, and DatasetError for one that is not
    empty, without ``overwrite``.
    """
    here, there = source.resolve(), out.resolve()
    if here == there or here in there.parents or there in here.parents:
        raise InputError(f"{out}: give a directory outside of {source}")
    if out.exists() and (not out.is_dir() or any(out.iterdir())) and not overwrite:
        raise DatasetError(f"{out}: is not empty; set `overwrite`, or give another directory")


def complete_folder(out: Path) -> AbstractContextManager[Path]:
    """Yield a temporary folder that replaces ``out`` unless the block raises.

    Files there that are not of a dataset stay, with a warning for each.
    """
    return replaced_folder(out, own=own_files)


def copy_dataset(source: Path, out: Path, *, leave_out: set[Path]) -> None:
    """Copy a directory but for its checksums and some files, named as in ``out``."""
    left = leave_out | {Paths(out).checksums}

    def skip(folder: str, names: list[str]) -> list[str]:
        place = out / Path(folder).relative_to(source)
        return [name for name in names if place / name in left]

    copy_folder(source, out, ignore=skip)


def copy_folder(
    source: Path, out: Path, *, ignore: Callable[[str, list[str]], list[str]] | None = None
) -> None:
    """Copy a directory, except the names that ``ignore`` returns for each folder.

    Raises NotWrittenError, which names the first file that could not be copied.
    """
    try:
        shutil.copytree(source, out, ignore=ignore, dirs_exist_ok=True)
    except shutil.Error as error:
        first, _, why = error.args[0][0]
        raise NotWrittenError(f"{first}: cannot be copied ({str(why).partition(': ')[0]})") from error


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
        known: dict[str, Any] = json.loads(path.read_text("utf-8-sig"))
        _ = [str(step["from"]) for step in known.get("derived_from", ())], known.get("recipe", {}).keys()
    return known
