"""Laser scanners: rays of a moving sensor, echoes of surfaces, detection and point clouds."""
