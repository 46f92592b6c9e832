"""Scenes, road graphs, programs and a browser for tests."""

import os
from pathlib import Path

DEMO_BOX = (24.9405, 60.1655, 24.9475, 60.1690)
"""West, south, east, north in degrees of the part of the demo map in the fixture ``scene``."""

ROOT = Path(__file__).resolve().parents[2]
"""The repository."""

os.environ["GEOSCENE_PROGRESS"] = "off"  # lines of slow stages are not what tests of messages count
