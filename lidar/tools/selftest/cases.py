"""Cases of the selftest."""

from __future__ import annotations

from lidar.tools.selftest import footprints, places, rays, regions, scale, statistics, times
from lidar.tools.selftest.case import ExtremeCase

CASES: tuple[ExtremeCase, ...] = (
    *rays.CASES,
    *places.CASES,
    *footprints.CASES,
    *times.CASES,
    *statistics.CASES,
    *scale.CASES,
    *regions.CASES,
)
"""All cases, by group."""

GROUPS = tuple(dict.fromkeys(case.group for case in CASES))
"""Names of the groups of cases."""
