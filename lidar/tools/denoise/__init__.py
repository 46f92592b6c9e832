"""Filters that remove the returns of rain and snow from point clouds, and their scores."""
