"""Facades: what lies behind the plane of the walls of buildings, from the map and by type of building."""

from __future__ import annotations

from typing import TYPE_CHECKING

from geoscene.support.registry import lazily

if TYPE_CHECKING:
    from geoscene.buildings.facades.description import FacadeTable as FacadeTable
    from geoscene.buildings.facades.description import Openings as Openings
    from geoscene.buildings.facades.description import WallRelief as WallRelief
    from geoscene.buildings.facades.layout import Layout as Layout
    from geoscene.buildings.facades.layout import wall_relief as wall_relief
    from geoscene.buildings.facades.setting import FacadeSetting as FacadeSetting
    from geoscene.buildings.facades.setting import read_setting as read_setting

__getattr__ = lazily(
    __name__,
    {
        "FacadeTable": "description",
        "Layout": "layout",
        "Openings": "description",
        "FacadeSetting": "setting",
        "WallRelief": "description",
        "read_setting": "setting",
        "wall_relief": "layout",
    },
)
