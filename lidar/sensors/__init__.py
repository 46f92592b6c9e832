"""Laser scanners: presets as data, when and where they fire, and what comes back."""
