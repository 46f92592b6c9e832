"""GPS time, leap seconds and the starts of drives."""

from datetime import UTC, datetime
from importlib import resources

import numpy as np
import pytest

from lidar.errors import InputError
from lidar.geometry.time_scales import GPS_EPOCH, KNOWN_UNTIL, LEAPS, check_start, gps_seconds, leap_seconds


@pytest.mark.parametrize(
    ("when", "week", "second"),
    [  # GPS week and second, leap seconds included
        ("1980-01-06T00:00:00+00:00", 0, 0),
        ("2016-11-21T12:00:00+00:00", 1924, 129617),
        ("2016-12-31T23:59:59+00:00", 1930, 16),
        ("2017-01-01T00:00:00+00:00", 1930, 18),
        ("2026-06-01T10:00:00+00:00", 2421, 122418),
    ],
)
def test_gps_time_of_known_moments(when, week, second):
    start = datetime.fromisoformat(when)
    seconds = gps_seconds(start, np.array([0, 500_000_000]))
    assert (seconds + 1e9).tolist() == [week * 604800 + second, week * 604800 + second + 0.5]


def test_leap_seconds_are_those_of_the_time_zone_database():
    lines = (
        pytest.importorskip("tzdata")
        and (resources.files("tzdata") / "zoneinfo" / "leapseconds").read_text("utf-8").splitlines()
    )
    rows = [line.split() for line in lines if line.startswith("Leap")]
    eves = [datetime.strptime(" ".join(r[1:4]) + " UTC", "%Y %b %d %Z").replace(tzinfo=UTC) for r in rows]
    known = [leap for eve in eves if (leap := eve.replace(hour=23)) > GPS_EPOCH]
    assert [leap.date() for leap in known] == [
        datetime.fromtimestamp(leap.timestamp() - 1, UTC).date() for leap in LEAPS
    ]
    assert leap_seconds(KNOWN_UNTIL) == 18


@pytest.mark.parametrize(
    ("when", "says"),
    [
        ("2999-01-01T00:00:00+00:00", "end of 2261"),
        ("1979-12-31T00:00:00+00:00", "from 1980-01-06"),
        ("2026-06-21T08:00:00", "time zone"),
        ("2016-12-31T23:59:55+00:00", "leap second before 2017-01-01"),
    ],
)
def test_starts_that_time_stamps_cannot_follow_are_refused(when, says):
    with pytest.raises(InputError, match=says):
        check_start(datetime.fromisoformat(when), 10 * 10**9)


def test_a_drive_may_end_before_a_leap_second_or_start_after_it():
    check_start(datetime(2016, 12, 31, 23, 59, 45, tzinfo=UTC), 10 * 10**9)
    check_start(LEAPS[-1], 10 * 10**9)
