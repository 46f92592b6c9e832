"""The page: scene, viewer and style in one HTML file, or in a folder that is loaded in parts."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np

from geoscene.errors import InputError
from geoscene.export.kinds import Summary
from geoscene.export.objects import attribution
from geoscene.options import ViewOptions
from geoscene.scene import Scene, SceneLike, open_scene
from geoscene.support.files import atomic_file, atomic_folder, exclusive, spool
from geoscene.support.progress import Progress, displayed, shows_progress
from geoscene.typing import Ints
from geoscene.view.assembly import check_page, write_blob, write_page
from geoscene.view.contents import ACCURACY, PageContents, tiles_within
from geoscene.view.streamed import MARK, NAMES, write_streamed

_SCRIPTS = ("data.js", "facades.js", "shaders.js", "draw.js", "panel.js")
"""The viewer's own scripts, in the order in which they are joined; then that of loading and ``main.js``."""


@shows_progress
def view_scene(
    scene: SceneLike,
    out: str | Path,
    *,
    options: ViewOptions = ViewOptions(),
    overwrite: bool = False,
    progress: Progress = displayed,
) -> Summary:
    """Write a scene as one web page that a browser opens from disk; returns its contents.

    The page is a file (``.html``) that loads nothing: data, style and viewer (WebGL 2) are in it. For a path
    without a suffix it is a folder with ``index.html``, which loads parts of the scene as they are seen.
    The bytes depend on the scene, the bounds and the layers alone.

    Raises InputError for a file or folder that exists or is not named as a page, bounds without a tile, an
    unknown layer, and a file that would be too large; the message then gives the bounds of a part that would
    fit.
    """
    scene = open_scene(scene)
    out = Path(out)
    scene.require("tiles", "tables")
    if out.suffix or out.is_file():
        check_page(out, overwrite=overwrite)
    elif out.exists() and not overwrite:
        raise InputError(f"{out}: exists already; set `overwrite` to replace it")
    chosen = tiles_within(scene, options.bounds_deg)
    contents = PageContents(scene, options.layers)
    if out.suffix:
        head = _write_file(contents, chosen, out=out, max_mb=options.max_mb, progress=progress)
    else:
        head = _write_folder(contents, chosen, out=out, progress=progress)
    notes = []
    shown, known = len(contents.tiles), len(scene.tile_indices)
    if shown < known:
        notes.append(f"{shown} of the scene's {known} tiles, whole: those within the bounds")
    if contents.left_out:
        notes.append(f"layers left out: {', '.join(contents.left_out)}")
    if (error := head["lonlat"]["error"]) > ACCURACY:
        notes.append(f"longitude and latitude under the cursor are within {error:.2g} m only")
    count, crs = int(contents.present.sum()), scene.frame.name
    return Summary.of(out, "html", objects=count, faces=contents.faces, crs=crs, notes=tuple(notes))


def _write_file(
    contents: PageContents, chosen: Ints, *, out: Path, max_mb: float, progress: Progress
) -> dict[str, Any]:
    """Write the page as one file; returns its header."""
    chosen = chosen[np.lexsort([chosen[:, 1], chosen[:, 0], _rings(chosen)])]  # from the middle outwards
    tiles: list[dict[str, Any]] = []
    ends: list[int] = []
    with exclusive(out), atomic_file(out) as file, spool(out) as blobs:
        for done, (i, j, _) in enumerate(chosen.tolist()):
            progress("page", done, total=len(chosen))
            entry, data = contents.pack(contents.tile(i, j))
            tiles.append({"index": [i, j], **entry})
            write_blob(blobs, f"tile-{done}", data=data)
            ends.append(blobs.tell())
            if blobs.tell() > max_mb * 1e6:
                break
        head, shapes = contents.head(step=max(entry["step"] for entry in tiles), tiles=tiles)
        write_blob(blobs, "shapes", data=shapes)
        write_blob(blobs, "boxes", data=contents.boxes())
        write_blob(blobs, "attributes", data=contents.attributes())
        if blobs.tell() > max_mb * 1e6:
            raise InputError(_too_large(contents.scene, chosen, sizes=ends, size=blobs.tell(), max_mb=max_mb))
        _join(file, contents.scene, head=head, blobs=blobs, load="whole.js")
    return head


def _write_folder(contents: PageContents, chosen: Ints, *, out: Path, progress: Progress) -> dict[str, Any]:
    """Write the page as a folder; returns its header."""
    with atomic_folder(out, mark=MARK, names=NAMES) as folder:
        more = write_streamed(contents, chosen, folder=folder, progress=progress)
        head, shapes = contents.head(**more)
        with (folder / "index.html").open("wb") as file, spool(folder / "index.html") as blobs:
            write_blob(blobs, "shapes", data=shapes)
            _join(file, contents.scene, head=head, blobs=blobs, load="stream.js")
    return head


def _join(file: IO[bytes], scene: Scene, *, head: dict[str, Any], blobs: IO[bytes], load: str) -> None:
    """Write the page with the bytes of the scene."""
    write_page(
        file,
        package="geoscene.view",
        scripts=(*_SCRIPTS, load, "main.js"),
        title=str(head["name"]),
        credit=attribution(scene),
        head=head,
        blobs=blobs,
        sources="" if load == "whole.js" else " 'self' file:",
    )


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
    message = (
        f"the page would have about {max(whole, 1.01 * max_mb):.3g} MB and `max_mb` is {max_mb:g}; "
        "a folder (a path without .html) is loaded in parts and may have any size"
    )
    ends = [int((rings <= ring).sum()) - 1 for ring in range(int(rings[len(sizes) - 1]) + 1)]
    fits = [ring for ring, end in enumerate(ends) if end < len(sizes) and sizes[end] * share < max_mb * 1e6]
    if not fits:
        return f"{message}; or give more, leave out `layers`, or build the scene with smaller tiles"
    middle, size_m = _middle(tiles), scene.tile_size
    low = (middle - fits[-1]) * size_m + 1.0
    high = (middle + fits[-1] + 1) * size_m - 1.0
    lon, lat = scene.frame.to_geographic(
        [low[0], low[0], high[0], high[0]], [low[1], high[1], low[1], high[1]]
    )
    inner = (max(lon[:2]), max(lat[0], lat[2]), min(lon[2:]), min(lat[1], lat[3]))
    box = ",".join(f"{v:.5f}" for v in inner)
    return f"{message}; the middle of it fits: `bounds_deg`={box} (or name fewer `layers`)"
