"""Statistics at the extremes: the table's cases, and independence of drawn streams."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lidar.geometry.random_streams import generator, normal_of, uniform_of
from lidar.tools.selftest.run import outcome
from lidar.tools.selftest.statistics import CASES

WORDS = st.tuples(st.integers(0, 2**31), st.text(max_size=8), st.integers(0, 10**6), st.text(max_size=8))


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_statistics_stay_within_the_bound(case):
    done = outcome(case, case.quick)
    assert done.error == ""
    assert done.measured <= case.bound


@settings(max_examples=50, deadline=None)
@given(st.integers(-(2**63), 2**63 - 1), st.integers(-(2**70), 2**70))
def test_numbers_of_any_size_give_finite_deviates(number, seed):
    numbers = np.array([number])
    assert 0 < uniform_of(numbers, seed)[0] < 1
    assert np.isfinite(normal_of(numbers, seed)[0])


@pytest.mark.full
@settings(max_examples=50, deadline=None)
@given(WORDS, WORDS)
def test_streams_with_other_words_are_uncorrelated(first, second):
    if first != second:
        one, two = (generator(*words).standard_normal(10_000) for words in (first, second))
        assert abs(one @ two) / 100 < 6
