"""Estimated motion of a vehicle: LiDAR and visual odometry, and their fusion with GNSS and IMU."""
