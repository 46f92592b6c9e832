"""Cameras: models, light, images by ray casting, and the files they are kept in."""
