"""Commands on a scene: `info`, `validate`, `export` and `view`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter, validators

from geoscene.cli.program import Out, Reporting, print_file, print_scene
from geoscene.options import ExportOptions, ViewOptions
from geoscene.support.console import FAILURE, Report, note_new_folder, print_json
from geoscene.support.progress import progress_bar


def info(
    scene: Annotated[Path, Parameter(validator=validators.Path(exists=False))], /, *, json: bool = False
) -> int:
    """Describe a scene: frame, extent, counts, sources of heights, repaired and dropped features.

    Parameters
    ----------
    scene
        Directory or URL of the scene.
    json
        Print as JSON.
    """
    from geoscene.scene.layout import open_scene  # noqa: PLC0415
    from geoscene.support.storage import shown  # noqa: PLC0415

    opened = open_scene(scene)
    xmin, ymin, xmax, ymax = opened.manifest["bounds"]
    size = {"width_m": xmax - xmin, "height_m": ymax - ymin}
    extent = size | {"geographic": opened.manifest["geographic_bounds"]}
    report = opened.manifest | {"path": shown(scene), "extent": extent}
    if json:
        print_json(report)
    else:
        print_scene(report)
    return 0


def validate(scene: Path, /, *, json: bool = False) -> int:
    """Check all files, solids and surfaces of a scene; exit code 1 if one has a fault.

    A file is as the build wrote it: neither damaged nor edited, nor of another scene.
    A solid is closed, oriented and of positive volume, its faces meet in common edges and vertices only, and
    no two of its vertices are within 1 mm. In a surface, such as a road, no two vertices are
    within 1 mm, no face is a line and no edge has three faces.

    Parameters
    ----------
    scene
        Directory or URL of the scene.
    json
        Print the result as JSON.
    """
    from geoscene.errors import DIFFERS  # noqa: PLC0415
    from geoscene.scene.layout import open_scene, using  # noqa: PLC0415
    from geoscene.scene.validate import check_scene  # noqa: PLC0415

    with using(open_scene(scene)) as opened:
        report = check_scene(opened)
    if json:
        print_json(report)
    else:
        for name in report["changed"]:
            print(f"{scene}/{name}: {DIFFERS}")
        for row in report["broken"]:
            print(f"{row['osm_id']} (feature {row['feature']}): {row['fault']}")
        valid = report["solids"] - len(report["broken"])
        print(f"{report['solids']} solids, {valid} closed, oriented and free of self-contact")
        for row in report["broken_surfaces"]:
            i, j = row["tile"]
            of = f" of {row['osm_id']} (feature {row['feature']})" if row["feature"] >= 0 else ""
            print(f"{row['class']}{of} in tile {i}, {j}: {row['fault']}")
        valid = report["surfaces"] - len(report["broken_surfaces"])
        print(f"{report['surfaces']} surfaces, {valid} without faults")
    return FAILURE if report["changed"] or report["broken"] or report["broken_surfaces"] else 0


def export(
    scene: Path, /, *, out: Out, options: ExportOptions = ExportOptions(), report: Reporting = Report()
) -> int:
    """Write a scene in another format.

    For example:

    geoscene export scene -o city.city.json

    geoscene export scene -o city.glb

    geoscene export scene --to 3dtiles -o tiles

    geoscene export scene -o surface.tif --model surface --resolution 0.5

    geoscene export scene -o roads.xodr

    Parameters
    ----------
    scene
        Directory or URL of the scene.
    out
        File to write; for 3D Tiles a directory.
    """
    from geoscene.export import export_scene  # noqa: PLC0415
    from geoscene.scene.layout import open_scene, using  # noqa: PLC0415

    note_new_folder(out)
    with progress_bar(quiet=report.quiet) as progress, using(open_scene(scene)) as opened:
        summary = export_scene(opened, out, options=options, overwrite=report.overwrite, progress=progress)
    print_file(
        summary,
        f"{summary.kind}, {summary.objects} {'cells' if summary.kind == 'geotiff' else 'objects'}",
        end=f", {summary.crs}",
        json=report.json,
    )
    return 0


def view(
    scene: Path, /, *, out: Out, options: ViewOptions = ViewOptions(), report: Reporting = Report()
) -> int:
    """Write a scene as one web page: rotate it, click an object, read its attributes and their sources.

    For example:

    geoscene view scene -o page.html

    geoscene view scene -o page

    The page needs no network and no server; open the file, or the index.html of the folder, in any browser
    with WebGL 2.

    Parameters
    ----------
    scene
        Directory or URL of the scene.
    out
        File to write (.html), or a folder (no suffix) whose page loads parts of the scene as they are seen:
        for scenes of any size.
    """
    from geoscene.scene.layout import open_scene, using  # noqa: PLC0415
    from geoscene.view import view_scene  # noqa: PLC0415

    note_new_folder(out)
    with progress_bar(quiet=report.quiet) as progress, using(open_scene(scene)) as opened:
        summary = view_scene(opened, out, options=options, overwrite=report.overwrite, progress=progress)
    print_file(summary, f"{summary.faces} faces, {summary.objects} objects", json=report.json)
    return 0
