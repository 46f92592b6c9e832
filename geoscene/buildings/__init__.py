"""Buildings: from map areas to a table, from the table to watertight solids."""

from geoscene.buildings.features import read_buildings as read_buildings
from geoscene.buildings.solids import build_solids as build_solids
from geoscene.buildings.table import BuildingOptions as BuildingOptions
from geoscene.buildings.table import Buildings as Buildings
