"""Surfaces behind the planes of faces, met by formula: openings of facades, rough ground."""

from lidar.relief.ground import GroundRefiner as GroundRefiner
from lidar.relief.ground import GroundTables as GroundTables
from lidar.relief.ground import ground_tables as ground_tables
from lidar.relief.ground import joined_ground as joined_ground
from lidar.relief.march import FRAME as FRAME
from lidar.relief.march import INFILL as INFILL
from lidar.relief.march import PARTS as PARTS
from lidar.relief.march import ROOM as ROOM
from lidar.relief.march import SILL as SILL
from lidar.relief.walls import NO_WALLS as NO_WALLS
from lidar.relief.walls import WallRefiner as WallRefiner
from lidar.relief.walls import WallTables as WallTables
from lidar.relief.walls import joined as joined
from lidar.relief.walls import pairs_of as pairs_of
from lidar.relief.walls import tables_of as tables_of
