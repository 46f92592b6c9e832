"""Everything that moves or stands about in a scene besides the ego vehicle."""

from lidar.actors.actors import Actors as Actors
from lidar.actors.actors import actor_shapes as actor_shapes
from lidar.actors.actors import actor_transforms as actor_transforms
from lidar.actors.actors import states as states
from lidar.actors.actors import velocities as velocities
from lidar.actors.among import drive_among as drive_among
from lidar.actors.among import drive_obeying as drive_obeying
from lidar.actors.boxes import box_rows as box_rows
from lidar.actors.boxes import count_points as count_points
from lidar.actors.boxes import image_boxes as image_boxes
from lidar.actors.fcd import TrafficFile as TrafficFile
from lidar.actors.populate import TrafficOptions as TrafficOptions
from lidar.actors.populate import populate as populate
from lidar.actors.replayed import replay as replay
