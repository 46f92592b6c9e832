"""Files of satellite receivers and inertial units, after stages on them, and readers of the same files."""

from __future__ import annotations

import re
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geoscene.typing import Float
from lidar.dataset.layout import Paths, read_rows, reading_file
from lidar.sensors.navigation.measurements import NAMES, STATES, Fixes, Inertial
from lidar.sensors.navigation.nmea import satellites_used


@dataclass(frozen=True, slots=True)
class FixHeights:
    """Vertical reference of the heights of fixes.

    vertical   : as in `geoscene.geometry.frames.Frame`
    separation : (n,) metres, geoid above the ellipsoid at each fix; None if unknown
    geoid      : its name, or empty
    """

    vertical: str
    separation: Float | None = None
    geoid: str = ""


def read_fixes(paths: Paths, name: str, *, vertical: str) -> tuple[Fixes, FixHeights]:
    """The fixes of a receiver of a dataset, and the vertical reference of their heights.

    vertical : of the dataset's frame

    Errors against the truth are NaN. Raises DatasetError for files that cannot be read.
    """
    path, sentences = paths.measurements(name), paths.measurements(name, ".nmea")
    rows = read_rows(path)
    with reading_file(path):
        columns = {key: np.array([row[key] for row in rows]) for key in (rows[0] if rows else _EMPTY)}
        value = {key: column.astype(np.float64) for key, column in columns.items() if key not in _TEXTS}
        quality = columns["quality"].astype(np.int8)
    with reading_file(sentences):
        note, *lines = sentences.read_text("utf-8-sig").splitlines()
        names, used, pdop = satellites_used(lines, count=len(rows))
    found = re.search(r"separation of (.*)\)", note)
    fixes = Fixes(
        time_ns=columns["time_ns"].astype(np.int64),
        state=_state(quality),
        quality=quality,
        satellites=columns["satellites"].astype(np.int8),
        dop=np.column_stack([value["hdop"], value["vdop"], pdop]),
        lonlath=np.column_stack([value[key] for key in ("lon", "lat", "h")]),
        speed=value["speed"],
        course=_radians(value["course_deg"]),
        error=np.full((len(rows), 3), np.nan),
        true_lonlath=np.column_stack([value[key] for key in ("true_lon", "true_lat", "true_h")]),
        true_velocity=np.column_stack([value[key] for key in ("true_east", "true_north", "true_up")]),
        used=used,
        names=names,
    )
    return fixes, FixHeights(vertical, value.get("geoid"), found[1] if found else "")


_TEXTS = ("timestamp", "h_above", "time_ns", "quality", "satellites")
_EMPTY = (
    *("timestamp", "time_ns", "lon", "lat", "h", "speed", "course_deg", "quality", "satellites", "hdop"),
    *("vdop", "true_lon", "true_lat", "true_h", "true_east", "true_north", "true_up", "h_above"),
)


def _radians(degrees: Float) -> Float:
    """Angles (n,) in radians that convert back to the given degrees bit for bit, where possible."""
    found = np.radians(degrees)
    for ulps in (-2, -1, 1, 2):
        near = found + ulps * np.spacing(found)
        found = np.where((np.degrees(near) == degrees) & (np.degrees(found) != degrees), near, found)
    return found


def _state(quality: NDArray[np.int8]) -> NDArray[np.int8]:
    """Rows (n,) of `NAMES` of the states with a quality, the first of several."""
    table = [next(k for k, name in enumerate(NAMES) if STATES[name].quality == q) for q in (0, 1, 2, 4, 5)]
    return np.array(table, np.int8)[np.searchsorted((0, 1, 2, 4, 5), quality)]


_SAMPLES = (
    "time_ns",
    *(f"{name}_{c}" for name in ("gyro", "accel", "true_gyro", "true_accel") for c in "xyz"),
)


def read_samples(path: Path) -> Inertial:
    """The samples of an inertial unit of a dataset.

    Raises DatasetError for a file that cannot be read.
    """
    with reading_file(path), path.open(encoding="utf-8-sig") as file, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of a file without samples
        names = next(file, "").rstrip("\n").split(",")
        columns = [names.index(name) for name in _SAMPLES]
        values = np.loadtxt(file, delimiter=",", usecols=columns, ndmin=2).reshape(-1, len(columns))
        if not (sound := np.isfinite(values).all(axis=1)).all():
            raise ValueError(f"line {sound.argmin() + 2} has a number that is not finite")
        return Inertial(values[:, 0].astype(np.int64), *np.split(values[:, 1:], 4, axis=1))
