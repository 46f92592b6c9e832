"""A real place from OpenStreetMap as a watertight 3D scene in a projected frame."""

__version__ = "0.1.0"
