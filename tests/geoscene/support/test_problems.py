"""Features that fail are left out alone; other errors are raised."""

import numpy as np
import pytest

from geoscene.errors import InputError
from geoscene.support.problems import make_without_failures


@pytest.mark.parametrize("bad", [set(), {0}, {3, 4}, {0, 6}, set(range(7))])
def test_only_rows_that_fail_are_left_out(bad):
    def make(rows):
        if bad & set(rows.tolist()):
            raise ZeroDivisionError
        return rows

    failed = []
    made = make_without_failures(make, np.arange(7), failed=lambda row, _: failed.append(row))
    assert np.concatenate([[], *made]).tolist() == sorted(set(range(7)) - bad)
    assert failed == sorted(bad)


@pytest.mark.parametrize("error", [InputError("x"), MemoryError(), OSError("full"), ImportError("gone")])
def test_errors_that_no_feature_causes_are_raised(error):
    def make(_):
        raise error

    with pytest.raises(type(error)):
        make_without_failures(make, np.arange(3), failed=lambda *_: None)


def test_without_rows_nothing_is_made():
    assert make_without_failures(lambda _: 1 / 0, np.arange(0), failed=lambda *_: None) == []
