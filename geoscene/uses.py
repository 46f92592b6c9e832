"""Contents of scenes: levels of relief, and what a drive, a map or a GIS needs of a scene.

Levels of relief:

off   : walls are planes and the ground is smooth
plain : windows and doors in depth, kerbs, rough ground, lined tunnels, trees with limbs
full  : guessed small parts, too
scene : what the scene was built with
mesh  : openings of walls as triangles, instead of surfaces that rays meet by formula
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

RELIEFS = ("off", "plain", "full")
"""Relief that a scene is built with; each has all of the former."""

MESH = "mesh"

USED_RELIEFS = ("scene", *RELIEFS, MESH)
"""Relief of a scene that a drive uses."""


def sufficient_reliefs(used: str) -> tuple[str, ...]:
    """Reliefs of which a scene must be built with one, for a relief of `USED_RELIEFS` to be used."""
    if used == "full":
        return ("full",)
    return RELIEFS[1:] if used in ("plain", MESH) else RELIEFS


@dataclass(frozen=True, slots=True)
class Needed:
    """Columns and rows of a table that a use needs.

    columns : besides geometry and number; None for all
    classes : values of the column ``class``; None for all rows
    """

    columns: tuple[str, ...] | None = None
    classes: tuple[str, ...] | None = None


_DRIVEN: Mapping[str, Needed] = {
    "buildings": Needed(("min_height",)),
    "building_parts": Needed(("building", "min_height")),
    "passages": Needed(("height",)),
    "landcover": Needed(("class",), ("parking",)),
    "road_surfaces": Needed(("class",), ("road", "lane_marking", "crossing", "parking", "sidewalk")),
    "structures": Needed(()),
}
"""What routes, traffic and parked vehicles are planned with."""


@dataclass(frozen=True, slots=True)
class Use:
    """Contents of scenes for a use.

    contents : what the scene holds, for its summary
    tiles  : meshes
    colors : colours of faces, and which of them are walls
    tables : columns and rows to write, by table; None for all tables in full
    indexed : tables have spatial indices
    """

    contents: str
    tiles: bool = True
    colors: bool = True
    tables: Mapping[str, Needed] | None = None
    indexed: bool = True

    def lacks(self, part: str) -> bool:
        """Whether scenes for this use lack a part: ``tiles``, ``colors`` or some of the ``tables``."""
        return self.tables is not None if part == "tables" else not getattr(self, part)


USES: Mapping[str, Use] = {
    "all": Use("everything"),
    "lidar": Use(
        "what laser scanners, GNSS, IMU and traffic need", colors=False, tables=_DRIVEN, indexed=False
    ),
    "camera": Use(
        "what cameras, laser scanners, GNSS, IMU and traffic need",
        tables={**_DRIVEN, "furniture": Needed(("shape", "face", "heading"))},
        indexed=False,
    ),
    "gis": Use("tables and road graph only", tiles=False),
    "map": Use(
        "road graph and tables in plan only",
        tiles=False,
        tables=dict.fromkeys(
            (
                "buildings",
                "passages",
                "landcover",
                "road_surfaces",
                "roads",
                "trees",
                "furniture",
                "barriers",
            ),
            Needed(),
        ),
    ),
}
"""Uses by name; ``all`` is the default."""
