"""Estimates against the truth: trajectories, detections and tracks of road users."""
