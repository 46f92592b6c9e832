"""Attacks against defences: which attacks succeed, which defences notice them, and at what cost."""

from lidar.tools.redteam.run import RedTeamSummary as RedTeamSummary
from lidar.tools.redteam.run import redteam as redteam
