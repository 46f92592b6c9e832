"""Which returns of a dataset a map is made of: by place, time, class, echo, origin and motion."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from pyproj import Transformer

from geoscene.classes import Class
from lidar.dataset.formats.table import Table, rows
from lidar.dataset.ground_truth import read_truth
from lidar.dataset.layout import Dataset, read_rows, reading_file
from lidar.errors import DatasetError, InputError
from lidar.geometry.poses import Trajectory
from lidar.geometry.time_scales import gps_seconds
from lidar.options import MapOptions, classes_of
from lidar.sensors.physics.echoes import Origin

_STEP_DEG = 1e-3
"""Degrees between points of a region's edges, about 100 m: edges are straight in longitude and latitude."""
_ROUNDING = 1e-6
"""Seconds, of GPS times as floating-point numbers."""


class Selection:
    """The returns of a dataset that options ask for.

    trajectory : that places the returns; those of times outside it have no place
    """

    def __init__(
        self, dataset: Dataset, options: MapOptions, *, trajectory: Trajectory | None = None
    ) -> None:
        self._dataset = dataset
        self._options = options
        self._without = classes_of(options.without)
        self._only = classes_of(options.only, option="only")
        self._region = _region(dataset, options)
        self._origins = [int(Origin[name.upper()]) for name in options.origin]
        self._begin = float(gps_seconds(dataset.start, np.zeros(1, np.int64))[0])
        self._placed = None if trajectory is None else trajectory.time_ns[[0, -1]] * 1e-9

    def may_hold(self, start_ns: int, period_ns: int) -> bool:
        """Whether a frame that lasts from ``start_ns`` can have returns within the time of the options."""
        if self._options.time is None:
            return True
        first, last = (seconds * 1e9 for seconds in self._options.time)
        return start_ns < last and start_ns + period_ns > first

    def unwanted(
        self, table: Table, *, name: str, frame: int, row: int
    ) -> Iterable[tuple[str, NDArray[Any]]]:
        """Masks (n,) of the returns to leave out, by reason, in the order in which they are counted.

        name, frame : of the scanner's cloud that the table is from
        row         : of the cloud with which the table begins
        """
        options, label = self._options, table["label"]
        if self._placed is not None:
            seconds, (first, last) = table["gps_time"] - self._begin, self._placed
            yield "poses", ~((seconds >= first - _ROUNDING) & (seconds <= last + _ROUNDING))
        if options.time is not None:
            seconds = table["gps_time"] - self._begin
            yield "time", ~((seconds >= options.time[0]) & (seconds < options.time[1]))
        if self._region is not None:
            yield "region", ~shapely.contains_xy(self._region, table["x"], table["y"])
        if self._only:
            yield "only", ~np.isin(label, self._only)
        if self._without:
            yield "without", np.isin(label, self._without)
        if options.echo != "all":
            echo, echoes = table["echo"], table["echoes"]
            kept = {"first": echo == 1, "last": echo == echoes, "single": echoes == 1}
            yield "echo", ~kept[options.echo]
        if self._origins:
            yield "origin", ~np.isin(self._origin(table, name, frame=frame, row=row), self._origins)
        elif not options.noise:
            yield "noise", label == Class.NOISE
        if "imaged" in table:
            yield "image", ~table["imaged"]
        if not options.moving:
            yield "moving", np.isin(table["instance"], self._moving(name, frame))

    def _origin(self, table: Table, name: str, *, frame: int, row: int) -> NDArray[np.uint8]:
        """Origins (n,) of returns by the truth of stages; without one: surfaces, noise of the receiver."""
        truth = read_truth(self._dataset.frame_file(self._dataset.paths.truth(name, frame)))
        if truth is None:
            noise = table["label"] == Class.NOISE
            return np.where(noise, Origin.RECEIVER, Origin.SURFACE).astype(np.uint8)
        found: NDArray[np.uint8] = truth["origin"][row : row + rows(table)]
        if len(found) != rows(table):
            path = self._dataset.paths.truth(name, frame)
            raise DatasetError(f"{path}: is of fewer returns than the cloud; drive again with `overwrite`")
        return found

    def _moving(self, name: str, frame: int) -> list[int]:
        """Instances of the road users near a frame of a scanner that move during the drive."""
        path = self._dataset.frame_file(self._dataset.paths.frame_boxes(name, frame))
        if not path.exists():  # without road users
            return []
        boxes = read_rows(path)
        with reading_file(path):
            return [int(row["instance"]) for row in boxes if {"True": True, "False": False}[row["moving"]]]


def _region(dataset: Dataset, options: MapOptions) -> Any:
    """The region of the options in the export CRS, prepared for queries; None for everything.

    Raises InputError for a file without polygons.
    """
    areas = []
    if options.bounds_deg is not None:
        areas.append(shapely.box(*options.bounds_deg))
    if options.polygon is not None:
        areas.append(_polygons(options.polygon))
    if not areas:
        return None
    area = shapely.segmentize(shapely.intersection_all(areas), _STEP_DEG)
    transformer = Transformer.from_crs("OGC:CRS84", dataset.crs, always_xy=True)
    projected = shapely.transform(area, lambda lonlat: np.column_stack(transformer.transform(*lonlat.T)))
    shapely.prepare(projected)
    return projected


def _polygons(path: Path) -> Any:
    """The union of the polygons of a GeoJSON file (RFC 7946: longitude and latitude on WGS 84)."""
    try:
        geometry = shapely.from_geojson(path.read_text("utf-8"))
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; `polygon` takes a GeoJSON file") from None
    except (OSError, UnicodeDecodeError, shapely.errors.GEOSException) as error:
        raise InputError(f"{path}: not a readable GeoJSON file ({error})") from error
    parts = shapely.get_parts(shapely.get_parts(geometry))
    found = [part for part in parts if part.geom_type == "Polygon" and not part.is_empty]
    if not found:
        raise InputError(f"{path}: no polygons in it; `polygon` takes a GeoJSON file with polygons")
    low, high = (
        np.array([part.bounds for part in found])[:, :2],
        np.array([part.bounds for part in found])[:, 2:],
    )
    if (np.abs([low[:, 0], high[:, 0]]) > 180).any() or (np.abs([low[:, 1], high[:, 1]]) > 90).any():
        raise InputError(f"{path}: not in degrees; GeoJSON has longitude and latitude on WGS 84")
    return shapely.union_all(shapely.make_valid(found))
