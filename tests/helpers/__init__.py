"""Worlds, grids of roads and a browser for tests."""

DEMO_BOX = (24.9405, 60.1655, 24.9475, 60.1690)
"""West, south, east, north of the part of the demo map that the fixture ``scene`` holds."""
