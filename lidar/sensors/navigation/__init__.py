"""GNSS receivers and inertial units: satellite visibility, fixes, samples and their errors."""
