"""Road users found in point clouds without learning: what attacks and defences are measured with."""

from lidar.detection.detector import Detections as Detections
from lidar.detection.detector import detect as detect
