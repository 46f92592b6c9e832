"""Buildings: from map areas to a table, from the table to watertight solids."""

from __future__ import annotations

from typing import TYPE_CHECKING

from geoscene.support.registry import lazily

if TYPE_CHECKING:
    from geoscene.buildings.features import read_buildings as read_buildings
    from geoscene.buildings.solids import build_solids as build_solids
    from geoscene.buildings.table import BuildingOptions as BuildingOptions
    from geoscene.buildings.table import Buildings as Buildings

__getattr__ = lazily(
    __name__,
    {
        "BuildingOptions": "table",
        "Buildings": "table",
        "build_solids": "solids",
        "read_buildings": "features",
    },
)
