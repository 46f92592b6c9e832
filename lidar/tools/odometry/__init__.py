"""Motion of a vehicle from what its sensors measured: LiDAR, cameras, and their fusion with GNSS and IMU."""
