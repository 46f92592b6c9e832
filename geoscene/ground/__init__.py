"""One ground surface: a partition of the plane by what lies on it, triangulated and draped on terrain.

>>> cover, problems = landcover(osm, frame, extent=extent)                           # doctest: +SKIP
>>> layers = Layers.concatenate([cover, road_surfaces, building_pads(footprints)])   # doctest: +SKIP
>>> plan = plan_ground(extent, layers, tile_size=250.0)                              # doctest: +SKIP
>>> meshes = [ground_tile(plan, i, j=j) for i, j in plan.tiles]                        # doctest: +SKIP
"""

from geoscene.ground.drape import WaterLevels as WaterLevels
from geoscene.ground.drape import drape as drape
from geoscene.ground.drape import ground_tile as ground_tile
from geoscene.ground.drape import water_levels as water_levels
from geoscene.ground.joining import ground_tiles as ground_tiles
from geoscene.ground.joining import join_tiles as join_tiles
from geoscene.ground.landcover import landcover as landcover
from geoscene.ground.layers import Layers as Layers
from geoscene.ground.layers import building_pads as building_pads
from geoscene.ground.partition import GroundPlan as GroundPlan
from geoscene.ground.partition import cut_along as cut_along
from geoscene.ground.partition import partition_tile as partition_tile
from geoscene.ground.partition import plan_ground as plan_ground
from geoscene.ground.partition import tile_box as tile_box
from geoscene.ground.partition import tile_place as tile_place
from geoscene.ground.partition import tile_span as tile_span
from geoscene.ground.triangulate import triangulate as triangulate
