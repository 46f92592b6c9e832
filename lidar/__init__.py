"""Vehicles with ray-cast sensors driven through a geoscene scene."""

__version__ = "0.1.0"
