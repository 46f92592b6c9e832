"""Settings of odometry methods: their defaults, bounds and texts."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Iterable
from dataclasses import dataclass, field, fields, replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from lidar.errors import InputError


def _setting(default: float, meaning: str, *, low: float, high: float) -> Any:
    return field(default=default, metadata={"meaning": meaning, "low": low, "high": high})


@dataclass(frozen=True, slots=True)
class OdometrySettings:
    """Settings of odometry; docs/reference/odometry.md lists them."""

    min_range: float = _setting(
        3.0, "metres from a scanner, below which points are left out", low=0, high=1000
    )
    max_range: float = _setting(
        0.0,
        "metres from a scanner, beyond which none are used; 0: its range, at most 100",
        low=0,
        high=1e4,
    )
    voxel: float = _setting(
        0.0,
        "metres, of the map; 0: max_range / 100 (kiss-icp), 0.3 (genz-icp), 0.25 (small_gicp)",
        low=0,
        high=100,
    )
    acceleration: float = _setting(
        3.0, "m/s^2, which the motion of the sweep or image before leaves open", low=1e-3, high=1e3
    )
    turn_acceleration: float = _setting(1.0, "rad/s^2, likewise", low=1e-3, high=1e3)
    features: int = _setting(500, "ORB features of an image", low=50, high=20000)
    pixel: float = _setting(1.0, "pixels: standard deviation of a feature's place", low=0.05, high=20)
    ransac: int = _setting(200, "trials of three points for a pose", low=10, high=100000)
    keyframe_matches: float = _setting(
        0.7, "share of a keyframe's matches, below which the next frame is a keyframe", low=0.05, high=1
    )
    window: int = _setting(6, "keyframes that are refined together; 0: no refinement", low=0, high=50)
    loop_distance: float = _setting(
        15.0, "metres between keyframes that may show the same place; 0: no loops are sought", low=0, high=1e4
    )
    loop_path: float = _setting(30.0, "metres of way between such keyframes, at least", low=1, high=1e6)
    depth_radius: float = _setting(
        12.0, "pixels around a feature in which laser points tell its depth", low=1, high=200
    )
    knot_s: float = _setting(0.2, "seconds between the poses of a fusion without odometry", low=0.01, high=10)
    gate: float = _setting(
        0.999, "probability that a fix without fault passes the chi-square test", low=0.5, high=0.999999
    )
    correlation_s: float = _setting(
        10.0, "seconds for which the errors of fixes are taken as the same", low=0, high=3600
    )


def read_settings(pairs: Iterable[tuple[str, str]], *, path: Path | None = None) -> OdometrySettings:
    """Settings that differ from the defaults by a TOML file, and by names and values as text after it.

    Raises InputError for unknown names, other values, and a file that cannot be read.
    """
    changes: list[tuple[str, Any, str]] = []
    if path is not None:
        try:
            table = tomllib.loads(path.read_text("utf-8"))
        except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
            why = error.strerror if isinstance(error, OSError) else error
            raise InputError(f"`settings_file` {path}: not a readable TOML file ({why})") from None
        changes += [(name, value, f"{path}: ") for name, value in table.items()]
    changes += [(name, text, "`settings` ") for name, text in pairs]
    known = {f.name: f for f in fields(OdometrySettings)}
    values: dict[str, Any] = {}
    for name, value, where in changes:
        if name not in known:
            near = get_close_matches(name, sorted(known), 3, 0.5)
            hint = f"is {' or '.join(near)} meant? " if near else ""
            raise InputError(f"{where}{name}: unknown; {hint}There are {', '.join(known)}")
        values[name] = _number(value, where=f"{where}{name}", of=known[name])
    return replace(OdometrySettings(), **values)


def _number(value: Any, *, where: str, of: Any) -> float | int:
    """A value as the number of a setting; raises InputError if it is none or out of bounds."""
    low, high, whole = of.metadata["low"], of.metadata["high"], isinstance(of.default, int)
    try:
        number = float(value) if not isinstance(value, bool) else math.nan
    except (TypeError, ValueError):
        number = math.nan
    if not low <= number <= high or (whole and number != int(number)):
        kind = "a whole number" if whole else "a number"
        raise InputError(f"{where} {value}: give {kind} from {low:g} to {high:g}")
    return int(number) if whole else number
