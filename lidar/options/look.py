"""Options of presentations of recorded data: players, figures and films."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

from cyclopts import Parameter, Token

from geoscene.support.console import SEVERAL, only_value, whole
from geoscene.support.option_values import take_values
from lidar.errors import InputError
from lidar.options.shared import check_positive, check_words, lower

SHOWN = ("all", "sweep", "cameras", "map")
"""What a film can show."""

FILM_VIEWS = ("chase", "top")
"""Where a film looks at sweeps from."""

FILM_COLORS = ("class", "height", "intensity", "time", "origin")
"""What colours of returns in a film can show."""


def _pixels(_: object, tokens: Sequence[Token]) -> tuple[int, int]:
    found = re.fullmatch(r"(\d{1,5})x(\d{1,5})", only_value(tokens).strip().lower())
    if not found:
        raise ValueError("give WIDTHxHEIGHT in pixels, such as 1280x720")
    return int(found[1]), int(found[2])


class _OfFrames:
    """Base of options with ``frames``, a text FIRST:END."""

    __slots__ = ()
    frames: str

    @property
    def limits(self) -> tuple[int, float]:
        """The first frame, and the one after the last; infinity for all further ones.

        Raises InputError for another text.
        """
        if not re.fullmatch(r"(\d*:\d*)?", self.frames):
            raise InputError(f"`frames` {self.frames}: give FIRST:END, such as 100:200, 100: or :200")
        first, _, end = self.frames.partition(":")
        return int(first or 0), int(end) if end else math.inf


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class PlaybackOptions(_OfFrames):
    """Options of the page that plays a drive."""

    sensors: Annotated[tuple[str, ...], Parameter(name="--sensor"), SEVERAL] = ()
    """Names of scanners and of cameras to show; by default the first scanner and the first camera with
    images. Frames are those of the first scanner named."""

    frames: str = ""
    """FIRST:END: frames from FIRST up to, not including, END, either of which may be left out; all by
    default."""

    every: Annotated[int | None, Parameter(converter=whole)] = None
    """Show each n-th of these frames only; by default all, or as many as fit `max_mb`."""

    max_mb: Annotated[float, Parameter(name="--max-size")] = 40.0
    """Maximum size of the page in megabytes."""

    def __post_init__(self) -> None:
        """Validate the options."""
        take_values(self, error=InputError)
        _ = self.limits
        if self.every is not None and self.every < 1:
            raise InputError(f"`every` {self.every}: give 1 or more")
        check_positive(self, max_mb=" of megabytes")


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class PlotOptions(_OfFrames):
    """Options of a figure of a dataset."""

    sensor: str = ""
    """Scanner or receiver; by default the first one, for coverage all scanners."""

    frames: str = ""
    """FIRST:END: frames from FIRST up to, not including, END, either of which may be left out; all by
    default. range-image shows the first of them."""

    resolution: float | None = None
    """Side of the cells of coverage in metres; by default as fits the picture."""

    def __post_init__(self) -> None:
        """Validate the options."""
        take_values(self, error=InputError)
        _ = self.limits
        check_positive(self, resolution=" of metres")


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class FilmOptions(_OfFrames):
    """Options of a film of a dataset."""

    show: Annotated[str, Parameter(converter=lower)] = "all"
    """What the film shows: sweep, cameras, map (which grows), or all of these that the dataset has."""

    view: Annotated[str, Parameter(converter=lower)] = "chase"
    """Sweeps from behind the vehicle (chase) or from above (top)."""

    color: Annotated[str, Parameter(converter=lower)] = "class"
    """What colours of returns show: class, height, intensity, time (in the sweep) or origin (where stages
    acted)."""

    sensors: Annotated[tuple[str, ...], Parameter(name="--sensor"), SEVERAL] = ()
    """Names of scanners and cameras to show; by default the first scanner and all cameras with images."""

    frames: str = ""
    """FIRST:END: frames from FIRST up to, not including, END, either of which may be left out; all by
    default. They are of the first scanner, or of the first camera in films of cameras only."""

    every: Annotated[int, Parameter(converter=whole)] = 1
    """Show each n-th of these frames only."""

    speed: float = 1.0
    """Seconds of the drive per second of the film."""

    size: Annotated[tuple[int, int], Parameter(converter=_pixels, n_tokens=1, metavar="WxH")] = (1280, 720)
    """Width and height of the film in pixels, both even."""

    def __post_init__(self) -> None:
        """Validate the options."""
        take_values(self, error=InputError)
        check_words(self, show=SHOWN, view=FILM_VIEWS, color=FILM_COLORS)
        _ = self.limits
        if self.every < 1:
            raise InputError(f"`every` {self.every}: give 1 or more")
        check_positive(self, speed="")
        if any(side % 2 or not 160 <= side <= 8192 for side in self.size):
            raise InputError(
                f"`size` {self.size[0]}x{self.size[1]}: give even numbers of pixels from 160 to 8192"
            )
