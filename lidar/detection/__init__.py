"""Road users found in point clouds: what attacks and defences are measured with."""

from lidar.detection.detector import Detections as Detections
from lidar.detection.detector import Detector as Detector
from lidar.detection.rules import RULES as RULES
from lidar.detection.rules import detect as detect
