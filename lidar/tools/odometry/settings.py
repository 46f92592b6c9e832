"""Settings of odometry methods: their defaults, bounds and texts."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from geoscene.errors import reason_of
from geoscene.support.untrusted import read_toml
from lidar.errors import InputError
from lidar.parameters import check_parameters, parameter, read_values


@dataclass(frozen=True, slots=True)
class OdometrySettings:
    """Settings of odometry; docs/reference/odometry.md lists them."""

    min_range: float = parameter(
        3.0, "range of a scanner, below which points are left out", unit="m", low=0, high=1000
    )
    max_range: float = parameter(
        0.0,
        "range of a scanner, beyond which none are used; 0: its own, at most 100",
        unit="m",
        low=0,
        high=1e4,
    )
    voxel: float = parameter(
        0.0,
        "side of the map's cells; 0: max_range / 100 (kiss-icp), 0.3 (genz-icp), 0.25 (small_gicp)",
        unit="m",
        low=0,
        high=100,
    )
    acceleration: float = parameter(
        3.0,
        "acceleration that the motion of the sweep or image before leaves open",
        unit="m/s^2",
        low=1e-3,
        high=1e3,
    )
    turn_acceleration: float = parameter(1.0, "the same of turns", unit="rad/s^2", low=1e-3, high=1e3)
    features: int = parameter(500, "ORB features of an image", low=50, high=20000)
    pixel: float = parameter(1.0, "standard deviation of a feature's place", unit="pixels", low=0.05, high=20)
    ransac: int = parameter(200, "trials of three points for a pose", low=10, high=100000)
    keyframe_matches: float = parameter(
        0.7, "share of a keyframe's matches, below which the next frame is a keyframe", low=0.05, high=1
    )
    window: int = parameter(6, "keyframes that are refined together; 0: no refinement", low=0, high=50)
    loop_distance: float = parameter(
        15.0,
        "distance of keyframes that may show the same place; 0: no loops are sought",
        unit="m",
        low=0,
        high=1e4,
    )
    loop_path: float = parameter(
        30.0, "least length of the way between such keyframes", unit="m", low=1, high=1e6
    )
    depth_radius: float = parameter(
        12.0, "distance from a feature in which laser points tell its depth", unit="pixels", low=1, high=200
    )
    knot_s: float = parameter(
        0.2, "time between the poses of a fusion without odometry", unit="s", low=0.01, high=10
    )
    gate: float = parameter(
        0.999, "probability that a fix without fault passes the chi-square test", low=0.5, high=0.999999
    )
    correlation_s: float = parameter(
        10.0, "time for which the errors of fixes are taken as the same", unit="s", low=0, high=3600
    )

    def __post_init__(self) -> None:
        """Validate the settings; one InputError names all faults."""
        check_parameters(self)


def read_settings(pairs: Iterable[tuple[str, str]], *, path: Path | None = None) -> OdometrySettings:
    """Settings that differ from the defaults by a TOML file, and by names and values as text after it.

    Raises InputError for unknown names, other values, and a file that cannot be read.
    """
    values = {} if path is None else _values(_file_table(path), where=f"{path}: ")
    return OdometrySettings(**values | _values(dict(pairs), where="`settings` "))


def _values(given: dict[str, Any], *, where: str) -> dict[str, Any]:
    """Values of settings, which are valid; errors begin with where they were given."""
    try:
        values = read_values(OdometrySettings, given)
        OdometrySettings(**values)
    except InputError as error:
        raise InputError(f"{where}{error}") from None
    return values


def _file_table(path: Path) -> dict[str, Any]:
    try:
        return read_toml(path.read_text("utf-8-sig"))
    except (OSError, ValueError) as error:
        raise InputError(f"`settings_file` {path}: not a readable TOML file ({reason_of(error)})") from None
