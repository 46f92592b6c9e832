"""Options of defences, and of signing and verifying."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from geoscene.support.console import whole
from geoscene.support.option_values import take_values
from lidar.errors import InputError
from lidar.options.shared import NAMED, check_seed, check_words, lower

FUSE = ("harmonic", "max", "fisher", "none")
"""Verdicts of several defences together."""


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class DefendOptions:
    """Options of defences on recorded data."""

    defences: Annotated[tuple[str, ...], Parameter(name="--defence"), NAMED]
    """Defences, separated by commas: NAME or NAME:KEY=VALUE,KEY=VALUE, or all that the data allow; or a TOML
    file with tables [[defence]]. lidar defences lists them."""

    scene: Path | None = None
    """Scene that the map defence compares with; by default the one that the dataset was driven in."""

    detector: str = "rules"
    """What gives the boxes of road users: rules, learned, or the file of a model (lidar train)."""

    fuse: Annotated[str, Parameter(converter=lower)] = "harmonic"
    """Verdict of all defences together, if there are several: harmonic (mean of the shares of genuine data
    that are as suspicious), max (the least of them), fisher (all count, as if independent) or none."""

    calibrate: bool = False
    """Instead of judging, write the suspicions of these datasets, which must be genuine, to the TOML file
    --out, for --calibration."""

    calibration: Path | None = None
    """TOML file of thresholds and suspicions of genuine data; by default those of
    docs/reference/defences.md, for the detector rules."""

    seed: Annotated[int, Parameter(converter=whole)] = 0
    """Seed of the defences' random numbers and of the intervals."""

    def __post_init__(self) -> None:
        """Validate the options."""
        take_values(self, error=InputError)
        check_words(self, fuse=FUSE)
        if self.calibrate and (self.fuse != "harmonic" or self.calibration is not None):
            raise InputError("`calibrate`: leave out `fuse` and `calibration`")
        check_seed(self.seed)


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class SignOptions:
    """Options of signing and verifying."""

    watermark: Path | None = None
    """File with the secret key of the watermark: 16 bytes or more, also as hexadecimal digits."""

    chain: Path | None = None
    """File with the key of the hash chain: a secret as of a watermark (HMAC-SHA-256), or an Ed25519 key
    (PEM), of which the public one is enough to verify."""

    step: float = 0.05
    """Metres between coordinates of the same bit of the watermark; points move by at most half of it along
    each axis. The same to sign and to verify."""

    def __post_init__(self) -> None:
        """Validate the options."""
        take_values(self, error=InputError)
