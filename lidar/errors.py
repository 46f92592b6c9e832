"""Errors of lidar; messages name parameters as in `geoscene.errors`."""

from __future__ import annotations

import geoscene.errors


class LidarError(Exception):
    """Base class of this package's errors; the command line shows one line and exits with code 1."""


class InputError(LidarError, ValueError):
    """The user's input or options cannot be used; the command line exits with code 2."""


class RouteError(InputError):
    """A route that cannot be driven on the scene's road graph."""


class OffStreetError(RouteError):
    """Waypoints without a drivable street nearby.

    places : scene metres (x, y) of waypoints that the message names and that nothing explains yet
    """

    def __init__(self, message: str, places: list[list[float]]) -> None:
        super().__init__(message)
        self.places = places


class BlockedError(RouteError):
    """A route that bends too tightly for the vehicle, or on which its body would touch an obstacle.

    turns : pairs of successive edges of the road graph that a detour must avoid; an edge twice if it must
            avoid the edge itself
    """

    def __init__(self, message: str, turns: list[tuple[int, int]]) -> None:
        super().__init__(message)
        self.turns = turns


class RigError(InputError):
    """A rig or sensor description with an error."""


class FormatError(InputError):
    """A file that cannot be read as the format of its name."""


class DamagedFileError(FormatError, geoscene.errors.DamagedFileError):
    """A LAS, LAZ or COPC file that does not hold what it states; the command line exits with code 1."""


class DatasetError(InputError):
    """A folder that is not a dataset, or one made with other options."""


class BackendError(LidarError):
    """A ray-casting backend that is missing or gives wrong answers."""
