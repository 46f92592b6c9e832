"""Everything lidar raises on purpose; messages name parameters as in `geoscene.errors`."""

from __future__ import annotations


class LidarError(Exception):
    """Root of what this package raises on purpose; the command line shows it as one line, exit code 1."""


class InputError(LidarError, ValueError):
    """The user's input or options cannot be used; the command line exits with code 2."""


class RouteError(InputError):
    """A route that cannot be driven on the scene's road graph."""


class BlockedError(RouteError):
    """A route that bends too tightly for the vehicle, or on which its body would touch an obstacle.

    turns : pairs of edges of the road graph that a detour must not take one after the other; an edge twice,
            if it must not be taken at all
    """

    def __init__(self, message: str, turns: list[tuple[int, int]]) -> None:
        super().__init__(message)
        self.turns = turns


class RigError(InputError):
    """A rig or sensor description with a mistake in it."""


class FormatError(InputError):
    """A file that is not what its name says."""


class DatasetError(InputError):
    """A folder that is not a dataset, or one made with other options."""


class BackendError(LidarError):
    """A ray-casting backend that is missing or gives wrong answers."""
