"""Road users found in point clouds: what attacks and defences are measured with."""

from lidar.tools.detection.detector import Detections as Detections
from lidar.tools.detection.detector import Detector as Detector
from lidar.tools.detection.rules import RULES as RULES
from lidar.tools.detection.rules import detect as detect
