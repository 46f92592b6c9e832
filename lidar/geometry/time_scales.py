"""GPS time and UTC: leap seconds, and the starts and durations that a drive may have."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import numpy as np
from numpy.typing import NDArray

from geoscene.typing import Float
from lidar.errors import InputError, RouteError

GPS_EPOCH = datetime(1980, 1, 6, tzinfo=UTC)
"""GPS time 0."""

_SINCE = (
    *("1981-07-01", "1982-07-01", "1983-07-01", "1985-07-01", "1988-01-01", "1990-01-01", "1991-01-01"),
    *("1992-07-01", "1993-07-01", "1994-07-01", "1996-01-01", "1997-07-01", "1999-01-01", "2006-01-01"),
    *("2009-01-01", "2012-07-01", "2015-07-01", "2017-01-01"),
)
LEAPS = tuple(datetime.fromisoformat(day).replace(tzinfo=UTC) for day in _SINCE)
"""Ends of the leap seconds since `GPS_EPOCH` (IERS, leap-seconds.list)."""

KNOWN_UNTIL = datetime(2027, 6, 28, tzinfo=UTC)
"""Until when the IERS has announced leap seconds or their absence; later dates have the last offset."""

LONGEST_S = 4 * 3600.0
"""Seconds of the longest drive."""

_LAST_YEAR = 2261  # of time stamps that count nanoseconds since 1970 in 64 bits


def leap_seconds(when: datetime) -> int:
    """GPS time minus UTC in seconds at a time with a zone, not before `GPS_EPOCH`."""
    return sum(when >= leap for leap in LEAPS)


def gps_seconds(start: datetime, time_ns: NDArray[np.integer]) -> Float:
    """Adjusted standard GPS time (seconds since `GPS_EPOCH` minus 1e9) of nanoseconds after a UTC start."""
    base = (start - GPS_EPOCH).total_seconds() + leap_seconds(start) - 1e9
    return base + np.asarray(time_ns, np.float64) * 1e-9


def drive_ns(start: datetime, gps: Float) -> NDArray[np.int64]:
    """Nanoseconds after a UTC start of adjusted standard GPS times, within 60 ns; undoes `gps_seconds`."""
    base = (start - GPS_EPOCH).total_seconds() + leap_seconds(start) - 1e9
    return np.rint((gps - base) * 1e9).astype(np.int64)


def posix_ns(start: datetime) -> int:
    """Nanoseconds since 1970 of a UTC time, without leap seconds."""
    return (start - datetime(1970, 1, 1, tzinfo=UTC)) // timedelta(microseconds=1) * 1000


def check_start(start: datetime, duration_ns: int) -> None:
    """Raise InputError for a drive without a time zone, outside GPS time or across a leap second.

    Time stamps as of POSIX and ISO 8601 in numpy cannot name the second 23:59:60.
    """
    if start.tzinfo is None:
        raise InputError(f"`start` {start.isoformat()}: give a time zone, such as {start.isoformat()}Z")
    if start < GPS_EPOCH or start.year > _LAST_YEAR:
        raise InputError(
            f"`start` {start.isoformat()}: give a time from {GPS_EPOCH.date()} (GPS time begins) to the end"
            f" of {_LAST_YEAR} (time stamps in nanoseconds end)"
        )
    end = start + timedelta(microseconds=duration_ns / 1000)
    for leap in LEAPS:
        if start < leap <= end:
            raise InputError(
                f"`start` {start.isoformat()}: the drive lasts until {end.isoformat(timespec='seconds')} and"
                f" crosses the leap second before {leap.isoformat()}; start there or end before"
            )


def iso_times(start: datetime, time_ns: NDArray[np.integer]) -> list[str]:
    """ISO 8601 UTC time stamps with nanoseconds of times since a start."""
    whole = start.replace(tzinfo=None)
    base = np.datetime64(whole - timedelta(microseconds=whole.microsecond), "ns")
    stamps = base + np.asarray(time_ns, "timedelta64[ns]") + np.timedelta64(whole.microsecond, "us")
    return [f"{s}Z" for s in np.datetime_as_string(stamps, unit="ns")]


def check_duration(seconds: float, *, what: str) -> None:
    """Raise RouteError for a drive of more than `LONGEST_S` seconds; ``what`` takes that long."""
    if not seconds <= LONGEST_S:
        raise RouteError(
            f"{what} takes {seconds / 3600:.1f} hours, and a drive lasts up to {LONGEST_S / 3600:.0f}; record"
            f" several drives, each along a part of it, or its beginning (`duration` {LONGEST_S:.0f})"
        )
