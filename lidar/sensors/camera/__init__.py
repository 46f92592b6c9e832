"""Cameras: light, images by ray casting, and image files."""
