"""Options of commands that make other data of recorded clouds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from cyclopts import Parameter

from geoscene.support.option_values import take_values
from lidar.dataset.formats import FORMATS
from lidar.dataset.layouts import EXPORTERS
from lidar.errors import InputError
from lidar.options.shared import NAMED
from lidar.options.stages import ATTACK, STAGE, STAGE_READERS, WEATHER, StageList, chosen_stages

CONVERTED_FORMATS = tuple(name for name in FORMATS if name not in EXPORTERS)
"""Formats that clouds of datasets are converted to; those of KITTI and nuScenes are parts of layouts."""

_LAYOUTS = (
    f"Layout: {'; '.join(f'{row.name} ({row.meaning})' for row in EXPORTERS.values())}."
    f" Or a format of clouds: {', '.join(CONVERTED_FORMATS)}."
)


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class ConvertOptions:
    """Options of a conversion of a dataset."""

    to: Annotated[str, Parameter(help=_LAYOUTS)]

    def __post_init__(self) -> None:
        """Validate the options."""
        take_values(self, error=InputError)


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class ApplyOptions:
    """Options of stages on recorded data."""

    stages: Annotated[StageList, STAGE] = ()
    """Stage to apply: NAME, NAME:KEY=VALUE,KEY=VALUE or a TOML file with tables [[stage]]; repeat for more.
    lidar stages lists them."""

    sensor: str = ""
    """Scanner of KITTI's or nuScenes' clouds: a preset or a TOML file; hdl64e_s2 or hdl32e by default."""

    weather: Annotated[StageList, WEATHER] = ()
    """Weather for all sensors: rain=10mm/h, fog=50m (visibility), snow=2mm/h (as water), dust, spray, several
    separated by commas, or a TOML file with tables [[weather]]; repeat for more."""

    attacks: Annotated[StageList, ATTACK] = ()
    """Attack on sensors: a TOML file with tables [[attack]], NAME or NAME:KEY=VALUE,KEY=VALUE; repeat for
    more. It acts after the weather and before other stages."""

    def __post_init__(self) -> None:
        """Validate the options."""
        take_values(self, error=InputError, readers=STAGE_READERS)
        if not self.all_stages:
            raise InputError("give one or more of `stages`, `weather` and `attacks`")

    @property
    def all_stages(self) -> StageList:
        """Weather, attacks and other stages in the order in which they act."""
        return chosen_stages(self.weather, self.attacks, self.stages)


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class DenoiseOptions:
    """Options of filters on recorded clouds."""

    methods: Annotated[tuple[str, ...], Parameter(name="--method"), NAMED]
    """Filters, separated by commas: statistical, dror, dsor, lior, ddior; NAME or NAME:KEY=VALUE,KEY=VALUE.
    docs/reference/weather.md lists their parameters."""

    def __post_init__(self) -> None:
        """Validate the options."""
        take_values(self, error=InputError)
