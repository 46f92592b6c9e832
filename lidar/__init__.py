"""Vehicles with ray-cast sensors driven through a geoscene scene."""

from geoscene import __version__ as __version__
