"""Firing patterns of laser scanners."""
