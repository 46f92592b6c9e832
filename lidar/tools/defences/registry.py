"""Registry of defences; reads them from text."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

from geoscene.support.registry import Registry
from lidar.errors import InputError
from lidar.grammar import Item, read_items
from lidar.parameters import build, parameter_rows
from lidar.tools.defences.defence import Defence

DEFENCES: Registry[type[Defence]] = Registry(
    "defence",
    {
        "occlusion": "lidar.tools.defences.occlusion:Occlusion",
        "shadow": "lidar.tools.defences.shadow:Shadow",
        "temporal": "lidar.tools.defences.temporal:Temporal",
        "void": "lidar.tools.defences.void:Void",
        "azimuth": "lidar.tools.defences.azimuth:Azimuth",
        "overlay": "lidar.tools.defences.overlay:Overlay",
        "map": "lidar.tools.defences.map:Map",
        "navigation": "lidar.tools.defences.navigation:NavigationDefence",
        "physics": "lidar.tools.defences.physics:Physics",
        "statistical": "lidar.tools.defences.statistical:StatisticalDefence",
        "timing": "lidar.tools.defences.timing:Timing",
        "watermark": "lidar.tools.defences.watermark:WatermarkDefence",
    },
    error=InputError,
)
"""Classes of defences by name."""


@dataclass(frozen=True, slots=True)
class NamedDefence:
    """A defence that is switched on; ``named`` by the user, not one of all."""

    name: str
    defence: Defence
    named: bool = True

    def to_json(self) -> dict[str, Any]:
        """Its name and parameters."""
        return {"name": self.name, **asdict(self.defence)}


def read_defences(texts: Iterable[str]) -> tuple[NamedDefence, ...]:
    """Defences from texts ``NAME:KEY=VALUE,KEY=VALUE``; several are separated by commas.

    texts : also ``all`` for those that the data allow, and files ``FILE.toml`` with tables ``[[defence]]``

    Raises InputError for a defence or parameter that is unknown or given twice, or a value out of its bounds.
    """
    found: dict[str, NamedDefence] = {}
    for item in read_items(texts, {"all", *DEFENCES}, table="defence"):
        is_all = item.name == "all" and not item.values
        for one in map(Item, DEFENCES) if is_all else [item]:
            if one.name in found:
                raise InputError(f"defence {one.name}: given twice")
            found[one.name] = NamedDefence(one.name, build(DEFENCES, one), named=not is_all)
    if not found:
        raise InputError(f"`defence`: give one or more of {', '.join(DEFENCES)}, or all")
    return tuple(found.values())


def defence_rows() -> list[dict[str, Any]]:
    """Name, meaning, needs, earlier frames and parameters of every defence."""
    rows = []
    for name, kind in DEFENCES.items():
        rows.append(
            {
                "name": name,
                "meaning": (kind.__doc__ or "").partition("\n")[0],
                "needs": sorted(kind.needs),
                "history": kind.history,
                "parameters": parameter_rows(kind),
            }
        )
    return rows
