"""Footprints that adapt at the extremes: the table's cases."""

import pytest

from lidar.tools.selftest.pulses import CASES
from lidar.tools.selftest.run import outcome


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_footprints_that_adapt_stay_within_the_bound(case):
    done = outcome(case, case.quick)
    assert done.error == ""
    assert done.measured <= case.bound
