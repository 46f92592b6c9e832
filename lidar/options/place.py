"""Options of the map that a drive is built of."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from cyclopts import Group, Parameter

from geoscene.options import KINDS, BuildOptions, Degrees
from geoscene.support.console import SEVERAL, WORDS, degrees, whole
from geoscene.support.option_values import take_values
from geoscene.uses import RELIEFS
from lidar.errors import InputError

MAP = Group("Map instead of a scene", sort_key=2)


@Parameter(name="*", group=MAP)
@dataclass(frozen=True, slots=True)
class PlaceOptions:
    """The map that a drive's scene is built of, and how; what the drive needs of it is built and cached."""

    place: str = ""
    """Name of a place instead of SCENE, found by Nominatim and downloaded from Overpass (needs a network;
    answers are cached)."""

    refresh: bool = False
    """Ask map servers for the place again, and replace their answers in the cache."""

    bbox: Annotated[Degrees | None, degrees("W,S,E,N")] = None
    """W,S,E,N in degrees: only this part of the map."""

    dem: Annotated[tuple[str, ...], SEVERAL] = ()
    """Elevation files, or the word tiles, as for geoscene build. By default the ground is level."""

    dem_gaps: str = "error"
    """If elevation files do not cover the scene: error, or nearest."""

    lod: Annotated[int, Parameter(converter=whole)] = 2
    """Level of detail of buildings: 0 blocks, 1 parts with flat roofs, 2 roofs."""

    only: Annotated[tuple[str, ...], WORDS] = KINDS
    """Kinds of features to build besides the ground, separated by commas."""

    scene_crs: str = "local"
    """CRS of the scene: local, utm or an EPSG code."""

    scene_cache: Path | None = None
    """Folder of the scenes that drives build; ~/.cache/geoscene/scenes by default."""

    def __post_init__(self) -> None:
        """Validate the options."""
        take_values(self, error=InputError)

    def build_options(self, name: str, *, relief: str) -> BuildOptions:
        """Options of the build, with a title of the scene; raises InputError for invalid ones.

        relief : that the drive uses, of `geoscene.uses.USED_RELIEFS`; the default of builds unless a scene
                 can be built with it
        """
        return BuildOptions(
            relief=relief if relief in RELIEFS else BuildOptions().relief,
            crs=self.scene_crs,
            lod=self.lod,
            dem=self.dem,
            dem_gaps=self.dem_gaps,
            only=self.only,
            use="camera",  # all that drives need
            name=name,
        )
