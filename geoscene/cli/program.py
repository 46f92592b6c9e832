"""The program `geoscene`, and the parameters and texts that its commands share."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

from cyclopts import App, Group, Parameter

from geoscene import __version__
from geoscene.support.console import DEFAULTS, Report, print_json, with_flags
from geoscene.uses import USES

app = App(
    name="geoscene",
    version=__version__,
    default_parameter=DEFAULTS,
    suppress_keyboard_interrupt=False,
    help="""Turn a real place from OpenStreetMap into a watertight 3D scene.

    A first scene, without a network:  geoscene build --demo -o scene

    Then look at it (geoscene view scene -o page.html), check it (geoscene validate scene), open
    scene/features.gpkg in QGIS, or drive through it:  lidar drive scene --route random -o drive
    """,
)
app.register_install_completion_command()

OUTPUT = Group("Output", sort_key=4)

Out = Annotated[Path, Parameter(name=["--out", "-o"], group=OUTPUT)]
Reporting = Annotated[Report, Parameter(group=OUTPUT)]


def print_file(summary: Any, contents: str, *, end: str = "", json: bool) -> None:
    """Print a summary of a written file, as JSON or as text."""
    if json:
        print_json({**asdict(summary), "path": str(summary.path)})
        return
    print(f"{summary.path}: {contents}, {summary.bytes / 1e6:.1f} MB{end}")
    for note in summary.notes:
        print(f"  {with_flags(app, note)}")


def _count_guessed(relief: dict[str, Any]) -> dict[str, int]:
    """Number of guessed features by kind, openings of facades excluded."""
    furniture = sum(relief.get("furniture_guessed", {}).values())
    found = relief.get("parts_guessed", {}) | relief.get("roofs_guessed", {}) | {"furniture": furniture}
    return {name: count for name, count in found.items() if count}


def print_scene(report: dict[str, Any]) -> None:
    """Print the manifest of a scene as text."""
    counts, frame, ground = report["counts"], report["frame"], report["ground"]
    water = ground.get("water_area", 0.0) / 1e6
    use = report["options"].get("use", "all")
    has_tiles = not USES[use].lacks("tiles")
    steep = _steep_roads(counts, terrain=frame["vertical"] != "flat")
    xmin, ymin, xmax, ymax = report["bounds"]
    west, south, east, north = report["geographic_bounds"]
    rows = {
        "frame": f"{frame['name']}, heights {frame['vertical']}",
        "extent": f"{xmax - xmin:.0f} x {ymax - ymin:.0f} m;"
        f" lon {west:.5f} to {east:.5f}, lat {south:.5f} to {north:.5f}",
        "buildings": f"{counts['buildings']} in the map, {counts['dropped']} dropped"
        + (f", {counts['solids']} solids" if has_tiles else ""),
        "watertight": f"{counts['watertight']} of {counts['closed_objects']} closed objects"
        if has_tiles
        else "",
        "standing": f"{counts['trees']} mapped trees, {counts['forest_trees']} in forests,"
        f" {counts['furniture']} lamps, signs and other furniture, {counts['barriers']} barriers",
        "ground": f"{ground['area'] / 1e6:.2f} km2" + (f", {water:.3g} km2 of it water" if water else "")
        if has_tiles
        else "",
        "roads": f"{counts['road_km']:.1f} km of carriageway in the extent; {counts['road_edges']} edges by"
        f" direction{steep}",
        "heights": _list_counts(report["heights"]),
        "roofs": _list_counts(report["roofs"]),
        "relief": report["options"].get("relief", "off"),
        "facades": _list_counts(report.get("relief", {}).get("facades", {})),
        "guessed": _list_counts(_count_guessed(report.get("relief", {}))),
    }
    for_drives = "area" in report
    if for_drives or report["options"].get("along"):
        features = max(stop for _, stop in report["layers"].values())
        part = "that drives need" if for_drives else "in range of the route"
        rows["along"] = (
            f"{len(report['tiles'])} tiles are built, those {part}; solids, watertight,"
            " trees in forests and ground count these tiles, all other figures the whole map (objects far"
            " away as mapped);"
            f" tables hold {sum(report['rows'].values())} of {features} features"
        )
    if use != "all":
        rows[f"for {use}"] = f"{USES[use].contents}; left out: {_left_out_text(report['left_out'])}"
    print(report["name"] or report["path"])
    for title, text in rows.items():
        if text:
            print(f"  {title:<10} {text}")
    for action, kinds in report["problems"].items():
        for kind, reasons in kinds.items():
            print(f"  {action:<10} {kind}: {_list_counts(reasons)}")
    for limit in report.get("limits", []):
        print(f"  {'limit':<10} {with_flags(app, limit['advice'])}")
    print(f"  {report['attribution']}")


def _left_out_text(counts: dict[str, int]) -> str:
    """Text on the contents that a scene for one use leaves out."""
    names = {
        "tiles": "tiles with all meshes",
        "features": "features of other tables",
        "attributes": "attributes of features",
    }
    parts = [f"{counts[name]:,} {title}" for name, title in names.items() if counts.get(name)]
    size = f" ({counts['bytes'] / 1e6:.2f} MB before compression)" if counts.get("bytes") else ""
    return f"{', '.join(parts)}{size}"


def _steep_roads(counts: dict[str, Any], *, terrain: bool) -> str:
    steep = counts["road_km_steep"]
    if not terrain or steep <= 0.005 * counts["road_km"]:
        return ""
    return f", {steep:.1f} km steeper than 20 %; the terrain model may be too coarse"


def _list_counts(counts: dict[str, int]) -> str:
    return ", ".join(f"{name} {n}" for name, n in counts.items())
