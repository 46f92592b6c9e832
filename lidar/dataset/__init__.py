"""Datasets on disk: layout, formats of files, layouts of other datasets, checksums."""
