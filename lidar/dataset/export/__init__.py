"""Datasets in the layouts of others."""
