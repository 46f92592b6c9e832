"""The page: scene, viewer and style in one HTML file."""

from __future__ import annotations

import html
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np

from geoscene.classes import Class, class_codes, materials
from geoscene.errors import InputError
from geoscene.export.files import Summary, compact_json
from geoscene.export.objects import attribution, read_features
from geoscene.files import atomic_file, exclusive, spool
from geoscene.options import Degrees, ViewOptions
from geoscene.progress import Progress, silent
from geoscene.scene import Scene
from geoscene.typing import Bools, Ints
from geoscene.view.assembly import check_page, gzip, linked, part, script_text, write_blob, write_page
from geoscene.view.attributes import tables
from geoscene.view.lonlat import ACCURACY, lonlat_grid
from geoscene.view.looks import Looks, read_looks
from geoscene.view.tiles import Groups, groups_of, only, pack_shapes, pack_tile

SCRIPTS = (
    *("blob.js", "camera.js", "gestures.js", "program.js"),
    *("data.js", "facades.js", "shaders.js", "draw.js", "panel.js", "main.js"),
)
"""The viewer's parts, in the order in which they are joined."""


def view_scene(
    scene: Scene,
    out: str | Path,
    *,
    options: ViewOptions = ViewOptions(),
    overwrite: bool = False,
    progress: Progress = silent,
) -> Summary:
    """Write a scene as one web page that a browser opens from disk; returns its contents.

    The page loads nothing: data, style and viewer (WebGL 2) are in it. Its bytes depend on the scene, the
    bounds and the layers alone.

    Raises InputError for a file that exists or is not named as a page, bounds without a tile, an unknown
    layer, and a page that would be too large; the message then gives the bounds of a part that would fit.
    """
    out = Path(out)
    scene.require("tiles", "tables")
    check_page(out, overwrite=overwrite)
    bounds_deg, layers, max_mb = options.bounds_deg, options.layers, options.max_mb
    chosen = _tiles_within(scene, bounds_deg)
    chosen = chosen[np.lexsort([chosen[:, 1], chosen[:, 0], _rings(chosen)])]  # from the middle outwards
    groups = groups_of(scene)
    kept = _kept(groups, layers)
    looks = read_looks(scene)
    shapes, shape_bytes = pack_shapes(list(scene.shapes().values()))
    present = np.zeros(len(groups.of) - 1, np.bool_)
    tiles: list[dict[str, Any]] = []
    ends: list[int] = []
    faces = 0
    with exclusive(out), atomic_file(out) as file, spool(out) as blobs:
        write_blob(blobs, "shapes", data=shape_bytes)
        for done, (i, j, _) in enumerate(chosen.tolist()):
            progress("page", done, total=len(chosen))
            tile = looks.dressed(only(scene.tile(i, j), groups, kept=kept))
            faces += len(tile.mesh)
            for column in (tile.mesh.feature, tile.instances.feature):
                present[column[column >= 0]] = True
            entry, data = pack_tile(tile, groups, facades=looks.facades_of(tile.mesh))
            tiles.append({"index": [i, j], **entry})
            write_blob(blobs, f"tile-{done}", data=data)
            ends.append(blobs.tell())
            if blobs.tell() > max_mb * 1e6:
                break
        write_blob(
            blobs, "attributes", data=gzip(compact_json(tables(looks.told(read_features(scene)), present)))
        )
        if blobs.tell() > max_mb * 1e6:
            raise InputError(_too_large(scene, chosen, sizes=ends, size=blobs.tell(), max_mb=max_mb))
        head = _head(scene, tiles, groups=groups, looks=looks, shapes=shapes)
        _join(file, scene, head=head, blobs=blobs)
    notes = []
    if len(tiles) < len(scene.tile_indices):
        notes.append(
            f"{len(tiles)} of the scene's {len(scene.tile_indices)} tiles, whole: those within the bounds"
        )
    if not kept.all():
        left = [name for name, keep in zip(groups.names, kept, strict=True) if not keep]
        notes.append(f"layers left out: {', '.join(left)}")
    if (error := head["lonlat"]["error"]) > ACCURACY:
        notes.append(f"longitude and latitude under the cursor are within {error:.2g} m only")
    count, crs = int(present.sum()), scene.frame.name
    return Summary.of(out, "html", objects=count, faces=faces, crs=crs, notes=tuple(notes))


def _kept(groups: Groups, layers: Sequence[str]) -> Bools:
    """Groups (n,) to include in the page."""
    if unknown := sorted(set(layers) - set(groups.names)):
        raise InputError(f"`layers`: no {', '.join(unknown)} in the scene; it has {', '.join(groups.names)}")
    return np.array([not layers or name in layers for name in groups.names])


def _join(file: IO[bytes], scene: Scene, *, head: dict[str, Any], blobs: IO[bytes]) -> None:
    """Write the page: the template with its placeholders filled in and the bytes of the scene."""
    words = {
        "title": html.escape(str(head["name"])),
        "credit": linked(attribution(scene)),
        "style": part("page.css"),
        "scene": script_text(compact_json(head).decode()),
        "script": "\n".join(part(name) for name in SCRIPTS),
    }
    write_page(file, part("page.html"), words=words, blobs=blobs)


