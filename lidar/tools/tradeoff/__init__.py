"""Cost and error of each setting of a drive, measured against an exact reference."""
