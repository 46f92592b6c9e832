"""NMEA 0183 sentences of fixes: GGA, RMC, VTG and GSA, in version 4.10; the geoid of their heights."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta

import numpy as np
from numpy.typing import NDArray
from pyproj import Transformer
from pyproj.exceptions import ProjError

from geoscene.typing import Float
from lidar.sensors.navigation.measurements import Fixes

HEIGHTS = {"flat": "an assumed level ground", "orthometric": "the geoid", "ellipsoidal": "the ellipsoid"}
"""What heights are above, by `geoscene.geometry.frames.Frame.vertical`."""
KNOT = 1852.0 / 3600.0
"""Metres per second in a knot."""
_SYSTEMS = {"G": ("GP", 1, 0), "R": ("GL", 2, 64), "E": ("GA", 3, 0), "C": ("GB", 4, 0)}
"""Talker, system number and offset of satellite numbers, by the letter of the system."""
_MODES = {0: "N", 1: "A", 2: "D", 4: "R", 5: "F"}  # NMEA's mode by fix quality


def checksum(body: str) -> str:
    """Checksum: exclusive or of the characters between $ and *, as two hexadecimal digits."""
    total = 0
    for byte in body.encode("ascii"):
        total ^= byte
    return f"{total:02X}"


def sentence(body: str) -> str:
    """A complete sentence, with checksum, carriage return and line feed."""
    return f"${body}*{checksum(body)}\r\n"


def latitude(deg: float) -> str:
    """Latitude in degrees as ``ddmm.mmmmmm,N``; only the comma if it is NaN."""
    return _angle(deg, 2, signs="NS")


def longitude(deg: float) -> str:
    """Longitude in degrees as ``dddmm.mmmmmm,E``; only the comma if it is NaN."""
    return _angle(deg, 3, signs="EW")


def _angle(deg: float, digits: int, *, signs: str) -> str:
    if not math.isfinite(deg):
        return ","
    micro = round(abs(deg) * 60e6)  # whole millionths of a minute: 59.9999999 never prints as 60
    degrees, minutes = divmod(micro, 60_000_000)
    return f"{degrees:0{digits}d}{minutes / 1e6:09.6f},{signs[deg < 0]}"


def _number(value: float, decimals: int) -> str:
    return f"{value:.{decimals}f}" if math.isfinite(value) else ""


def height_note(vertical: str, geoid: str = "") -> str:
    """A TXT sentence that says what the heights in GGA are above.

    vertical : as in `geoscene.geometry.frames.Frame`
    geoid    : name of the geoid that `nmea` is given, or empty
    """
    text = f"heights above {HEIGHTS[vertical]}"
    if geoid:
        text = f"heights above the geoid (separation of {geoid})"
    return sentence(f"GNTXT,01,01,02,{text}")


def nmea(
    fixes: Fixes, start: datetime, *, vertical: str = "flat", separation: Float | None = None
) -> Iterator[str]:
    """Sentences for each fix: GGA, RMC, VTG, and a GSA for each system; at most 82 characters each.

    The talker is GN for a receiver of several systems, else that of its system. GSA lists at most twelve
    satellites of a system (GLONASS from 65 on) and ends with the number of the system.

    start      : UTC of the drive's start; sentences carry UTC
    vertical   : reference of the fixes' heights, as in `geoscene.geometry.frames.Frame`
    separation : (n,) heights of the geoid above the ellipsoid, metres, for GGA, whose heights are then above
                 the geoid. Without it, heights are unchanged and the field is empty

    Fields of a missing fix are empty.
    """
    known = np.full(len(fixes), np.nan) if separation is None else separation
    for k in range(len(fixes)):
        when = start + timedelta(microseconds=round(int(fixes.time_ns[k]) / 1000))
        height = fixes.lonlath[k, 2]
        if vertical == "ellipsoidal" and math.isfinite(known[k]):
            height -= known[k]
        yield from _epoch(fixes, k, when=when, height=float(height), separation=float(known[k]))


def _epoch(fixes: Fixes, k: int, *, when: datetime, height: float, separation: float) -> Sequence[str]:
    lon, lat, _ = fixes.lonlath[k].tolist()
    quality, fixed = int(fixes.quality[k]), math.isfinite(lon)
    hundredths = round(when.microsecond / 1e4)
    if hundredths == 100:
        when, hundredths = when + timedelta(seconds=1), 0
    clock, day = f"{when:%H%M%S}.{hundredths:02d}", f"{when:%d%m%y}"
    place = f"{latitude(lat)},{longitude(lon)}"
    pdop, hdop, vdop = (_dop(fixes.dop[k, i]) for i in (2, 0, 1))
    geoid = _number(separation, 1) if fixed else ""
    speed = float(fixes.speed[k]) if fixed else math.nan
    course = _number(math.degrees(fixes.course[k]) % 360.0, 1) if fixed else ""
    course = "0.0" if course == "360.0" else course
    mode = _MODES[quality]
    used = fixes.names[fixes.used[k]].tolist() if fixed else []
    letters = list(dict.fromkeys(name[0] for name in fixes.names.tolist()))
    talker = "GN" if len(letters) > 1 else _SYSTEMS[letters[0]][0]
    dimension = 3 if fixed else 1
    active = []
    for letter in letters:
        _, system, added = _SYSTEMS[letter]
        own = [int(name[1:]) + added for name in used if name[0] == letter][:12]
        prn = ",".join(f"{p:02d}" for p in own) + "," * (12 - max(len(own), 1))
        active.append(sentence(f"{talker}GSA,A,{dimension},{prn},{pdop},{hdop},{vdop},{system}"))
    return [
        sentence(
            f"{talker}GGA,{clock},{place},{quality},{int(fixes.satellites[k]):02d},{hdop},"
            f"{_number(height, 3)},M,{geoid},M,,"
        ),
        sentence(
            f"{talker}RMC,{clock},{'A' if fixed else 'V'},{place},{_number(speed / KNOT, 3)},"
            f"{course},{day},,,{mode}"
        ),
        sentence(
            f"{talker}VTG,{course},T,,M,{_number(speed / KNOT, 3)},N,{_number(speed * 3.6, 3)},K,{mode}"
        ),
        *active,
    ]


def satellites_used(lines: Sequence[str], *, count: int) -> tuple[NDArray[np.str_], NDArray[np.bool_], Float]:
    """Names (k,) of satellites, which are used (n, k), and PDOP (n,), of `count` fixes, from their sentences.

    At most twelve satellites of a system; of a system that is never used there is one, which is not used.
    Raises ValueError for sentences of another number of fixes.
    """
    letters = {str(number): letter for letter, (_, number, _) in _SYSTEMS.items()}
    epoch, found, pdop = -1, [], np.full(count, np.nan)
    names: dict[str, dict[str, None]] = {}
    for line in lines:
        fields = line.partition("*")[0].split(",")
        epoch += fields[0].endswith("GGA")
        if not fields[0].endswith("GSA"):
            continue
        letter = letters[fields[18]]
        own = names.setdefault(letter, {})
        for text in filter(None, fields[3:15]):
            name = f"{letter}{int(text) - _SYSTEMS[letter][2]:02d}"
            own[name] = None
            found.append((epoch, name))
        if fields[15]:
            pdop[epoch] = float(fields[15])
    if epoch + 1 != count:
        raise ValueError(f"sentences of {epoch + 1} fixes, where there are {count}")
    columns = [name for letter, own in names.items() for name in sorted(own) or [f"{letter}00"]]
    used = np.zeros((count, len(columns)), bool)
    column = {name: k for k, name in enumerate(columns)}
    for row, name in found:
        used[row, column[name]] = True
    return np.array(columns, np.str_), used, pdop


def _dop(value: float) -> str:
    return f"{min(value, 99.9):.1f}" if math.isfinite(value) else ""


_MODELS = {"EGM2008": "EPSG:9518", "EGM96": "EPSG:9707"}  # WGS 84 with heights above each geoid


@dataclass(frozen=True, slots=True)
class Geoid:
    """Separation (n,) in metres of a geoid from the WGS 84 ellipsoid, upwards, and the geoid's name."""

    name: str
    separation: Float


def geoid_at(lon: Float, lat: Float) -> Geoid | None:
    """The geoid at longitudes and latitudes (n,) in degrees; None if PROJ has a grid of neither model.

    EGM2008, else EGM96: `projsync --file us_nga_egm96_15` installs a grid.
    """
    for name, code in _MODELS.items():
        try:
            turned = Transformer.from_crs(
                "EPSG:4979", code, always_xy=True, allow_ballpark=False, only_best=True
            )
            height = turned.transform(lon, lat, np.zeros(len(lon)))[2]
        except ProjError:
            continue
        separation = -np.asarray(height, float)
        if np.isfinite(separation).all():
            return Geoid(name, separation)
    return None
