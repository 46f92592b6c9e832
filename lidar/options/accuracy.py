"""Options by which settings are picked and compared: accuracies, budgets, samples."""

from __future__ import annotations

import math
import re
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Annotated

from cyclopts import Parameter

from geoscene.support.console import SEVERAL, WORDS, whole
from geoscene.support.option_values import take_values
from lidar.errors import InputError
from lidar.options.shared import check_whole

PERCENTS = (50.0, 68.0, 90.0, 95.0, 99.0, 99.9)
"""Percent of the returns, or of the pixels with a depth, that an accuracy may be asked for."""

_ACCURACY = re.compile(r"([\d.]+) ?(um|µm|mm|cm|m|levels?)(?:@([\d.]+) ?%?)?")
_METRES = {"um": 1e-6, "µm": 1e-6, "mm": 1e-3, "cm": 1e-2, "m": 1.0}


@dataclass(frozen=True, slots=True)
class AccuracyTarget:
    """Maximum errors of the sensors of a drive; 0 without a limit.

    text    : as it was asked for
    metres  : error of ranges of scanners, and of depths of cameras
    percent : share of the returns or pixels to which it applies, of `PERCENTS`
    levels  : rms error of colours of cameras, levels of 255
    """

    text: str
    metres: float = 0.0
    percent: float = 99.9
    levels: float = 0.0


def read_accuracy(text: str) -> AccuracyTarget:
    """An accuracy of a text such as ``1cm``, ``5mm@99``, ``3levels`` or ``1cm,3levels``.

    Raises InputError for others.
    """
    asked = AccuracyTarget(text.strip())
    for part in text.lower().split(","):
        found = _ACCURACY.fullmatch(part.strip())
        size = 0.0
        with suppress(ValueError):  # of numbers with two points
            size = float(found[1]) if found else 0.0
        if found and found[2].startswith("level"):
            if not 0 < size <= 255 or found[3]:
                raise InputError(f"`accuracy` {text}: give levels of 255, rms, as in 3levels")
            given, asked = asked.levels, replace(asked, levels=size)
        else:
            metres = size * _METRES[found[2]] if found else 0.0
            if not found or not 1e-6 <= metres <= 1000:
                raise InputError(
                    f"`accuracy` {text}: give a length and its unit, as in 1cm, 5mm@99 or 0.1m, levels of"
                    " colours, as in 3levels, or both, as in 1cm,3levels"
                )
            given, asked = asked.metres, replace(asked, metres=metres, percent=_percent(text, found[3]))
        if given:
            raise InputError(f"`accuracy` {text}: give one length and one number of levels at most")
    return asked


def _percent(text: str, share: str | None) -> float:
    """Percent of the returns, of `PERCENTS`."""
    percent = 99.9
    with suppress(ValueError):
        percent = float(share) if share else percent
        if percent in PERCENTS:
            return percent
    among = ", ".join(f"{p:g}" for p in PERCENTS)
    raise InputError(f"`accuracy` {text}: after the @ give one of {among} percent of the returns")


def read_budget(text: str) -> float:
    """Simulated seconds per second, of a text such as ``2x-realtime``; raises InputError for others."""
    found = re.fullmatch(r"(\d+\.?\d*|\.\d+)x-realtime", text.strip().lower())
    speed = float(found[1]) if found else 0.0
    if not 0 < speed < math.inf:
        raise InputError(f"`budget` {text}: give a speed such as 2x-realtime or 0.5x-realtime")
    return speed


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class AccuracyOptions:
    """Options by which rays of scanners and cameras are picked, and errors are checked."""

    accuracy: Annotated[str, Parameter(metavar="LENGTH[@PERCENT],LEVELS")] = ""
    """Pick the cheapest rays with which every sensor errs less than this: 1cm for 99.9 % of the ranges and
    depths, 5mm@99 for 99 % of them, 3levels for colours of cameras (rms, of 255), 1cm,3levels for both. What
    counts is the upper end of the 95 % interval, by a sample of the drive's frames."""

    budget: Annotated[str, Parameter(metavar="Nx-realtime")] = ""
    """Pick the most rays with which the workers simulate the drive at this speed: 2x-realtime is two
    simulated seconds per second, 0.5x-realtime half of one. With an accuracy: a limit to it."""

    spot_check: bool = False
    """Compare a sample of the recorded frames with the exact reference (float64, up to 999 rays a pulse)
    afterwards; always done for an accuracy or a budget."""

    resume: bool = False
    """Of a finished drive that missed its accuracy, record the sensors that missed it again with the next
    finer setting; the files of other sensors are kept. Unfinished drives are resumed without this."""

    def __post_init__(self) -> None:
        """Validate the options."""
        take_values(self, error=InputError)
        if self.accuracy:
            read_accuracy(self.accuracy)
        if self.budget:
            read_budget(self.budget)
        if self.resume and not self.accuracy:
            raise InputError(
                "`resume` is for drives that missed an accuracy: give `accuracy`, too; unfinished drives are"
                " resumed without it"
            )

    @property
    def picks(self) -> bool:
        """Whether settings are to be picked."""
        return bool(self.accuracy or self.budget)

    @property
    def checks(self) -> bool:
        """Whether a sample of frames is to be checked."""
        return self.picks or self.spot_check

    @property
    def request(self) -> dict[str, str]:
        """Accuracy and budget that are given, as text."""
        texts = {"accuracy": self.accuracy.strip(), "budget": self.budget.strip()}
        return {name: text for name, text in texts.items() if text}


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class TradeoffOptions:
    """Options of a comparison of settings."""

    compare: Annotated[tuple[str, ...], Parameter(name="--settings"), WORDS] = ()
    """Settings to compare, separated by commas: rays, footprint, poses, mirrors, foliage of scanners;
    supersample, edge_rays, blur, shadows, detail, resolution, haze of cameras; precision, retrace of both;
    origin, reach, forests, trees, furniture, barriers, relief, scene, traffic; georeferencing; all by
    default. Cheap ones are also tried together. lidar settings explains them."""

    sensors: Annotated[tuple[str, ...], Parameter(name="--sensor"), SEVERAL] = ()
    """Names of the scanners and cameras to compare; all by default."""

    frames: Annotated[int, Parameter(converter=whole)] = 8
    """Frames to sample, spread over the drive: 2 to 1000."""

    pulses: Annotated[int, Parameter(converter=whole)] = 16_000
    """Pulses of each scanner to compare, at random over the sampled frames: 100 to 10,000,000."""

    pixels: Annotated[int, Parameter(converter=whole)] = 16384
    """Pixels of each camera to compare, in blocks of 4 by 4 spread over the sampled frames: 256 to
    10,000,000."""

    reference_rays: Annotated[int, Parameter(converter=whole)] = 217
    """Rays per pulse of the reference: 7 to 665."""

    repetitions: Annotated[int, Parameter(converter=whole)] = 3
    """Repetitions of every timing, interleaved: 3 to 100."""

    def __post_init__(self) -> None:
        """Validate the options."""
        take_values(self, error=InputError)
        check_whole(self, frames=(2, 1000), pulses=(100, 10**7), pixels=(256, 10**7))
        check_whole(self, reference_rays=(7, 665), repetitions=(3, 100))