def _tiles_within(scene: Scene, bounds_deg: Degrees | None) -> Ints:
    """(i, j, span) of the tiles (n, 3) that intersect the bounds."""
    tiles = np.column_stack([np.array(scene.tile_indices, np.int64).reshape(-1, 2), scene.tile_spans])
    if bounds_deg is None:
        return tiles
    west, south, east, north = bounds_deg
    if not (west < east and south < north):
        raise InputError(f"bounds {bounds_deg}: give west, south, east, north in degrees, in this order")
    x, y = scene.frame.from_geographic([west, west, east, east], [south, north, south, north])
    low, high = scene.tile_boxes[:, :2], scene.tile_boxes[:, 2:]
    inside = (low[:, 0] < x.max()) & (high[:, 0] > x.min()) & (low[:, 1] < y.max()) & (high[:, 1] > y.min())
    if not inside.any():
        xmin, ymin, xmax, ymax = scene.bounds
        lon, lat = scene.frame.to_geographic([xmin, xmax], [ymin, ymax])
        raise InputError(
            f"bounds {bounds_deg}: the scene has nothing there; it covers "
            f"{lon[0]:.5f},{lat[0]:.5f},{lon[1]:.5f},{lat[1]:.5f}"
        )
    chosen: Ints = tiles[inside]
    return chosen


def _middle(tiles: Ints) -> Ints:
    """The square (2,) in the middle of tiles (n, 3)."""
    middle: Ints = (tiles[:, :2].min(axis=0) + (tiles[:, :2] + tiles[:, 2:] - 1).max(axis=0)) // 2
    return middle


def _rings(tiles: Ints) -> Ints:
    """Chebyshev distance (n,) of the nearest square of each tile (n, 3) from the middle one, in squares."""
    low, middle = tiles[:, :2], _middle(tiles)
    rings: Ints = np.maximum(low - middle, middle - (low + tiles[:, 2:] - 1)).max(axis=1).clip(0)
    return rings


def _too_large(scene: Scene, tiles: Ints, *, sizes: Sequence[int], size: int, max_mb: float) -> str:
    """Error text: how large the page would be, and the bounds of a part that would fit."""
    rings, share = _rings(tiles), size / sizes[-1]
    whole = size / len(sizes) * len(tiles) / 1e6
    message = f"the page would have about {max(whole, 1.01 * max_mb):.3g} MB and `max_mb` is {max_mb:g}"
    ends = [int((rings <= ring).sum()) - 1 for ring in range(int(rings[len(sizes) - 1]) + 1)]
    fits = [ring for ring, end in enumerate(ends) if end < len(sizes) and sizes[end] * share < max_mb * 1e6]
    if not fits:
        return f"{message}; give more, leave out `layers`, or build the scene with smaller tiles"
    middle, size_m = _middle(tiles), scene.tile_size
    low = (middle - fits[-1]) * size_m + 1.0
    high = (middle + fits[-1] + 1) * size_m - 1.0
    lon, lat = scene.frame.to_geographic(
        [low[0], low[0], high[0], high[0]], [low[1], high[1], low[1], high[1]]
    )
    inner = (max(lon[:2]), max(lat[0], lat[2]), min(lon[2:]), min(lat[1], lat[3]))
    box = ",".join(f"{v:.5f}" for v in inner)
    return f"{message}; the middle of it fits: `bounds_deg`={box} (or name fewer `layers`)"


def _head(
    scene: Scene, tiles: list[dict[str, Any]], *, groups: Groups, looks: Looks, shapes: list[list[int]]
) -> dict[str, Any]:
    """Header that the viewer needs to read the bytes."""
    low = np.min([entry["low"] for entry in tiles], axis=0).tolist()
    high = np.max([entry["high"] for entry in tiles], axis=0).tolist()
    bounds = (low[0], low[1], high[0], high[1])
    grid = lonlat_grid(scene.frame, bounds)
    middle = scene.frame.to_geographic((bounds[0] + bounds[2]) / 2, (bounds[1] + bounds[3]) / 2)
    colors = class_codes().color.tolist()
    return {
        "name": scene.manifest.get("name") or scene.path.name,
        "frame": scene.frame.name,
        "vertical": scene.frame.vertical,
        "low": low,
        "high": high,
        "convergence": round(float(scene.frame.convergence(*middle)), 9),
        "lonlat": {
            "bounds": bounds,
            "lon": grid.lon.tolist(),
            "lat": grid.lat.tolist(),
            "error": float(f"{grid.error:.2g}"),
        },
        "region": looks.region,
        "groups": groups.names,
        "features": len(groups.of) - 1,
        "classes": {int(code): [code.name.lower(), colors[code]] for code in Class},
        "materials": {
            material.code: [material.name, material.color, material.reflectance]
            for material in materials().values()
        },
        "shapes": shapes,
        "tiles": tiles,
    }
