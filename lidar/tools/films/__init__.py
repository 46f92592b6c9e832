"""Films of recorded drives: sweeps, cameras and the growing map, in the drive's own time."""
