"""Everything that moves or stands about in a scene besides the ego vehicle."""

from lidar.actors.actors import Actors as Actors
from lidar.actors.actors import actor_shapes as actor_shapes
from lidar.actors.actors import actor_transforms as actor_transforms
from lidar.actors.actors import velocities as velocities
from lidar.actors.populate import TrafficOptions as TrafficOptions
from lidar.actors.populate import populate as populate
