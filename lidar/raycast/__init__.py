"""Ray casting against triangles: exact ranges, instances, motion within a sweep."""

from lidar.raycast.caster import Caster as Caster
from lidar.raycast.columns import PRECISIONS as PRECISIONS
from lidar.raycast.geometry import ALL as ALL
from lidar.raycast.geometry import Geometry as Geometry
from lidar.raycast.geometry import MeshInstances as MeshInstances
from lidar.raycast.hits import Hits as Hits
