"""Sweeps: grids of drives as one job."""

from lidar.sweep.run import SweepSummary as SweepSummary
from lidar.sweep.run import sweep as sweep
