"""GNSS and IMU."""
