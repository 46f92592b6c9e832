"""Watermarks of point clouds and signatures of datasets, and where either was tampered with."""
