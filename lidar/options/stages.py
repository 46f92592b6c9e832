"""Options that take weather, attacks and other stages."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from itertools import chain
from typing import TYPE_CHECKING, Any

from cyclopts import Parameter, Token

from geoscene.support.option_values import Reader, listed

if TYPE_CHECKING:
    from lidar.signal.registry import NamedStage

    StageList = tuple[NamedStage, ...]
else:  # the type that help shows; converters make the values, whose classes take a second to import; Any, as
    # cyclopts checks values against this type where pydantic is imported
    StageList = tuple[str, ...] | Any


def _stages(_: object, tokens: Sequence[Token]) -> Any:
    return tuple(_stages_of([token.value for token in tokens]))


def _attacks(_: object, tokens: Sequence[Token]) -> Any:
    return tuple(_attacks_of([token.value for token in tokens]))


def _weather(_: object, tokens: Sequence[Token]) -> Any:
    return tuple(_weather_of([token.value for token in tokens]))


STAGE = Parameter(name="--stage", converter=_stages, n_tokens=1, accepts_keys=False, metavar="STAGE")
ATTACK = Parameter(name="--attack", converter=_attacks, n_tokens=1, accepts_keys=False, metavar="ATTACK")
WEATHER = Parameter(name="--weather", converter=_weather, n_tokens=1, accepts_keys=False, metavar="WEATHER")


def chosen_stages(*groups: Iterable[NamedStage]) -> tuple[NamedStage, ...]:
    """All stages in order of application: weather, attacks, others."""
    from lidar.signal.registry import number_stages  # noqa: PLC0415

    return number_stages(chain.from_iterable(groups))


def with_stage_settings(
    settings: Sequence[tuple[str, str]], stages: Iterable[NamedStage]
) -> tuple[tuple[str, str], ...]:
    """Settings that differ from a fidelity level: those of stages, unless given, and the given ones."""
    given = {name for name, _ in settings}
    by_stages = (pair for named in stages for pair in named.stage.settings)
    return (*dict.fromkeys(pair for pair in by_stages if pair[0] not in given), *settings)


def _taken_stages(read: Callable[[list[str]], Iterable[Any]]) -> Reader:
    """A reader of stages of Python code: texts as on the command line, or stages that were read."""

    def reader(value: Any) -> tuple[Any, ...]:
        from lidar.signal.registry import NamedStage, Stages, number_stages  # noqa: PLC0415

        if isinstance(value, Stages):
            return value.stages
        taken: list[Any] = []
        for one in [value] if isinstance(value, str | os.PathLike | NamedStage) else listed(value):
            if isinstance(one, str | os.PathLike):
                taken += read([os.fspath(one)])
            elif isinstance(one, NamedStage):
                taken.append(one)
            else:
                raise TypeError("give texts as on the command line, or what read_stages returns")
        return number_stages(taken)

    return reader


def _weather_of(texts: list[str]) -> Iterable[Any]:
    from lidar.signal.weather.setting import read_weather  # noqa: PLC0415

    return chain.from_iterable(map(read_weather, texts))


def _stages_of(texts: list[str]) -> Iterable[Any]:
    from lidar.signal.registry import read_stages  # noqa: PLC0415

    return read_stages(texts).stages


def _attacks_of(texts: list[str]) -> Iterable[Any]:
    from lidar.signal.registry import read_attacks  # noqa: PLC0415

    return read_attacks(texts)


STAGE_READERS = {
    "stages": _taken_stages(_stages_of),
    "weather": _taken_stages(_weather_of),
    "attacks": _taken_stages(_attacks_of),
}
