"""What a vehicle carries: rigs, laser scanners, cameras, GNSS receivers and inertial units."""
