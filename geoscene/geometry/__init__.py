"""Projected frames, meshes and polylines; tests for intersections and watertightness."""
