"""Surfaces behind the planes of faces, intersected by formula: openings of facades, rough ground."""

from lidar.raycast.relief.ground import GroundRefiner as GroundRefiner
from lidar.raycast.relief.ground import GroundTables as GroundTables
from lidar.raycast.relief.ground import ground_tables as ground_tables
from lidar.raycast.relief.ground import joined_ground as joined_ground
from lidar.raycast.relief.march import FRAME as FRAME
from lidar.raycast.relief.march import INFILL as INFILL
from lidar.raycast.relief.march import PARTS as PARTS
from lidar.raycast.relief.march import ROOM as ROOM
from lidar.raycast.relief.march import SILL as SILL
from lidar.raycast.relief.walls import NO_WALLS as NO_WALLS
from lidar.raycast.relief.walls import WallRefiner as WallRefiner
from lidar.raycast.relief.walls import WallTables as WallTables
from lidar.raycast.relief.walls import join as join
from lidar.raycast.relief.walls import pairs_of as pairs_of
from lidar.raycast.relief.walls import tables_of as tables_of
