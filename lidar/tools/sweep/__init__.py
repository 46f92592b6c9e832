"""Sweeps: grids of drives as one job."""

from lidar.tools.sweep.run import SweepSummary as SweepSummary
from lidar.tools.sweep.run import sweep as sweep
