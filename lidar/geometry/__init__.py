"""Poses, attitude, mounts and georeferencing."""
