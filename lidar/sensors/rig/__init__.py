"""Specifications of sensors and vehicles, read from TOML."""
