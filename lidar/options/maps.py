"""Options of maps of recorded clouds."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter, Token

from geoscene.classes import Class
from geoscene.options import Degrees
from geoscene.support.console import SEVERAL, WORDS, degrees, numbers, only_value, whole
from geoscene.support.option_values import take_values
from geoscene.support.registry import unknown_name
from lidar.errors import InputError
from lidar.options.shared import check_positive, check_words

COLORS = ("class", "height", "intensity", "sensor", "image")
"""What red, green and blue of a map can show."""

TILE_FORMATS = ("laz", "las", "copc")
"""Formats of the tiles of a map."""

LARGEST_TILE = 1_000_000
"""Metres."""

MOST_NEIGHBOURS = 500
"""Neighbours by which outliers are found."""

RASTERS = ("dsm", "dtm", "density", "intensity")
"""Rasters of a map."""

ORIGINS = ("surface", "weather", "interference", "injected", "replayed", "moved", "receiver")
"""Origins of returns, `lidar.sensors.physics.echoes.Origin` in lower case."""

ECHOES = ("all", "first", "last", "single")
"""Echoes of a pulse that a map can be made of."""


_SPAN = numbers(2, "two numbers of seconds as FROM,TO")


def _outliers(_: object, tokens: Sequence[Token]) -> tuple[int, float]:
    with suppress(ValueError):
        neighbours, factor = only_value(tokens).split(",")
        return int(neighbours), float(factor)
    raise ValueError("give a number of neighbours and a factor, once, such as 16,2")


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class MapOptions:
    """Options of an aggregated map."""

    voxel: float | None = None
    """Keep only the return nearest to the centre of each cube with this side in metres; all by default."""

    color: str = "class"
    """What colours show: class, height, intensity, sensor, or image (what cameras saw of each point; those
    that none saw are left out)."""

    sensors: Annotated[tuple[str, ...], Parameter(name="--sensor"), SEVERAL] = ()
    """Names of the scanners to use; all by default."""

    noise: bool = False
    """Keep returns of class noise: false alarms and mirror images."""

    moving: bool = False
    """Keep returns of road users that move during the drive; they leave trails."""

    without: Annotated[tuple[str, ...], WORDS] = ()
    """Classes of returns to leave out, separated by commas: names that lidar classes lists, or vehicles,
    which are all of them, parked ones too."""

    only: Annotated[tuple[str, ...], WORDS] = ()
    """Classes of returns to use, by the same names; all by default."""

    bounds_deg: Annotated[Degrees | None, Parameter(name="--bbox"), degrees("W,S,E,N")] = None
    """Use returns in this box only: degrees on WGS 84."""

    polygon: Path | None = None
    """Use returns in the polygons of this GeoJSON file only; with --bbox, in both."""

    time: Annotated[tuple[float, float] | None, Parameter(converter=_SPAN, n_tokens=1, metavar="FROM,TO")] = (
        None
    )
    """Use returns of this time only: seconds since the drive's start, the end excluded."""

    echo: str = "all"
    """Echoes of each pulse to use: all, first, last, or single (of pulses with one echo)."""

    origin: Annotated[tuple[str, ...], WORDS] = ()
    """Origins of returns to use, separated by commas, by the ground truth of stages: surface, weather,
    interference, injected, replayed, moved, receiver; all by default, but for noise."""

    poses: str = "truth"
    """Poses that place the points: truth, or FILE.tum: a trajectory of the vehicle, such as lidar odometry
    writes."""

    outliers: Annotated[
        tuple[int, float] | None,
        Parameter(converter=_outliers, n_tokens=1, metavar="NEIGHBOURS,FACTOR"),
    ] = None
    """Leave out returns whose mean distance to this many neighbours is above the map's mean by more than
    FACTOR standard deviations; after --voxel."""

    tiles: Annotated[int | None, Parameter(converter=whole)] = None
    """Write a file for each square of the projected grid with this side in whole metres, and an index, to the
    folder that --out names."""

    tile_format: str = "laz"
    """Format of the tiles: laz, las or copc."""

    raster: Annotated[tuple[str, ...], WORDS] = ()
    """Rasters to write beside the map as GeoTIFF, separated by commas: dsm (highest return), dtm (mean height
    of the ground's returns), density (returns per square metre), intensity (mean)."""

    resolution: float = 0.5
    """Side of the rasters' cells in metres."""

    compare: Path | None = None
    """Scene to compare with: distances from the map's points to its surfaces, as a table and a picture beside
    the map."""

    def __post_init__(self) -> None:
        """Validate the options."""
        take_values(self, error=InputError)
        check_words(self, color=COLORS, echo=ECHOES, tile_format=TILE_FORMATS)
        check_positive(self, voxel=" of metres", resolution=" of metres")
        if self.outliers is not None:
            neighbours, factor = self.outliers
            if not (1 <= neighbours <= MOST_NEIGHBOURS and factor >= 0):
                raise InputError(
                    f"`outliers` {neighbours},{factor:g}: give 1 to {MOST_NEIGHBOURS} neighbours and a"
                    " factor of 0 or more"
                )
        if self.tiles is not None and not 1 <= self.tiles <= LARGEST_TILE:
            raise InputError(f"`tiles` {self.tiles}: give 1 to {LARGEST_TILE} metres")
        classes_of(self.without)
        classes_of(self.only, option="only")
        check_words(self, origin=ORIGINS, raster=RASTERS)
        if self.poses != "truth" and not self.poses.lower().endswith(".tum"):
            raise InputError(
                f"`poses` {self.poses}: give truth or FILE.tum; lidar odometry --method fused writes"
                " trajectory.tum by receivers, inertial units and scanners"
            )
        if self.time is not None and not self.time[0] < self.time[1]:
            raise InputError(f"`time` {self.time[0]:g},{self.time[1]:g}: ends before it begins")
        if self.bounds_deg is not None:
            west, south, east, north = self.bounds_deg
            if not (-180 <= west < east <= 180 and -90 <= south < north <= 90):
                raise InputError("`bounds_deg`: give west, south, east and north in degrees, in this order")


def classes_of(names: Iterable[str], *, option: str = "without") -> list[int]:
    """Codes of classes by name; ``vehicles`` stands for all of them, with and without riders.

    option : that names them, for errors

    Raises InputError for an unknown name.
    """
    vehicles = [k for k in Class if Class.CAR <= k <= Class.MOTORCYCLIST and k != Class.PEDESTRIAN]
    known = {k.name.lower(): [k] for k in Class} | {"vehicles": vehicles}
    for name in names:
        if name not in known:
            remedy = "lidar classes lists all names; vehicles is one, too"
            raise InputError(unknown_name(f"`{option}`", name, known=known, remedy=remedy))
    return [int(code) for name in names for code in known[name]]
