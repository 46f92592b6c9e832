"""Worlds, grids of roads and a browser for tests."""
