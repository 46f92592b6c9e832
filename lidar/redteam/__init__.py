"""Attacks against defences: which attacks succeed, which defences notice them, and at what cost."""

from lidar.redteam.run import RedTeamSummary as RedTeamSummary
from lidar.redteam.run import redteam as redteam
