"""Aggregated maps and pictures."""
