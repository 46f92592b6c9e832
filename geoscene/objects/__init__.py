"""Vegetation, street furniture, barriers, rooftop objects and overhead wires."""
